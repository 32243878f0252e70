"""Viewpoints around an object: azimuth and elevation (supplement, II.C)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class View:
    """Where the camera stands: angles in degrees; azimuth 0 looks at the object's front (which faces -x).

    Positive azimuth walks counter-clockwise seen from above; elevation is above the horizon.
    """

    azimuth: float
    elevation: float


@dataclass(frozen=True)
class ViewRange:
    """Ranges (degrees) that viewpoints are drawn from; equal ends fix the angle."""

    azimuth: tuple[float, float] = (-45.0, 45.0)
    elevation: tuple[float, float] = (15.0, 60.0)

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
