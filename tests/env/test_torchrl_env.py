"""The TorchRL adapter: its specs hold, and each reset of a collector starts the next trial."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from torchrl.collectors import Collector
from torchrl.envs.utils import check_env_specs

from fb3d_rl import contract
from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.contract import UserError
from fb3d_rl.env.options import EnvOptions, default_trial
from fb3d_rl.env.torchrl_env import ManiSkillEnv, make_env

OPTIONS = EnvOptions(points=64, horizon=5)


@pytest.fixture(scope="module")
def wrapped(objects: dict[str, ArticulatedObject]) -> ManiSkillEnv:
    return make_env([objects["Table"], objects["Oven"]], OPTIONS)


def test_specs_hold(wrapped: ManiSkillEnv) -> None:
    check_env_specs(wrapped, break_when_any_done="both")


def test_steps_keep_the_contract(wrapped: ManiSkillEnv) -> None:
    td = wrapped.rollout(3)
    assert td.batch_size == (1, 3)
    for group in ("observation", "privileged", "metrics"):
        contract.check(td, group)
        contract.check(td["next"], group)
    contract.check(td, "action")


def test_every_reset_starts_the_next_trial(wrapped: ManiSkillEnv, objects: dict[str, ArticulatedObject]) -> None:
    table, oven = default_trial(objects["Table"]), default_trial(objects["Oven"])
    wrapped.set_trials([table, oven, dataclasses.replace(table, seed=1)])
    still = lambda td: td.set("action", torch.zeros(1, 8))  # noqa: E731
    collector = Collector(wrapped, still, frames_per_batch=20, total_frames=20)
    (batch,) = list(collector)
    assert batch["trial"].flatten().tolist() == [0] * 5 + [1] * 5 + [2] * 5 + [0] * 5
    ends = batch["next", "done"].flatten().nonzero().flatten().tolist()
    assert ends == [4, 9, 14, 19]
    points = batch["observation", "points"][0]
    assert torch.equal(points[0], points[15]), "the same trial, the same bits"
    assert not torch.equal(points[0], points[10]), "another seed draws other points"


def test_observations_are_not_overwritten_by_later_steps(wrapped: ManiSkillEnv) -> None:
    td = wrapped.reset()
    kept = td.clone()
    for _ in range(2):
        wrapped.step(td.clone().set("action", torch.full((1, 8), 0.5)))
    assert (td == kept).all()


def test_no_trials_are_refused(wrapped: ManiSkillEnv) -> None:
    with pytest.raises(UserError, match="empty"):
        wrapped.set_trials([])


def test_an_environment_without_points(objects: dict[str, ArticulatedObject]) -> None:
    env = make_env([objects["Table"]], OPTIONS, obs_mode="state_dict")
    td = env.rollout(2)
    assert ("observation", "points") not in td.keys(include_nested=True)
    contract.check(td, "metrics")
    env.close()
