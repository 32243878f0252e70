"""Point operations on padded batches of clouds: sampling, neighbours, gathering, PCA curvature.

Shapes: B clouds, N points each, M centres, K neighbours. ``valid`` is False on padding: a padding point is
never sampled, grouped or interpolated from. All runs on CPU and CUDA in shapes that do not depend on the points, and
gives the same bits every time on a CPU. It is plain PyTorch but for sampling and neighbours: with NumPy on a CPU
(:mod:`fb3d_rl.geometry.points_cpu`), with Triton on CUDA (:mod:`fb3d_rl.geometry.farthest_triton`,
:mod:`fb3d_rl.geometry.neighbors_triton`).
"""

from __future__ import annotations

from functools import cache
from importlib.util import find_spec
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional


def _all_valid(points: Tensor, valid: Tensor | None) -> Tensor:
    return torch.ones(points.shape[:2], dtype=torch.bool, device=points.device) if valid is None else valid


@cache
def has_triton() -> bool:
    """PyTorch brings Triton along for CUDA on Linux only."""
    return find_spec("triton") is not None


def squared_distances(points: Tensor, others: Tensor) -> Tensor:
    """Squared distances (m^2) between points [B, N, 3] and others [B, M, 3] -> [B, N, M].

    Differences are squared directly: the shorter |a|^2 - 2ab + |b|^2 loses digits on close points.
    """
    own, other = points.mT.contiguous()[..., None], others.mT.contiguous()[:, :, None]
    total = (own[:, 0] - other[:, 0]).square_()
    for axis in (1, 2):
        total += (own[:, axis] - other[:, axis]).square_()
    return total


@torch.no_grad()
def farthest_point_sample(points: Tensor, count: int, valid: Tensor | None = None) -> Tensor:
    """Pick ``count`` points that cover each cloud (Eldar et al. 1997).

    Deterministic: starts at the first valid point, and of equally far points the lower index wins. Where a cloud has
    fewer than ``count`` distinct valid points, valid points repeat; a cloud with none gives index 0.

    Args:
        points: [B, N, 3].
        count: how many to pick.
        valid: [B, N] bool, or None for all.

    Returns:
        Indices [B, count], int64. The first m of them are the answer to ``count=m``.
    """
    valid = _all_valid(points, valid)
    if points.is_cuda and has_triton():
        from fb3d_rl.geometry import farthest_triton

        if points.shape[1] <= farthest_triton.LARGEST:
            return farthest_triton.farthest_point_sample(points, count, valid)
    if points.device.type == "cpu":
        from fb3d_rl.geometry import points_cpu

        if len(points) <= points_cpu.FEW and points.dtype == torch.float32:
            return points_cpu.farthest_point_sample(points, count, valid)
    return _farthest_plain(points, count, valid)


def _farthest_plain(points: Tensor, count: int, valid: Tensor) -> Tensor:
    coordinates = points.permute(2, 0, 1).contiguous()
    distance = torch.full(points.shape[:2], torch.inf, device=points.device, dtype=points.dtype)
    distance.masked_fill_(~valid, -1.0)
    chosen = torch.empty(points.shape[0], count, dtype=torch.int64, device=points.device)
    current = valid.to(torch.uint8).argmax(1, keepdim=True)
    scratch, step = torch.empty_like(distance), torch.empty_like(distance)
    for i in range(count):
        chosen[:, i : i + 1] = current
        for axis, values in enumerate(coordinates):
            torch.sub(values, values.gather(1, current), out=step)
            if axis == 0:
                torch.mul(step, step, out=scratch)
            else:
                scratch.addcmul_(step, step)
        torch.minimum(distance, scratch, out=distance)
        current = distance.argmax(1, keepdim=True)
    return chosen


@torch.no_grad()
def ball_query(
    points: Tensor, centres: Tensor, radius: float, count: int, valid: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """The first ``count`` valid points, by index, within ``radius`` of each centre.

    Clouds come in random order, so the first by index are an unbiased sample of an overfull ball; keeping the
    nearest, or those first in a search tree, shrinks or skews the neighbourhood.

    Args:
        points: [B, N, 3].
        centres: [B, M, 3], same frame.
        radius: in the unit of the points, inclusive.
        count: K, the most neighbours kept.
        valid: [B, N] bool, or None for all.

    Returns:
        Indices [B, M, K] int64 and a mask [B, M, K] that is True on real neighbours, which come first.
        Free slots hold the ball's first neighbour (0 where the ball is empty).
    """
    valid = _all_valid(points, valid)
    if points.is_cuda and has_triton():
        from fb3d_rl.geometry import farthest_triton, neighbors_triton

        if points.shape[1] <= farthest_triton.LARGEST:
            return neighbors_triton.ball_query(points, centres, radius, count, valid)
    if points.device.type == "cpu":
        from fb3d_rl.geometry import points_cpu

        return points_cpu.ball_query(points, centres, radius, count, valid)
    return _balls_plain(points, centres, radius, count, valid)


def _balls_plain(points: Tensor, centres: Tensor, radius: float, count: int, valid: Tensor) -> tuple[Tensor, Tensor]:
    inside = (squared_distances(centres, points) <= radius * radius) & valid[:, None]
    inside_so_far = torch.cumsum(inside, 2, dtype=torch.int32)
    # The k-th neighbour is the point at which the number of points inside first reaches k.
    rank = torch.arange(1, count + 1, dtype=torch.int32, device=points.device).repeat(*centres.shape[:2], 1)
    mask = rank <= inside_so_far[..., -1:]
    index = torch.searchsorted(inside_so_far, rank)
    first = index[..., :1] * mask[..., :1]
    return torch.where(mask, index, first), mask


@torch.no_grad()
def knn(points: Tensor, queries: Tensor, count: int, valid: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """The ``count`` nearest valid points of each query, nearest first.

    Args:
        points: [B, N, 3], searched.
        queries: [B, M, 3].
        count: K. Where a cloud has fewer valid points, the last slots have an infinite distance.
        valid: [B, N] bool, or None for all.

    Returns:
        Squared distances [B, M, K] and indices [B, M, K]; with N < K, K shrinks to N.
    """
    valid = _all_valid(points, valid)
    count = min(count, points.shape[1])
    shape = (*queries.shape[:2], count)
    distance = torch.empty(shape, dtype=points.dtype, device=points.device)
    index = torch.empty(shape, dtype=torch.int64, device=points.device)
    on_cpu = points.device.type == "cpu"
    size, whole = (1 if on_cpu else len(points)), on_cpu and bool(valid.all())  # elsewhere asking would wait
    for start in range(0, len(points), size):
        part = slice(start, start + size)
        squared = squared_distances(queries[part], points[part])
        if not whole:
            squared.masked_fill_(~valid[part, None], torch.inf)
        distance[part], index[part] = squared.topk(count, dim=2, largest=False)
    return distance, index


@torch.no_grad()
def three_nn(points: Tensor, queries: Tensor, valid: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Indices and inverse-squared-distance weights for interpolation (PointNet++, section 3.4, k = 3, p = 2).

    Args:
        points: [B, N, 3], interpolated from.
        queries: [B, M, 3].
        valid: [B, N] bool, or None for all.

    Returns:
        Indices [B, M, 3] and weights [B, M, 3] that sum to 1 (0 in a cloud without valid points); fewer than
        three columns where N < 3.
    """
    squared, index = _three_nearest(points, queries, _all_valid(points, valid))
    weight = squared.clamp_(min=1e-16).reciprocal_()
    return index, weight / weight.sum(2, keepdim=True).clamp_(min=torch.finfo(weight.dtype).tiny)


def _three_nearest(points: Tensor, queries: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
    if points.is_cuda and has_triton():
        from fb3d_rl.geometry import neighbors_triton

        if 3 <= points.shape[1] <= neighbors_triton.MOST_CENTRES:
            return neighbors_triton.three_nearest(points, queries, valid)
    return knn(points, queries, 3, valid)


def gather(values: Tensor, index: Tensor) -> Tensor:
    """Rows of values [B, N, C] at index [B, ...] -> [B, ..., C]."""
    cloud = torch.arange(len(values), device=values.device).view(-1, *[1] * (index.dim() - 1))
    return values[cloud, index]


def take_rows(rows: Tensor, index: Tensor) -> Tensor:
    """Rows [P, C] at index [...] -> [..., C]. Its gradient adds up in a fixed order, unlike that of
    ``rows[index]``.
    """
    return functional.embedding(index, rows)


def weighted_rows(rows: Tensor, index: Tensor, weight: Tensor) -> Tensor:
    """Sums [Q, C] of the rows [P, C] at index [Q, K], weighted [Q, K]. The gradient's sums have no order on a GPU."""
    sums: Tensor = _WeightedRows.apply(rows, index, weight)
    return sums


class _WeightedRows(torch.autograd.Function):
    """Column by column of the index: no array has all [Q, K, C] rows."""

    @staticmethod
    def forward(ctx: Any, rows: Tensor, index: Tensor, weight: Tensor) -> Tensor:
        """See :func:`weighted_rows`."""
        weight = weight.to(rows.dtype)
        ctx.save_for_backward(index, weight)
        ctx.rows = len(rows)
        total = rows.index_select(0, index[:, 0]) * weight[:, :1]
        for k in range(1, index.shape[1]):
            total.addcmul_(rows.index_select(0, index[:, k]), weight[:, k : k + 1])
        return total

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        """Each row's share of the gradients of the sums that it is in."""
        index, weight = ctx.saved_tensors
        total = gradient.new_zeros(ctx.rows, gradient.shape[1])
        for k in range(index.shape[1]):
            total.index_add_(0, index[:, k], gradient * weight[:, k : k + 1])
        return total, None, None


def pca_curvature(
    points: Tensor, nearest: tuple[Tensor, Tensor], valid: Tensor | None = None, viewpoint: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Surface variation and normals from the covariance of each point's nearest neighbours (Pauly et al.
    2002).

    Args:
        points: [B, N, 3].
        nearest: each point's nearest valid points, itself included, which make the covariance, as :func:`knn` finds
            them.
        valid: [B, N] bool, or None for all.
        viewpoint: [B, 3] in the points' frame; normals are turned towards it. None leaves their sign open.

    Returns:
        Curvature [B, N], the least eigenvalue over the sum of the three: 0 on a plane, at most 1/3; and unit
        normals [B, N, 3]. Both are 0 on padding.
    """
    valid = _all_valid(points, valid)
    squared, index = nearest
    weight = squared.isfinite().to(points.dtype)[..., None]
    local = gather(points, index)
    total = weight.sum(2, keepdim=True).clamp(min=1.0)
    local = (local - (local * weight).sum(2, keepdim=True) / total) * weight
    values, vectors = torch.linalg.eigh(local.transpose(2, 3) @ local / total)
    values = values.clamp(min=0.0)
    normals = vectors[..., 0]
    if viewpoint is not None:
        away = ((viewpoint[:, None] - points) * normals).sum(2, keepdim=True) < 0
        normals = torch.where(away, -normals, normals)
    curvature = values[..., 0] / values.sum(2).clamp(min=torch.finfo(values.dtype).tiny)
    return curvature * valid, normals * valid[..., None]
