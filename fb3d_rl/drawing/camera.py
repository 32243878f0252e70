"""A pinhole camera for pictures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fb3d_rl.camera.views import View, look_at
from fb3d_rl.drawing.bodies import F32


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera.

    Attributes:
        pose: T_world_camera [4, 4]; x right, y down, z forward.
        size: width and height of the image, pixels.
        fov: field of view across the width, degrees.
    """

    pose: NDArray[np.float64]
    size: tuple[int, int]
    fov: float

    @classmethod
    def fitting(
        cls, view: View, points: NDArray[np.float64], size: tuple[int, int], fov: float = 28.0, margin: float = 0.05
    ) -> Camera:
        """The nearest camera in the direction of ``view`` whose image has all ``points`` [P, 3] (m).

        ``margin`` is the share of the image that stays free on each side.
        """
        pose = look_at(view, np.zeros(3), 0.0)
        seen = points @ pose[:3, :3]
        slope = np.tan(np.radians(0.5 * fov)) * (1 - 2 * margin) * np.array([1.0, size[1] / size[0]])
        # All points lie between the planes through two opposite edges of the image: two bounds on the eye for each.
        right = (seen[:, :2] - slope * seen[:, 2:]).max(0)
        left = (-seen[:, :2] - slope * seen[:, 2:]).max(0)
        eye = np.append(0.5 * (right - left), (-0.5 * (right + left) / slope).min())
        pose[:3, 3] = pose[:3, :3] @ eye
        return cls(pose, size, fov)

    @property
    def focal(self) -> float:
        """Focal length, pixels."""
        return float(0.5 * self.size[0] / np.tan(np.radians(0.5 * self.fov)))

    def rays(self, at: NDArray[np.float64]) -> F32:
        """Unit rays [R, 3] in the world through the image points ``at`` [R, 2] (pixels; x right, y down)."""
        across = (at - 0.5 * np.array(self.size)) / self.focal
        rays = np.column_stack([across, np.ones(len(at))]) @ self.pose[:3, :3].T
        return (rays / np.linalg.norm(rays, axis=-1, keepdims=True)).astype(np.float32)

    def project(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Image points [P, 2] (pixels) of world points [P, 3] in front of the camera."""
        seen = (points - self.pose[:3, 3]) @ self.pose[:3, :3]
        return np.asarray(self.focal * seen[:, :2] / seen[:, 2:] + 0.5 * np.array(self.size))
