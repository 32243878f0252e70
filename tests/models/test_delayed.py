from __future__ import annotations

import pytest
import torch

from fb3d_rl.models.delayed import DelayedPointNet2, map_with_position, pooled_max
from fb3d_rl.models.dense import DenseLayer, initialize


def balls(seed: int, count: int, points: int, most: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Neighbours [count, most] and which are real; the free slots repeat the first."""
    generator = torch.Generator().manual_seed(seed)
    size = torch.randint(1, most + 1, (count, 1), generator=generator)
    mask = torch.arange(most) < size
    index = torch.randint(points, (count, most), generator=generator)
    return torch.where(mask, index, index[:, :1]), mask


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_maximum_over_balls_is_that_of_a_gather(dtype: torch.dtype) -> None:
    index, mask = balls(0, 30, 50, 7)
    rows = torch.randn(50, 5, generator=torch.Generator().manual_seed(1)).to(dtype).requires_grad_()
    weight = torch.randn(30, 5, generator=torch.Generator().manual_seed(2)).to(dtype)
    expected = rows[index].amax(1)
    assert torch.equal(pooled_max(rows, index, mask), expected)
    # Where a point is twice in a ball it gets the gradient once.
    (of_gather,) = torch.autograd.grad((expected * weight).sum(), rows)
    (of_pool,) = torch.autograd.grad((pooled_max(rows, index, mask) * weight).sum(), rows)
    torch.testing.assert_close(of_pool, of_gather)


def test_autocast_leaves_places_exact() -> None:
    """In bfloat16, 1.234 m is 1.2344 and 0.567 m 0.5664."""
    layer = DenseLayer(3, 8)
    points = torch.tensor([[1.234, 0.567, -0.321]])
    exact = map_with_position(layer, None, points)
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(map_with_position(layer, None, points), exact)
        assert not torch.equal(layer.linear(points).float(), exact)


def test_a_network_in_fixed_shapes_is_the_same_network() -> None:
    """Where padding has rows, too, it has no part in outputs, gradients or statistics."""
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(3, 150, 3, generator=generator, dtype=torch.float64)
    valid = torch.arange(150) < torch.tensor([[150], [90], [20]])
    features = torch.rand(3, 150, 1, generator=generator, dtype=torch.float64)
    points[1, 90:], features[2, 20:] = 7.0, -3.0  # what padding holds
    weight = torch.randn(3, 150, 3, generator=generator, dtype=torch.float64)
    found = []
    for fixed in (False, True):
        net = DelayedPointNet2(inputs=1, neighbors=16)
        initialize(net, torch.Generator().manual_seed(1))
        net.double().train().fixed_shapes = fixed
        output = net(points, valid, features)
        assert (output[~valid] == 0).all()
        (output * weight).sum().backward()
        gradients = {name: value.grad for name, value in net.named_parameters()}
        found.append({"output": output} | gradients | dict(net.named_buffers()))
    assert found[0].keys() == found[1].keys()
    for name, expected in found[0].items():
        torch.testing.assert_close(found[1][name], expected, msg=name)
