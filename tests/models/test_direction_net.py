"""The search for the best direction, and what DirectionNet's scores depend on."""

from __future__ import annotations

import torch

from fb3d_rl.geometry.transforms import normalize
from fb3d_rl.models.direction_net import DirectionNet, SearchOptions, best_direction, directions_at

CPU = torch.device("cpu")


def random(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def test_the_maximum_of_a_known_score_is_found() -> None:
    goal = normalize(random(40, 3))

    def score(directions: torch.Tensor) -> torch.Tensor:
        return (directions * goal[:, None]).sum(-1)

    found = best_direction(score, SearchOptions(), CPU)
    torch.testing.assert_close(found.norm(dim=-1), torch.ones(40))
    assert (found * goal).sum(-1).min() > 0.995
    at_random = best_direction(score, SearchOptions(rounds=1, samples=128 * 4), CPU)
    assert (found * goal).sum(-1).mean() > (at_random * goal).sum(-1).mean(), "better than as many draws at random"


def test_the_higher_of_two_peaks_is_found_and_what_was_found_is_kept() -> None:
    high, low = torch.tensor([0.0, 0.0, 1.0]), torch.tensor([0.0, 1.0, 0.0])

    def score(directions: torch.Tensor) -> torch.Tensor:
        return torch.maximum((directions @ high - 0.6) * 2, directions @ low - 0.7)

    found = best_direction(score, SearchOptions(rounds=5), CPU)
    assert found[0] @ high > 0.99
    options = [best_direction(score, SearchOptions(rounds=rounds), CPU) for rounds in (1, 2, 3, 4)]
    scores = [float(score(found[:, None])) for found in options]
    assert scores == sorted(scores)


def test_the_search_repeats_and_depends_on_its_seed_and_not_on_the_batch() -> None:
    goal = normalize(random(3, 3, seed=1))

    def search(goal: torch.Tensor, seed: int = 0) -> torch.Tensor:
        return best_direction(lambda d: (d * goal[:, None]).sum(-1), SearchOptions(seed=seed), CPU)

    assert torch.equal(search(goal), search(goal)) and not torch.equal(search(goal), search(goal, seed=1))
    assert torch.equal(search(goal)[1:2], search(goal[1:2]))


def test_scores_are_of_the_point_and_the_direction() -> None:
    net = DirectionNet(neighbors=16, generator=torch.Generator().manual_seed(0)).eval()
    points, valid = random(2, 80, 3), torch.ones(2, 80, dtype=torch.bool)
    contact, directions = torch.tensor([[3, 7], [7, 3]]), normalize(random(2, 2, 5, 3, seed=1))
    scores = net(points, valid, points[..., 0] > 0, contact, directions)
    assert scores.shape == (2, 2, 5) and len(scores.unique()) == 20
    swapped = net(points, valid, points[..., 0] > 0, contact.flip(1), directions.flip(1))
    torch.testing.assert_close(swapped, scores.flip(1))
    found = directions_at(net, points, valid, points[..., 0] > 0, contact[:, 0], SearchOptions())
    best = net(points, valid, points[..., 0] > 0, contact[:, :1], found[:, None, None])[:, 0, 0]
    anywhere = normalize(random(1, 1, 2000, 3, seed=2)).expand(2, 1, -1, 3)
    assert (best > net(points, valid, points[..., 0] > 0, contact[:, :1], anywhere).amax((1, 2)) - 0.01).all()
