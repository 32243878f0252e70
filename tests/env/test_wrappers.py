"""The task behind the interfaces that others drive it by: gymnasium's check and vectors, and ManiSkill's wrappers."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import gymnasium
import h5py
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from mani_skill.utils.wrappers import CPUGymWrapper, RecordEpisode
from mani_skill.vector.wrappers.gymnasium import ManiSkillVectorEnv

from fb3d_rl.env.options import EnvOptions, default_trial
from fb3d_rl.env.task import OpenArticulatedEnv
from fb3d_rl.errors import UserError

NAME = "fb3d_rl.env.task:OpenArticulated-v1"
POINTS, HORIZON, SEEDS = 64, 3, (5, 6)
GIVEN = {"options": EnvOptions(points=POINTS, horizon=HORIZON), "obs_mode": "pointcloud"}
ACTIONS = np.random.default_rng(0).uniform(-1, 1, (7, len(SEEDS), 8)).astype(np.float32)
ENDS = [(step + 1) % HORIZON == 0 for step in range(len(ACTIONS))]


def flat(observation: Any) -> list[np.ndarray]:
    if isinstance(observation, dict):
        return [array for key in sorted(observation) for array in flat(observation[key])]
    return [np.asarray(observation)]


def same(first: Any, second: Any) -> bool:
    return all(np.array_equal(a, b) for a, b in zip(flat(first), flat(second), strict=True))


def row(batch: Any, e: int) -> Any:
    """Environment ``e`` of a batched observation."""
    return {key: row(value, e) for key, value in batch.items()} if isinstance(batch, dict) else batch[e]


@pytest.fixture(scope="module")
def driven() -> list[list[dict[str, Any]]]:
    """What one environment by itself answers to each seed: its observations, ends and resets, step by step."""
    histories = []
    for e, seed in enumerate(SEEDS):
        env = CPUGymWrapper(gymnasium.make(NAME, **GIVEN))
        moments = [{"obs": env.reset(seed=seed)[0]}]
        for action in ACTIONS[:, e]:
            obs, reward, terminated, truncated, info = env.step(action)
            moments.append({"obs": obs, "reward": reward, "truncated": truncated, "info": info})
            assert not terminated
            if truncated:
                moments[-1]["next"] = env.reset()[0]
        histories.append(moments)
    assert not same(histories[0][0]["obs"], histories[1][0]["obs"]), "the seeds give different episodes"
    return histories


@pytest.fixture(params=["sync", pytest.param("async", marks=pytest.mark.slow)])
def vector(request: pytest.FixtureRequest) -> Iterator[Any]:
    """A maker of a vector of two."""
    made = []

    def make(mode: AutoresetMode) -> gymnasium.vector.VectorEnv:
        made.append(
            gymnasium.make_vec(
                NAME, num_envs=2, vectorization_mode=request.param, wrappers=[CPUGymWrapper],
                vector_kwargs={"autoreset_mode": mode}, **GIVEN,
            )
        )  # fmt: skip
        return made[-1]

    yield make
    for env in made:
        env.close()


@pytest.mark.filterwarnings("ignore:.*(space m|unwrapped version|having a spec)")
@pytest.mark.parametrize("mode", ["state", "pointcloud"])
def test_gymnasium_finds_no_fault(mode: str) -> None:
    """Both with the spec, from which ManiSkill's wrapper cannot be made again, and without, when all is checked."""
    made = gymnasium.make(NAME, **{**GIVEN, "obs_mode": mode})
    check_env(CPUGymWrapper(made), skip_render_check=True, skip_close_check=True)
    made.close()
    made.close()
    check_env(CPUGymWrapper(OpenArticulatedEnv(**{**GIVEN, "obs_mode": mode}, render_mode="rgb_array")))


def test_a_vector_that_resets_in_the_same_step(vector: Any, driven: list[list[dict[str, Any]]]) -> None:
    env = vector(AutoresetMode.SAME_STEP)
    obs, _ = env.reset(seed=SEEDS[0])  # gymnasium gives each environment the next number
    assert obs["observation"]["points"].shape == (2, POINTS, 3)
    assert all(same(row(obs, e), driven[e][0]["obs"]) for e in range(2))
    for actions, ends, *moments in zip(ACTIONS, ENDS, driven[0][1:], driven[1][1:], strict=True):
        obs, rewards, _, truncated, info = env.step(actions)
        assert truncated.tolist() == [ends, ends]
        assert rewards.tolist() == [moment["reward"] for moment in moments]
        for e, moment in enumerate(moments):
            assert same(row(obs, e), moment["next" if ends else "obs"])
            if ends:
                assert same(info["final_obs"][e], moment["obs"])
                assert info["final_info"]["normalized_distance"][e] == moment["info"]["normalized_distance"]
                assert info["final_info"]["elapsed_steps"][e] == HORIZON


def test_a_vector_that_resets_in_the_next_step(vector: Any, driven: list[list[dict[str, Any]]]) -> None:
    """The step after an end is the reset, whose action counts for nothing; a vector seeded again repeats itself."""
    env = vector(AutoresetMode.NEXT_STEP)
    for _ in range(2):
        env.reset(seed=list(SEEDS))
        for actions, ends, *moments in zip(ACTIONS, ENDS, driven[0][1:], driven[1][1:], strict=True):
            obs, *_, truncated, _ = env.step(actions)
            assert truncated.tolist() == [ends, ends]
            assert all(same(row(obs, e), moment["obs"]) for e, moment in enumerate(moments))
            if ends:
                obs, rewards, *_, truncated, _ = env.step(actions)
                assert not truncated.any() and not rewards.any()
                assert all(same(row(obs, e), moment["next"]) for e, moment in enumerate(moments))


def test_a_vectors_time_limit_is_the_horizon() -> None:
    env = gymnasium.make_vec(NAME, num_envs=2, vectorization_mode="sync", wrappers=[CPUGymWrapper],
                             obs_mode="state", max_episode_steps=2)  # fmt: skip
    env.reset(seed=0)
    assert [env.step(actions)[3].tolist() for actions in ACTIONS[:2]] == [[False] * 2, [True] * 2]
    env.close()


def test_maniskills_vector_keeps_the_final_observation(driven: list[list[dict[str, Any]]]) -> None:
    env = ManiSkillVectorEnv(gymnasium.make(NAME, **GIVEN), auto_reset=True, record_metrics=True)
    obs, _ = env.reset(seed=SEEDS[0])
    assert same(row(obs, 0), driven[0][0]["obs"])
    for action, ends, moment in zip(ACTIONS[:, :1], ENDS, driven[0][1:], strict=True):
        obs, reward, _, truncated, info = env.step(action)
        assert (bool(truncated), float(reward)) == (ends, float(moment["reward"]))
        assert same(row(obs, 0), moment["next" if ends else "obs"])
        if ends:
            assert same(row(info["final_observation"], 0), moment["obs"])
            assert int(info["final_info"]["episode"]["episode_len"]) == HORIZON
            assert bool(info["_final_info"]) and not info["final_info"]["episode"]["success_once"]
    env.close()


def test_a_recorded_episode_is_made_again_from_its_file(tmp_path: Path, driven: list[list[dict[str, Any]]]) -> None:
    """With the options of the task, by its seed and by its trial, all of them read from the JSON file."""
    trial = default_trial(next(iter(OpenArticulatedEnv(obs_mode="none").objects.values())), seed=3)
    recorder = RecordEpisode(gymnasium.make(NAME, **GIVEN, render_mode="rgb_array"), str(tmp_path),
                             trajectory_name="x", save_video=True)  # fmt: skip
    env = CPUGymWrapper(recorder, record_metrics=True)
    for how in ({"seed": SEEDS[0]}, {"options": {"trials": [asdict(trial)]}}):
        obs, _ = env.reset(**how)
        for action in ACTIONS[:HORIZON, 0]:
            _, _, _, truncated, info = env.step(action)
        assert truncated and info["episode"]["episode_len"] == HORIZON
    assert recorder.base_env.stages[0].trial == trial
    env.close()
    assert {path.suffix for path in tmp_path.iterdir()} == {".h5", ".json", ".mp4"}
    about = json.loads((tmp_path / "x.json").read_text())
    kwargs = about["env_info"]["env_kwargs"]
    assert EnvOptions.of(kwargs["options"]) == GIVEN["options"]
    again = CPUGymWrapper(gymnasium.make(NAME, **kwargs))
    with h5py.File(tmp_path / "x.h5") as file:
        for entry in about["episodes"]:
            kept = file[f"traj_{entry['episode_id']}"]
            np.testing.assert_array_equal(kept["actions"][:], ACTIONS[:HORIZON, 0])
            assert kept["truncated"][:].tolist() == [False, False, True]
            seen = [again.reset(**entry["reset_kwargs"])[0], *(again.step(action)[0] for action in kept["actions"])]
            for moment, obs in enumerate(seen):
                for group, entries in obs.items():
                    for key, value in entries.items():
                        np.testing.assert_array_equal(kept["obs"][group][key][moment], value, err_msg=key)
        for moment in range(HORIZON + 1):
            points = driven[0][moment]["obs"]["observation"]["points"]
            np.testing.assert_array_equal(file["traj_0/obs/observation/points"][moment], points)


def test_options_and_trials_that_are_none_are_said() -> None:
    with pytest.raises(UserError, match="horizont"):
        EnvOptions.of({"horizont": 3})
    assert EnvOptions.of({"horizon": 3, "suction": {"reach": 0.1}}).suction.reach == 0.1
    env = OpenArticulatedEnv(obs_mode="none", options={"horizon": 3})
    assert env.options == EnvOptions(horizon=3)
    with pytest.raises(UserError, match="is no trial; give object"):
        env.reset(options={"trials": [{"object": "x"}]})
