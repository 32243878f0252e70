"""A training step as a CUDA graph against the same step without it."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from fb3d_rl.models.artflownet import ArtFlowNet
from fb3d_rl.training.graph import GraphedLoss
from fb3d_rl.training.objective import cloud_loss, flow_objective
from fb3d_rl.training.options import FitOptions


def clouds(device: str) -> TensorDict:
    generator = torch.Generator().manual_seed(0)
    valid = torch.arange(200) < torch.tensor([[200], [150], [40]])
    rows = {
        "observation": {
            "points": torch.rand(3, 200, 3, generator=generator),
            "valid": valid,
            "part_mask": valid & (torch.arange(200) % 3 > 0),
        },
        "privileged": {
            "flow": torch.randn(3, 200, 3, generator=generator),
            "link": torch.arange(200, dtype=torch.int16).expand(3, -1) % 4,
        },
    }
    return TensorDict(rows, batch_size=[3]).to(device)


def test_a_cpu_has_no_graph() -> None:
    net = ArtFlowNet(backbone="delayed", generator=torch.Generator().manual_seed(0)).train()
    options = FitOptions(steps=1, batch_size=3, rotate=False)
    loss = flow_objective(net, options)(clouds("cpu"), 0)
    assert loss.requires_grad and not net.network.fixed_shapes


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("hypotheses", [1, 3])
def test_a_graph_has_the_loss_and_the_gradients_of_its_steps(hypotheses: int) -> None:
    generator = torch.Generator().manual_seed(0)
    options = FitOptions(steps=1, batch_size=3, rotate=False)
    net = ArtFlowNet(backbone="delayed", generator=generator, hypotheses=hypotheses).cuda().train()
    other = ArtFlowNet(backbone="delayed", hypotheses=hypotheses).cuda().train()
    other.load_state_dict(net.state_dict())
    graph, plain = GraphedLoss(net, cloud_loss(net, options)), cloud_loss(other, options)
    for step in range(3):
        rows = clouds("cuda")
        rows["observation", "points"] *= 1.0 + 0.1 * step
        value = graph(rows)
        expected = plain(rows)
        other.zero_grad()
        expected.backward()
        torch.testing.assert_close(value, expected.detach(), rtol=1e-4, atol=1e-5)
        for (name, mine), theirs in zip(net.named_parameters(), other.parameters(), strict=True):
            torch.testing.assert_close(mine.grad, theirs.grad, rtol=1e-2, atol=1e-4, msg=name)
    for mine, theirs in zip(net.buffers(), other.buffers(), strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-4, atol=1e-5)
