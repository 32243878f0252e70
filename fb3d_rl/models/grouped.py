"""The inside of a set abstraction: three layers on every (centre, neighbour) pair and the maximum over each
ball.

A batch has about a million pairs. Run layer by layer, 64 to 256 channels of them stream through memory a
dozen times. Here they are cut into blocks of a few thousand pairs that stay in the cache, and the backward
pass is written out:
    - balls are sorted by size, so that a block is a dense [balls, K, C] array with next to no empty slots;
    - the last layer's pre-activations are never stored: its batch statistics follow from the second moment of
      its inputs, and only the winner of each maximum has a gradient of its own, the rest share a closed form
      (see ``backward``).

Pairs e = (point j, centre i) have h1 = U_j - V_i, x1 = relu(bn1(h1)), y2 = W2 x1, x2 = relu(bn2(y2)), y3 = W3
x2, and the ball's output is relu(bn3(y3)) at its maximum. Batch norm is monotone in each channel, so that the
maximum may be taken of s y3 with s = sign(gamma3), before the statistics are known.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from fb3d_rl.models.dense import DenseMLP, eager

_BLOCK_ROWS = 4096  # x 64 to 256 channels x 4 bytes: a few blocks fit in two cores' caches


class Block(NamedTuple):
    """Balls that are worked on together as a dense [balls, width, C] array.

    Attributes:
        here: the balls' sorted places.
        part: their slots.
        balls: number of balls.
        width: slots of each.
        full: no slot is a repeat.
    """

    here: slice
    part: slice
    balls: int
    width: int
    full: bool


@dataclass
class Grouping:
    """Which points lie in which balls, laid out for blockwise work. Balls are sorted by size, largest first.

    Attributes:
        points: P, the number of points.
        order: [Q] the ball at each sorted place.
        ball_size: [Q] f32 real neighbours of each ball, at least 1: a centre lies in its own ball.
        ball_start: [Q] each ball's first slot.
        source: [R] the point in each slot.
        weight: [R] f32: 1, or 0 on a slot that repeats a point only to fill a block.
        blocks: how the balls are cut up.
        pairs: number of weights that are 1.
    """

    points: int
    order: Tensor
    ball_size: Tensor
    ball_start: Tensor
    source: Tensor
    weight: Tensor
    blocks: list[Block]
    pairs: int

    # What only a gradient needs is made when it is asked for.

    @cached_property
    def owner(self) -> Tensor:
        """[R] the sorted place of each slot's ball."""
        slots = torch.arange(len(self.source), device=self.source.device)
        return torch.searchsorted(self.ball_start, slots, right=True) - 1

    @cached_property
    def _sorted(self) -> tuple[Tensor, Tensor]:
        by_value, by_point = self.source.sort(stable=True)
        return by_point, torch.searchsorted(by_value, torch.arange(self.points, device=by_value.device))

    @property
    def by_point(self) -> Tensor:
        """[R] slots sorted by their point."""
        return self._sorted[0]

    @property
    def point_start(self) -> Tensor:
        """[P] where each point's slots begin in by_point."""
        return self._sorted[1]

    def weigh(self, rows: Tensor, block: Block) -> Tensor:
        """Rows [slots, C] of a block with repeated slots set to 0."""
        return rows if block.full else rows * self.weight[block.part, None]

    def sum_by_point(self, table: Tensor, slots: Tensor | None = None, weight: Tensor | None = None) -> Tensor:
        """Sum rows of a table over the slots of each point: table row = slot, or ``slots[slot]``."""
        if _at_once(table):
            rows = table if slots is None else table[slots]
            rows = rows if weight is None else rows * weight[:, None].to(table.dtype)
            return table.new_zeros(self.points, table.shape[1]).index_add_(0, self.source, rows)
        index = self.by_point if slots is None else slots[self.by_point]
        share = None if weight is None else weight[self.by_point].to(table.dtype)
        return functional.embedding_bag(index, table, self.point_start, mode="sum", per_sample_weights=share)

    def sum_by_ball(self, table: Tensor) -> Tensor:
        """Sum rows of a table, one for each point, over the real points of each ball -> [Q, C]."""
        if _at_once(table):
            (block,) = self.blocks
            return self.weigh(table[self.source], block).view(block.balls, block.width, -1).sum(1)
        return functional.embedding_bag(self.source, table, self.ball_start, mode="sum", per_sample_weights=self.weight)


def _at_once(rows: Tensor) -> bool:
    """Whether all balls are one block: a GPU has no cache to stay in, and adds where embedding_bag would gather."""
    return rows.is_cuda


def make_grouping(index: Tensor, mask: Tensor, points: int) -> Grouping:
    """Lay out the neighbours index [Q, K] (rows of points), real where mask [Q, K] (first in each row, at
    least one).
    """
    device = index.device
    ball_size, order = mask.sum(1).sort(descending=True, stable=True)
    index, mask = index[order], mask[order]
    sizes = ball_size.tolist()
    block_rows = index.numel() if _at_once(index) else _BLOCK_ROWS
    blocks, sources, weights, starts = [], [], [], []
    first = slot = 0
    while first < len(sizes):
        width = sizes[first]
        balls = min(max(1, block_rows // width), len(sizes) - first)
        here, part = slice(first, first + balls), slice(slot, slot + balls * width)
        blocks.append(Block(here, part, balls, width, sizes[first + balls - 1] == width))
        sources.append(index[here, :width].flatten())
        weights.append(mask[here, :width].flatten().float())
        starts.append(slot + torch.arange(balls, device=device) * width)
        first, slot = first + balls, slot + balls * width
    return Grouping(
        points, order, ball_size.float(), torch.cat(starts), torch.cat(sources), torch.cat(weights), blocks, sum(sizes)
    )


def _fold(mean: Tensor, inverse: Tensor, norm_weight: Tensor, norm_bias: Tensor) -> tuple[Tensor, Tensor]:
    """Batch norm as scale and shift."""
    scale = norm_weight * inverse
    return scale, norm_bias - mean * scale


class _GroupedMax(torch.autograd.Function):
    """Training-mode forward and backward. Returns the output, and mean and biased variance of the three
    layers.
    """

    @staticmethod
    def forward(  # noqa: PLR0913 - autograd needs every tensor as an argument of its own
        ctx: Any, u: Tensor, v: Tensor, group: Grouping, eps: float,
        g1: Tensor, b1: Tensor, w2: Tensor, g2: Tensor, b2: Tensor, w3: Tensor, g3: Tensor, b3: Tensor,
    ) -> tuple[Tensor, ...]:  # fmt: skip
        """U [P, C1], V [Q, C1], then scale and shift of bn1; W2, bn2; W3, bn3 -> [Q, C3] and statistics."""
        pairs, weight = group.pairs, group.weight
        v = v[group.order]
        # Layer 1: the statistics of U_j - V_i from sums over points and centres only.
        ball_size = group.ball_size[:, None]
        point_size = group.sum_by_point(weight[:, None])
        near_points = group.sum_by_ball(u)
        ud, vd = u.double(), v.double()
        mean1 = ((point_size * ud).sum(0) - (ball_size * vd).sum(0)) / pairs
        square = (point_size * ud * ud).sum(0) + (vd * (ball_size * vd - 2 * near_points)).sum(0)
        var1 = (square / pairs - mean1 * mean1).clamp_(min=0)
        mean1, var1 = mean1.float(), var1.float()
        inv1 = (var1 + eps).rsqrt()
        scale1, shift1 = _fold(mean1, inv1, g1, b1)
        u1, v1 = u * scale1 + shift1, v * scale1

        # Layer 2: stored, with its statistics.
        y2 = u.new_empty(len(weight), w2.shape[0])
        total, square = (u.new_zeros(w2.shape[0], dtype=torch.float64) for _ in range(2))
        for block, x1 in _first_layer(group, u1, v1):
            y = torch.mm(x1, w2.T, out=y2[block.part])
            weighted = group.weigh(y, block)
            total += weighted.sum(0)
            square += (weighted * y).sum(0)
        mean2 = total / pairs
        var2 = (square / pairs - mean2 * mean2).clamp_(min=0).float()
        mean2 = mean2.float()
        inv2 = (var2 + eps).rsqrt()
        scale2, shift2 = _fold(mean2, inv2, g2, b2)

        # Layer 3: its maximum, and the first and second moments of its inputs.
        sign = torch.where(g3 < 0, -1.0, 1.0)
        w3s = w3 * sign[:, None]
        best = u.new_empty(len(v), w3.shape[0])
        winner = torch.empty(len(v), w3.shape[0], dtype=torch.int64, device=u.device)
        moment1 = u.new_zeros(w3.shape[1], dtype=torch.float64)
        moment2 = u.new_zeros(w3.shape[1], w3.shape[1], dtype=torch.float64)
        for block in group.blocks:
            x2 = torch.addcmul(shift2, y2[block.part], scale2).relu_()
            y3 = (x2 @ w3s.T).view(block.balls, block.width, -1)
            best[block.here], place = _largest(y3)
            winner[block.here] = place + group.ball_start[block.here, None]
            weighted = group.weigh(x2, block)
            moment1 += weighted.sum(0)
            moment2 += weighted.T @ x2
        moment1 /= pairs
        moment2 = moment2 / pairs
        w3d = w3s.double()
        mean3 = w3d @ moment1
        var3 = ((w3d @ (moment2 - torch.outer(moment1, moment1))) * w3d).sum(1).clamp_(min=0).float()
        mean3 = mean3.float()
        inv3 = (var3 + eps).rsqrt()
        normal = (best - mean3) * inv3
        output = torch.empty_like(best)
        output[group.order] = torch.addcmul(b3, normal, g3.abs()).relu_()

        ctx.group = group
        ctx.save_for_backward(
            u, v, near_points, point_size, y2, winner, normal, output,
            mean1, inv1, scale1, shift1, g2, mean2, inv2, scale2, shift2, w2,
            sign, w3s, g3, mean3, inv3, moment1.float(), moment2.float(),
        )  # fmt: skip
        statistics = (mean1, var1, mean2, var2, mean3 * sign, var3)
        ctx.mark_non_differentiable(*statistics)
        return output, *statistics

    @staticmethod
    def backward(ctx: Any, gradient: Tensor, *_: Tensor) -> tuple[Tensor | None, ...]:
        """The chain rule through the three layers.

        Batch norm's gradient is scale * (dz - mean(dz) - xhat mean(dz xhat)). In layer 3, dz is not zero at
        the winners only, and xhat is affine in x2: what is not sparse is one small matrix applied to x2.
        """
        group = ctx.group
        (u, v, near_points, point_size, y2, winner, normal, output,
         mean1, inv1, scale1, shift1, g2, mean2, inv2, scale2, shift2, w2,
         sign, w3s, g3, mean3, inv3, moment1, moment2) = ctx.saved_tensors  # fmt: skip
        pairs, weight, ball_size = group.pairs, group.weight, group.ball_size[:, None]
        gradient = (gradient * (output > 0))[group.order]

        # Layer 3.
        d_b3 = gradient.sum(0)
        d_g3 = (gradient * normal).sum(0)
        scale3 = g3.abs() * inv3
        slope = scale3 * d_g3 * inv3 / pairs
        level = scale3 * d_b3 / pairs - slope * mean3
        sparse = gradient * scale3
        w3_slope = w3s * slope[:, None]
        dense = w3s.T @ w3_slope
        dense_shift = level @ w3s
        d_w3 = -(torch.outer(level, moment1) + w3_slope @ moment2) * pairs
        dz = _behind_winners(winner, sparse, w3s, len(weight))
        d_b2, d_g2 = (u.new_zeros(w2.shape[0], dtype=torch.float64) for _ in range(2))
        for block in group.blocks:
            x2 = torch.addcmul(shift2, y2[block.part], scale2).relu_()
            d_w3 += _with_winners(winner[block.here] - block.part.start, sparse[block.here], x2)
            d = dz[block.part]
            d -= group.weigh(torch.addmm(dense_shift, x2, dense), block)
            _mask_by_relu(d, x2)
            d_b2 += d.sum(0)
            d_g2 += (d * y2[block.part]).sum(0)
        d_b2, d_g2 = d_b2.float(), ((d_g2 - mean2 * d_b2) * inv2).float()

        # Layer 2; dz becomes the gradient behind layer 1's ReLU.
        slope = d_g2 * inv2 / pairs
        level = d_b2 / pairs - slope * mean2
        d_w2 = torch.zeros_like(w2)
        w2_scaled = w2 * scale2[:, None]
        from_centre = torch.empty_like(v)
        dz1 = dz if w2.shape[0] == w2.shape[1] else u.new_empty(len(weight), w2.shape[1])
        for block, x1 in _first_layer(group, u * scale1 + shift1, v * scale1):
            dy = dz[block.part] - group.weigh(torch.addcmul(level, y2[block.part], slope), block)
            d_w2.addmm_(dy.T, x1)
            d = torch.mm(dy, w2_scaled, out=dz1[block.part])
            _mask_by_relu(d, x1)
            torch.sum(d.view(block.balls, block.width, -1), 1, out=from_centre[block.here])
        d_w2 *= scale2[:, None]

        # Layer 1, by sums over points and centres only.
        from_point = group.sum_by_point(dz1)
        near_centres = group.sum_by_point(v, group.owner, weight)
        d_b1 = from_centre.sum(0)
        d_g1 = ((u * from_point).sum(0) - (v * from_centre).sum(0) - mean1 * d_b1) * inv1
        slope = d_g1 * inv1 / pairs
        level = d_b1 / pairs - slope * mean1
        d_u = scale1 * (from_point - point_size * level - slope * (point_size * u - near_centres))
        d_v = torch.empty_like(v)
        d_v[group.order] = -scale1 * (from_centre - ball_size * level - slope * (near_points - ball_size * v))
        return d_u, d_v, None, None, d_g1, d_b1, d_w2, d_g2, d_b2, d_w3 * sign[:, None], d_g3 * sign, d_b3


def _first_layer(group: Grouping, u: Tensor, v: Tensor) -> Iterator[tuple[Block, Tensor]]:
    """relu(U_j - V_i) [slots, C] of each block."""
    for block in group.blocks:
        x = u.index_select(0, group.source[block.part]).view(block.balls, block.width, -1)
        x -= v[block.here, None]
        yield block, x.view(block.balls * block.width, -1).relu_()


def _largest(values: Tensor) -> tuple[Tensor, Tensor]:
    """Maximum [Q, C] of values [Q, K, C] over K, and where it is [Q, C]: first on a CPU. Overwrites the values.

    The indices of ``torch.max`` over a middle dimension take six times as long on a CPU.
    """
    if _at_once(values):
        best, place = values.max(1)
        return best, place
    maximum, width = values.amax(1), values.shape[1]
    countdown = torch.arange(width, 0, -1, device=values.device, dtype=values.dtype)[:, None]
    values -= maximum[:, None]
    torch.add(countdown, values, alpha=1e38, out=values)  # any difference but 0 outweighs the place
    return maximum, width - values.amax(1).long().clamp_(1, width)


def _behind_winners(winner: Tensor, gradient: Tensor, weights: Tensor, slots: int) -> Tensor:
    """Gradient [slots, C2] of the last layer's inputs from that of its maxima [Q, C3], of which ``winner`` names the
    slots; weights [C3, C2].
    """
    if _at_once(gradient):
        return gradient.new_zeros(slots, gradient.shape[1]).scatter_(0, winner, gradient) @ weights
    order = winner.flatten().sort(stable=True).indices
    won = winner.flatten().bincount(minlength=slots)
    return functional.embedding_bag(
        order % weights.shape[0], weights, won.cumsum(0) - won, mode="sum",
        per_sample_weights=gradient.flatten()[order],
    )  # fmt: skip


def _with_winners(winner: Tensor, gradient: Tensor, inputs: Tensor) -> Tensor:
    """Gradient [C3, C2] of the last layer's weights from that of its maxima [Q, C3]; inputs [slots, C2]."""
    if _at_once(gradient):
        return gradient.new_zeros(len(inputs), gradient.shape[1]).scatter_(0, winner, gradient).T @ inputs
    return functional.embedding_bag(
        winner.T.contiguous(), inputs, mode="sum", per_sample_weights=gradient.T.contiguous()
    )


def _mask_by_relu(gradient: Tensor, activation: Tensor) -> None:
    """Set the gradient to 0 where the activation is 0, in place."""
    torch.ops.aten.threshold_backward.grad_input(gradient, activation, 0, grad_input=gradient)


@eager
def grouped_max(u: Tensor, v: Tensor, group: Grouping, layers: DenseMLP) -> Tensor:
    """Maximum over each ball of the layers' output.

    Args:
        u: [P, C1] the first linear map of every point.
        v: [Q, C1] the first linear map of every centre's position, to be subtracted.
        group: the balls.
        layers: three dense layers; the first one's linear map is in u and v already.

    Returns:
        [Q, C3].
    """
    first, second, third = layers
    if first.training:
        output, *statistics = _GroupedMax.apply(
            u, v, group, first.norm.eps, first.norm.weight, first.norm.bias,
            second.linear.weight, second.norm.weight, second.norm.bias,
            third.linear.weight, third.norm.weight, third.norm.bias,
        )  # fmt: skip
        for layer, mean, variance in zip(layers, statistics[::2], statistics[1::2], strict=True):
            layer.track(mean, variance, group.pairs)
        return output
    # Evaluation: batch norm is a fixed scale and shift, which is folded into the linear maps.
    (scale1, shift1), (scale2, shift2), (scale3, shift3) = (layer.fixed_norm() for layer in layers)
    w2, w3 = second.linear.weight * scale2[:, None], third.linear.weight * scale3[:, None]
    best = []
    blocks = _first_layer(group, u * scale1 + shift1, (v * scale1)[group.order])
    for block, x1 in blocks:
        x2 = torch.addmm(shift2, x1, w2.T).relu_()
        best.append(torch.addmm(shift3, x2, w3.T).view(block.balls, block.width, -1).amax(1).relu_())
    return torch.cat(best)[group.order.argsort()]
