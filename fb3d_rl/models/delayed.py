"""A faster PointNet++: features are computed once per point and only then pooled in balls (delayed aggregation, Feng et
al., "Mesorasi", MICRO 2020).

    N points -> 20 % of them, balls of 0.2 m -> 25 % of those, balls of 0.4 m -> one vector for the cloud, and back by
    the three nearest, as in :mod:`fb3d_rl.models.pointnet2`, with narrower layers.

PointNet++ runs its layers on every (centre, neighbour) pair, about 45 a centre. Here the layers run on single points,
in the cloud's frame. The one thing that needs a pair is the offset p_j - c_i, and as the last map before the maximum is
linear, its part of a centre leaves the maximum: max_j (W h_j + V (p_j - c_i)) = max_j (W h_j + V p_j) - V c_i.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

from fb3d_rl.geometry import points as ops
from fb3d_rl.models.dense import DenseLayer, DenseMLP, eager
from fb3d_rl.models.pointnet2 import FeaturePropagation, GlobalAbstraction, Level, PointwiseNet, map_with_position

# A warning of every process; tests cover what is used here.
warnings.filterwarnings("ignore", message="Sparse CSR tensor support is in beta state")


class PooledAbstraction(nn.Module):
    """Layers on every point, the maximum over each centre's ball, layers on every centre.

    Args:
        inputs: feature channels of the fine points.
        before: widths of the layers on points; what the last one's linear map yields is pooled.
        after: widths of the layers on centres.
        ratio: centres for each point.
        radius: of the balls, m.
        neighbors: points kept in a ball.
    """

    def __init__(
        self, inputs: int, before: Sequence[int], after: Sequence[int], ratio: float, radius: float, neighbors: int
    ) -> None:
        super().__init__()
        *widths, pooled = before
        self.before = DenseMLP(inputs + 3, *widths)
        self.pooled = DenseLayer(widths[-1] + 3, pooled)
        self.after = DenseMLP(pooled, *after)
        self.ratio, self.radius, self.neighbors = ratio, radius, neighbors

    def forward(self, features: Tensor | None, fine: Level) -> tuple[Tensor, Tensor, Level]:
        """Features [P, inputs] (None if inputs = 0) of the fine points -> theirs [P, before[-2]], those of the coarse
        points [Q, after[-1]], and these points.
        """
        points = fine.flat(fine.points)
        first, *others = self.before
        own = first.activate(map_with_position(first, features, points), fine.present)
        for layer in others:
            own = layer(own, fine.present)
        coarse, index, mask = fine.balls(self.ratio, self.radius, self.neighbors)
        best = pooled_max(map_with_position(self.pooled, own, points), index, mask)
        best = best - map_with_position(self.pooled, None, coarse.flat(coarse.points))
        return own, self.after(self.pooled.activate(best, coarse.present), coarse.present), coarse


@eager
def pooled_max(rows: Tensor, index: Tensor, mask: Tensor) -> Tensor:
    """Maximum of rows [P, C] over each ball, index [Q, K] of which mask [Q, K] is real (the first of a ball always), ->
    [Q, C].
    """
    if rows.is_cuda and ops.has_triton():
        from fb3d_rl.geometry.neighbors_triton import largest_rows

        return largest_rows(rows, index)  # what the free slots hold is in the ball, too
    if rows.device.type != "cpu":
        return ops.take_rows(rows, index).amax(1)
    # A product with a sparse matrix of ones whose sums are maxima: no [Q, K, C] array.
    starts = functional.pad(mask.sum(1).cumsum(0), (1, 0))
    ones = torch.ones(int(starts[-1]), dtype=rows.dtype)
    balls = torch.sparse_csr_tensor(starts, index[mask], ones, (len(index), len(rows)), check_invariants=False)
    return torch.sparse.mm(balls, rows, "amax")


class DelayedPointNet2(PointwiseNet):
    """See the module; arguments as of :class:`fb3d_rl.models.pointnet2.PointNet2`."""

    FIXED_SHAPES = True

    def __init__(self, inputs: int = 0, outputs: int = 3, neighbors: int = 64) -> None:
        super().__init__(outputs)
        self.sa1 = PooledAbstraction(inputs, (32, 64, 64), (128, 128), 0.2, 0.2, neighbors)
        self.sa2 = PooledAbstraction(128, (128, 256), (256,), 0.25, 0.4, neighbors)
        self.sa3 = GlobalAbstraction(256, (256, 512))
        self.fp3 = FeaturePropagation(512, 256, (256, 256))
        self.fp2 = FeaturePropagation(256, 128, (128, 128))
        self.fp1 = FeaturePropagation(128, 64, (64, 64))
        self.head = nn.Sequential(DenseMLP(64, 64), nn.Linear(64, outputs))

    def rows(self, features: Tensor | None, cloud: Level) -> Tensor:
        """See the base class."""
        own, fine, level1 = self.sa1(features, cloud)
        _, middle, level2 = self.sa2(fine, level1)
        whole = self.sa3(middle, level2)
        middle = self.fp3(whole, None, middle, level2)
        fine = self.fp2(middle, level2, fine, level1)
        layers, last = self.head
        rows: Tensor = last(layers(self.fp1(fine, level1, own, cloud), cloud.present))
        return rows
