"""PointNet++ (Qi et al. 2017) for one output vector per point, in plain PyTorch.

    N points -> SA1: 20 % of them, balls of 0.2 m, MLP 64-64-128
             -> SA2: 25 % of those, balls of 0.4 m, MLP 128-128-256
             -> SA3: one vector for the cloud, MLP 256-512-1024
    and back: FP3 256-256 (copied), FP2 256-128 and FP1 128-128-128 (3 nearest, inverse squared distance)
             -> head 128-128-outputs

Every MLP layer is linear, batch norm, ReLU. Geometry works on padded clouds [B, N, 3] with a mask; features
live in flat rows [P, C], one row for each *valid* point of the batch, so that padding reaches neither batch
norm nor a maximum.

What makes it fast without a compiled extension, all of it exact:
    - a layer on neighbours relative to a centre is linear: W(p - c) = Wp - Wc is computed per point and per
      centre, not per pair; a layer on interpolated features commutes with the interpolation in the same way;
    - the layers inside a ball run in blocks that fit a cache, and forward and backward share one function.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from fb3d_rl.geometry import points as ops
from fb3d_rl.models.dense import DenseLayer, DenseMLP, eager
from fb3d_rl.models.grouped import Grouping, grouped_max, make_grouping


@dataclass
class Level:
    """The points of one resolution.

    Attributes:
        points: [B, N, 3] m.
        valid: [B, N] bool.
        row: [B, N] the point's row among all valid points of the batch; on padding, of some other point.
        total: P, the number of rows.
        farthest: the points come in the order of farthest point sampling.
        present: [B, 1, N] f32, 0 on padding, if each point has a row, so that no shape depends on the clouds; None if
            only the valid ones have.
    """

    points: Tensor
    valid: Tensor
    row: Tensor
    total: int
    farthest: bool = False
    present: Tensor | None = None

    @classmethod
    @eager
    def of(cls, points: Tensor, valid: Tensor, farthest: bool = False, fixed: bool = False) -> Level:
        """Number the valid points, or with ``fixed`` all of them."""
        if fixed:
            row = torch.arange(valid.numel(), device=valid.device).view_as(valid)
            return cls(points, valid, row, valid.numel(), farthest, valid[:, None].to(points.dtype))
        row = valid.flatten().cumsum(0).view_as(valid)
        return cls(points, valid, (row - 1).clamp_(min=0), int(row[-1, -1]), farthest)

    @eager
    def flat(self, values: Tensor) -> Tensor:
        """Values [B, N, ...] -> [P, ...]."""
        return values.flatten(0, 1) if self.total == self.valid.numel() else values[self.valid]

    @eager
    def padded(self, rows: Tensor) -> Tensor:
        """Rows [P, C] -> [B, N, C], 0 on padding."""
        if self.present is not None:
            return rows.view(*self.valid.shape, -1).masked_fill(~self.valid[..., None], 0.0)
        if self.total == self.valid.numel():
            return rows.view(*self.valid.shape, -1)
        output = rows.new_zeros(*self.valid.shape, rows.shape[1])
        output[self.valid] = rows
        return output

    def coarser(self, ratio: float) -> Level:
        """Farthest points, ceil(ratio * number of valid points) of each cloud."""
        most = -int(-ratio * self.valid.shape[1] // 1)
        if self.farthest:  # the first of them are what sampling them again would choose
            points = self.points[:, :most]
        else:
            points = ops.gather(self.points, ops.farthest_point_sample(self.points, most, self.valid))
        count = torch.ceil(self.valid.sum(1, keepdim=True) * ratio)
        kept = torch.arange(most, device=points.device) < count
        return Level.of(points, kept, farthest=True, fixed=self.present is not None)

    @eager
    @torch.no_grad()
    def balls(self, ratio: float, radius: float, neighbors: int) -> tuple[Level, Tensor, Tensor]:
        """Coarser points, and around each [Q] at most K of these points: their rows [Q, K], real where a mask [Q, K] is
        (first in each row; the other slots repeat the first).
        """
        coarse = self.coarser(ratio)
        index, mask = ops.ball_query(self.points, coarse.points, radius, neighbors, self.valid)
        rows = self.row.gather(1, index.flatten(1)).view_as(index)
        return coarse, coarse.flat(rows), coarse.flat(mask)

    @eager
    @torch.no_grad()
    def nearest(self, fine: Level) -> tuple[Tensor, Tensor]:
        """Rows of the three points that are the nearest to each of the finer points [P', 3], and their weights."""
        index, share = ops.three_nn(self.points, fine.points, self.valid)
        index = self.row.gather(1, index.flatten(1)).view_as(index)
        return fine.flat(index), fine.flat(share)


def map_with_position(layer: DenseLayer, features: Tensor | None, points: Tensor) -> Tensor:
    """The layer's linear map of (features [P, C], points [P, 3]) -> [P, out]; features may be None.

    The points' part is computed in full precision: autocast would round positions to some 4 mm.
    """
    weight = layer.linear.weight
    with torch.autocast(points.device.type, enabled=False):
        rows = points @ weight[:, -3:].T
    return rows if features is None else rows + functional.linear(features, weight[:, :-3])


class SetAbstraction(nn.Module):
    """Gather each centre's ball, run a three-layer MLP on (features, position relative to the centre), take
    the maximum.
    """

    def __init__(self, inputs: int, widths: Sequence[int], ratio: float, radius: float, neighbors: int) -> None:
        super().__init__()
        if len(widths) != 3:
            raise ValueError(f"A set abstraction has three layers, not {len(widths)}.")
        self.layers = DenseMLP(inputs + 3, *widths)
        self.inputs, self.ratio, self.radius, self.neighbors = inputs, ratio, radius, neighbors

    @eager
    @torch.no_grad()
    def group(self, fine: Level) -> tuple[Level, Grouping]:
        """Choose centres and their neighbours; depends on the geometry only."""
        coarse, rows, mask = fine.balls(self.ratio, self.radius, self.neighbors)
        return coarse, make_grouping(rows, mask, fine.total)

    def forward(self, features: Tensor | None, fine: Level) -> tuple[Tensor, Level]:
        """Features [P, inputs] (None if inputs = 0) of the fine points -> [Q, widths[-1]] and the coarse
        points.
        """
        coarse, grouping = self.group(fine)
        first = next(iter(self.layers))
        # Inside the balls all is in the points' precision, under autocast, too.
        with torch.autocast(fine.points.device.type, enabled=False):
            own = None if features is None else features.to(fine.points.dtype)
            of_points = map_with_position(first, own, fine.flat(fine.points))
            of_centres = map_with_position(first, None, coarse.flat(coarse.points))
            return grouped_max(of_points, of_centres, grouping, self.layers), coarse


class GlobalAbstraction(nn.Module):
    """MLP on (features, position), then the maximum over each cloud."""

    def __init__(self, inputs: int, widths: Sequence[int]) -> None:
        super().__init__()
        self.layers = DenseMLP(inputs + 3, *widths)

    def forward(self, features: Tensor, level: Level) -> Tensor:
        """Features [Q, inputs] -> [B, widths[-1]]; 0 for a cloud without points."""
        rows = self.layers(torch.cat([features, level.flat(level.points)], 1), level.present)
        # Features after ReLU are not negative, so that 0 is neutral in the maximum.
        if level.present is not None:
            return level.padded(rows).amax(1)
        return ops.take_rows(rows, level.row).masked_fill(~level.valid[..., None], 0.0).amax(1)


class FeaturePropagation(nn.Module):
    """Interpolate coarse features at finer points, join the finer points' own features, run an MLP."""

    def __init__(self, inputs: int, skip: int, widths: Sequence[int]) -> None:
        super().__init__()
        self.layers = DenseMLP(inputs + skip, *widths)
        self.inputs = inputs

    def forward(self, features: Tensor, coarse: Level | None, skip: Tensor | None, fine: Level) -> Tensor:
        """Carry features to the finer level.

        Args:
            features: [Q, inputs] of the coarse points; [B, inputs], one row a cloud, if coarse is None.
            coarse: the points that the features belong to.
            skip: [P, skip] of the fine points, or None.
            fine: the points to carry to.

        Returns:
            [P, widths[-1]].
        """
        first, *others = self.layers
        weight = first.linear.weight
        rows = features @ weight[:, : self.inputs].T
        if fine.present is not None:
            rows = self._carried(rows, coarse, fine)
        elif coarse is None:
            clouds = torch.arange(len(rows), device=rows.device)[:, None].expand_as(fine.valid)
            rows = ops.take_rows(rows, fine.flat(clouds))
        else:
            index, share = coarse.nearest(fine)
            rows = functional.embedding_bag(index, rows, per_sample_weights=share.to(rows.dtype), mode="sum")
        if skip is not None:
            rows = rows + skip @ weight[:, self.inputs :].T
        rows = first.activate(rows, fine.present)
        for layer in others:
            rows = layer(rows, fine.present)
        return rows

    @staticmethod
    def _carried(rows: Tensor, coarse: Level | None, fine: Level) -> Tensor:
        """Rows of the coarse points at the fine ones, where each point has a row."""
        if coarse is None:
            return rows[:, None].expand(-1, fine.valid.shape[1], -1).flatten(0, 1)
        index, share = coarse.nearest(fine)
        return ops.weighted_rows(rows, index, share)


class PointwiseNet(nn.Module):
    """A network with a vector of ``outputs`` numbers for each point.

    Shapes:
        points [B, N, 3] m, valid [B, N] bool, features [B, N, inputs] or None -> [B, N, outputs], 0 on
        padding.
    """

    FIXED_SHAPES = False
    """Whether it can compute in shapes that do not depend on the clouds, as a CUDA graph needs."""

    def __init__(self, outputs: int) -> None:
        super().__init__()
        self.outputs = outputs
        self.fixed_shapes = False

    def rows(self, features: Tensor | None, cloud: Level) -> Tensor:
        """Features [P, inputs] of the valid points -> [P, outputs]; P > 0."""
        raise NotImplementedError

    def forward(self, points: Tensor, valid: Tensor, features: Tensor | None = None) -> Tensor:
        """See the class."""
        cloud = Level.of(points, valid, fixed=self.fixed_shapes)
        if cloud.total == 0:
            return points.new_zeros(*valid.shape, self.outputs)
        return cloud.padded(self.rows(None if features is None else cloud.flat(features), cloud))


class PointNet2(PointwiseNet):
    """PointNet++ as in the paper; see the module.

    Args:
        inputs: feature channels of each point beside its position.
        outputs: numbers for each point.
        neighbors: points kept in a ball.
    """

    def __init__(self, inputs: int = 0, outputs: int = 3, neighbors: int = 64) -> None:
        super().__init__(outputs)
        self.sa1 = SetAbstraction(inputs, (64, 64, 128), ratio=0.2, radius=0.2, neighbors=neighbors)
        self.sa2 = SetAbstraction(128, (128, 128, 256), ratio=0.25, radius=0.4, neighbors=neighbors)
        self.sa3 = GlobalAbstraction(256, (256, 512, 1024))
        self.fp3 = FeaturePropagation(1024, 256, (256, 256))
        self.fp2 = FeaturePropagation(256, 128, (256, 128))
        self.fp1 = FeaturePropagation(128, inputs, (128, 128, 128))
        self.head = nn.Sequential(DenseMLP(128, 128, 128), nn.Linear(128, outputs))

    def rows(self, features: Tensor | None, cloud: Level) -> Tensor:
        """See the base class."""
        fine, level1 = self.sa1(features, cloud)
        middle, level2 = self.sa2(fine, level1)
        whole = self.sa3(middle, level2)
        middle = self.fp3(whole, None, middle, level2)
        fine = self.fp2(middle, level2, fine, level1)
        rows: Tensor = self.head(self.fp1(fine, level1, features, cloud))
        return rows
