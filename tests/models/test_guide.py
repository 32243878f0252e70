"""What a learner tells of the expert's intention: one of two places, learned as a score for each point."""

from __future__ import annotations

import torch
from torch.nn import functional

from fb3d_rl.models.dense import initialize
from fb3d_rl.models.guide import Guide, Intention, Told

PHASES = 3


def guide(contact: bool = True, phase: bool = True) -> Guide:
    net = Guide(1, 2, PHASES, 16, contact, phase)
    initialize(net, torch.Generator().manual_seed(0))
    return net


def scene(count: int, seed: int = 0) -> tuple[torch.Tensor, ...]:
    """Clouds of 40 points in which two clumps of 10 are marked; points, features, valid, context."""
    source = torch.Generator().manual_seed(seed)
    points = torch.rand(count, 40, 3, generator=source)
    points[:, :10] = points[:, :1] + 0.01 * torch.randn(count, 10, 3, generator=source)
    points[:, 10:20] = 1.0 - points[:, :10]
    features = torch.zeros(count, 40, 1)
    features[:, :20] = 1.0
    return points, features, torch.ones(count, 40, dtype=torch.bool), torch.zeros(count, 2)


def test_it_chooses_one_of_two_places_and_not_their_mean() -> None:
    net, (points, features, valid, context) = guide(), scene(64)
    first = (torch.rand(64, generator=torch.Generator().manual_seed(1)) < 0.5)[:, None]
    contact = torch.where(first, points[:, 3], points[:, 13])
    up = torch.tensor([0.0, 0.0, 1.0]).expand(64, 3)
    true = Intention(contact, up, functional.one_hot(torch.arange(64) % 2, PHASES).float())
    context[:, 0] = torch.arange(64) % 2  # says the phase
    optimizer = torch.optim.Adam(net.parameters(), lr=3e-3)
    goes = torch.ones(64, dtype=torch.bool)
    for _ in range(150):
        optimizer.zero_grad()
        net(points, features, valid, context).loss(true, goes, contact=True, phase=True).backward()
        optimizer.step()
    with torch.no_grad():
        told = net(points, features, valid, context).intention()
    off = torch.stack([(told.contact - points[:, k]).norm(dim=-1) for k in (0, 10)]).amin(0)
    assert (off < 0.04).float().mean() > 0.9, "at one of the two places, although the expert goes to either"
    assert torch.equal(told.phase.argmax(1), torch.arange(64) % 2)
    assert (told.standoff * up).sum(1).min() > 0.95


def test_points_that_are_not_valid_are_never_chosen_and_situations_without_a_goal_do_not_count() -> None:
    net, (points, features, valid, context) = guide(), scene(4)
    valid[:, :20] = False
    told = net(points, features, valid, context)
    off = (told.points - told.intention().contact[:, None]).norm(dim=-1)
    assert bool((told.scores.argmax(1) >= 20).all()) and bool((off[:, 20:].amin(1) < 0.1).all())
    true = Intention(torch.randn(4, 3), functional.normalize(torch.randn(4, 3), dim=1), torch.eye(PHASES)[[0, 1, 2, 0]])
    goes = torch.tensor([True, False, True, False])
    other = Intention(torch.where(goes[:, None], true.contact, 9.0), true.standoff, true.phase)
    assert torch.equal(told.loss(true, goes, True, True), told.loss(other, goes, True, True))
    assert told.loss(true, goes & False, True, False) == 0.0


def test_words_are_in_the_frame_of_the_approach_line_and_end_with_the_hold() -> None:
    net = guide(phase=False)
    axis = functional.normalize(torch.tensor([[1.0, 2.0, 2.0]]), dim=1)
    intention = Intention(-0.3 * axis + 0.02 * torch.tensor([[0.0, 1.0, -1.0]]), axis, torch.eye(PHASES)[:1])
    free, held = (net.words(intention, torch.tensor([[x]])) for x in (0.0, 1.0))
    assert free.shape == (1, net.size) and not held.any()
    assert torch.allclose(free[0, -4], torch.tensor(0.3)), "so far in front of the point"
    assert torch.allclose(free[0, -3:], -0.02 * torch.tensor([0.0, 1.0, -1.0]), atol=1e-6)
    both = guide()
    assert torch.equal(both.words(intention, torch.ones(1, 1))[0, -PHASES:], intention.phase[0]), "phases stay"


def test_what_is_told_turns_with_the_points() -> None:
    told = Told(torch.rand(2, 6, 3), torch.randn(2, 6), torch.randn(2, 3), torch.randn(2, PHASES))
    turn = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    turned = Told(told.points @ turn.T, told.scores, told.standoff @ turn.T, told.phase).intention()
    assert torch.allclose(turned.contact, told.intention().contact @ turn.T, atol=1e-6)
    assert torch.allclose(turned.standoff, told.intention().standoff @ turn.T, atol=1e-6)
