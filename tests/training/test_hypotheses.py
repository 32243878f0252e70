"""The loss of several hypotheses: one winner a part, the others kept alive, probabilities that are learned."""

from __future__ import annotations

import pytest
import torch

from fb3d_rl.models.artflownet import Hypotheses
from fb3d_rl.training.hypotheses import RELAXATION, SCORE_WEIGHT, hypotheses_loss
from fb3d_rl.training.objective import flow_loss


def drawn(hypotheses: int) -> tuple[Hypotheses, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Hypotheses for two clouds of 30 points: links 0 (still), 1 and 2, and padding."""
    generator = torch.Generator().manual_seed(0)
    flows = torch.randn(2, hypotheses, 30, 3, generator=generator)
    scores = torch.randn(2, hypotheses, 30, generator=generator).log_softmax(1)
    target = torch.randn(2, 30, 3, generator=generator)
    link = torch.arange(3).repeat_interleave(10).expand(2, -1)
    target = target.masked_fill((link == 0)[..., None], 0.0)
    valid = torch.ones(2, 30, dtype=torch.bool)
    valid[0, 25:] = False
    return Hypotheses(flows, scores), target, valid, link


def test_one_hypothesis_has_the_usual_loss() -> None:
    found, target, valid, link = drawn(1)
    torch.testing.assert_close(hypotheses_loss(found, target, valid, link), flow_loss(found.flows[:, 0], target, valid))


def test_each_part_of_a_cloud_has_its_own_winner() -> None:
    found, target, valid, link = drawn(3)
    flows = found.flows.clone()
    # Cloud 0: hypothesis 2 is right about link 1, and hypothesis 0 about link 2; cloud 1: hypothesis 1 about both.
    for cloud, part, right in ((0, 1, 2), (0, 2, 0), (1, 1, 1), (1, 2, 1)):
        flows[cloud, right, link[cloud] == part] = target[cloud, link[cloud] == part]
    found = Hypotheses(flows, found.log_probabilities)
    squared = (flows - target[:, None]).square().sum(3)
    expected = torch.zeros(())
    score = torch.zeros(())
    moving = 0
    for cloud in range(2):
        for point in range(30):
            if not valid[cloud, point]:
                continue
            if link[cloud, point] == 0:
                expected = expected + squared[cloud, :, point].mean()
                continue
            right = {(0, 1): 2, (0, 2): 0}.get((cloud, int(link[cloud, point])), 1)
            others = [k for k in range(3) if k != right]
            expected = expected + squared[cloud, others, point].sum() * RELAXATION / 2
            score = score - found.log_probabilities[cloud, right, point]
            moving += 1
    expected = expected / valid.sum() + SCORE_WEIGHT * score / moving
    torch.testing.assert_close(hypotheses_loss(found, target, valid, link), expected)


def test_no_hypothesis_is_left_without_a_gradient() -> None:
    found, target, valid, link = drawn(4)
    flows = found.flows.clone().requires_grad_()
    hypotheses_loss(Hypotheses(flows, found.log_probabilities), target, valid, link).backward()
    assert flows.grad is not None
    per_hypothesis = flows.grad[:, :, 10:25].abs().sum((2, 3))
    assert (per_hypothesis > 0).all()
    assert flows.grad[0, :, 25:].abs().max() == 0, "padding teaches nothing"


def test_what_can_go_either_way_is_learned_as_two_answers_with_their_probabilities() -> None:
    """A part that moves forwards in three of four clouds that look alike, and backwards in the others."""
    target = torch.zeros(8, 5, 3)
    target[:6, :, 0], target[6:, :, 0] = 1.0, -1.0
    valid, link = torch.ones(8, 5, dtype=torch.bool), torch.ones(8, 5, dtype=torch.int64)
    flows = torch.tensor([[0.1, 0.0, 0.0], [-0.1, 0.0, 0.0]], requires_grad=True)
    scores = torch.zeros(2, requires_grad=True)
    optimizer = torch.optim.Adam([flows, scores], lr=0.05)
    for _ in range(400):
        found = Hypotheses(
            flows[None, :, None].expand(8, 2, 5, 3), scores.log_softmax(0)[None, :, None].expand(8, 2, 5)
        )
        optimizer.zero_grad()
        hypotheses_loss(found, target, valid, link).backward()
        optimizer.step()
    assert flows[0, 0] > 0.8 and flows[1, 0] < -0.7
    assert scores.softmax(0)[0].item() == pytest.approx(0.75, abs=0.02)


def test_links_beyond_the_table_count_as_its_last_and_nothing_fails() -> None:
    found, target, valid, link = drawn(3)
    assert hypotheses_loss(found, target, valid, link + 10_000).isfinite()
    # As many parts as there are links in sight, whatever their numbers.
    expected = hypotheses_loss(found, target, valid, link)
    torch.testing.assert_close(hypotheses_loss(found, target, valid, link * 100), expected)
