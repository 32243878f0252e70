"""The simulated suction cup: the exact surface decides whether it seals, the loads when it tears."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import sapien
from numpy.typing import NDArray
from sapien.physx import PhysxArticulationLinkComponent, PhysxDriveComponent
from scipy.spatial.transform import Rotation

from fb3d_rl.perception.suction import CupOptions, Seal, loads, seal
from fb3d_rl.robot.sight import Bodies

Array = NDArray[np.float64]

STIFFNESS, DAMPING = 4000.0, 40.0
"""Of the bellows, N/m and N s/m (ours: a cup of 3 cm with 1.5 folds gives some 1 cm under its full load)."""

BENDING, BENDING_DAMPING = 0.4, 0.004
"""Of the bellows when the lip tilts, Nm/rad and Nm s/rad (ours)."""

TRAVEL = 0.006
"""How far the surface below the cup's middle may be from the lip for the bellows to reach it, m."""

PITCH = 0.001
"""Between the rays that look at the surface below the cup, m."""

BEFORE = 0.02
"""They start so far behind the lip, m."""

SMOOTHING = 3
"""Control steps over which loads are averaged: a cup does not tear within milliseconds."""


class Below(NamedTuple):
    """The surface below the cup: points [P, 3] (m, world), and the link and the distance (m) from the lip of each."""

    points: Array
    links: NDArray[np.int64]
    beyond: Array


class SimulatedCup:
    """Holds the link below the cup by a spring, until loads tear it.

    Args:
        scene: where the spring is made.
        tip: the arm's last link, whose frame is that of the cup's opening.
        links: the object's links [L].
        surfaces: what is seen of them, in the same order.
        options: the cup.
        perfect: it holds whatever link it touches, and never tears.
    """

    def __init__(
        self,
        scene: sapien.Scene,
        tip: PhysxArticulationLinkComponent,
        links: Sequence[PhysxArticulationLinkComponent],
        surfaces: Bodies,
        options: CupOptions,
        perfect: bool,
    ) -> None:
        self.options, self.perfect = options, perfect
        self.held: int | None = None
        self.seal: Seal | None = None
        """What was found when the cup was last asked to hold."""
        self.torn: tuple[str, ...] = ()
        """The loads that tore it off, of "pull", "shear" and "peel"."""
        self._scene, self._tip, self._links, self._surfaces = scene, tip, links, surfaces
        self._drive: PhysxDriveComponent | None = None
        self._on_link = np.eye(4)
        self._loads: list[Array] = []
        ticks = np.arange(-2.0 * options.radius, 2.0 * options.radius + PITCH / 2, PITCH)
        grid = np.stack(np.meshgrid(ticks, ticks), axis=-1).reshape(-1, 2)
        grid = grid[np.linalg.norm(grid, axis=1) <= 2.0 * options.radius]
        self._grid = np.column_stack([grid, np.full(len(grid), -BEFORE)])

    def below(self) -> Below:
        """The object's surface below the cup as it is."""
        tip = _matrix(self._tip)
        depth, link = np.full(len(self._grid), np.inf), np.full(len(self._grid), -1, dtype=np.int64)
        for i, (component, scene) in enumerate(zip(self._links, self._surfaces.scenes, strict=True)):
            if scene is None:
                continue
            local = np.linalg.inv(_matrix(component)) @ tip
            starts = (self._grid @ local[:3, :3].T + local[:3, 3]).astype(np.float32)
            rays = np.tile(local[:3, 2], (len(starts), 1)).astype(np.float32)
            found = scene.run(starts, rays, np.inf, "DISTANCE")
            nearer = found < depth
            depth[nearer], link[nearer] = found[nearer], i
        met = np.isfinite(depth) & (depth < 3 * BEFORE)
        points = self._grid[met] + depth[met, None] * (0.0, 0.0, 1.0)
        return Below(points @ tip[:3, :3].T + tip[:3, 3], link[met], depth[met] - BEFORE)

    def hold(self) -> bool:
        """Hold what is below the cup, if it seals; whether it holds."""
        if self.held is not None:
            return True
        surface, tip = self.below(), _matrix(self._tip)
        if not len(surface.points):
            return False
        middle = int(np.linalg.norm(np.cross(surface.points - tip[:3, 3], tip[:3, 2]), axis=1).argmin())
        self.seal = seal(surface.points, surface.points[middle], tip[:3, 2], self.options)
        reached = abs(surface.beyond[middle]) < (3 * TRAVEL if self.perfect else TRAVEL)
        if not reached or not (self.perfect or self.seal.holds):
            return False
        self.held, self.torn, self._loads = int(surface.links[middle]), (), []
        link = self._links[self.held]
        self._on_link = np.linalg.inv(_matrix(link)) @ tip
        drive = self._scene.create_drive(self._tip, sapien.Pose(), link, sapien.Pose(self._on_link))
        for set_axis in (drive.set_drive_property_x, drive.set_drive_property_y, drive.set_drive_property_z):
            set_axis(STIFFNESS, DAMPING)
        drive.set_drive_property_slerp(BENDING, BENDING_DAMPING)
        self._drive = drive
        return True

    def update(self) -> None:
        """Tear the cup off if its loads are too much; after each control step."""
        if self.held is None or self.perfect:
            return
        tip = _matrix(self._tip)
        anchor = _matrix(self._links[self.held]) @ self._on_link
        force = STIFFNESS * (tip[:3, 3] - anchor[:3, 3])
        moment = BENDING * Rotation.from_matrix(tip[:3, :3] @ anchor[:3, :3].T).as_rotvec()
        self._loads = [*self._loads[1 - SMOOTHING :], np.concatenate([force, moment])]
        mean = np.mean(self._loads, axis=0)
        shares = loads(-anchor[:3, 2], mean[:3], mean[3:], self.options)
        torn = tuple(name for name, share in zip(("pull", "shear", "peel"), shares, strict=True) if share > 1.0)
        if torn:
            self.release()
            self.torn = torn

    def release(self) -> None:
        """Let go."""
        if self._drive is not None:
            self._drive.entity.remove_component(self._drive)
        self._drive, self.held = None, None


def _matrix(component: Any) -> Array:
    """T_world_component [4, 4]."""
    return np.asarray(component.entity_pose.to_transformation_matrix(), dtype=np.float64)
