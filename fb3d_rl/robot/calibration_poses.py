"""Poses of the flange to calibrate from: the marker in view, reachable, turned about axes as different as can be."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fb3d_rl.errors import UserError
from fb3d_rl.perception.depth import Intrinsics
from fb3d_rl.robot.marker import Marker, project

Array = NDArray[np.float64]
Reachable = Callable[[Array], bool]
"""Whether the arm reaches T_base_flange [4, 4] and may go there."""

CANDIDATES = 4000
"""Poses that are drawn, among which the best are chosen."""

TILT = 50.0
"""Largest angle (degrees) between the marker's normal and the direction to the camera."""

ROLL = 90.0
"""Largest turn (degrees) of the marker about its normal, either way."""

SMALLEST = 40.0
"""Length (pixels) of the marker's side below which its corners are too uncertain."""

NEAREST = 0.4
"""Least distance (m) of the marker from the camera."""

MARGIN = 0.08
"""Share of the image along each border that stays free, since the camera's place is known roughly only."""


def within(inner: float, outer: float, lowest: float) -> Reachable:
    """A stand-in for an arm's model: the flange between two balls around the base and above a height (all in m)."""

    def reachable(flange: Array) -> bool:
        return bool(inner <= np.linalg.norm(flange[:3, 3]) <= outer and flange[2, 3] >= lowest)

    return reachable


def choose_poses(
    count: int,
    camera: Array,
    mount: Array,
    marker: Marker,
    lens: Intrinsics,
    reachable: Reachable,
    rng: np.random.Generator,
) -> Array:
    """Choose poses T_base_flange [count, 4, 4] for a calibration, from where camera and marker roughly are.

    Of random poses the one is taken next that adds most to the determinant of the scatter of rotation vectors and
    positions of those before (a D-optimal design): turns about all axes, places all over the image and near and far.

    Args:
        count: how many.
        camera: T_base_camera [4, 4], roughly.
        mount: T_flange_marker [4, 4], roughly.
        marker: its size.
        lens: the camera, with the size of its image.
        reachable: asked only about poses that are about to be taken.
        rng: draws the candidates.

    Raises:
        UserError: too few poses are reachable with the marker in view.
    """
    seen = _candidates(marker, lens, rng)
    flange = camera @ seen @ np.linalg.inv(mount)
    turned = Rotation.from_matrix(_facing().T @ seen[:, :3, :3]).as_rotvec()
    # A turn by one radian counts as much as a step by half a metre.
    features = np.concatenate([turned, (seen[:, :3, 3] - seen[:, :3, 3].mean(0)) / 0.5], axis=1)
    scatter = 1e-3 * np.eye(6)
    left = np.ones(len(flange), dtype=bool)
    chosen: list[int] = []
    while len(chosen) < count:
        # det(S + v v^T) = det(S) (1 + v^T S^-1 v)
        gain = ((features @ np.linalg.inv(scatter)) * features).sum(1)
        for best in np.argsort(-gain, kind="stable"):
            if left[best]:
                left[best] = False
                if reachable(flange[best]):
                    break
        else:
            raise UserError(
                f"only {len(chosen)} of {count} poses can be reached with the marker in view; move the camera or the "
                f"marker, or take fewer samples"
            )
        chosen.append(int(best))
        scatter += np.outer(features[best], features[best])
    return flange[chosen]


def in_view(seen: Array, marker: Marker, lens: Intrinsics, margin: float = 0.0) -> NDArray[np.bool_]:
    """Whether markers at T_camera_marker [N, 4, 4] are wholly in the image, face the camera and are large enough.

    Args:
        seen: the poses.
        marker: its size.
        lens: the camera, with the size of its image.
        margin: share of the image along each border where a marker does not count.
    """
    size = np.array([lens.width or 2 * lens.cx + 1, lens.height or 2 * lens.cy + 1])
    pixels = project(seen, marker.corners, lens)
    inside = ((pixels > margin * size) & (pixels < (1 - margin) * size - 1)).all((1, 2))
    position = seen[:, :3, 3]
    faces = (seen[:, :3, 2] * position).sum(1) < -np.cos(np.radians(TILT + 10.0)) * np.linalg.norm(position, axis=1)
    return inside & faces & (position[:, 2] > 0.0) & (lens.fx * marker.side >= SMALLEST * position[:, 2])


def _candidates(marker: Marker, lens: Intrinsics, rng: np.random.Generator) -> Array:
    """Random T_camera_marker [N, 4, 4] in view."""
    width, height = lens.width or 2 * lens.cx + 1, lens.height or 2 * lens.cy + 1
    depth = rng.uniform(NEAREST, max(lens.fx * marker.side / SMALLEST, NEAREST), CANDIDATES)
    pixels = rng.uniform(0.0, 1.0, (CANDIDATES, 2)) * (width, height)
    way = rng.uniform(0.0, 2.0 * np.pi, CANDIDATES)
    tilt = np.radians(TILT) * np.sqrt(rng.uniform(0.0, 1.0, CANDIDATES))
    roll = np.radians(ROLL) * rng.uniform(-1.0, 1.0, CANDIDATES)
    zero = np.zeros(CANDIDATES)
    tilts = Rotation.from_rotvec(tilt[:, None] * np.stack([np.cos(way), np.sin(way), zero], axis=1))
    rolls = Rotation.from_rotvec(np.stack([zero, zero, roll], axis=1))
    seen = np.tile(np.eye(4), (CANDIDATES, 1, 1))
    seen[:, :3, :3] = _facing() @ (tilts * rolls).as_matrix()
    seen[:, :3, 3] = depth[:, None] * np.stack(
        [(pixels[:, 0] - lens.cx) / lens.fx, (pixels[:, 1] - lens.cy) / lens.fy, np.ones(CANDIDATES)], axis=1
    )
    return seen[in_view(seen, marker, lens, MARGIN)]


def _facing() -> Array:
    """Rotation [3, 3] of a marker that faces the camera upright: x right, y up, z towards it."""
    return np.diag([1.0, -1.0, -1.0])
