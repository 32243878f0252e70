from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TypeAlias

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from fb3d_rl.errors import UserError
from fb3d_rl.models.artflownet import POINTS, ArtFlowNet, artflownet_module
from fb3d_rl.models.cloud_network import BACKBONES

Maker: TypeAlias = "Callable[..., ArtFlowNet]"


@pytest.fixture(params=list(BACKBONES))
def make_net(request: pytest.FixtureRequest) -> Maker:
    """Makes networks, of each kind, whose batch norms have seen data."""

    def make(part_mask_input: bool = True, neighbors: int = 16, hypotheses: int = 1) -> ArtFlowNet:
        generator = torch.Generator().manual_seed(0)
        net = ArtFlowNet(part_mask_input, neighbors, request.param, generator, hypotheses)
        for module in net.modules():
            if isinstance(module, torch.nn.BatchNorm1d):
                module.momentum = 1.0  # take the statistics of one batch as they are
        net(*make_batch(1))
        return net

    return make


def make_batch(seed: int = 0) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    points = torch.rand(3, 80, 3, generator=generator)
    valid = torch.rand(3, 80, generator=generator) < 0.8
    return points, valid, (points[..., 2] > 0.5) & valid


@pytest.mark.parametrize("training", [False, True])
def test_padding_changes_nothing(make_net: Maker, training: bool) -> None:
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


def test_moving_the_scene_changes_nothing_but_scaling_does(make_net: Maker) -> None:
    net = make_net().eval()
    points, valid, mask = make_batch()
    expected = net(points, valid, mask)
    # A shift by a power of two keeps the differences of coordinates.
    torch.testing.assert_close(net(points + 0.5, valid, mask), expected, atol=1e-3, rtol=1e-3)
    assert not torch.allclose(net(points * 1.5, valid, mask), expected, atol=1e-2)


def test_order_of_points_changes_nothing(make_net: Maker) -> None:
    """Balls here are never overfull. The first point stays where it is: sampling starts there."""
    net = make_net(neighbors=80).eval()
    points, valid, mask = make_batch()
    valid[:, 0] = True
    order = torch.cat([torch.zeros(1, dtype=torch.int64), 1 + torch.randperm(79)])
    mixed = net(points[:, order], valid[:, order], mask[:, order])
    torch.testing.assert_close(mixed, net(points, valid, mask)[:, order], atol=1e-4, rtol=1e-4)


def test_clouds_of_a_batch_do_not_mix_in_evaluation(make_net: Maker) -> None:
    net = make_net().eval()
    points, valid, mask = make_batch()
    together = net(points, valid, mask)
    alone = torch.cat([net(points[i : i + 1], valid[i : i + 1], mask[i : i + 1]) for i in range(3)])
    torch.testing.assert_close(alone, together, atol=1e-4, rtol=1e-4)


def test_part_mask_is_read_only_if_asked_for(make_net: Maker) -> None:
    points, valid, mask = make_batch()
    for used in (True, False):
        net = make_net(part_mask_input=used).eval()
        assert torch.equal(net(points, valid, mask), net(points, valid, ~mask)) is not used


@pytest.mark.parametrize("hypotheses", [1, 3])
def test_where_the_mask_is_optional_none_is_a_mask_of_all_points(tmp_path: Path, hypotheses: int) -> None:
    net = ArtFlowNet(True, 8, "pointnet2", torch.Generator().manual_seed(0), hypotheses, mask_optional=True).eval()
    points, valid, _ = make_batch()
    assert torch.equal(net.propose(points, valid).flows, net.propose(points, valid, valid).flows)
    cloud, everywhere = points[0], torch.ones(len(points[0]), dtype=torch.bool)
    for found, expected in zip(net.predict_all(cloud), net.predict_all(cloud, everywhere), strict=True):
        assert found.shape == expected.shape
    assert net.predict(cloud).abs().max() > 0
    assert ("observation", "part_mask") not in artflownet_module(net, masked=False).in_keys
    assert ("observation", "part_mask") in artflownet_module(net).in_keys
    net.save_pretrained(tmp_path / "net.safetensors")
    again = ArtFlowNet.from_pretrained(tmp_path / "net.safetensors")
    assert torch.equal(again.predict(cloud), net.predict(cloud))
    needy = ArtFlowNet(True, 8, "pointnet2", torch.Generator().manual_seed(0), hypotheses)
    with pytest.raises(UserError, match="give part_mask"):
        needy.predict(cloud)


def test_empty_clouds_give_zeros(make_net: Maker) -> None:
    points, valid, mask = make_batch()
    valid[1] = False
    for net in (make_net().train(), make_net().eval()):
        output = net(points, valid, mask)
        assert output.isfinite().all()
        assert output[1].abs().max() == 0
        assert net(points, torch.zeros_like(valid), mask).abs().max() == 0


def test_every_parameter_learns_and_module_has_the_contract_keys(make_net: Maker) -> None:
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


def test_a_small_cloud_is_predicted_as_it_is(make_net: Maker) -> None:
    net = make_net()
    points, valid, mask = make_batch()
    expected = net.eval()(points[:1], valid[:1], mask[:1])[0].detach()
    net.train()
    missing = points[0].masked_fill(~valid[0, :, None], torch.nan)
    torch.testing.assert_close(net.predict(missing, mask[0]), expected, atol=1e-4, rtol=1e-4)
    assert net.training, "the mode is left as it was"
    array = net.predict(missing.numpy(), mask[0].numpy())
    assert isinstance(array, np.ndarray) and array.dtype == np.float32
    np.testing.assert_allclose(array, expected, atol=1e-4, rtol=1e-4)
    np.testing.assert_array_equal(net.predict(missing.double().numpy(), mask[0]), array)


@pytest.mark.parametrize("count", [0, 1, POINTS, POINTS + 1, 3000])
def test_a_cloud_of_any_size_gets_a_flow_for_each_point(make_net: Maker, count: int) -> None:
    net = make_net()
    points = torch.rand(count, 3, generator=torch.Generator().manual_seed(1))
    mask = points[:, 2] > 0.5
    flow = net.predict(points, mask)
    assert flow.shape == (count, 3) and torch.equal(flow, net.predict(points, mask))
    assert (flow.norm(dim=1) > 0).all()


def test_a_large_cloud_gets_what_its_parts_would(make_net: Maker) -> None:
    """Dealt out at random, so that the flow of a point hardly depends on the cloud's size."""
    net = make_net()
    few = torch.rand(POINTS, 3, generator=torch.Generator().manual_seed(1))
    many = torch.cat([few, torch.rand(2 * POINTS, 3, generator=torch.Generator().manual_seed(2))])
    alone, among = net.predict(few, few[:, 2] > 0.5), net.predict(many, many[:, 2] > 0.5)[:POINTS]
    assert torch.cosine_similarity(alone, among).median() > 0.95


def test_a_huge_cloud_gets_the_flow_of_the_nearest_points_of_a_smaller_one(
    make_net: Maker, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fb3d_rl.models.artflownet.LARGEST", 1500)
    net = make_net()
    points = torch.rand(6000, 3, generator=torch.Generator().manual_seed(1))
    mask = points[:, 2] > 0.5
    drawn = torch.randperm(len(points), generator=torch.Generator().manual_seed(0))[:1500]
    own, flow = net.predict(points[drawn], mask[drawn]), net.predict(points, mask)
    assert torch.equal(flow[drawn], own)
    same_side = mask[:, None] == mask[drawn]
    distance = torch.cdist(points, points[drawn]).masked_fill(~same_side, torch.inf)
    source = (flow[:, None] == own).all(2).float().argmax(1)  # which of the drawn points a flow is that of
    taken = distance.gather(1, source[:, None]).squeeze(1)
    assert taken.isfinite().all(), "no flow crosses the border of the part"
    assert (taken <= distance.amin(1) + 0.02).all(), "it is the nearest one, but for the size of a cell"


def test_a_cloud_in_map_coordinates_gets_what_it_gets_at_the_origin(make_net: Maker) -> None:
    net, points = make_net(), torch.rand(80, 3, generator=torch.Generator().manual_seed(1)).double()
    expected = net.predict(points, points[:, 2] > 0.5)
    moved = points + torch.tensor([3.2e6, 5.4e6, 120.0])
    torch.testing.assert_close(net.predict(moved, points[:, 2] > 0.5), expected, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize(
    ("shape", "mask", "word"),
    [((5, 2), torch.ones(5), "cloud"), ((2, 5, 3), torch.ones(5), "cloud"), ((5, 3), torch.ones(4), "mask"),
     ((5, 3), None, "part_mask")],
)  # fmt: skip
def test_wrong_shapes_are_named(make_net: Maker, shape: tuple[int, ...], mask: torch.Tensor | None, word: str) -> None:
    with pytest.raises(UserError, match=word):
        make_net().predict(torch.zeros(shape), mask)
    assert make_net(part_mask_input=False).predict(torch.rand(5, 3)).shape == (5, 3)


def test_weights_come_back_as_they_were(make_net: Maker, tmp_path: Path) -> None:
    net = make_net().eval()
    net.save_pretrained(tmp_path / "net.safetensors", {"command": "python launch/train.py"})
    again = ArtFlowNet.from_pretrained(tmp_path / "net.safetensors")
    assert not again.training and again.arguments == net.arguments
    assert torch.equal(again(*make_batch()), net(*make_batch()))
    assert [path.name for path in tmp_path.iterdir()] == ["net.safetensors"]


@pytest.mark.parametrize("damage", ["cut", "flip", "text", "pickle", "other", "missing"])
def test_damaged_weights_end_in_one_sentence(make_net: Maker, tmp_path: Path, damage: str) -> None:
    path = tmp_path / "net.safetensors"
    make_net().save_pretrained(path)
    content = bytearray(path.read_bytes())
    if damage == "cut":
        path.write_bytes(content[:-1000])
    elif damage == "flip":
        content[20] ^= 255
        path.write_bytes(content)
    elif damage == "text":
        path.write_text("no weights")
    elif damage == "pickle":
        torch.save({"a": 1}, path)
    elif damage == "other":
        from safetensors.torch import save_file

        save_file({"a": torch.zeros(3)}, path)
    else:
        path.unlink()
    with pytest.raises(UserError, match=r"net\.safetensors"):
        ArtFlowNet.from_pretrained(path)


@pytest.mark.parametrize("masked", [True, False])
def test_the_most_probable_of_several_hypotheses_is_the_answer(make_net: Maker, masked: bool) -> None:
    net = make_net(part_mask_input=masked, hypotheses=3).eval()
    points, valid, mask = make_batch()
    found = net.propose(points, valid, mask)
    assert found.flows.shape == (3, 3, 80, 3) and found.log_probabilities.shape == (3, 3, 80)
    torch.testing.assert_close(found.log_probabilities.exp().sum(1), torch.ones(3, 80))
    answer = net(points, valid, mask)
    if masked:
        best = (found.log_probabilities * mask[:, None]).sum(2).argmax(1)
        assert torch.equal(answer, found.flows[torch.arange(3), best])
    else:
        best = found.log_probabilities.argmax(1)
        for cloud in range(3):
            for point in range(80):
                assert torch.equal(answer[cloud, point], found.flows[cloud, best[cloud, point], point])
    assert answer[~valid].abs().max() == 0


def test_predict_all_orders_the_hypotheses_by_their_probability(make_net: Maker) -> None:
    net = make_net(hypotheses=4).eval()
    points, _, mask = make_batch()
    flows, probabilities = net.predict_all(points[0].numpy(), mask[0].numpy())
    assert isinstance(flows, np.ndarray) and flows.shape == (4, 80, 3) and probabilities.shape == (4,)
    assert probabilities.sum() == pytest.approx(1.0, abs=1e-5) and (np.diff(probabilities) <= 0).all()
    np.testing.assert_array_equal(flows[0], net.predict(points[0].numpy(), mask[0].numpy()))
    large = torch.rand(3 * POINTS, 3)
    flows, probabilities = net.predict_all(large, large[:, 2] > 0.5)
    assert flows.shape == (4, 3 * POINTS, 3) and torch.equal(flows[0], net.predict(large, large[:, 2] > 0.5))
    one = make_net()
    flows, probabilities = one.predict_all(points[0], mask[0])
    assert torch.equal(flows[0], one.predict(points[0], mask[0])) and probabilities.tolist() == [1.0]


def test_hypotheses_are_kept_with_the_weights(make_net: Maker, tmp_path: Path) -> None:
    net = make_net(hypotheses=3).eval()
    net.save_pretrained(tmp_path / "net.safetensors")
    points, valid, mask = make_batch()
    again = ArtFlowNet.from_pretrained(tmp_path / "net.safetensors")
    assert again.hypotheses == 3 and torch.equal(again(points, valid, mask), net(points, valid, mask))
