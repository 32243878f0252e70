"""The kept clouds of a run as the two linked 3D scenes of a report's page."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fb3d_rl.evaluation.runs import CLOUD_ARRAYS
from fb3d_rl.report.page import Block, Note, Viewer

_ARROWS = 160
"""Arrows per cloud: more hide the shape."""


def viewer(clouds: Mapping[str, NDArray[Any]] | None) -> list[Block]:
    """The arrays of ``clouds.npz`` (see :data:`CLOUD_ARRAYS`) as blocks; nothing without any."""
    if clouds is None:
        return []
    samples = zip(*(clouds[name] for name in CLOUD_ARRAYS), strict=True)
    prepared = [_cloud(*sample) for sample in samples if sample[1].any()]
    if not prepared:
        return []
    note = (
        "The same cloud twice; drag to turn, scroll to zoom. Arrows start at the same points on both sides, "
        "chosen among those that move or are predicted to move (flow above 0.1); arrows below 0.02 are "
        "left out."
    )
    return [Note(note), Viewer(prepared)]


def _cloud(
    points: NDArray[np.float32],
    valid: NDArray[np.bool_],
    part_mask: NDArray[np.bool_],
    flow_true: NDArray[np.float32],
    flow_predicted: NDArray[np.float32],
    title: str,
) -> dict[str, Any]:
    """One cloud for :class:`Viewer`; arrays [N, ...], padding dropped."""
    points, part = points[valid], part_mask[valid]
    true, predicted = flow_true[valid], flow_predicted[valid]
    low, high = points.min(0), points.max(0)
    size = 0.18 * float(np.linalg.norm(high - low))
    moving = np.flatnonzero((np.linalg.norm(true, axis=1) > 0) | (np.linalg.norm(predicted, axis=1) > 0.1))
    # Evenly through the cloud's order, so that a report is the same each time it is written.
    chosen = moving[np.unique(np.linspace(0, len(moving) - 1, _ARROWS).astype(int))] if len(moving) else moving

    def arrows(flow: NDArray[np.float32]) -> dict[str, list[list[float]]]:
        kept = chosen[np.linalg.norm(flow[chosen], axis=1) > 0.02]
        return {"start": _rounded(points[kept]), "vector": _rounded(flow[kept])}

    return {
        "title": str(title),
        "rest": _rounded(points[~part].T),
        "part": _rounded(points[part].T),
        "true": arrows(true),
        "predicted": arrows(predicted),
        "size": size,
        "box": _rounded(np.stack([low - 0.6 * size, high + 0.6 * size], axis=1)),
    }


def _rounded(values: NDArray[np.float32]) -> list[list[float]]:
    rounded: list[list[float]] = np.round(values.astype(np.float64), 4).tolist()
    return rounded
