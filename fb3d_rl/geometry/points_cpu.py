"""Sampling and balls with NumPy, for CPUs: the same answers as :mod:`fb3d_rl.geometry.points` with PyTorch, to the last
index. An operation on the few thousand numbers of one cloud takes PyTorch several times as long to begin as to do.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from fb3d_rl.geometry.points import squared_distances

FEW = 4
"""Clouds up to which each is sampled on its own; PyTorch does more of them faster together."""


def farthest_point_sample(points: Tensor, count: int, valid: Tensor) -> Tensor:
    """As :func:`fb3d_rl.geometry.points.farthest_point_sample`, of float32 points."""
    chosen = [_farthest(cloud, count, real) for cloud, real in zip(points.numpy(), valid.numpy(), strict=True)]
    return torch.from_numpy(np.stack(chosen))


def _farthest(points: NDArray[np.float32], count: int, valid: NDArray[np.bool_]) -> NDArray[np.int64]:
    columns, rows = np.ascontiguousarray(points.T), np.ascontiguousarray(points)[:, :, None]
    distance = np.where(valid, np.float32(np.inf), np.float32(-1.0))
    step, squared = np.empty_like(columns), np.empty_like(distance)
    exact = np.empty((2, len(points)))
    chosen = np.empty(count, dtype=np.int64)
    current = valid.argmax()
    for i in range(count):
        chosen[i] = current
        np.subtract(columns, rows[current], out=step)
        np.multiply(step[0], step[0], out=squared)
        # PyTorch adds y * y and z * z without rounding them before (fused), which double precision does, too.
        np.multiply(step[1:], step[1:], out=exact, dtype=np.float64)
        np.add(squared, exact[0], out=squared, casting="same_kind")
        np.add(squared, exact[1], out=squared, casting="same_kind")
        np.minimum(distance, squared, out=distance)
        current = distance.argmax()
    return chosen


def ball_query(points: Tensor, centres: Tensor, radius: float, count: int, valid: Tensor) -> tuple[Tensor, Tensor]:
    """As :func:`fb3d_rl.geometry.points.ball_query`."""
    clouds, balls = centres.shape[:2]
    index = np.empty((clouds, balls, count), dtype=np.int64)
    mask = np.empty((clouds, balls, count), dtype=np.bool_)
    for b in range(clouds):  # one at a time, so that its distances stay in the cache
        inside = squared_distances(centres[b : b + 1], points[b : b + 1])[0] <= radius * radius
        _first(inside.logical_and_(valid[b]).numpy(), index[b], mask[b])
    return torch.from_numpy(index), torch.from_numpy(mask)


def _first(inside: NDArray[np.bool_], index: NDArray[np.int64], mask: NDArray[np.bool_]) -> None:
    """Write the first K columns of each row of ``inside`` [M, N] that are True to ``index`` and ``mask`` [M, K]."""
    found = np.flatnonzero(inside)  # all points inside, ball by ball
    sizes = np.count_nonzero(inside, axis=1)
    begins = (np.cumsum(sizes) - sizes)[:, None]
    slots = np.arange(index.shape[1])
    np.less(slots, sizes[:, None], out=mask)
    if len(found) == 0:
        index[:] = 0
        return
    places = np.where(mask, begins + slots, np.minimum(begins, len(found) - 1))
    np.subtract(found[places], inside.shape[1] * np.arange(len(inside))[:, None], out=index)
    index[sizes == 0] = 0
