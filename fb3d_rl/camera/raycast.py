"""A depth camera on the CPU: Embree rays on link meshes, no Vulkan, no GPU.

Every link keeps one static bounding-volume hierarchy in its own frame; for each frame the rays are moved into the
links' frames, and only the rays that can hit a link's bounding sphere are cast. Nothing is rebuilt when joints move.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fb3d_rl.assets.articulation import ArticulatedObject, Mesh
from fb3d_rl.camera.views import View, look_at
from fb3d_rl.contract import UserError
from fb3d_rl.flow.opening import standing_bounds

try:
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene
except ImportError as error:  # no wheel for this platform
    raise UserError("the raycast camera needs the package embreex; install it with `pip install embreex`") from error


@dataclass(frozen=True)
class CameraOptions:
    """A pinhole camera.

    Attributes:
        resolution: pixels along each side of the square image.
        fov: full field of view, degrees.
        margin: the closed object's bounding sphere fills 1 / margin of the field of view.
    """

    resolution: int = 96
    fov: float = 40.0
    margin: float = 1.15


class _Body:
    """One rigid mesh with its Embree scene and bounding sphere, in its own frame."""

    def __init__(self, meshes: Sequence[Mesh]) -> None:
        self.scene = EmbreeScene()
        triangles = np.concatenate([mesh.vertices[mesh.faces] for mesh in meshes]).astype(np.float32)
        TriangleMesh(self.scene, triangles)
        corners = triangles.reshape(-1, 3).astype(np.float64)
        self.centre = 0.5 * (corners.min(0) + corners.max(0))
        self.radius = float(np.linalg.norm(corners - self.centre, axis=-1).max())

    def cast(self, pose: NDArray[np.float64], eye: NDArray[np.float64], rays: NDArray[np.float64], out: _Hits) -> None:
        """Cast ``rays`` [R, 3] (unit, world) from ``eye`` [3] and keep hits that are nearer than those in ``out``."""
        to_centre = pose[:3, :3] @ self.centre + pose[:3, 3] - eye
        along = rays @ to_centre
        near = np.flatnonzero(to_centre @ to_centre - along * along <= self.radius**2 * 1.0001)
        if not len(near):
            return
        origin = (pose[:3, :3].T @ (eye - pose[:3, 3])).astype(np.float32)
        directions = (rays[near] @ pose[:3, :3]).astype(np.float32)
        hits = self.scene.run(np.tile(origin, (len(near), 1)), directions, output=True)
        distance = np.where(hits["primID"] >= 0, hits["tfar"], np.inf)
        better = distance < out.distance[near]
        out.distance[near[better]] = distance[better]
        out.link[near[better]] = out.current


@dataclass
class _Hits:
    distance: NDArray[np.float64]
    link: NDArray[np.int64]
    current: int = -1


class RaycastCamera:
    """Depth camera that looks at one object, and at further bodies (a gripper) that may stand in the way.

    Args:
        obj: the object; its links are numbered as in ``obj.links``.
        bodies: meshes of further rigid bodies, numbered on from ``len(obj.links)``.
        options: the camera's optics.
    """

    def __init__(
        self, obj: ArticulatedObject, bodies: Sequence[Sequence[Mesh]] = (), options: CameraOptions | None = None
    ) -> None:
        self.options = options or CameraOptions()
        shapes = [link.visuals for link in obj.links] + [tuple(meshes) for meshes in bodies]
        self._bodies = [_Body(meshes) if meshes else None for meshes in shapes]
        bounds = standing_bounds(obj)
        self.centre: NDArray[np.float64] = bounds.mean(0)
        """Point that the camera looks at: the centre of the closed, standing object's bounding box, m."""
        self.radius = 0.5 * float(np.linalg.norm(bounds[1] - bounds[0]))
        """Radius (m) of the sphere around that box."""
        half = np.radians(0.5 * self.options.fov)
        self.distance = self.options.margin * self.radius / np.sin(half)
        n = self.options.resolution
        ticks = (np.arange(n) + 0.5) / n * 2.0 - 1.0
        x, y = np.meshgrid(ticks * np.tan(half), ticks * np.tan(half))
        rays = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)
        self._rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True)

    def pose(self, view: View) -> NDArray[np.float64]:
        """T_world_camera [4, 4] of a view; x right, y down, z forward."""
        return look_at(view, self.centre, self.distance)

    def capture(self, poses: NDArray[np.float64], view: View) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Take one depth image.

        Args:
            poses: T_world_body [L + bodies, 4, 4] of all links and further bodies.
            view: the viewpoint.

        Returns:
            World points [P, 3] (m) where rays hit, row by row of the image, and the index of the body hit [P].
        """
        camera = self.pose(view)
        eye, rays = camera[:3, 3], self._rays @ camera[:3, :3].T
        hits = _Hits(np.full(len(rays), np.inf), np.full(len(rays), -1, dtype=np.int64))
        for index, body in enumerate(self._bodies):
            if body is not None:
                hits.current = index
                body.cast(poses[index], eye, rays, hits)
        seen = np.flatnonzero(hits.link >= 0)
        return eye + rays[seen] * hits.distance[seen, None], hits.link[seen]
