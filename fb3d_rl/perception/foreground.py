"""What of a cloud is the object (supplement, I.D): what it stands on, what is the robot's, which way is up, and where
the camera was.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter
from scipy.spatial import cKDTree

from fb3d_rl.geometry.transforms import alignment, rotate

Points = NDArray[np.float64]

HEIGHT = 0.015
"""Points lower than this above the support plane are the support's (supplement, I.D), m."""

_SAMPLE = 4000
"""Points among which a plane is looked for."""

_TRIPLES = 400
"""Planes that are tried."""

_WIDER = 1.2
"""A support reaches this many times as far as what stands on it, in every direction: the base of a laptop does not."""


class Plane(NamedTuple):
    """Where ``normal @ point == height``, with a unit normal [3] that points up."""

    normal: Points
    height: float


LEVEL = Plane(np.array([0.0, 0.0, 1.0]), 0.0)
"""The table, in a frame that stands on it."""


def above(points: NDArray[np.floating], support: Plane = LEVEL, least: float = HEIGHT) -> NDArray[np.bool_]:
    """Which points [..., 3] are higher than ``least`` (m) above a plane; NaN is not."""
    return np.asarray(points @ support.normal - support.height > least)


def turned_up(up: Points) -> Points:
    """The rotation [3, 3] by the shortest way that takes a direction [3] to +z."""
    turn = alignment(torch.as_tensor(up, dtype=torch.float64), torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    return rotate(torch.eye(3, dtype=torch.float64), turn.expand(3, 3)).T.numpy()


def support_plane(points: Points, up: Points, tilt: float, rng: np.random.Generator) -> Plane | None:
    """The table or floor that an object stands on, by RANSAC; None if none is seen that reaches beyond the object.

    Args:
        points: [N, 3] m.
        up: [3] unit, about upwards.
        tilt: largest angle (rad) between ``up`` and the plane's normal.
        rng: draws the planes that are tried.
    """
    some = points[rng.choice(len(points), min(len(points), _SAMPLE), replace=False)]
    thick = max(0.008, 0.004 * float(np.linalg.norm(np.ptp(some, axis=0))))
    plane = _plane(some, up, tilt, thick, 0.02, rng)
    return plane if plane is not None and _reaches_beyond(some, plane, thick) else None


def table_plane(
    points: Points, rng: np.random.Generator, expected: Plane = LEVEL, off: float = 0.03, tilt: float = 0.3
) -> Plane:
    """The table, whose place is roughly known, by RANSAC; a camera whose calibration is a little off sees it elsewhere.

    Args:
        points: [..., 3] m, NaN where nothing was measured.
        rng: draws the planes that are tried.
        expected: where it should be.
        off: how far from there its points may be, m.
        tilt: largest angle (rad) between the expected normal and the found one.

    Returns:
        The plane; the expected one where too few points make one.
    """
    near = points[np.abs(points @ expected.normal - expected.height) < off]
    if len(near) < 3:
        return expected
    some = near[rng.choice(len(near), min(len(near), _SAMPLE), replace=False)]
    return _plane(some, expected.normal, tilt, 0.008, 1.0, rng) or expected


def _plane(
    points: Points, up: Points, tilt: float, thick: float, below: float, rng: np.random.Generator
) -> Plane | None:
    """The plane, ``thick`` to either side, with most of the points [N, 3] and less than a share ``below`` of them under
    it; None if there is none with a tenth of them.
    """
    best, most = None, 0.1 * len(points)
    for a, b, c in points[rng.integers(len(points), size=(_TRIPLES, 3))]:
        normal = np.cross(b - a, c - a)
        size = float(np.linalg.norm(normal))
        normal = normal / max(size, 1e-12) * (1.0 if normal @ up >= 0 else -1.0)
        if size < 1e-9 or normal @ up < np.cos(tilt):
            continue
        height = points @ normal - normal @ a
        on = np.abs(height) < thick
        if on.sum() > most and (height < -2 * thick).mean() < below:
            best, most = on, on.sum()
    if best is None:
        return None
    middle = points[best].mean(0)
    normal = np.linalg.svd(points[best] - middle, full_matrices=False)[2][2]
    normal = normal if normal @ up >= 0 else -normal
    return Plane(normal, float(normal @ middle))


def _reaches_beyond(points: Points, plane: Plane, thick: float) -> bool:
    """Whether what lies on the plane reaches farther than what stands on it, in all directions along the plane."""
    above = points @ plane.normal - plane.height
    on, rest = points[np.abs(above) < thick], points[above > 2 * thick]
    if len(rest) < 10:
        return False
    first = turned_up(plane.normal)[:2]
    for angle in np.radians([0, 45, 90, 135]):
        way = np.cos(angle) * first[0] + np.sin(angle) * first[1]
        wide, narrow = (float(np.subtract(*np.percentile(x @ way, (98, 2)))) for x in (on, rest))
        if wide < _WIDER * narrow:
            return False
    return True


def on_robot(
    depth: NDArray[np.floating], robot: NDArray[np.floating], band: float = 0.03, dilation: int = 4
) -> NDArray[np.bool_]:
    """Which pixels [H, W] show the robot: what lies at or behind where its model is drawn, with a margin for the errors
    of calibration and camera. What is in front of the robot stays.

    Args:
        depth: [H, W] measured, m, 0 where nothing was.
        robot: [H, W] of the robot's model alone in its present posture, drawn from the calibrated camera, likewise.
        band: how far before the model a pixel may lie, m.
        dilation: radius by which the model's outline is widened, pixels.
    """
    y, x = np.ogrid[-dilation : dilation + 1, -dilation : dilation + 1]
    model = minimum_filter(
        np.where(robot > 0, robot, np.inf), footprint=x**2 + y**2 <= dilation**2, mode="constant", cval=np.inf
    )
    return np.asarray((depth > 0) & (depth > model - band))


def object_points(
    points: Points, table: Plane, robot: NDArray[np.bool_] | None = None, least: float = HEIGHT, deviations: float = 2.0
) -> NDArray[np.bool_]:
    """Which points of an organised cloud are the object's: above the table, not the robot's, and no outliers of what is
    left. Meant for the whole cloud, before it is thinned: in a thin one outliers are not sparser than the rest.

    Args:
        points: [N, 3] m, NaN where nothing was measured.
        table: of :func:`table_plane`, or :data:`LEVEL`.
        robot: [N] of :func:`on_robot`.
        least: height above the table, m.
        deviations: of :func:`outliers`; inf keeps them.
    """
    kept = above(points, table, least)
    if robot is not None:
        kept &= ~robot
    if np.isfinite(deviations):
        kept[kept] = ~outliers(points[kept], deviations=deviations)
    return kept


def outliers(points: Points, neighbors: int = 20, deviations: float = 3.0) -> NDArray[np.bool_]:
    """Which points [N] are far sparser than the rest: remains of the robot and points between edges (supplement, I.D).

    By their mean distance to the nearest ``neighbors``, which is ``deviations`` standard deviations above the mean.
    """
    if len(points) <= neighbors:
        return np.zeros(len(points), dtype=bool)
    distance = cKDTree(points).query(points, neighbors + 1, workers=-1)[0][:, 1:].mean(1)
    return np.asarray(distance > distance.mean() + deviations * distance.std())


def viewpoint(points: Points) -> Points:
    """Where the camera stood that saw a cloud, when nobody knows.

    It is where the fewest points hide others. From behind, the shell that a camera saw of a solid hides as little, but
    most of its points lie on the camera's side of the middle.

    Args:
        points: [N, 3] m, z up.

    Returns:
        [3] m, one of 72 places around the cloud; of nearly equal ones the nearest to the front, -x.
    """
    some = points[:: max(1, len(points) // 2000)]
    middle = 0.5 * (some.min(0) + some.max(0))
    size = float(np.linalg.norm(np.ptp(some, axis=0)))
    bulge = 0.3 * (some.mean(0) - middle) / size
    places = []
    for elevation in np.radians([10, 30, 50]):
        for azimuth in np.radians(np.arange(0, 360, 15)):
            outward = [-np.cos(azimuth) * np.cos(elevation), -np.sin(azimuth) * np.cos(elevation), np.sin(elevation)]
            front = abs((azimuth + np.pi) % (2 * np.pi) - np.pi)
            hidden = _hidden(some - middle, np.array(outward), size)
            places.append((hidden - float(bulge @ outward) + 0.002 * front, outward))
    return middle + 1.5 * size * np.array(min(places, key=lambda place: place[0])[1])


def _hidden(points: Points, outward: Points, size: float) -> float:
    """Share of points [N, 3] that others hide from a camera in the direction ``outward``."""
    turn = turned_up(outward)
    across, depth = points @ turn[:2].T, -(points @ outward)
    cell = 1.5 * np.sqrt(np.prod(np.ptp(across, axis=0)) / len(points)) + 1e-9
    place = np.floor((across - across.min(0)) / cell).astype(np.int64)
    code = place[:, 0] * (place[:, 1].max() + 1) + place[:, 1]
    nearest = np.full(int(code.max()) + 1, np.inf)
    np.minimum.at(nearest, code, depth)
    return float((depth > nearest[code] + 0.1 * size).mean())
