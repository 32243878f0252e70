"""Depth images of rigid bodies for any pinhole camera, by ray casting: what the robot hides, what a cell looks like."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from trimesh.util import append_faces

from fb3d_rl.assets.articulation import Mesh
from fb3d_rl.assets.shapes import solid
from fb3d_rl.camera.embree import EmbreeScene, triangle_scene
from fb3d_rl.perception.depth import Intrinsics
from fb3d_rl.robot.arm import Arm
from fb3d_rl.robot.capsules import Capsule
from fb3d_rl.robot.collision import Box

Array = NDArray[np.float64]


class Bodies:
    """Rigid bodies that are seen together.

    Args:
        meshes: of each of the B bodies, in its own frame, m; a body without is not seen.
    """

    def __init__(self, meshes: Sequence[Sequence[Mesh]]) -> None:
        self.scenes: list[EmbreeScene | None] = []
        self._corners = np.zeros((len(meshes), 8, 3))
        for body, own in enumerate(meshes):
            if not own:
                self.scenes.append(None)
                continue
            vertices, faces = append_faces([mesh.vertices for mesh in own], [mesh.faces for mesh in own])
            self.scenes.append(triangle_scene(vertices.astype(np.float32), faces.astype(np.int32)))
            ends = np.stack([vertices.min(0), vertices.max(0)])
            self._corners[body] = [[ends[c[k], k] for k in range(3)] for c in itertools.product((0, 1), repeat=3)]

    def depth(
        self, poses: Array, camera: Array, lens: Intrinsics, shape: tuple[int, int]
    ) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
        """What a camera sees.

        Args:
            poses: T_world_body [B, 4, 4].
            camera: T_world_camera [4, 4]; x right, y down, z forward.
            lens: of the image.
            shape: its rows and columns.

        Returns:
            Depth [H, W] (m along the camera's axis) and the body at each pixel; 0 and -1 where there is none.
        """
        depth, bodies = np.full(shape, np.inf, dtype=np.float32), np.full(shape, -1, dtype=np.int64)
        x, y = ((np.arange(shape[1]) - lens.cx) / lens.fx), ((np.arange(shape[0]) - lens.cy) / lens.fy)
        to_camera = np.linalg.inv(camera) @ poses
        for body, scene in enumerate(self.scenes):
            window = None if scene is None else self._window(to_camera[body], body, lens, shape)
            if scene is None or window is None:
                continue
            rows, columns = window
            turn, origin = to_camera[body, :3, :3], to_camera[body, :3, 3]
            rays = np.stack(np.broadcast_arrays(x[None, columns], y[rows, None], 1.0), axis=-1).reshape(-1, 3)
            starts = np.tile(-(origin @ turn), (len(rays), 1)).astype(np.float32)
            # Of rays with a depth of 1 the distance is the depth.
            found = scene.run(starts, (rays @ turn).astype(np.float32), np.inf, "DISTANCE")
            found = found.reshape(depth[window].shape)
            nearer = found < depth[window]
            depth[window][nearer], bodies[window][nearer] = found[nearer], body
        return np.where(bodies >= 0, depth, np.float32(0)), bodies

    def _window(self, pose: Array, body: int, lens: Intrinsics, shape: tuple[int, int]) -> tuple[slice, slice] | None:
        """The rows and columns that a body at T_camera_body may cover; None if it is not in the picture."""
        corners = self._corners[body] @ pose[:3, :3].T + pose[:3, 3]
        if corners[:, 2].max() <= 0.0:
            return None
        if corners[:, 2].min() <= 1e-3:  # beside the lens: it may cover anything
            return slice(0, shape[0]), slice(0, shape[1])
        pixels = corners[:, :2] / corners[:, 2:] * (lens.fx, lens.fy) + (lens.cx, lens.cy)
        low, high = np.floor(pixels.min(0)).astype(int), np.ceil(pixels.max(0)).astype(int) + 1
        (left, top), (right, bottom) = np.maximum(low, 0), np.minimum(high, shape[::-1])
        return (slice(top, bottom), slice(left, right)) if left < right and top < bottom else None


def capsule_mesh(capsule: Capsule) -> Mesh:
    """The surface of a capsule, m."""
    way = capsule.ends[1] - capsule.ends[0]
    length = float(np.linalg.norm(way))
    pose = np.eye(4)
    pose[:3, 3] = capsule.ends.mean(0)
    if length < 1e-9:
        return solid("sphere", np.array([capsule.radius]), pose)
    axis = way / length
    across = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    across /= np.linalg.norm(across)
    pose[:3, :3] = np.stack([across, np.cross(axis, across), axis], axis=1)
    return solid("capsule", np.array([capsule.radius, length]), pose)


def box_mesh(box: Box) -> Mesh:
    """The surface of a box in the base's frame, m."""
    return solid("box", np.asarray(box.size), box.pose)


class ArmSight:
    """An arm as a camera sees it: its bodies, drawn from its joint state alone."""

    def __init__(self, arm: Arm) -> None:
        self.arm = arm
        capsules = [Capsule(ends, float(radius)) for ends, radius in zip(arm.ends, arm.radii, strict=True)]
        links = range(len(arm.tree.parents))
        self.meshes: list[list[Mesh]] = [
            [capsule_mesh(capsule) for capsule, own in zip(capsules, arm.links, strict=True) if own == link]
            for link in links
        ]
        self._bodies = Bodies(self.meshes)

    def poses(self, q: Array) -> Array:
        """T_base_link [J + 2, 4, 4] at a joint state [J]."""
        return np.asarray(self.arm.forward(torch.as_tensor(q)).numpy())

    def depth(self, q: Array, camera: Array, lens: Intrinsics, shape: tuple[int, int]) -> NDArray[np.float32]:
        """Depth [H, W] (m) of the arm alone from a camera at T_base_camera [4, 4]; 0 where it is not."""
        return self._bodies.depth(self.poses(q), camera, lens, shape)[0]
