"""An object in the world, with all that is computed from it once."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from pkgutil import resolve_name

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from fb3d_rl.assets.articulation import ArticulatedObject, Mesh
from fb3d_rl.camera.options import SENSORS, CameraOptions
from fb3d_rl.camera.raycast import RaycastCamera
from fb3d_rl.kinematics.opening import link_corners, openable_links, opening_range, standing_pose
from fb3d_rl.kinematics.tree import KinematicTree

FAR_BELOW = -1e3
"""Height (m) at which a body hides nothing."""


class Posed:
    """An object of L links and J joints on the ground before a depth camera.

    Args:
        obj: the object.
        camera: the camera's optics.
        bodies: meshes of further rigid bodies that may occlude it, such as a gripper's.

    Attributes:
        obj: the object.
        bodies: the further bodies.
        tree: the object's kinematic tree.
        closed: joint state [J] (rad or m) in which everything is closed.
        opened: joint state [J] in which everything is open.
        T_world_base: pose [4, 4] of the object on the ground.
        openable: indices of the links that can be opened.
    """

    def __init__(
        self, obj: ArticulatedObject, camera: CameraOptions | None = None, bodies: Sequence[Sequence[Mesh]] = ()
    ) -> None:
        self.obj, self.bodies = obj, bodies
        self.tree = KinematicTree.from_object(obj)
        self.closed, self.opened = opening_range(obj)
        self.T_world_base = standing_pose(obj)
        self.openable = openable_links(obj)
        self._optics = camera

    @cached_property
    def camera(self) -> RaycastCamera:
        """Sees the object's links and then the further bodies."""
        optics = self._optics or CameraOptions()
        made: RaycastCamera = resolve_name(SENSORS[optics.kind])(self.obj, self.bodies, optics)
        return made

    @property
    def visuals(self) -> list[Sequence[Mesh]]:
        """Visible meshes of the links and of the further bodies, in their frames [L + bodies]."""
        return [*(link.visuals for link in self.obj.links), *self.bodies]

    def poses(self, state: Sequence[float] | NDArray[np.float64]) -> NDArray[np.float64]:
        """T_world_link [L, 4, 4] at a joint state [J]."""
        return np.asarray(self.T_world_base @ self.tree.forward(torch.as_tensor(state, dtype=torch.float64)).numpy())

    def poses_alone(self, state: Sequence[float] | NDArray[np.float64]) -> NDArray[np.float64]:
        """T_world_body [L + bodies, 4, 4] at a joint state [J], the further bodies where they hide nothing."""
        away = np.tile(np.eye(4), (len(self.bodies), 1, 1))
        away[:, 2, 3] = FAR_BELOW
        return np.concatenate([self.poses(state), away])

    def bounds(self, state: Sequence[float] | NDArray[np.float64]) -> NDArray[np.float64]:
        """Bounds [2, 3] (m, world) of the links' bounding boxes at a joint state [J]."""
        points = (self._corners @ self.poses(state).swapaxes(1, 2))[..., :3].reshape(-1, 3)
        return np.stack([np.nanmin(points, 0), np.nanmax(points, 0)])

    @cached_property
    def _corners(self) -> NDArray[np.float64]:
        """Corners [L, 8, 4] (homogeneous, in its frame) of each link's bounding box; nan for a link without a mesh."""
        corners = np.full((len(self.obj.links), 8, 4), np.nan)
        for row, link in zip(corners, self.obj.links, strict=True):
            if link.visuals:
                row[:, :3], row[:, 3] = link_corners(link), 1.0
        return corners

    def direction(self, *links: int) -> Tensor:
        """Signs [J] float64 that open: +1 towards higher positions, -1 towards lower ones.

        With ``links``, the signs of other joints are 0. Joints without limits open towards higher positions.
        """
        signs = np.where(self.opened < self.closed, -1.0, 1.0)
        if links:
            signs[[other not in links for other in self.obj.movable]] = 0.0
        return torch.from_numpy(signs)
