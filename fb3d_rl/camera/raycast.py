"""A depth camera on the CPU: Embree rays on link meshes, no Vulkan, no GPU.

Every body keeps one static bounding-volume hierarchy in its own frame; for each frame the rays are moved into that
frame, and only those through pixels that its bounding box may cover are cast. A body's hits are kept until its pose or
the view changes, so that a frame of an episode casts only what moves. A picture depends on poses and view only, not on
earlier pictures.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from trimesh.util import append_faces

from fb3d_rl.assets.articulation import ArticulatedObject, Mesh
from fb3d_rl.camera.embree import EmbreeScene, triangle_scene
from fb3d_rl.camera.options import CameraOptions
from fb3d_rl.camera.views import View, look_at, pixel_points, pixel_rays
from fb3d_rl.kinematics.opening import standing_bounds

_LOW = np.uint64(0xFFFFFFFF)
_HALF = np.uint64(32)
NOTHING = np.uint64(np.float32(np.inf).view(np.uint32)) << _HALF
"""What a pixel shows is a key: the bits of its depth (float32) above the index of its body. Depths are not negative, so
keys sort as depths do, and of two bodies at the same depth the one with the lower index is seen, in whatever order they
are merged. From this key on there is no hit."""


def _depth(keys: NDArray[np.uint64]) -> NDArray[np.float32]:
    return (keys >> _HALF).astype(np.uint32).view(np.float32)


class RaycastCamera:
    """Depth camera before one object, and further bodies (a gripper) that may occlude it.

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
        self._links = len(obj.links)
        self._scenes: dict[int, EmbreeScene] = {}
        self._corners = np.zeros((len(shapes), 3, 8))  # of the bodies' bounding boxes
        for index, meshes in enumerate(shapes):
            if meshes:
                together = append_faces([mesh.vertices for mesh in meshes], [mesh.faces for mesh in meshes])
                vertices = together[0].astype(np.float32)
                self._scenes[index] = triangle_scene(vertices, together[1].astype(np.int32))
                extents = zip(vertices.min(0), vertices.max(0), strict=True)
                self._corners[index] = np.array(list(itertools.product(*extents))).T
        bounds = standing_bounds(obj)
        self.centre: NDArray[np.float64] = bounds.mean(0)
        """The point in the middle of the image: the centre of the closed, standing object's bounding box, m."""
        self.radius = 0.5 * float(np.linalg.norm(bounds[1] - bounds[0]))
        """Radius (m) of the sphere around that box."""
        self.distance = self.options.margin * self.radius / math.sin(math.radians(0.5 * self.options.fov))
        self._ticks = self.options.ticks
        # The last frame: view, poses, each body's hits (the rows and columns that it may cover and the keys there), and
        # which links are merged in the background.
        self._view: View | None = None
        self._poses = np.zeros((0, 4, 4))
        self._hits: dict[int, tuple[tuple[slice, slice], NDArray[np.uint64]]] = {}
        self._in_background = np.zeros(0, dtype=bool)
        self._background = np.empty([self.options.resolution] * 2, dtype=np.uint64)

    def pose(self, view: View) -> NDArray[np.float64]:
        """T_world_camera [4, 4] of a view; x right, y down, z forward."""
        return look_at(view, self.centre, self.distance)

    def turn(self, view: View) -> NDArray[np.float64] | None:
        """R [3, 3] that turns flow samples from the object's world to that of the camera's networks; None: the same."""
        return None

    def capture(
        self, poses: NDArray[np.float64], view: View, further: bool = True
    ) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Take one depth image.

        Args:
            poses: T_world_body [L + bodies, 4, 4] of all links and further bodies.
            view: the viewpoint.
            further: also return the points on further bodies; they hide what is behind them in any case.

        Returns:
            World points [P, 3] (m) where rays hit, row by row of the image, and the index of the body hit [P].

        Raises:
            ValueError: there is not one pose for each link and further body.
        """
        image = self._nearest(poses, view).ravel()
        seen = np.flatnonzero((image < NOTHING) if further else (image < NOTHING) & ((image & _LOW) < self._links))
        keys = image.take(seen)
        return pixel_points(self._camera, self._rays, seen, _depth(keys)), (keys & _LOW).astype(np.int64)

    def depth_image(self, poses: NDArray[np.float64], view: View) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
        """Take one depth image; what :meth:`capture` takes, by pixels.

        Returns:
            Depth [n, n] (m along the camera's axis) and the index of the body hit [n, n]; 0 and -1 where no ray hits.
        """
        image = self._nearest(poses, view)
        hit = image < NOTHING
        return np.where(hit, _depth(image), np.float32(0)), np.where(hit, (image & _LOW).astype(np.int64), -1)

    def _nearest(self, poses: NDArray[np.float64], view: View) -> NDArray[np.uint64]:
        """Keys [n, n] of what each pixel shows. The hits of links that rest are kept merged, as the background."""
        if len(poses) != len(self._corners):
            raise ValueError(f"{len(poses)} poses were given for {len(self._corners)} links and further bodies")
        poses = np.array(poses, dtype=np.float64, order="C")
        links = np.arange(len(poses)) < self._links
        last, self._view = self._view, None  # nothing is kept of a frame that fails
        if view != last:
            self._camera = self.pose(view)
            self._rays = pixel_rays(self._camera, self._ticks)
            rests, background = np.zeros(len(poses), dtype=bool), links
        else:
            rests = (poses.view(np.uint64) == self._poses.view(np.uint64)).all((1, 2))
            background = self._in_background if rests[self._in_background].all() else rests & links
        self._cast([index for index in np.flatnonzero(~rests).tolist() if index in self._scenes], poses)
        if background is not self._in_background:
            self._background.fill(NOTHING)
            self._merge(background, self._background)
        self._view, self._poses, self._in_background = view, poses, background
        image = self._background.copy()
        self._merge(~background, image)
        return image

    def _cast(self, indices: list[int], poses: NDArray[np.float64]) -> None:
        """Take new hits of some bodies."""
        if not indices:
            return
        n, ticks, to_camera = self.options.resolution, self._ticks[:, None], self._camera[:3, :3].T
        rotations = to_camera @ poses[indices, :3, :3]  # of T_camera_body
        origins = to_camera @ (poses[indices, :3, 3:] - self._camera[:3, 3:])
        corners = rotations @ self._corners[indices] + origins
        pixels = corners[:, :2] / np.maximum(corners[:, 2:], 1e-6) * (0.5 * n / self.options.slope) + (0.5 * n - 0.5)
        low, high = pixels.min(-1), pixels.max(-1)
        beside = corners[:, 2].min(-1) <= 1e-6  # or behind the lens: the body may cover any pixel
        low[beside], high[beside] = 0.0, n
        # A twentieth of a pixel covers what rounding may do.
        low = np.ceil(low - 0.05).clip(0, n).astype(np.int64).tolist()
        high = np.floor(high + 1.05).clip(0, n).astype(np.int64).tolist()
        # In the bodies' frames: where rays begin, and what the directions (of depth 1) in a row and in a column share.
        starts = -(rotations * origins).sum(1).astype(np.float32)
        rows = (rotations[:, 2:] + ticks * rotations[:, 1:2]).astype(np.float32)
        columns = (ticks * rotations[:, :1]).astype(np.float32)
        for k, (index, (left, top), (right, bottom)) in enumerate(zip(indices, low, high, strict=True)):
            rays = rows[k, top:bottom, None] + columns[k, left:right]
            begins = np.empty_like(rays)
            begins[:] = starts[k]
            depth = self._scenes[index].run(begins.reshape(-1, 3), rays.reshape(-1, 3), np.inf, "DISTANCE")
            keys = (depth.view(np.uint32).astype(np.uint64) << _HALF) | np.uint64(index)
            self._hits[index] = (slice(top, bottom), slice(left, right)), keys.reshape(rays.shape[:2])

    def _merge(self, bodies: NDArray[np.bool_], image: NDArray[np.uint64]) -> None:
        """Keep the nearer of what ``image`` [n, n] shows and the hits of some bodies."""
        for index in np.flatnonzero(bodies).tolist():
            if index in self._hits:
                window, keys = self._hits[index]
                np.minimum(image[window], keys, out=image[window])
