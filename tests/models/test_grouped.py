"""The blockwise set abstraction against one written the obvious way."""

from __future__ import annotations

import pytest
import torch

from fb3d_rl.geometry import points as ops
from fb3d_rl.models import grouped
from fb3d_rl.models.pointnet2 import Level, SetAbstraction


def make_case(inputs: int = 2) -> tuple[SetAbstraction, torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(3)
    points = torch.rand(3, 60, 3, generator=generator)
    valid = torch.rand(3, 60, generator=generator) < 0.8
    features = torch.randn(3, 60, inputs, generator=generator)
    layer = SetAbstraction(inputs, (8, 6, 10), ratio=0.3, radius=0.35, neighbors=7)
    with torch.no_grad():
        for parameter in layer.parameters():
            parameter.copy_(torch.randn(parameter.shape, generator=generator))  # scales of both signs
    return layer, points, valid, features


def naive(layer: SetAbstraction, points: torch.Tensor, valid: torch.Tensor, features: torch.Tensor) -> torch.Tensor:
    """Every cloud, centre and neighbour in turn; batch norm over the list of all pairs."""
    pairs, balls = [], []
    for cloud, inside, own in zip(points, valid, features, strict=True):
        cloud, own = cloud[inside], own[inside]
        for centre in ops.farthest_point_sample(cloud[None], -int(-0.3 * len(cloud) // 1))[0]:
            near = [j for j in range(len(cloud)) if (cloud[j] - cloud[centre]).norm() <= layer.radius]
            near = near[: layer.neighbors]
            pairs += [torch.cat([own[j], cloud[j] - cloud[centre]]) for j in near]
            balls.append(len(near))
    rows = layer.layers(torch.stack(pairs))
    return torch.stack([part.amax(0) for part in rows.split(balls)])


@pytest.mark.parametrize("block_rows", [16, 4096, None])
def test_equals_naive_forward_backward_and_statistics(block_rows: int | None, monkeypatch: pytest.MonkeyPatch) -> None:
    if block_rows is None:  # as on a GPU
        monkeypatch.setattr(grouped, "_at_once", lambda rows: True)
    else:
        monkeypatch.setattr(grouped, "_BLOCK_ROWS", block_rows)
    results = []
    for fast in (True, False):
        layer, points, valid, features = make_case()
        points.requires_grad_(True)
        features.requires_grad_(True)
        if fast:
            level = Level.of(points, valid)
            output, _ = layer(level.flat(features), level)
        else:
            output = naive(layer, points, valid, features)
        (output * torch.randn(output.shape, generator=torch.Generator().manual_seed(1))).sum().backward()
        gradients = {name: p.grad for name, p in layer.named_parameters()} | {"features": features.grad}
        buffers = dict(layer.named_buffers())
        layer.eval()
        with torch.no_grad():
            evaluated = layer(level.flat(features), level)[0] if fast else naive(layer, points, valid, features)
        results.append({"output": output, "evaluated": evaluated} | gradients | buffers)
    assert results[0].keys() == results[1].keys()
    for name, expected in results[1].items():
        scale = expected.abs().max().clamp(min=1.0)
        error = (results[0][name] - expected).abs().max() / scale
        assert error < 1e-5, f"{name}: {error:.1e}"
