"""Capsules as the bodies of a robot: the ones that enclose a mesh, and distances between segments."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError
from trimesh.intersections import slice_faces_plane

from fb3d_rl.assets.articulation import Mesh

Array = NDArray[np.float64]

SPLITS = 2
"""How often a capsule is halved."""

WORTHWHILE = 0.75
"""A capsule is replaced by two that together have less than this share of its volume."""


class Capsule(NamedTuple):
    """All points within ``radius`` (m) of the segment between ``ends`` [2, 3] (m); a sphere if these are equal."""

    ends: Array
    radius: float

    @property
    def volume(self) -> float:
        length = float(np.linalg.norm(self.ends[1] - self.ends[0]))
        return np.pi * self.radius**2 * (length + 4 / 3 * self.radius)


def enclosing_capsule(points: Array) -> Capsule:
    """A small capsule that encloses points [N, 3] (m), and so their convex hull: the best of six axes."""
    axes = np.concatenate([np.linalg.svd(points - points.mean(0), full_matrices=False)[2], np.eye(3)])
    return min((_along(points, axis) for axis in axes), key=lambda capsule: capsule.volume)


def enclosing_capsules(mesh: Mesh, splits: int = SPLITS) -> list[Capsule]:
    """Capsules that together enclose the convex hull of a mesh: one, or more where these are much smaller."""
    try:
        hull = trimesh.Trimesh(mesh.vertices, ConvexHull(mesh.vertices).simplices, process=False)
    except QhullError:  # flat
        return [enclosing_capsule(mesh.vertices)]
    return _halved(hull, splits)


def _halved(surface: trimesh.Trimesh, splits: int) -> list[Capsule]:
    whole = enclosing_capsule(np.asarray(surface.vertices))
    axis = whole.ends[1] - whole.ends[0]
    if splits == 0 or not axis.any():
        return [whole]
    # Trimesh's own slice_plane wants shapely, for caps that are not needed here.
    halves = [slice_faces_plane(surface.vertices, surface.faces, way, whole.ends.mean(0))[:2] for way in (axis, -axis)]
    if min(len(vertices) for vertices, _ in halves) < 4:
        return [whole]
    surfaces = [trimesh.Trimesh(vertices, faces, process=False) for vertices, faces in halves]
    parts = [capsule for half in surfaces for capsule in _halved(half, splits - 1)]
    return parts if sum(part.volume for part in parts) < WORTHWHILE * whole.volume else [whole]


def _along(points: Array, axis: Array) -> Capsule:
    """The smallest capsule along a unit axis: of wider ones, less of the ends is needed."""
    z = points @ axis
    across = points - z[:, None] * axis
    centre = _centre(across)
    rho = np.linalg.norm(across - centre, axis=1)
    best = None
    for radius in rho.max() * np.linspace(1.0, 1.6, 25) + 1e-9:
        reach = np.sqrt(radius**2 - rho**2)  # how far along the axis a point may be from the segment
        low, high = (z + reach).min(), (z - reach).max()
        if low > high:
            low = high = (low + high) / 2
        capsule = Capsule(centre + np.outer([low, high], axis), float(radius))
        if best is None or capsule.volume < best.volume:
            best = capsule
    assert best is not None
    return best


def _centre(points: Array) -> Array:
    """Centre [D] of nearly the smallest ball around points [N, D] (Badoiu and Clarkson's iteration)."""
    centre = (points.min(0) + points.max(0)) / 2
    for i in range(2, 200):
        centre = centre + (points[np.linalg.norm(points - centre, axis=1).argmax()] - centre) / i**1.5
    return centre


def segment_distance(a: Array, b: Array) -> Array:
    """Distances [...] between segments ``a`` and ``b`` [..., 2, 3], which may be points.

    The closest pair is that of the lines if it is within both segments; else it includes an end of one of them.
    """
    u, v = a[..., 1, :] - a[..., 0, :], b[..., 1, :] - b[..., 0, :]
    w = a[..., 0, :] - b[..., 0, :]
    uu, uv, vv = (u * u).sum(-1), (u * v).sum(-1), (v * v).sum(-1)
    uw, vw = (u * w).sum(-1), (v * w).sum(-1)
    det = uu * vv - uv * uv
    lines = det > 1e-12 * uu * vv + 1e-30
    safe = np.where(lines, det, 1.0)
    s, t = (uv * vw - vv * uw) / safe, (uu * vw - uv * uw) / safe
    inside = lines & (s >= 0) & (s <= 1) & (t >= 0) & (t <= 1)
    between = np.linalg.norm(w + s[..., None] * u - t[..., None] * v, axis=-1)
    ends = [point_distance(a[..., i, :], b) for i in (0, 1)] + [point_distance(b[..., i, :], a) for i in (0, 1)]
    return np.where(inside, between, np.minimum.reduce(ends))


def point_distance(points: Array, segments: Array) -> Array:
    """Distances [...] of points [..., 3] from segments [..., 2, 3]."""
    start, way = segments[..., 0, :], segments[..., 1, :] - segments[..., 0, :]
    square = (way * way).sum(-1)
    share = np.clip(((points - start) * way).sum(-1) / np.where(square > 0, square, 1.0), 0.0, 1.0)
    return np.asarray(np.linalg.norm(points - start - share[..., None] * way, axis=-1))
