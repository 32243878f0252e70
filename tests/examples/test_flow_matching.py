"""The example of a network with a loss of its own: it learns, draws several answers, and repeats."""

from __future__ import annotations

from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor

from fb3d_rl.flow.metrics import flow_metrics
from fb3d_rl.models.artflownet import ArtFlowNet
from fb3d_rl.training.fit import fit
from fb3d_rl.training.options import FitOptions
from tests.examples.flow_matching import FlowMatching

OPTIONS = FitOptions(steps=150, batch_size=16, lr=0.004, seed=0, rotate=False, mirror=False, scale=0.0, jitter=0.0,
                     dropout=0.0, ema=None)  # fmt: skip


def lids(count: int) -> TensorDict:
    """The same plate [count] times, which goes up or down as a whole: nothing shows which way."""
    plate = torch.rand(48, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([0.5, 0.5, 0.02])
    points = plate.repeat(count, 1, 1)
    way = torch.where(torch.arange(count) % 2 == 0, 1.0, -1.0)
    flow = torch.zeros_like(points)
    flow[..., 2] = way[:, None]
    mask = torch.ones(count, 48, dtype=torch.bool)
    observation = {"points": points, "valid": mask, "part_mask": mask}
    privileged = {"flow": flow, "link": torch.zeros(count, 48, dtype=torch.int32)}
    return TensorDict({"observation": observation, "privileged": privileged}, batch_size=[count])


def fitted(kind: type[ArtFlowNet], count: int, options: FitOptions = OPTIONS) -> ArtFlowNet:
    net = kind(neighbors=16, backbone="delayed", generator=torch.Generator().manual_seed(0), hypotheses=count)
    fit(net, lids(64), options, device="cpu", progress=False)
    return net.eval()


def asked(net: ArtFlowNet) -> tuple[Tensor, Tensor]:
    with torch.no_grad():
        points = lids(2)["observation", "points"][0]
        return net.predict_all(points, torch.ones(len(points), dtype=torch.bool))


def test_draws_are_both_ways_where_one_regressed_flow_is_neither() -> None:
    flows, probabilities = asked(fitted(FlowMatching, 8))
    ups = flows[..., 2].mean(1)
    assert (ups > 0.6).any() and (ups < -0.6).any(), "a draw is one of the two ways"
    assert ups.abs().mean() > 0.6, "and not their mean"
    assert torch.isclose(probabilities.sum(), torch.tensor(1.0))
    assert probabilities[0] >= probabilities[-1]
    single, _ = asked(fitted(ArtFlowNet, 1))
    assert single[0, :, 2].mean().abs() < 0.4, "the mean of both ways is the least squares' answer"


def test_the_same_seed_gives_the_same_bits_and_another_one_others() -> None:
    few = FitOptions(**{**OPTIONS.__dict__, "steps": 5})
    first, again = fitted(FlowMatching, 2, few), fitted(FlowMatching, 2, few)
    assert first.digest() == again.digest()
    assert first.digest() != fitted(FlowMatching, 2, FitOptions(**{**few.__dict__, "seed": 1})).digest()


def test_weights_are_read_back(tmp_path: Path) -> None:
    net = fitted(FlowMatching, 2, FitOptions(**{**OPTIONS.__dict__, "steps": 3}))
    net.save_pretrained(tmp_path / "net.safetensors")
    again = FlowMatching.from_pretrained(tmp_path / "net.safetensors")
    assert torch.equal(asked(net)[0], asked(again)[0])
    sample = lids(2)
    numbers = flow_metrics(asked(again)[0][:1], sample["privileged", "flow"][:1], sample["observation", "valid"][:1])
    assert set(numbers) >= {"cosine", "rmse"}
