from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from fb3d_rl.models.artflownet import ArtFlowNet, artflownet_module


def make_net(part_mask_input: bool = True) -> ArtFlowNet:
    """A network whose batch norms have seen data."""
    net = ArtFlowNet(part_mask_input, neighbors=16, generator=torch.Generator().manual_seed(0))
    for module in net.modules():
        if isinstance(module, torch.nn.BatchNorm1d):
            module.momentum = 1.0  # take the statistics of one batch as they are
    net(*make_batch(1))
    return net


def make_batch(seed: int = 0) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    points = torch.rand(3, 80, 3, generator=generator)
    valid = torch.rand(3, 80, generator=generator) < 0.8
    return points, valid, (points[..., 2] > 0.5) & valid


@pytest.mark.parametrize("training", [False, True])
def test_padding_changes_nothing(training: bool) -> None:
    net = make_net().train(training)
    points, valid, mask = make_batch()
    clean = points.masked_fill(~valid[..., None], 0.0)
    expected = net(clean, valid, mask)
    dirty = points.masked_fill(~valid[..., None], torch.nan)
    more = torch.nn.functional.pad(dirty, (0, 0, 0, 25), value=7.0)
    output = net(more, torch.nn.functional.pad(valid, (0, 25)), torch.nn.functional.pad(mask, (0, 25), value=True))
    assert torch.equal(output[:, 80:], torch.zeros(3, 25, 3))
    torch.testing.assert_close(output[:, :80], expected, atol=1e-5, rtol=1e-5)
    assert expected[~valid].abs().max() == 0
    assert expected[valid].abs().min() > 0


def test_moving_the_scene_changes_nothing_but_scaling_does() -> None:
    net = make_net().eval()
    points, valid, mask = make_batch()
    expected = net(points, valid, mask)
    # A shift by a power of two keeps the differences of coordinates.
    torch.testing.assert_close(net(points + 0.5, valid, mask), expected, atol=1e-3, rtol=1e-3)
    assert not torch.allclose(net(points * 1.5, valid, mask), expected, atol=1e-2)


def test_clouds_of_a_batch_do_not_mix_in_evaluation() -> None:
    net = make_net().eval()
    points, valid, mask = make_batch()
    together = net(points, valid, mask)
    alone = torch.cat([net(points[i : i + 1], valid[i : i + 1], mask[i : i + 1]) for i in range(3)])
    torch.testing.assert_close(alone, together, atol=1e-4, rtol=1e-4)


def test_part_mask_is_read_only_if_asked_for() -> None:
    points, valid, mask = make_batch()
    for used in (True, False):
        net = make_net(part_mask_input=used).eval()
        assert torch.equal(net(points, valid, mask), net(points, valid, ~mask)) is not used


def test_empty_clouds_give_zeros() -> None:
    points, valid, mask = make_batch()
    valid[1] = False
    for net in (make_net().train(), make_net().eval()):
        output = net(points, valid, mask)
        assert output.isfinite().all()
        assert output[1].abs().max() == 0
        assert net(points, torch.zeros_like(valid), mask).abs().max() == 0


def test_every_parameter_learns_and_module_has_the_contract_keys() -> None:
    module = artflownet_module(make_net())
    points, valid, mask = make_batch()
    td = TensorDict({"observation": {"points": points, "valid": valid, "part_mask": mask}}, batch_size=[3])
    module(td)["prediction", "flow"].square().sum().backward()
    for name, parameter in module.named_parameters():
        assert parameter.grad is not None and parameter.grad.abs().max() > 0, name
    assert module.in_keys == [("observation", key) for key in ("points", "valid", "part_mask")]
    assert module.out_keys == [("prediction", "flow")]


def test_widths_are_those_of_pointnet2() -> None:
    shapes = [tuple(p.shape) for n, p in ArtFlowNet().named_parameters() if n.endswith("weight") and p.dim() == 2]
    assert shapes == [
        (64, 4), (64, 64), (128, 64),
        (128, 131), (128, 128), (256, 128),
        (256, 259), (512, 256), (1024, 512),
        (256, 1280), (256, 256),
        (256, 384), (128, 256),
        (128, 129), (128, 128), (128, 128),
        (128, 128), (128, 128), (3, 128),
    ]  # fmt: skip
