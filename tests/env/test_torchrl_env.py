"""The TorchRL adapter: its specs hold for ManiSkill's own tasks and ours, and each reset starts the next trial."""

from __future__ import annotations

import dataclasses
import itertools
from functools import partial
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from tensordict import TensorDictBase
from torchrl.collectors import Collector
from torchrl.envs import ParallelEnv
from torchrl.envs.utils import check_env_specs

from fb3d_rl import contract
from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.env.options import EnvOptions, default_trial
from fb3d_rl.env.torchrl_env import ManiSkillEnv, TrialEnv, make_env

OPTIONS = EnvOptions(points=64, horizon=5)


# --------------------------------------------------------------------------------------------- any ManiSkill task


class Counters(gymnasium.Env):
    """What ManiSkill's API looks like for three parallel scenes: each counts its steps and ends after 2, 3 or 4."""

    num_envs, device = 3, torch.device("cpu")
    single_action_space = gymnasium.spaces.Box(np.array([-1.0, 0.0]), np.array([1.0, 2.0]), dtype=np.float64)

    def __init__(self, flat: bool = False) -> None:
        self.flat = flat
        self.count, self.episode = torch.zeros(3, dtype=torch.int32), torch.zeros(3)
        self.seeds: list[int | None] = []
        self.actions: list[torch.Tensor] = []

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        self.seeds.append(seed)
        scenes = (options or {}).get("env_idx", torch.arange(3))
        self.count[scenes] = 0
        self.episode[scenes] += 1
        return self.observe(), {**self.info(), "reconfigure": False}

    def step(self, action: torch.Tensor) -> tuple[Any, ...]:
        self.actions.append(action)
        self.count += 1
        ends = self.count >= torch.tensor([2, 3, 4])
        return self.observe(), action.sum(-1), ends, torch.zeros(3, dtype=torch.bool), self.info()

    def observe(self) -> Any:
        if self.flat:
            return torch.stack([self.count.float(), self.episode], -1)
        image = torch.full((3, 4, 4, 3), 255, dtype=torch.uint8)
        return {
            "agent": {"count": self.count, "touching": self.count > 0},
            "sensor_data": {"camera": {"rgb": image}},
            "episode": self.episode,
            "extra": {},
        }

    def info(self) -> dict[str, Any]:
        return {"fail": self.count > 3, "note": "text", "depth": torch.zeros(3, 2)}


@pytest.mark.parametrize("flat", [False, True])
def test_specs_hold_for_every_kind_of_observation(flat: bool) -> None:
    env = ManiSkillEnv(Counters(flat))
    check_env_specs(env)
    td = env.reset()
    if flat:
        assert td["observation"].shape == (3, 2)
    else:
        assert td["agent", "count"].shape == td["episode"].shape == (3, 1) and td["agent", "count"].dtype == torch.int32
        assert td["sensor_data", "camera", "rgb"].dtype == torch.uint8 and td["agent", "touching"].dtype == torch.bool
    assert td["fail"].shape == (3, 1) and td["depth"].shape == (3, 2)
    assert not {"note", "reconfigure", "extra"} & set(td.keys())


def test_actions_have_the_bounds_of_the_box() -> None:
    env = ManiSkillEnv(Counters())
    assert env.action_spec.shape == (3, 2) and env.action_spec.dtype == torch.float64
    assert torch.equal(env.action_spec.space.low, torch.tensor([[-1.0, 0.0]] * 3, dtype=torch.float64))
    assert torch.equal(env.action_spec.space.high, torch.tensor([[1.0, 2.0]] * 3, dtype=torch.float64))
    action = env.rand_action(env.reset())
    env.step(action)
    assert torch.equal(env.env.actions[-1], action["action"])  # type: ignore[attr-defined]


def test_each_scene_is_reset_when_it_is_done() -> None:
    env = ManiSkillEnv(Counters())
    counts = env.rollout(7, break_when_any_done=False)["agent", "count"].squeeze(-1)
    # Scene k ends after k + 2 steps; the others are not touched by its reset.
    assert counts.tolist() == [[0, 1, 0, 1, 0, 1, 0], [0, 1, 2, 0, 1, 2, 0], [0, 1, 2, 3, 0, 1, 2]]


def test_a_mask_resets_the_marked_scenes_only() -> None:
    env = ManiSkillEnv(Counters())
    td = env.step(env.rand_action(env.reset()))["next"]
    td["_reset"] = torch.tensor([[False], [True], [False]])
    episodes = env.env.episode.clone()  # type: ignore[attr-defined]
    after = env.reset(td)
    assert after["agent", "count"].flatten().tolist() == [1, 0, 1]
    assert (env.env.episode - episodes).tolist() == [0, 1, 0]  # type: ignore[attr-defined]


def test_buffers_that_a_task_writes_again_are_copied() -> None:
    env = ManiSkillEnv(Counters())
    first = env.reset()
    env.step(env.rand_action(first.clone()))
    assert first["agent", "count"].flatten().tolist() == [0, 0, 0]


def test_a_seed_is_for_the_next_reset() -> None:
    env = ManiSkillEnv(Counters())
    env.set_seed(7)
    env.reset()
    env.reset()
    assert env.env.seeds[-2:] == [7, None]  # type: ignore[attr-defined]


def test_an_action_space_that_is_no_box_is_refused() -> None:
    task = Counters()
    task.single_action_space = gymnasium.spaces.Discrete(3)  # type: ignore[assignment]
    with pytest.raises(ValueError, match="no box"):
        ManiSkillEnv(task)


STOCK = {
    "a panda, nested observations": ("Empty-v1", dict(obs_mode="state_dict", render_backend="none")),
    "a panda, flat observations": ("Empty-v1", dict(obs_mode="state", render_backend="none")),
    "a cart and a pole": ("MS-CartpoleBalance-v1", dict(obs_mode="state", render_backend="cpu")),
    "a panda and a cube": ("PickCube-v1", dict(obs_mode="state_dict", render_backend="cpu")),
}


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", STOCK)
def test_maniskills_own_tasks(name: str) -> None:
    import mani_skill.envs  # noqa: F401

    task, kwargs = STOCK[name]

    def four_steps(seed: int) -> TensorDictBase:
        env.set_seed(seed)
        td = env.reset()
        for value in (-0.5, 0.2, 0.1, 0.4):
            td["action"] = torch.full_like(env.action_spec.zero(), value)
            td = env.step(td)["next"]
        return td

    ends = []
    for seed in (3, 3, 4):
        try:
            env = ManiSkillEnv(gymnasium.make(task, num_envs=1, sim_backend="physx_cpu", **kwargs))
        except RuntimeError as error:
            if "rendering device" not in str(error) and "vk::" not in str(error):
                raise
            pytest.skip(f"{task} makes render materials, which needs Vulkan: {error}")
        ends.append(four_steps(seed))
        check_env_specs(env)
        env.close()
    assert (ends[0] == ends[1]).all(), "the same seed, the same bits"
    if task != "Empty-v1":  # in which nothing is drawn
        assert not (ends[0] == ends[2]).all()
    assert ends[0]["elapsed_steps"].item() == 4


# --------------------------------------------------------------------------------------------------- our own task


@pytest.fixture(scope="module")
def wrapped(objects: dict[str, ArticulatedObject]) -> TrialEnv:
    return make_env([objects["Table"], objects["Oven"]], OPTIONS)


def test_specs_hold(wrapped: TrialEnv) -> None:
    check_env_specs(wrapped, break_when_any_done="both")


def test_steps_keep_the_contract(wrapped: TrialEnv) -> None:
    td = wrapped.rollout(3)
    assert td.batch_size == (1, 3)
    for group in ("observation", "privileged", "metrics"):
        contract.check(td, group)
        contract.check(td["next"], group)
    contract.check(td, "action")


def still(td: TensorDictBase) -> TensorDictBase:
    return td.set("action", torch.zeros(*td.batch_size, 8))


def test_every_reset_starts_the_next_trial(wrapped: TrialEnv, objects: dict[str, ArticulatedObject]) -> None:
    table, oven = default_trial(objects["Table"]), default_trial(objects["Oven"])
    wrapped.set_trials(itertools.cycle([table, oven, dataclasses.replace(table, seed=1)]))
    collector = Collector(wrapped, still, frames_per_batch=20, total_frames=20)
    (batch,) = list(collector)
    assert batch["trial"].flatten().tolist() == [0] * 5 + [1] * 5 + [2] * 5 + [3] * 5
    ends = batch["next", "done"].flatten().nonzero().flatten().tolist()
    assert ends == [4, 9, 14, 19]
    points = batch["observation", "points"][0]
    assert torch.equal(points[0], points[15]), "the same trial, the same bits"
    assert not torch.equal(points[0], points[10]), "another seed draws other points"


def test_no_scene_is_built_once_the_trials_have_run_out(
    wrapped: TrialEnv, objects: dict[str, ArticulatedObject], monkeypatch: pytest.MonkeyPatch
) -> None:
    wrapped.set_trials([default_trial(objects["Oven"])])
    td = wrapped.reset()
    assert td["trial"].item() == 0 and not wrapped.idle
    monkeypatch.setattr(wrapped.env, "reset", None)
    after = wrapped.reset()
    assert after["trial"].item() == -1 and wrapped.idle
    assert (after.exclude("trial") == td.exclude("trial")).all()


def test_observations_are_not_overwritten_by_later_steps(wrapped: TrialEnv) -> None:
    td = wrapped.reset()
    kept = td.clone()
    for _ in range(2):
        wrapped.step(td.clone().set("action", torch.full((1, 8), 0.5)))
    assert (td == kept).all()


def test_an_environment_without_points(objects: dict[str, ArticulatedObject]) -> None:
    env = make_env([objects["Table"]], OPTIONS, obs_mode="state_dict")
    td = env.rollout(2)
    assert ("observation", "points") not in td.keys(include_nested=True)
    contract.check(td, "metrics")
    env.close()


@pytest.mark.slow
def test_torchrls_parallel_env(objects: dict[str, ArticulatedObject]) -> None:
    table, oven = objects["Table"], objects["Oven"]
    make = partial(make_env, [table, oven], OPTIONS)
    creators = [partial(make, trials=[default_trial(obj), default_trial(obj)]) for obj in (table, oven)]
    env = ParallelEnv(2, creators, mp_start_method="spawn")
    try:
        td = env.rollout(7, still, break_when_any_done=False)
        assert td.batch_size == (2, 1, 7)
        assert td["trial"][:, 0, :, 0].tolist() == [[0] * 5 + [1] * 2] * 2
        alone = make(trials=[default_trial(oven)] * 2).rollout(7, still, break_when_any_done=False)
        assert torch.equal(td["next", "observation", "points"][1], alone["next", "observation", "points"])
    finally:
        env.close()
