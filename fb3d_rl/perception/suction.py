"""Where a suction cup holds: the contact heuristic for a real cup (supplement, I.E) and a model of its seal.

Both see a cloud of the surface on the side that the cup comes from, dense enough to show the ring of a cup: a few
millimetres between points, as a depth image has them, not the thinned cloud of the networks.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from fb3d_rl.errors import UserError
from fb3d_rl.geometry.points import pca_curvature
from fb3d_rl.options import check, option

Array = NDArray[np.float64]

_RING = 32
"""Places along the ring of a cup."""

_MOUTH = 128
"""Places inside it."""

_BLOCK = 500
"""Points whose neighbourhoods are in memory at once."""

_TESTS = 500
"""Places whose seal is tested before the first of them is taken: a cloud may be too noisy to show one."""


@dataclass(frozen=True)
class CupOptions:
    """A suction cup and what it takes to hold; the defaults are a bellows cup of 3 cm (supplement, I.A)."""

    radius: float = option(0.015, "radius of the lip", "m", "(0, inf)")
    gap: float = option(
        0.002, "largest gap between lip and surface; a cup without bellows closes about half of it", "m", "[0, inf)"
    )
    ring: float = option(0.9, "least share of the lip that has surface below it", within="[0, 1]")
    mouth: float = option(0.97, "least share of the area inside the lip that has surface below it", within="[0, 1]")
    angle: float = option(25.0, "largest angle between the cup's axis and the surface's normal", "degrees", "[0, 90]")
    bend: float = option(2.0, "least radius of the surface's curvature, in radii of the lip", within="[0, inf)")
    vacuum: float = option(60e3, "pressure below that of the air", "Pa", "(0, inf)")
    friction: float = option(0.5, "coefficient of friction between lip and surface", within="[0, inf)")

    def __post_init__(self) -> None:
        check(self)

    @property
    def hold(self) -> float:
        """Force (N) with which the vacuum presses the cup to the surface."""
        return self.vacuum * math.pi * self.radius**2


@dataclass(frozen=True)
class PlaceOptions:
    """The contact heuristic (supplement, I.E) and a test for rims, which curvature does not see."""

    radius: float = option(0.025, "radius of the neighbourhood whose PCA gives the curvature", "m", "(0, inf)")
    curvature: float = option(0.045, "curvature above which a point is no place for a cup", within="[0, inf)")
    distance: float = option(0.02, "where the max-flow point is none, its stand-in is this far off", "m", "[0, inf)")
    flow: float = option(0.5, "least share of the largest flow that a point must have", within="[0, 1]")
    rim: bool = option(
        True, "whether the lip must have surface below it all around, and the cup hold as far as one sees"
    )
    margin: float = option(0.005, "by how much farther out than the lip: a hand misses by millimetres", "m", "[0, inf)")
    slant: float = option(
        90.0, "largest angle between flow and normal, for a cup that comes along the flow", "degrees", "[0, 90]"
    )
    near: float = option(0.003, "how near to the plane around the point that surface must be", "m", "(0, inf)")

    def __post_init__(self) -> None:
        check(self)


class Seal(NamedTuple):
    """Whether a cup holds at a point, and why not.

    Attributes:
        normal: [3] unit, of the plane of the lip, to the cup's side.
        gap: largest distance of the surface from that plane along the lip, m.
        ring: share of the lip that has surface below it.
        mouth: share of the area inside the lip that has.
        angle: between the cup's axis and the normal, degrees.
        bend: least radius of the surface's curvature inside the lip, in radii of the lip.
        pull: force off the surface, as a share of what the vacuum holds; above 1 the cup comes off.
        shear: force along the surface, as a share of what friction holds.
        peel: moment that tips the cup, as a share of the one at which the lip lifts on one side.
        failed: the names of the terms that break their limits.
    """

    normal: Array
    gap: float
    ring: float
    mouth: float
    angle: float
    bend: float
    pull: float
    shear: float
    peel: float
    failed: tuple[str, ...]

    @property
    def holds(self) -> bool:
        return not self.failed


class Place(NamedTuple):
    """A point for a cup.

    Attributes:
        row: which of the points it is.
        curvature: of PCA there.
        ring: share of a cup's lip that has surface below it.
        normal: [3] unit, to the camera's side.
        stands_in: whether it stands in for the max-flow point.
    """

    row: int
    curvature: float
    ring: float
    normal: Array
    stands_in: bool


def seal(
    points: Array,
    contact: Array,
    approach: Array,
    cup: CupOptions | None = None,
    force: Array | tuple[float, float, float] = (0.0, 0.0, 0.0),
    moment: Array | tuple[float, float, float] = (0.0, 0.0, 0.0),
    smoothing: float = 0.0,
) -> Seal:
    """Whether a suction cup holds at a point. The bellows let the lip lie in the plane that fits the surface below it.

    The shape decides whether the seal forms, as in Dex-Net 3.0 (Mahler et al. 2018): the lip projected on the surface
    must meet it everywhere, and bend little. The loads decide whether it lasts: a ring that is pressed on with a force
    F slides at friction * F, and lifts on one side at a moment of F * radius / 2.

    Args:
        points: [..., 3] m, the surface as it is seen from the cup's side; NaN where nothing was measured.
        contact: [3] m, the middle of the lip.
        approach: [3], which way the cup comes, about against the normal.
        cup: the cup and its limits.
        force: [3] N, with which the cup pulls the surface.
        moment: [3] Nm about the middle of the lip, likewise.
        smoothing: radius (m) within which heights along the lip are averaged, at least as far as the points are apart.
            On an exact surface 0 sees every groove; a noisy one needs about .3 radii of the lip.
    """
    cup = cup or CupOptions()
    offsets = points.reshape(-1, 3) - contact
    offsets = offsets[np.linalg.norm(offsets, axis=1) < 2.0 * cup.radius]  # NaN is not
    core = offsets[np.linalg.norm(offsets, axis=1) < cup.radius]
    if len(core) < 10:
        nothing = ("gap", "ring", "mouth", "angle", "bend")
        return Seal(-approach, math.inf, 0.0, 0.0, 90.0, 0.0, math.inf, math.inf, math.inf, nothing)
    frame = np.linalg.svd(core - core.mean(0), full_matrices=False)[2]  # rows: along the surface twice, normal
    frame[2] *= -np.sign(frame[2] @ approach) or 1.0
    local = offsets @ frame.T
    local = local[np.abs(local[:, 2] - np.median(core @ frame[2])) < 2.0 / 3.0 * cup.radius]  # the bellows' travel
    gap, ring, mouth, slope = _lip(local, cup.radius, smoothing)
    normal = np.array([-slope[0], -slope[1], 1.0]) @ frame
    normal /= np.linalg.norm(normal)
    cosine = float(-normal @ approach / np.linalg.norm(approach))
    pull, shear, peel = loads(normal, np.asarray(force), np.asarray(moment), cup)
    terms = {
        "gap": gap,
        "ring": ring,
        "mouth": mouth,
        "angle": math.degrees(math.acos(min(1.0, max(-1.0, cosine)))),
        "bend": _bend(local, cup.radius),
        "pull": pull,
        "shear": shear,
        "peel": peel,
    }
    least = {"ring": cup.ring, "mouth": cup.mouth, "bend": cup.bend}
    most = {"gap": cup.gap, "angle": cup.angle, "pull": 1.0, "shear": 1.0, "peel": 1.0}
    failed = tuple(
        name for name, value in terms.items() if value < least.get(name, -1.0) or value > most.get(name, math.inf)
    )
    return Seal(normal, **terms, failed=failed)


def loads(normal: Array, force: Array, moment: Array, cup: CupOptions) -> tuple[float, float, float]:
    """Pull, shear and peel of :class:`Seal`: what a cup bears, as shares of what it can.

    Args:
        normal: [3] unit, of the lip's plane, to the cup's side.
        force: [3] N, with which the cup pulls the surface.
        moment: [3] Nm about the middle of the lip, likewise.
        cup: the cup.
    """
    off = float(normal @ force)
    left = max(cup.hold - off, 1e-9)
    along = float(np.linalg.norm(force - off * normal))
    tipping = float(np.linalg.norm(np.cross(normal, moment)))
    shear = along / max(cup.friction * left, 1e-9)
    return max(off, 0.0) / cup.hold, shear, tipping / (left * cup.radius / 2.0)


def _lip(local: Array, radius: float, smoothing: float) -> tuple[float, float, float, Array]:
    """Gap, ring and mouth of :class:`Seal` and the slope [2] of the lip's plane, for a surface [N, 3] in the frame of
    the lip's middle, the third axis up.
    """
    tree = cKDTree(local[:, :2])
    # As far as the eighth neighbour: that is never empty on a surface, be its points in rows or at random.
    reach = min(float(np.median(tree.query(local[:, :2], min(9, len(local)))[0][:, -1])), 0.2 * radius)
    turn = 2.0 * np.pi * np.arange(_RING) / _RING
    ring = radius * np.stack([np.cos(turn), np.sin(turn)], 1)
    met = tree.query_ball_point(ring, reach, return_length=True) > 0
    around = tree.query_ball_point(ring[met], max(reach, smoothing))
    heights = np.array([np.median(local[near, 2]) for near in around])
    spiral = np.arange(_MOUTH) + 0.5
    inside = radius * np.sqrt(spiral / _MOUTH)[:, None] * np.stack([np.cos(2.4 * spiral), np.sin(2.4 * spiral)], 1)
    mouth = float((tree.query_ball_point(inside, reach, return_length=True) > 0).mean())
    if met.sum() < 3:
        return math.inf, float(met.mean()), mouth, np.zeros(2)
    plane = np.column_stack([ring[met], np.ones(met.sum())])
    fitted = np.linalg.lstsq(plane, heights, rcond=None)[0]
    return float(np.abs(heights - plane @ fitted).max()), float(met.mean()), mouth, fitted[:2]


def _bend(local: Array, radius: float) -> float:
    """Least radius of curvature, in radii of the lip, of the quadric that fits the surface [N, 3] around the lip."""
    u, v, height = local[np.linalg.norm(local[:, :2], axis=1) < 1.2 * radius].T
    terms = np.stack([np.ones_like(u), u, v, 0.5 * u * u, u * v, 0.5 * v * v], 1)
    uu, uv, vv = np.linalg.lstsq(terms, height, rcond=None)[0][3:]
    curvature = float(np.abs(np.linalg.eigvalsh([[uu, uv], [uv, vv]])).max())
    return 1.0 / max(curvature * radius, 1e-9)


def choose_place(
    points: Array,
    flow: Array,
    camera: Array,
    cup: CupOptions | None = None,
    options: PlaceOptions | None = None,
) -> Place | None:
    """The max-flow point where a cup can hold it, else the nearest good point at least 2 cm from it (supplement, I.E).

    Args:
        points: [N, 3] m, the object.
        flow: [N, 3], the largest is taken.
        camera: [3] m, from where it was seen.
        cup: the cup.
        options: thresholds.

    Returns:
        None if there is no good point among those that move. With the test for rims :func:`seal` has to hold, too;
        where it does nowhere near, on a noisy cloud, the first point that is good otherwise.

    Raises:
        UserError: nothing moves, or a point or a flow is no number.
    """
    cup, options = cup or CupOptions(), options or PlaceOptions()
    size = np.linalg.norm(flow, axis=1)
    if not (np.isfinite(size).all() and np.isfinite(points).all() and size.any()):
        raise UserError("A place for the cup needs finite points and a flow that is not 0 everywhere.")
    moves = np.flatnonzero(size >= max(options.flow * size.max(), 1e-12))
    peak = int(size.argmax())
    distance = np.linalg.norm(points[moves] - points[peak], axis=1)
    order = distance.argsort(kind="stable")
    stand_ins = moves[order[distance[order] >= options.distance]]
    tree, unsealed = cKDTree(points), list[Place]()
    for start in range(-_BLOCK, len(stand_ins), _BLOCK):  # the nearest first, so that few are looked at
        rows = np.array([peak]) if start < 0 else stand_ins[start : start + _BLOCK]
        curvature, ring, normals = _surface(points, points[rows], tree, cup, options)
        good = (curvature <= options.curvature) & ((ring >= cup.ring) | (not options.rim))
        along = np.abs((flow[rows] * normals).sum(1)) / size[rows]
        good &= along >= math.cos(math.radians(options.slant)) - 1e-9
        for i in np.flatnonzero(good):
            normal = normals[i] * (1.0 if normals[i] @ (camera - points[rows[i]]) >= 0 else -1.0)
            place = Place(int(rows[i]), float(curvature[i]), float(ring[i]), normal, start >= 0)
            if not options.rim or seal(points, points[rows[i]], -normal, cup, smoothing=0.3 * cup.radius).holds:
                return place
            unsealed.append(place)
        if len(unsealed) > _TESTS:
            break
    return unsealed[0] if unsealed else None


def surface(
    points: Array, at: Array, cup: CupOptions | None = None, options: PlaceOptions | None = None
) -> tuple[Array, Array, Array]:
    """The surface around some points.

    Args:
        points: [N, 3] m, finite.
        at: [M, 3] m.
        cup: the cup.
        options: radius, margin and near.

    Returns:
        PCA curvature [M], 0 to 1/3; the share [M] of a cup's lip, widened by the margin, that has points near it; and
        unit normals [M, 3] of either sign.
    """
    cup, options = cup or CupOptions(), options or PlaceOptions()
    tree = cKDTree(points)
    blocks = [_surface(points, at[start : start + _BLOCK], tree, cup, options) for start in range(0, len(at), _BLOCK)]
    curvature, ring, normals = (np.concatenate(parts) for parts in zip(*blocks, strict=True))
    return curvature, ring, normals


def _surface(
    points: Array, at: Array, tree: cKDTree, cup: CupOptions, options: PlaceOptions
) -> tuple[Array, Array, Array]:
    most = max(3, int(tree.query_ball_point(at, options.radius, return_length=True).max(initial=0)))
    distance, index = tree.query(at, most, distance_upper_bound=options.radius)
    known = np.isfinite(distance)
    index = np.where(known, index, 0)
    nearest = torch.from_numpy(distance**2)[None], torch.from_numpy(index)[None]
    found = pca_curvature(torch.from_numpy(points)[None], nearest, torch.ones(1, len(at), dtype=torch.bool))
    curvature, normals = (values[0].numpy() for values in found)
    middle = (points[index] * known[..., None]).sum(1) / np.maximum(known.sum(1), 1)[:, None]
    height = ((middle - at) * normals).sum(1, keepdims=True)
    first = np.cross(normals, np.eye(3)[np.abs(normals).argmin(1)])
    first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-12)
    second = np.cross(normals, first)
    turn = 2.0 * np.pi * np.arange(_RING)[:, None, None] / _RING
    ring = (at + height * normals) + (cup.radius + options.margin) * (np.cos(turn) * first + np.sin(turn) * second)
    near = np.isfinite(tree.query(ring, distance_upper_bound=options.near)[0])
    return curvature, near.mean(0), normals
