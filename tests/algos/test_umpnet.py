"""algo=umpnet: pairs of clouds, labels from simulated pulls, and that the networks learn them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDictBase

from fb3d_rl.algos.run import run_training
from fb3d_rl.algos.umpnet_training import pull_cosine, pulled, pulls_objective
from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.camera.options import CameraOptions
from fb3d_rl.contract import GOAL_POINTS
from fb3d_rl.data.options import SampleOptions
from fb3d_rl.data.pairs import PAIRS, draw_pair
from fb3d_rl.errors import UserError
from fb3d_rl.geometry.points import gather
from fb3d_rl.geometry.transforms import normalize
from fb3d_rl.models.direction_net import SearchOptions
from fb3d_rl.models.umpnet import AWAY, STILL, TOWARDS, UmpNet, score
from fb3d_rl.policies.umpnet_policy import best_pull
from fb3d_rl.scene.posed import Posed
from fb3d_rl.training.fit import fit
from fb3d_rl.training.options import FitOptions

Pairs = Callable[[str], TensorDictBase]
OPTIONS = SampleOptions(points=256, camera=CameraOptions(resolution=64))


@pytest.fixture(scope="module")
def pairs(objects: dict[str, ArticulatedObject]) -> Pairs:
    """Eight pairs of an object of a category."""

    def drawn(name: str) -> TensorDictBase:
        posed, rng = Posed(objects[name], OPTIONS.camera), np.random.default_rng(3)
        found = [draw_pair(posed, OPTIONS, rng) for _ in range(8)]
        rows: TensorDictBase = torch.stack([one for one in found if one is not None])
        return rows

    return drawn


def test_a_pair_shows_the_part_in_two_states(pairs: Pairs) -> None:
    batch = pairs("Laptop")
    blank = PAIRS.blank(OPTIONS.points)
    for key in blank.keys(True, True):
        assert batch[key].shape[1:] == blank[key].shape and batch[key].dtype == blank[key].dtype
    other, flow = batch["observation", "part_mask"], batch["privileged", "flow"]
    assert not other[:, :-GOAL_POINTS].any() and not flow[:, -GOAL_POINTS:].any() and flow[:, :-GOAL_POINTS].any()
    closed, opened, then = batch["privileged", "travel"].unbind(-1)
    assert (closed <= 0).all() and (opened >= 0).all() and (closed <= then).all() and (then <= opened).all()
    same = then == 0
    assert same.any() and not same.all()
    # Where the part has moved, the surface of the other image is somewhere else.
    points, valid = batch["observation", "points"], batch["observation", "valid"]
    gaps = []
    for one, known, part in zip(points, valid, flow.any(-1), strict=True):
        there = one[-GOAL_POINTS:][known[-GOAL_POINTS:]]
        gaps.append(float(torch.cdist(one[part], there).min(1).values.mean()))
    far = then.abs() > 0.3 * (opened - closed)
    gap = torch.tensor(gaps)
    assert far.any() and gap[far].min() > 1.5 * gap[same].max()


@pytest.mark.parametrize("name", ["Laptop", "Table"])
def test_labels_are_what_pulls_do(name: str, pairs: Pairs) -> None:
    """A pull along the true flow opens, one against it closes, as far as the limits go; across it nothing moves."""
    batch = pairs(name)
    contact = batch["privileged", "flow"].norm(dim=-1).argmax(-1)[:, None]
    way = normalize(gather(batch["privileged", "flow"], contact))
    across = normalize(torch.linalg.cross(way, torch.tensor([[[0.3, 0.5, 0.8]]]).expand_as(way)))
    true = pulled(batch, contact, torch.stack([way, -way, across], dim=2))
    closed, opened, then = batch["privileged", "travel"].unbind(-1)
    for row, (low, high, other) in enumerate(zip(closed.tolist(), opened.tolist(), then.tolist(), strict=True)):
        opens, closes, aside = true.arrow[row, 0].tolist()
        room = 0.3 * (high - low)
        assert aside == STILL
        if high > room:
            assert opens == (TOWARDS if other > room else AWAY if other <= 0 else opens) != STILL
        if low > -0.01:
            assert closes == STILL, "a closed part cannot be closed"
            assert true.distance[row, 0, 1] < 0.05 < true.distance[row, 0, 0]
        elif low < -room:
            assert closes == (TOWARDS if other < -room else AWAY if other >= 0 else closes) != STILL


def test_the_score_is_signed_by_the_arrow() -> None:
    arrow = 50.0 * torch.eye(3)[[TOWARDS, STILL, AWAY, AWAY]]
    assert score(torch.tensor([0.5, 0.5, 0.5, -0.5]), arrow).tolist() == pytest.approx([-0.5, 0.0, 0.5, 0.0])
    unsure = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    assert 0.0 == float(score(torch.ones(2), unsure)[0]) < float(score(torch.ones(2), unsure)[1]) < 1.0


def test_pulls_are_learned_and_banned(pairs: Pairs) -> None:
    """On what it has seen the pull leads to the other image's state; where that is ruled out, another one is taken."""
    batch = pairs("Laptop")
    options = FitOptions(steps=150, batch_size=len(batch), lr=2e-3, schedule="one_cycle", clip_norm=1.0, rotate=False,
                         log_every=1000)  # fmt: skip
    net = UmpNet(True, 16, "delayed", torch.Generator().manual_seed(0))
    before = float(pull_cosine(net.eval(), batch, torch.device("cpu"))["cosine"].nanmean())
    fit(net.train(), batch, options, objective=pulls_objective(net, options), progress=False)
    numbers = pull_cosine(net.eval(), batch, torch.device("cpu"))
    assert numbers["cosine"].nanmean() > 0.8 > before and numbers["movable"].min() > 0.7
    points, valid, other = (batch["observation", key] for key in ("points", "valid", "part_mask"))
    contact = batch["privileged", "flow"].norm(dim=-1).argmax(-1)
    with torch.no_grad():
        seen = net.see(points, valid, other)
        first = best_pull(net, seen, contact, -1.0, torch.zeros(len(batch), 1, 3), SearchOptions())
        second = best_pull(net, seen, contact, -1.0, first[:, None], SearchOptions())
    assert ((first * second).sum(-1) < np.cos(0.25)).all()


@pytest.mark.slow
def test_a_run_in_small(tmp_path: Path, config: Callable[[str, list[str]], Any]) -> None:
    words = [
        "algo=umpnet", "experiment=smoke", "assets.categories=[Microwave]", "data.points=128", "data.workers=0",
        "camera.resolution=48", "evaluation.trials=1", "evaluation.expert=false", "algo.epochs=1.0",
        "algo.batch_size=4", "algo.neighbors=16", "data.train_samples=16", "env.horizon=40",
    ]  # fmt: skip
    rows = run_training(config("train", words), tmp_path / "run")
    assert [(row.policy, row.status) for row in rows] == [("umpnet", "ok")]
    samples = tmp_path / "run" / "samples"
    with pytest.raises(UserError, match="holds pairs of clouds, not flow samples"):
        run_training(config("train", [*words[1:], f"data.dataset={samples}"]), tmp_path / "other")


def test_rollouts_are_no_pairs(tmp_path: Path, config: Callable[[str, list[str]], Any]) -> None:
    with pytest.raises(UserError, match=r"leave data\.met_by out"):
        run_training(config("train", ["algo=umpnet", "data.met_by=pretrained", "evaluation.trials=0"]), tmp_path)
