"""Options of the depth camera."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fb3d_rl.camera.views import ViewRange
from fb3d_rl.options import option

SENSORS: dict[str, str] = {
    "raycast": "fb3d_rl.camera.raycast:RaycastCamera",
    "sapien": "fb3d_rl.camera.raycast:RaycastCamera",  # where no simulator runs; in the task its renderer draws
    "umpnet": "fb3d_rl.camera.umpnet:UmpnetCamera",
}
"""The class of each kind, as "module:object": :class:`fb3d_rl.camera.raycast.RaycastCamera`, or one derived from it."""


@dataclass(frozen=True)
class CameraOptions:
    """A pinhole camera."""

    resolution: int = option(96, "pixels along each side of the square image", within="[8, inf)")
    fov: float = option(40.0, "full field of view", "degrees", "(0, 180)")
    margin: float = option(1.15, "the closed object's bounding sphere fills 1 / margin of the field of view")
    kind: str = option(
        "raycast",
        "the camera of the simulated task: ray casting on the CPU, or SAPIEN's renderer, which needs Vulkan. Both give "
        "the same clouds; flow samples for training are always ray-cast. umpnet: UMPNet's camera, ray-cast, with "
        "clouds in its frame for training (camera=umpnet sets its optics)",
        among=SENSORS,
    )
    shader: Literal["minimal", "default"] = option(
        "minimal",
        "SAPIEN's shader pack: minimal has depth in whole millimetres up to 32 m, default is exact and slower (its ray "
        "tracers jitter their rays and blur depth over several pixels)",
    )

    @property
    def slope(self) -> float:
        """Largest x / z and y / z in the image: at its edge."""
        return math.tan(math.radians(0.5 * self.fov))

    @property
    def ticks(self) -> NDArray[np.float64]:
        """Centres [resolution] of the pixels: x / z of the columns and y / z of the rows."""
        return ((np.arange(self.resolution) + 0.5) / self.resolution * 2.0 - 1.0) * self.slope

    @property
    def pinhole(self) -> tuple[float, float, float, float]:
        """Focal lengths and principal point fx, fy, cx, cy in pixels, whose centres are whole numbers."""
        focal, middle = 0.5 * self.resolution / self.slope, 0.5 * (self.resolution - 1)
        return focal, focal, middle, middle


@dataclass(frozen=True)
class DepthCameraOptions(ViewRange, CameraOptions):
    """The depth camera and its viewpoints."""
