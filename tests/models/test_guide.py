"""What a learner tells of the expert's intention: one of two places, learned as a score for each point."""

from __future__ import annotations

import torch
from torch.nn import functional

from fb3d_rl.models.dense import initialize
from fb3d_rl.models.guide import KEPT, Guide, Hand, Intention, Told

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
    up, phase = torch.tensor([0.0, 0.0, 1.0]).expand(64, 3), torch.arange(64) % 2  # what it feels says the phase
    free = Hand(up, torch.zeros(64, 1), phase[:, None].expand(64, 2).float())
    side = torch.where(first, up, up.roll(1, 1))
    optimizer = torch.optim.Adam(net.parameters(), lr=3e-3)
    for _ in range(150):
        optimizer.zero_grad()
        told = net(points, features, valid, context)
        logits = net.phase_logits(told, contact, side, context, free)
        (told.loss(contact, side).mean() + functional.cross_entropy(logits, phase)).backward()
        optimizer.step()
    with torch.no_grad():
        told = net(points, features, valid, context)
        own, own_side = told.likeliest()
        logits = net.phase_logits(told, own, own_side, context, free)
    off = torch.stack([(own - points[:, k]).norm(dim=-1) for k in (0, 10)]).amin(0)
    assert (off < 0.04).float().mean() > 0.9, "at one of the two places, although the expert goes to either"
    assert torch.equal(logits.argmax(1), phase)
    assert (own_side - up).norm(dim=1).minimum((own_side - up.roll(1, 1)).norm(dim=1)).max() < 1.0


def test_whether_to_approach_depends_on_how_the_hand_stands_to_the_point_that_was_chosen() -> None:
    net, (points, features, valid, context) = guide(), scene(64)
    source = torch.Generator().manual_seed(2)
    side = functional.normalize(torch.randn(64, 3, generator=source), dim=1)
    on_the_line = torch.arange(64) % 2 == 0
    contact = -0.1 * side + torch.where(on_the_line[:, None], 0.0, 0.1) * side.roll(1, 1)
    optimizer = torch.optim.Adam(net.parameters(), lr=3e-3)
    for _ in range(200):
        optimizer.zero_grad()
        told = net(points, features, valid, context)
        logits = net.phase_logits(told, contact, side, context, Hand(side, torch.zeros(64, 1), torch.zeros(64, 2)))
        functional.cross_entropy(logits, on_the_line.long()).backward()
        optimizer.step()
    assert (logits.argmax(1) == on_the_line).float().mean() > 0.95, "the cloud says nothing about it"
    hand = Hand(side, torch.zeros(64, 1), torch.zeros(64, 2))
    other = net.phase_logits(net(points.flip(0), features, valid, context + 1.0), contact, side, context + 1.0, hand)
    assert torch.equal(other, net.phase_logits(told, contact, side, context, hand)), "and neither does its own motion"


def test_only_the_part_is_touched_and_what_is_not_there_never() -> None:
    net, (points, features, valid, context) = guide(), scene(4)
    told = net(points, features, valid, context)
    assert bool((told.scores.argmax(1) < 20).all()) and bool((told.scores[:, 20:] == -1e9).all())
    valid[:, :20] = False
    told = net(points, features, valid, context)  # no point of the part is left: any of the others
    off = (told.points - told.likeliest()[0][:, None]).norm(dim=-1)
    assert bool((told.scores.argmax(1) >= 20).all()) and bool((off[:, 20:].amin(1) < 0.1).all())


def test_a_point_is_doubted_when_another_is_much_likelier_than_what_is_near_it() -> None:
    points = torch.tensor([[[0.0, 0, 0], [1.0, 0, 0], [2.0, 0, 0]]])
    told = Told(points, torch.tensor([[0.0, KEPT - 0.1, -1e9]]), torch.zeros(1, 3, 3), torch.zeros(1, 2))
    first, last = torch.tensor([[0.1, 0, 0]]), torch.tensor([[2.1, 0, 0]])
    assert not told.doubts(first).item()
    assert not told.doubts(last).item(), "the nearest that can be touched is the likeliest"
    assert told._replace(scores=torch.tensor([[0.0, KEPT + 0.1, -1e9]])).doubts(first).item()


def test_words_are_in_the_frame_of_the_approach_line_and_end_with_the_hold() -> None:
    net = guide(phase=False)
    axis = functional.normalize(torch.tensor([[1.0, 2.0, 2.0]]), dim=1)
    intention = Intention(-0.3 * axis + 0.02 * torch.tensor([[0.0, 1.0, -1.0]]), axis, torch.eye(PHASES)[:1])
    free, held = (
        net.words(intention, Hand(axis.roll(1, 1), torch.tensor([[x]]), torch.zeros(1, 2))) for x in (0.0, 1.0)
    )
    assert free.shape == (1, net.size) and not held.any()
    ahead, aside, turn, near = free[0, 12], free[0, 13:16], free[0, 16:19], free[0, 19:]
    assert torch.allclose(ahead, torch.tensor(0.3)), "so far in front of the point"
    assert torch.allclose(aside, -0.02 * torch.tensor([0.0, 1.0, -1.0]), atol=1e-6)
    angle = torch.tensor(8 / 9).acos()
    assert torch.allclose(turn.norm(), angle, atol=1e-5)
    wanted = [-0.02 * 2**0.5 / scale for scale in net.OFF_LINE] + [-angle / scale for scale in net.TURNS]
    assert torch.allclose(near, torch.tensor(wanted).exp(), atol=1e-5)
    both = guide()
    assert torch.equal(
        both.words(intention, Hand(axis, torch.ones(1, 1), torch.zeros(1, 2)))[0, -PHASES:], intention.phase[0]
    ), "phases stay"


def test_what_is_told_turns_with_the_points() -> None:
    told = Told(torch.rand(2, 6, 3), torch.randn(2, 6), torch.randn(2, 6, 3), torch.randn(2, PHASES))
    turn = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    turned = told._replace(points=told.points @ turn.T, standoff=told.standoff @ turn.T)
    for one, other in zip(turned.likeliest(), told.likeliest(), strict=True):
        assert torch.allclose(one, other @ turn.T, atol=1e-6)
