"""Neighbours of points as Triton kernels: each reads its cloud once and writes the answer, where PyTorch writes and
reads an array of all distances several times.

Of points at the same distance to the last bit, or on the border of a ball, PyTorch may choose others: a GPU rounds sums
of squares once where it can.
"""

from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from fb3d_rl.geometry.farthest_triton import block_of

MOST_CENTRES = 1024
"""Points of a coarse cloud among which the three nearest are looked for."""

QUERIES = 16
"""Points whose three nearest one program finds."""


@triton.jit
def inside_balls(points, valid, centres, index, sizes, squared, n, m, most, block: tl.constexpr, slots: tl.constexpr):  # type: ignore[no-untyped-def]
    """One program for each centre: points [B, n, 3] and centres [B, m, 3] f32, valid [B, n] bool -> index [B, m, most]
    i64 and sizes [B, m] i32; ``block`` >= n, ``slots`` >= most.
    """
    centre = tl.program_id(0).to(tl.int64)
    cloud = centre // m
    place = tl.arange(0, block)
    inside = place < n
    start = points + (cloud * n + place) * 3
    dx = tl.load(start, mask=inside, other=0.0) - tl.load(centres + centre * 3)
    dy = tl.load(start + 1, mask=inside, other=0.0) - tl.load(centres + centre * 3 + 1)
    dz = tl.load(start + 2, mask=inside, other=0.0) - tl.load(centres + centre * 3 + 2)
    real = tl.load(valid + cloud * n + place, mask=inside, other=0).to(tl.int32)
    near = tl.where((dx * dx + dy * dy + dz * dz <= squared) & inside, real, 0)
    rank = tl.cumsum(near, 0)
    size = tl.minimum(tl.sum(near, 0), most)
    first = tl.argmax(near, 0)
    tl.store(sizes + centre, size)
    tl.store(index + centre * most + rank - 1, place.to(tl.int64), mask=(near > 0) & (rank <= most))
    slot = tl.arange(0, slots)
    free = tl.full((slots,), 0, tl.int64) + first.to(tl.int64)
    tl.store(index + centre * most + slot, free, mask=(slot >= size) & (slot < most))


@triton.jit
def nearest(points, valid, queries, index, distance, m, n, block: tl.constexpr, rows: tl.constexpr):  # type: ignore[no-untyped-def]
    """One program for ``rows`` queries: points [B, m, 3] and queries [B, n, 3] f32, valid [B, m] bool -> index i64 and
    squared distance f32 [B, n, 3]; ``block`` >= m.
    """
    cloud = tl.program_id(1).to(tl.int64)
    query = tl.program_id(0) * rows + tl.arange(0, rows)
    asked = query < n
    place = tl.arange(0, block)
    inside = place < m
    start = points + (cloud * m + place) * 3
    here = queries + (cloud * n + query) * 3
    x = tl.load(here, mask=asked, other=0.0)[:, None] - tl.load(start, mask=inside, other=0.0)[None, :]
    y = tl.load(here + 1, mask=asked, other=0.0)[:, None] - tl.load(start + 1, mask=inside, other=0.0)[None, :]
    z = tl.load(here + 2, mask=asked, other=0.0)[:, None] - tl.load(start + 2, mask=inside, other=0.0)[None, :]
    real = tl.load(valid + cloud * m + place, mask=inside, other=0).to(tl.int32)
    squared = tl.where(real[None, :] > 0, x * x + y * y + z * z, float("inf"))
    for k in tl.static_range(3):
        closest = tl.argmin(squared, 1)
        place_out = (cloud * n + query) * 3 + k
        tl.store(index + place_out, closest.to(tl.int64), mask=asked)
        tl.store(distance + place_out, tl.min(squared, 1), mask=asked)
        # Padding stays behind everything else, but what was chosen is not chosen again.
        squared = tl.where(place[None, :] == closest[:, None], float("inf"), squared)


@triton.jit
def largest(rows, index, best, winner, channels, most: tl.constexpr, block: tl.constexpr):  # type: ignore[no-untyped-def]
    """One program for each ball: rows [P, channels] f32, index [Q, most] i64 -> the largest of its rows [Q, channels]
    f32 and whose it is, i64; ``block`` >= channels.
    """
    ball = tl.program_id(0).to(tl.int64)
    channel = tl.arange(0, block)
    inside = channel < channels
    chosen = tl.load(index + ball * most)
    value = tl.load(rows + chosen * channels + channel, mask=inside, other=0.0)
    whose = tl.full((block,), 0, tl.int64) + chosen
    for k in range(1, most):
        row = tl.load(index + ball * most + k)
        other = tl.load(rows + row * channels + channel, mask=inside, other=0.0)
        better = other > value
        value = tl.where(better, other, value)
        whose = tl.where(better, row, whose)
    tl.store(best + ball * channels + channel, value, mask=inside)
    tl.store(winner + ball * channels + channel, whose, mask=inside)


def ball_query(points: Tensor, centres: Tensor, radius: float, count: int, valid: Tensor) -> tuple[Tensor, Tensor]:
    """As :func:`fb3d_rl.geometry.points.ball_query`, of clouds of at most
    :data:`fb3d_rl.geometry.farthest_triton.LARGEST` points.
    """
    clouds, n = valid.shape
    m = centres.shape[1]
    index = torch.empty(clouds, m, count, dtype=torch.int64, device=points.device)
    sizes = torch.empty(clouds, m, dtype=torch.int32, device=points.device)
    block, warps = block_of(n)
    given = (points.float().contiguous(), valid.contiguous(), centres.float().contiguous())
    with torch.cuda.device_of(points):  # Triton launches on the current device, which need not be the points'
        inside_balls[(clouds * m,)](
            *given, index, sizes, radius * radius, n, m, count, block, triton.next_power_of_2(count),
            num_warps=warps,
        )  # fmt: skip
    return index, torch.arange(count, device=points.device) < sizes[..., None]


def three_nearest(points: Tensor, queries: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
    """Squared distances [B, N, 3] and indices [B, N, 3] of the nearest valid points [B, M, 3] of each query [B, N, 3];
    3 <= M <= :data:`MOST_CENTRES`.
    """
    clouds, m = valid.shape
    n = queries.shape[1]
    index = torch.empty(clouds, n, 3, dtype=torch.int64, device=points.device)
    distance = torch.empty(clouds, n, 3, dtype=torch.float32, device=points.device)
    given = (points.float().contiguous(), valid.contiguous(), queries.float().contiguous())
    with torch.cuda.device_of(points):
        nearest[(triton.cdiv(n, QUERIES), clouds)](
            *given, index, distance, m, n, triton.next_power_of_2(m), QUERIES, num_warps=4
        )
    return distance.to(points.dtype), index


def largest_rows(rows: Tensor, index: Tensor) -> Tensor:
    """Maximum [Q, C] of the rows [P, C] at index [Q, K]. Its gradient adds up in no fixed order."""
    best: Tensor = _LargestRows.apply(rows, index)
    return best


class _LargestRows(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, rows: Tensor, index: Tensor) -> Tensor:
        balls, most = index.shape
        channels = rows.shape[1]
        best = torch.empty(balls, channels, dtype=torch.float32, device=rows.device)
        winner = torch.empty(balls, channels, dtype=torch.int64, device=rows.device)
        block = triton.next_power_of_2(channels)
        with torch.cuda.device_of(rows):
            largest[(balls,)](
                rows.float().contiguous(), index.contiguous(), best, winner, channels, most, block,
                num_warps=min(4, max(1, block // 32)),
            )  # fmt: skip
        ctx.save_for_backward(winner)
        ctx.rows = len(rows)
        return best.to(rows.dtype)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        (winner,) = ctx.saved_tensors
        return gradient.new_zeros(ctx.rows, gradient.shape[1]).scatter_add_(0, winner, gradient), None
