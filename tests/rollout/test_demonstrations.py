"""Recorded demonstrations: what the expert did, in the schedule's order, and the same again when run again."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import torch
from tensordict import TensorDictBase

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.contract import check
from fb3d_rl.data import maniskill
from fb3d_rl.data.demonstrations import DemonstrationBuffer, EpisodeInfo
from fb3d_rl.data.samples import SampleOptions
from fb3d_rl.env.options import EnvOptions
from fb3d_rl.errors import UserError
from fb3d_rl.rollout.collectors import CollectorOptions, Episode, Workers
from fb3d_rl.rollout.demonstrations import (
    KEYS,
    Assets,
    Replay,
    plan,
    recipe,
    record_expert,
    recorded_object,
    recorded_options,
    replay,
    trial_of,
)
from fb3d_rl.rollout.run import create_env, state_of
from fb3d_rl.rollout.trials import Scheduled

OPTIONS = EnvOptions(points=64, horizon=60)
ASSETS = Assets(categories=("Microwave", "KitchenPot", "StorageFurniture"), count=1)


@pytest.fixture(scope="module")
def objects() -> list[tuple[ArticulatedObject, str]]:
    return ASSETS.load()


@pytest.fixture(scope="module")
def scheduled(objects: list[tuple[ArticulatedObject, str]]) -> list[Scheduled]:
    return plan(objects, SampleOptions(points=OPTIONS.points, camera=OPTIONS.camera), 0, 4)


def run(
    path: Path, objects: list[tuple[ArticulatedObject, str]], scheduled: list[Scheduled], collector: CollectorOptions
) -> DemonstrationBuffer:
    buffer = DemonstrationBuffer.create(path, len(scheduled) * OPTIONS.horizon, recipe(OPTIONS, ASSETS))
    record_expert(buffer, [obj for obj, _ in objects], scheduled, OPTIONS, collector)
    return buffer


@pytest.fixture(scope="module")
def buffer(
    tmp_path_factory: pytest.TempPathFactory, objects: list[tuple[ArticulatedObject, str]], scheduled: list[Scheduled]
) -> DemonstrationBuffer:
    return run(tmp_path_factory.mktemp("demos") / "all", objects, scheduled, CollectorOptions())


def differs(a: TensorDictBase, b: TensorDictBase) -> list[object]:
    return [key for key in KEYS if not torch.equal(a.get(key), b.get(key))]


def test_rows_are_the_experts_episodes(buffer: DemonstrationBuffer, scheduled: list[Scheduled]) -> None:
    assert [trial_of(info) for info in buffer.episodes] == [item.trial for item in scheduled]
    assert any(info.success for info in buffer.episodes)
    for episode, info in enumerate(buffer.episodes):
        frames = buffer.frames(episode)
        check(frames, "observation")
        assert frames["elapsed_steps"].flatten().tolist() == list(range(info.steps))
        assert torch.equal(frames["action"], frames["expert", "action"]) and bool(frames["expert", "acts"].all())
        assert info.success == (info.normalized_distance < OPTIONS.success)
        assert info.rows == info.steps <= OPTIONS.horizon and (info.success or info.steps == OPTIONS.horizon)
    assert differs(DemonstrationBuffer.open(buffer.path)[range(len(buffer))], buffer[range(len(buffer))]) == []


def test_more_trials_than_parts_have_other_seeds(
    objects: list[tuple[ArticulatedObject, str]], scheduled: list[Scheduled]
) -> None:
    options = SampleOptions(points=OPTIONS.points, camera=OPTIONS.camera)
    all_parts = plan(objects, options, 0, None)
    twice = plan(objects, options, 0, 2 * len(all_parts))
    assert twice[: len(all_parts)] == all_parts and len(twice) == 2 * len(all_parts) > 2
    assert len({item.trial.seed for item in twice}) == len(twice)


def test_recorded_actions_lead_to_the_recorded_states_bit_for_bit(
    buffer: DemonstrationBuffer, objects: list[tuple[ArticulatedObject, str]]
) -> None:
    options = recorded_options(buffer)
    assert options == OPTIONS
    for episode, info in enumerate(buffer.episodes):
        frames = buffer.frames(episode)
        replay, shown = Replay(frames["action"]), replace(options, horizon=info.rows)
        create = partial(create_env, [recorded_object(buffer, episode)], shown, state_of(replay))
        with Workers(create, replay, CollectorOptions(), info.rows) as workers:
            (again,) = workers.run([trial_of(info)])
        assert again.frames is not None, again.error
        assert [key for key in differs_in(again, frames)] == []
        after = again.frames["next"][-1]
        assert (bool(after["success"]), float(after["normalized_distance"])) == (info.success, info.normalized_distance)


def differs_in(again: Episode, frames: TensorDictBase) -> list[object]:
    assert again.frames is not None
    seen = [key for key in KEYS if "expert" not in key]
    return [key for key in seen if not torch.equal(again.frames.get(key), frames.get(key))]


def test_a_film_of_an_episode_knows_whether_it_repeats(tmp_path: Path, buffer: DemonstrationBuffer) -> None:
    obj = recorded_object(buffer, 1)
    film, exact = replay(buffer, 1, obj)
    assert exact and len(film) == buffer.episodes[1].rows + 1 and film.success == buffer.episodes[1].success
    changed = DemonstrationBuffer.create(tmp_path / "b", 100, buffer.about)
    frames = buffer.frames(1)
    frames["action"][0, 0] += 0.1
    changed.extend(frames, buffer.episodes[1])
    assert not replay(changed, 0, obj)[1]


def test_only_successful_ones(
    tmp_path: Path, buffer: DemonstrationBuffer, objects: list[tuple[ArticulatedObject, str]],
    scheduled: list[Scheduled],
) -> None:  # fmt: skip
    """With one step less than the slowest episode took, only the others succeed."""
    most = max(info.steps for info in buffer.episodes) - 1
    options = replace(OPTIONS, horizon=most)
    kept: list[bool] = []
    some = DemonstrationBuffer.create(tmp_path / "b", 4 * options.horizon)
    record_expert(
        some, [obj for obj, _ in objects], scheduled, options, CollectorOptions(), successful=True,
        progress=lambda episode, keeps: kept.append(keeps),
    )  # fmt: skip
    assert kept == [info.steps <= most for info in buffer.episodes]
    assert some.episodes == [info for info in buffer.episodes if info.steps <= most] != []


@pytest.mark.slow
def test_worker_processes_record_the_same(
    tmp_path: Path, buffer: DemonstrationBuffer, objects: list[tuple[ArticulatedObject, str]],
    scheduled: list[Scheduled],
) -> None:  # fmt: skip
    other = run(tmp_path / "b", objects, scheduled, CollectorOptions("process", 2))
    assert other.episodes == buffer.episodes
    assert differs(other[range(len(other))], buffer[range(len(buffer))]) == []


def test_leaving_early_keeps_what_was_done(
    tmp_path: Path, buffer: DemonstrationBuffer, objects: list[tuple[ArticulatedObject, str]],
    scheduled: list[Scheduled],
) -> None:  # fmt: skip
    def leave(episode: Episode, kept: bool) -> None:
        if episode.index == 1:
            raise KeyboardInterrupt

    path = tmp_path / "b"
    left = DemonstrationBuffer.create(path, 4 * OPTIONS.horizon)
    with pytest.raises(KeyboardInterrupt):
        record_expert(left, [obj for obj, _ in objects], scheduled, OPTIONS, CollectorOptions(), progress=leave)
    assert DemonstrationBuffer.open(path).episodes == buffer.episodes[:2]


def test_a_trajectory_file_that_record_episode_wrote_is_read(
    tmp_path: Path, buffer: DemonstrationBuffer, objects: list[tuple[ArticulatedObject, str]]
) -> None:
    """The recorded actions, recorded by ManiSkill, give the recorded rows but for what it does not know."""
    from mani_skill.utils.wrappers.record import RecordEpisode

    from fb3d_rl.env.task import TASK, OpenArticulatedEnv

    env = OpenArticulatedEnv([obj for obj, _ in objects], OPTIONS)
    recorder = RecordEpisode(env, str(tmp_path), trajectory_name="x", save_video=False, save_on_reset=False)
    try:
        recorder.reset(options={"trials": [trial_of(buffer.episodes[1])]})
        recorder.last_reset_kwargs = {}  # a trial is nothing that JSON can hold
        frames = buffer.frames(1)
        for action in frames["action"]:
            recorder.step(action[None])
        recorder.flush_trajectory()
    finally:
        recorder.close()
    maniskill.write(buffer, tmp_path / "y.h5")
    theirs, ours = (json.loads((tmp_path / name).read_text()) for name in ("x.json", "y.json"))
    assert theirs["episodes"][0]["control_mode"] == ours["episodes"][0]["control_mode"]
    assert (ours["env_info"]["env_id"], ours["env_info"]["max_episode_steps"]) == (TASK, OPTIONS.horizon)
    read = maniskill.read(tmp_path / "x.h5", tmp_path / "b")
    assert read.keys.keys() >= buffer.keys.keys()
    assert {key: read.keys[key] for key in buffer.keys} == buffer.keys
    assert differs(read.frames(0), frames) == []
    maniskill.write(read, tmp_path / "z.h5")  # its file says nothing about the task, and can be written again
    (info,) = read.episodes
    assert (info.steps, info.success) == (buffer.episodes[1].steps, buffer.episodes[1].success)
    with pytest.raises(UserError, match="from another source"):
        trial_of(info)
    with pytest.raises(UserError, match="does not say how"):
        recorded_options(read)
    with pytest.raises(UserError, match="--root"):
        recorded_object(read, 0)


def test_the_object_is_found_where_it_is_now(
    tmp_path: Path, procedural_root: Path, procedural_objects: dict[str, ArticulatedObject]
) -> None:
    pot = procedural_objects["KitchenPot"].id
    assets = Assets(str(tmp_path / "where it was"))
    buffer = DemonstrationBuffer.create(tmp_path / "b", 1, recipe(OPTIONS, assets))
    info = EpisodeInfo(pot, "KitchenPot", 1, (0.0,), plan(ASSETS.load(), SampleOptions(), 0, 1)[0].trial.view)
    buffer.extend(run_nothing(), info)
    assert recorded_object(buffer, 0, str(procedural_root)).id == pot
    with pytest.raises(UserError, match="where it was"):
        recorded_object(buffer, 0)


def run_nothing() -> TensorDictBase:
    from tensordict import TensorDict

    return TensorDict({"action": torch.zeros(1, 8)}, batch_size=[1])
