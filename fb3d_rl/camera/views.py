"""Viewpoints around an object: azimuth and elevation (supplement, II.C); rays and points of a picture's pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fb3d_rl.options import option


@dataclass(frozen=True)
class View:
    """The camera's viewpoint: angles in degrees; azimuth 0 faces the object's front (which faces -x).

    Positive azimuth is counter-clockwise seen from above; elevation is above the horizon.
    """

    azimuth: float
    elevation: float


@dataclass(frozen=True)
class ViewRange:
    """Ranges (degrees) that viewpoints are drawn from; equal ends fix the angle."""

    azimuth: tuple[float, float] = option((-45.0, 45.0), "lowest and highest; 0 faces the object's front", "degrees")
    elevation: tuple[float, float] = option((15.0, 60.0), "lowest and highest, above the horizon", "degrees")

    def sample(self, rng: np.random.Generator) -> View:
        """Draw a view, uniformly in both angles."""
        return View(float(rng.uniform(*self.azimuth)), float(rng.uniform(*self.elevation)))


def look_at(view: View, centre: NDArray[np.float64], distance: float) -> NDArray[np.float64]:
    """T_world_camera [4, 4] of a camera at ``distance`` m from ``centre`` [3]; camera x right, y down, z forward."""
    azimuth, elevation = np.radians([180.0 + view.azimuth, view.elevation])
    outward = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    forward = -outward
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    down = np.cross(forward, right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, down, forward], axis=1)
    pose[:3, 3] = centre + distance * outward
    return pose


def pixel_rays(camera: NDArray[np.float64], ticks: NDArray[np.float64]) -> NDArray[np.float64]:
    """World directions [3, n * n] of a picture's pixels, row by row, each with a depth of 1.

    Args:
        camera: T_world_camera [4, 4]; camera x right, y down, z forward.
        ticks: x / z of the columns' and y / z of the rows' pixel centres [n].
    """
    right, down, forward = camera[:3, :3].T[:, :, None, None]
    return (forward + ticks[:, None] * down + ticks * right).reshape(3, -1)


def pixel_points(
    camera: NDArray[np.float64], rays: NDArray[np.float64], pixels: NDArray[np.int64], depth: NDArray[np.floating]
) -> NDArray[np.float64]:
    """World points [P, 3] (m) at ``depth`` [P] (m) on the ``rays`` [3, n * n] of some ``pixels`` [P]."""
    points = np.empty((len(pixels), 3))
    for axis in range(3):
        points[:, axis] = camera[axis, 3] + depth * rays[axis].take(pixels)
    return points
