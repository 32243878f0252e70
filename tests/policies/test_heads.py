"""Every head learns as it should where the expert has two ways, fits a few labels, and leaves out padding."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor, nn

from fb3d_rl.models.bc_losses import mean_of_kept
from fb3d_rl.models.dense import initialize
from fb3d_rl.models.heads import HEADS, Head, make_head
from fb3d_rl.training.draws import generator, global_draws

CHUNK, SIZE = 3, 2


class Toy(nn.Module):
    """A head on a linear encoder of one number."""

    def __init__(self, name: str) -> None:
        super().__init__()
        self.made: Head = make_head(name, CHUNK, SIZE, width=8, components=3, calls=10)
        self.encoder = nn.Sequential(nn.Linear(1, 32), nn.ReLU(), nn.Linear(32, self.made.inputs))
        if self.made.network is not None:
            self.head = self.made.network
        initialize(self, torch.Generator().manual_seed(1))

    def plans(self, situation: Tensor) -> Tensor:
        with torch.no_grad():
            noise = torch.randn(len(situation), self.made.noise, generator=torch.Generator().manual_seed(2))
            return self.made.plan(self.encoder(situation), noise)


def batch(encoded: Tensor, twist: Tensor, pad: Tensor | None = None) -> TensorDict:
    pad = torch.zeros(twist.shape[:2], dtype=torch.bool) if pad is None else pad
    return TensorDict({"encoded": encoded, "twist": twist, "is_pad": pad}, batch_size=[len(twist)])


def trained(name: str, situations: Tensor, plans: Tensor, steps: int = 250, pad: Tensor | None = None) -> Toy:
    toy = Toy(name)
    loss, optimizer = toy.made.loss("l2", kl_weight=10.0), torch.optim.Adam(toy.parameters(), lr=3e-3)
    for step in range(steps):
        with global_draws(generator(0, 1, step), torch.device("cpu")):
            value = loss(batch(toy.encoder(situations), plans, pad))
        optimizer.zero_grad()
        value.backward()
        optimizer.step()
    return toy


@pytest.mark.parametrize("name", HEADS)
def test_where_the_expert_goes_left_or_right_a_head_averages_or_chooses(name: str) -> None:
    way = torch.tensor([1.0, -1.0]).repeat(32)[:, None, None]
    found = trained(name, torch.ones(64, 1), way.expand(64, CHUNK, SIZE)).plans(torch.ones(200, 1))
    between = (found.abs() < 0.5).float().mean()
    if name in ("deterministic", "gaussian", "act"):
        assert between > 0.95, "what goes between two ways hits what stands there"
        return
    assert between < 0.15
    same = (found.flatten(1) > 0).float().mean(1)
    assert ((same < 0.1) | (same > 0.9)).float().mean() > 0.8, "all steps of a plan go the same way"
    if name != "mixture":  # which executes the likeliest
        assert 0.3 < (same > 0.5).float().mean() < 0.7, "either way as often as the expert"


@pytest.mark.parametrize("name", HEADS)
def test_a_head_fits_a_few_labels_and_leaves_out_padding(name: str) -> None:
    source = torch.Generator().manual_seed(3)
    situations, plans = torch.linspace(-1, 1, 4)[:, None], torch.rand(4, CHUNK, SIZE, generator=source) * 2 - 1
    pad = torch.zeros(64, CHUNK, dtype=torch.bool)
    pad[:32, 2] = True  # in every second row a plan ends early, and 0 stands in its place
    shown = plans.repeat(16, 1, 1).masked_fill(pad[..., None], 0.0)
    toy = trained(name, situations.repeat(16, 1), shown, 350, pad)
    error = (toy.plans(situations) - plans).abs()
    assert error.mean() < 0.3 * (plans - plans.mean(0)).abs().mean()
    assert error[:, 2].mean() < 0.3 * plans[:, 2].abs().mean(), "with padding it would be half way to 0"
    padded, pad = Toy(name), pad[:4]
    loss = padded.made.loss("l1", kl_weight=0.0)
    values = []
    for fill in (0.0, 0.0, 3.0):
        with global_draws(generator(0, 1, 0), torch.device("cpu")):
            labels = plans.masked_fill(pad[..., None], fill)
            values.append(loss(batch(padded.encoder(situations).detach(), labels, pad)).item())
    assert values[0] == values[1], "the same draws"
    if name in ("deterministic", "gaussian", "mixture"):  # the others are shown it, as noise or as what came before
        assert values[2] == pytest.approx(values[0])


def test_the_mean_of_kept_steps() -> None:
    error = torch.tensor([[[1.0, 3.0], [100.0, 100.0]], [[5.0, 7.0], [1.0, 1.0]]])
    pad = torch.tensor([[False, True], [False, False]])
    assert mean_of_kept(error, pad) == (1 + 3 + 5 + 7 + 1 + 1) / 6
    assert mean_of_kept(error, None) == error.mean()
    assert mean_of_kept(error, torch.ones_like(pad)) == 0


def test_global_draws_are_put_back() -> None:
    before = torch.get_rng_state()
    with global_draws(generator(0, 1, 2), torch.device("cpu")):
        first = torch.rand(3)
    assert torch.equal(torch.get_rng_state(), before)
    with global_draws(generator(0, 1, 2), torch.device("cpu")):
        assert torch.equal(torch.rand(3), first)
    with global_draws(generator(0, 1, 3), torch.device("cpu")):
        assert not torch.equal(torch.rand(3), first)
