"""ArtFlowNet in dense operations of fixed shapes: for torch.export, and as a plain reference implementation."""

from __future__ import annotations

import io
import math
from pathlib import Path

import torch
from torch import Tensor, nn

from fb3d_rl.errors import UserError
from fb3d_rl.files import write_bytes
from fb3d_rl.models.artflownet import ArtFlowNet
from fb3d_rl.models.delayed import DelayedPointNet2, PooledAbstraction
from fb3d_rl.models.dense import DenseLayer, DenseMLP
from fb3d_rl.models.pointnet2 import FeaturePropagation, SetAbstraction


class DenseArtFlowNet(nn.Module):
    """What an :class:`ArtFlowNet` answers in evaluation mode, to rounding; it shares the network's weights.

    Shapes:
        points [B, N, 3] f32, m, all of them there; part_mask [B, N] bool -> flow [B, N, 3] f32.
    """

    def __init__(self, net: ArtFlowNet) -> None:
        super().__init__()
        self.net = net.eval()

    def forward(self, points: Tensor, part_mask: Tensor) -> Tensor:
        """See the class."""
        network = self.net.network
        points = points - points.mean(1, keepdim=True)
        own = part_mask[..., None].to(points.dtype) if self.net.part_mask_input else None
        if isinstance(network, DelayedPointNet2):
            own, fine, points1 = _pool(network.sa1, own, points)
            _, middle, points2 = _pool(network.sa2, fine, points1)
        else:
            fine, points1 = _abstract(network.sa1, own, points)
            middle, points2 = _abstract(network.sa2, fine, points1)
        whole = _layers(network.sa3.layers, torch.cat([middle, points2], -1)).amax(1, keepdim=True)
        middle = _layers(network.fp3.layers, torch.cat([whole.expand(-1, points2.shape[1], -1), middle], -1))
        fine = _propagate(network.fp2, middle, points2, fine, points1)
        rows = _propagate(network.fp1, fine, points1, own, points)
        dense, last = network.head
        assert isinstance(dense, DenseMLP)
        found = self.net.hypotheses_of(last(_layers(dense, rows)))
        return self.net.most_probable(found, torch.ones_like(part_mask), part_mask)


def export(net: ArtFlowNet, path: Path, points: int) -> None:
    """Write the network for clouds of ``points`` points and any batch size as a torch.export program, .pt2.

    Raises:
        UserError: there are too few points.
    """
    if points < 16:
        raise UserError(f"A program for clouds of {points} points makes no sense: give 16 or more.")
    example = (torch.rand(2, points, 3), torch.zeros(2, points, dtype=torch.bool))
    batch = {0: torch.export.Dim("batch")}
    program = torch.export.export(DenseArtFlowNet(net), example, dynamic_shapes=(batch, batch))
    content = io.BytesIO()  # a full disk ends the whole process where torch writes to it itself
    torch.export.save(program, content)
    write_bytes(path, content.getbuffer())


def _abstract(layer: SetAbstraction, features: Tensor | None, points: Tensor) -> tuple[Tensor, Tensor]:
    """The set abstraction's features [B, M, C] and centres [B, M, 3]."""
    centres, near = _balls(layer, points)
    rows = _gather(points, near) - centres[:, :, None]
    if features is not None:
        rows = torch.cat([_gather(features, near), rows], -1)
    return _layers(layer.layers, rows).amax(2), centres


def _pool(layer: PooledAbstraction, features: Tensor | None, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The points' features [B, N, C], the centres' [B, M, C'] and the centres [B, M, 3]."""
    own = _layers(layer.before, points if features is None else torch.cat([features, points], -1))
    centres, near = _balls(layer, points)
    rows = _gather(own, near), _gather(points, near) - centres[:, :, None]
    best = _activate(layer.pooled, layer.pooled.linear(torch.cat(rows, -1)).amax(2))
    return own, _layers(layer.after, best), centres


def _balls(layer: SetAbstraction | PooledAbstraction, points: Tensor) -> tuple[Tensor, Tensor]:
    """Centres [B, M, 3] and the neighbours of each [B, M, K]."""
    centres = _gather(points, _farthest(points, math.ceil(points.shape[1] * layer.ratio)))
    # The first neighbours by index: the largest of falling numbers.
    inside = _squared(centres, points) <= layer.radius * layer.radius
    falling = torch.arange(points.shape[1], 0, -1, device=points.device)
    rank, near = torch.where(inside, falling, 0).topk(min(layer.neighbors, points.shape[1]))
    return centres, torch.where(rank > 0, near, near[..., :1])  # a repeat changes no maximum


def _propagate(
    layer: FeaturePropagation, features: Tensor, coarse: Tensor, skip: Tensor | None, fine: Tensor
) -> Tensor:
    squared, near = _squared(fine, coarse).topk(min(3, coarse.shape[1]), largest=False)
    weight = squared.clamp(min=1e-16).reciprocal()
    weight = weight / weight.sum(-1, keepdim=True)
    rows = (_gather(features, near) * weight[..., None]).sum(2)
    return _layers(layer.layers, rows if skip is None else torch.cat([rows, skip], -1))


def _layers(layers: DenseMLP, rows: Tensor) -> Tensor:
    for layer in layers:
        rows = _layer(layer, rows)
    return rows


def _layer(layer: DenseLayer, rows: Tensor) -> Tensor:
    return _activate(layer, layer.linear(rows))


def _activate(layer: DenseLayer, rows: Tensor) -> Tensor:
    scale, shift = layer.fixed_norm()
    return (rows * scale + shift).relu()


def _farthest(points: Tensor, count: int) -> Tensor:
    """Indices [B, count] of farthest points, from the first on."""
    chosen = [torch.zeros_like(points[:, 0, 0], dtype=torch.int64)]
    distance = torch.full_like(points[..., 0], torch.inf)
    for _ in range(count - 1):
        last = points.gather(1, chosen[-1][:, None, None].expand(-1, 1, 3))
        distance = torch.minimum(distance, (points - last).square().sum(-1))
        chosen.append(distance.argmax(1))
    return torch.stack(chosen, 1)


def _squared(a: Tensor, b: Tensor) -> Tensor:
    """Squared distances [B, N, M] between a [B, N, 3] and b [B, M, 3]."""
    return (a[:, :, None] - b[:, None]).square().sum(-1)


def _gather(values: Tensor, index: Tensor) -> Tensor:
    """Rows of values [B, N, C] at index [B, ...] -> [B, ..., C]."""
    flat = index.flatten(1)
    rows = values.gather(1, flat[..., None].expand(-1, -1, values.shape[-1]))
    return rows.view(*index.shape, values.shape[-1])
