"""How objects of two kinds differ, category by category: whether procedural objects look and move like real ones.

What a flow network sees of an object is described by a few numbers (:data:`FEATURES`). A linear classifier is asked to
tell the two kinds by them, each object by what the others taught it; the numbers that tell them best say what differs.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.stats import mannwhitneyu

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.assets.partnet_mobility import load_usable
from fb3d_rl.data.options import SampleOptions
from fb3d_rl.data.samples import draw_sample
from fb3d_rl.errors import UserError
from fb3d_rl.scene.posed import Posed

FEATURES = (
    "depth / height",
    "width / height",
    "parts that open",
    "visible share of the part",
    "part: longest extent",
    "part: middle extent",
    "part: shortest extent",
    "part: to the front",
    "part: sideways",
    "part: height",
    "flow to the front or back",
    "flow sideways",
    "flow up or down",
    "mean flow of the part",
    "range of the joint, rad",
    "way of the joint",
)
"""Of an object: lengths and places of its part are shares of the cloud's extent; ways of sliders are of its diagonal,
and 0 for hinges, as ranges are for sliders."""

RIDGE = 0.3
"""Share of the identity in the classifier's covariance, since a category has fewer objects than there are numbers."""

FEWEST = 4
"""Objects of each kind that a category needs."""


@dataclass(frozen=True)
class Likeness:
    """How two kinds of objects of a category differ.

    Attributes:
        category: the category.
        counts: the number of objects of each kind.
        told: the share of pairs, one object of each kind, that the classifier orders rightly (area under its curve):
            0.5 where it cannot tell them, 1 where it always can.
        means: of each feature the mean of the two kinds.
        apart: of each feature the same share by itself, in whichever order, 0.5 to 1.
    """

    category: str
    counts: tuple[int, int]
    told: float
    means: tuple[tuple[float, float], ...]
    apart: tuple[float, ...]

    def telling(self, count: int = 3) -> list[int]:
        """Indices of the features that tell the kinds best."""
        return sorted(range(len(FEATURES)), key=lambda i: -self.apart[i])[:count]


def describe(obj: ArticulatedObject, options: SampleOptions, clouds: int = 6, seed: int = 0) -> NDArray[np.float64]:
    """The :data:`FEATURES` of an object, means over clouds that are drawn as for training; nan if no part is seen."""
    posed = Posed(obj, options.camera)
    options = replace(options, all_parts_share=0.0, some_parts_share=0.0, unmasked_share=0.0, closed_share=1.0)
    rng, rows = np.random.default_rng([seed, zlib.crc32(obj.id.encode())]), []
    for _ in range(clouds if posed.openable else 0):
        sample = draw_sample(posed, options, rng)
        if sample is None:
            continue
        seen = sample["observation", "valid"].numpy()
        points = sample["observation", "points"].numpy()[seen].astype(np.float64)
        part, flow = (sample[key].numpy()[seen] for key in (("observation", "part_mask"), ("privileged", "flow")))
        if part.sum() < 4:
            continue
        low, high = points.min(0), points.max(0)
        size = np.maximum(high - low, 1e-6)
        diagonal, mine = float(np.linalg.norm(size)), points[part]
        extents = np.sqrt(12.0 * np.linalg.eigvalsh(np.cov(mine.T)).clip(0.0))[::-1] / diagonal  # of a uniform body
        place = (mine.mean(0) - low) / size
        moves = flow[part].astype(np.float64)
        ways = np.abs(moves).mean(0) / max(float(np.abs(moves).mean(0).sum()), 1e-9)
        link = int(sample["target"])
        joint = posed.obj.movable.index(link)
        opens = float(abs(posed.opened[joint] - posed.closed[joint]))
        slides = posed.obj.links[link].joint.type == "prismatic"  # type: ignore[union-attr]
        rows.append(
            [size[0] / size[2], size[1] / size[2], len(posed.openable), part.mean(), *extents, *place, *ways]
            + [np.linalg.norm(moves, axis=1).mean(), 0.0 if slides else opens, opens / diagonal if slides else 0.0]
        )
    return np.mean(rows, 0) if rows else np.full(len(FEATURES), np.nan)


def of_folder(folder: Path) -> tuple[str, NDArray[np.float64]]:
    """Category and description of the object in a folder; nan if it cannot be used."""
    try:
        obj = load_usable(folder)
    except UserError:
        return "", np.full(len(FEATURES), np.nan)
    return obj.category, describe(obj, SampleOptions())


def compare(
    ours: Mapping[str, Sequence[NDArray[np.float64]]], theirs: Mapping[str, Sequence[NDArray[np.float64]]]
) -> list[Likeness]:
    """Compare the descriptions of two kinds of objects by category, those that are told best first.

    Args:
        ours: descriptions [F] by category.
        theirs: as ``ours``. Categories with fewer than :data:`FEWEST` objects of a kind are left out.
    """
    found = []
    for category in sorted(ours.keys() & theirs.keys()):
        kinds = [np.array([row for row in kind[category] if np.isfinite(row).all()]) for kind in (ours, theirs)]
        if min(map(len, kinds)) < FEWEST:
            continue
        apart = [_order(*(kind[:, i] for kind in kinds)) for i in range(len(FEATURES))]
        means = tuple(zip(*(kind.mean(0).tolist() for kind in kinds), strict=True))
        counts = (len(kinds[0]), len(kinds[1]))
        found.append(Likeness(category, counts, _told(*kinds), means, tuple(max(x, 1.0 - x) for x in apart)))
    return sorted(found, key=lambda likeness: -likeness.told)


def _order(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """Share of the pairs (a, b) with a > b, ties counted half."""
    return float(mannwhitneyu(a, b).statistic) / (len(a) * len(b))


def _told(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """How well linear discriminants tell a [n, F] from b [m, F], each object by one that was made without it."""
    rows, kind = np.concatenate([a, b]), np.repeat([True, False], [len(a), len(b)])
    scores = np.empty(len(rows))
    for i in range(len(rows)):
        others = np.arange(len(rows)) != i
        centre, spread = rows[others].mean(0), rows[others].std(0) + 1e-9
        x = (rows - centre) / spread
        first, second = x[others & kind], x[others & ~kind]
        inner = np.concatenate([first - first.mean(0), second - second.mean(0)])
        covariance = (1.0 - RIDGE) * inner.T @ inner / len(inner) + RIDGE * np.eye(x.shape[1])
        way = np.linalg.solve(covariance, first.mean(0) - second.mean(0))
        scores[i] = (x[i] - 0.5 * (first.mean(0) + second.mean(0))) @ way
    return _order(scores[kind], scores[~kind])
