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

FIRST = 8
"""Points that are chosen one by one: each of the first changes what is far as a whole."""

CANDIDATES = 128
"""Points among which several are chosen in a row."""


def farthest_point_sample(points: Tensor, count: int, valid: Tensor) -> Tensor:
    """As :func:`fb3d_rl.geometry.points.farthest_point_sample`, of float32 points."""
    chosen = [_farthest(cloud, count, real) for cloud, real in zip(points, valid, strict=True)]
    return torch.from_numpy(np.stack(chosen))


def _farthest(points: Tensor, count: int, valid: Tensor) -> NDArray[np.int64]:
    """Of one cloud [N, 3].

    Candidates are the ``CANDIDATES`` points that are the farthest from all chosen ones. It chooses among these alone as
    long as the farthest of them is farther than any other point was, since distances only become smaller. So what is
    done with all points is done for many choices at once; most of its time would be that of the calls.
    """
    columns = points.T.contiguous()
    nearest = torch.where(valid, torch.inf, -1.0)  # from each point to the nearest chosen one
    distance, chosen, done = nearest.numpy(), np.empty(count, dtype=np.int64), 0
    while done < count:
        bound, candidates = np.float32(-1.0), np.array([valid.numpy().argmax() if done == 0 else distance.argmax()])
        if done >= FIRST:
            if len(distance) > CANDIDATES:
                bound = np.partition(distance, -CANDIDATES)[-CANDIDATES]
            candidates = above if len(above := np.flatnonzero(distance > bound)) else candidates
        own, rows = distance[candidates], columns[:, candidates]
        between, begun, best = _between(rows, rows).numpy(), done, own.argmax()
        while True:
            chosen[done], done = best, done + 1
            np.minimum(own, between[best], out=own)
            best = own.argmax()
            if done == count or own[best] <= bound or len(own) == 1:
                break
        chosen[begun:done] = candidates[chosen[begun:done]]
        torch.minimum(nearest, _between(columns[:, chosen[begun:done]], columns).amin(0), out=nearest)
    return chosen


def _between(points: Tensor, others: Tensor) -> Tensor:
    """Squared distances [M, N] between points [3, M] and others [3, N], rounded as PyTorch's sampling rounds them."""
    step = points[0][:, None] - others[0]
    total = step * step
    for axis in (1, 2):
        torch.sub(points[axis][:, None], others[axis], out=step)
        total.addcmul_(step, step)
    return total


def ball_query(points: Tensor, centres: Tensor, radius: float, count: int, valid: Tensor) -> tuple[Tensor, Tensor]:
    """As :func:`fb3d_rl.geometry.points.ball_query`."""
    clouds, balls = centres.shape[:2]
    index = np.empty((clouds, balls, count), dtype=np.int64)
    mask = np.empty((clouds, balls, count), dtype=np.bool_)
    for b in range(clouds):  # one at a time, so that its distances stay in the cache
        inside = squared_distances(centres[b : b + 1], points[b : b + 1])[0].numpy() <= radius * radius
        if not valid[b].all():
            inside &= valid[b].numpy()
        _first(inside, index[b], mask[b])
    return torch.from_numpy(index), torch.from_numpy(mask)


def _first(inside: NDArray[np.bool_], index: NDArray[np.int64], mask: NDArray[np.bool_]) -> None:
    """Write the first K columns of each row of ``inside`` [M, N] that are True to ``index`` and ``mask`` [M, K]."""
    found = np.flatnonzero(inside)  # all points inside, ball by ball
    balls, size = inside.shape
    bounds = np.searchsorted(found, size * np.arange(balls + 1))  # where each ball's points begin
    sizes, begins = np.diff(bounds), bounds[:-1, None]
    slots = np.arange(index.shape[1])
    np.less(slots, sizes[:, None], out=mask)
    if len(found) == 0:
        index[:] = 0
        return
    places = np.where(mask, begins + slots, np.minimum(begins, len(found) - 1))
    np.subtract(found[places], size * np.arange(balls)[:, None], out=index)
    index[sizes == 0] = 0
