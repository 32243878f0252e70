"""The benchmarks measure what they say, on work that is the same for all sides."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from types import SimpleNamespace

import pytest
import torch

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.assets.partnet_mobility import load_object
from fb3d_rl.benchmarks import environment as benchmark
from fb3d_rl.camera.raycast import CameraOptions
from fb3d_rl.contract import Key
from fb3d_rl.data.samples import SampleOptions
from fb3d_rl.env.options import EnvOptions, Trial
from fb3d_rl.procedural import generate
from fb3d_rl.rollout.trials import schedule

OPTIONS = EnvOptions(points=128, camera=CameraOptions(resolution=32), horizon=40)


@pytest.fixture(scope="module")
def objects(tmp_path_factory: pytest.TempPathFactory) -> list[ArticulatedObject]:
    root = tmp_path_factory.mktemp("objects")
    return [load_object(root / name) for name in generate(root, ["Microwave", "Table"], 1, seed=0)]


def silent(text: str) -> None:
    assert text


def test_rates_are_of_the_same_steps(objects: list[ArticulatedObject], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(benchmark, "_stock_env", lambda *_: (None, "not asked for"))
    cpu = SimpleNamespace(perf_counter=time.process_time)  # what other processes take does not count
    monkeypatch.setattr(benchmark, "time", cpu)
    episodes = benchmark.expert_episodes(objects, OPTIONS)
    made, make_env = [], benchmark.make_env
    monkeypatch.setattr(benchmark, "make_env", lambda *a, **k: made.append(make_env(*a, **k)) or made[-1])
    found = benchmark.step_rates(objects, OPTIONS, rounds=2, progress=silent)
    assert found["steps"] == sum(len(episode.actions) for episode in episodes) > 20
    assert found["no observation, steps/s"] > found["point cloud, steps/s"] > 0
    assert 0.1 < found["point cloud / no observation"] < 1
    assert len(made) == len(objects) + 2 and not any(env.idle for env in made), "every step was of a trial"
    assert found["ManiSkill's point cloud"] == "not measured: not asked for"


def test_labelled_rows_are_those_that_the_learner_collects_alone(
    objects: list[ArticulatedObject], monkeypatch: pytest.MonkeyPatch
) -> None:
    labels, run = {}, benchmark.Workers.run

    def recorded(self: benchmark.Workers, trials: list[Trial], keys: list[Key]) -> Iterator[object]:
        for episode in run(self, trials, keys):
            assert episode.frames is not None
            labels.setdefault(episode.index, {})[len(keys)] = episode.frames
            yield episode

    monkeypatch.setattr(benchmark.Workers, "run", recorded)
    found = benchmark.labelling(objects, OPTIONS, rounds=1, progress=silent)
    episodes = benchmark.expert_episodes(objects, OPTIONS)
    assert found["rows"] == sum(len(episode.actions) for episode in episodes) > 20
    for i, episode in enumerate(episodes):
        alone, labelled = labels[i][1], labels[i][2]
        assert torch.equal(alone["observation", "points"], labelled["observation", "points"])
        # In the same states the expert would do what it did, but where it meanwhile came nearer to another good point.
        difference = (labelled["expert", "action"] - episode.actions).abs().amax(-1)
        assert difference[0] < 1e-5 and (difference[:8] < 1e-5).sum() >= 6 and (difference < 0.01).float().mean() > 0.9
    assert 0.1 < found["labelled / alone"] < 3  # about 0.7 on an idle machine
    assert found["labelled by the expert, rows/s"] > 0


def test_reading_begins_with_an_empty_cache_and_leaves_none(objects: list[ArticulatedObject]) -> None:
    before = os.environ["FB3D_CACHE"]
    found = benchmark.reading([obj.urdf.parent for obj in objects], silent)
    assert os.environ["FB3D_CACHE"] == before
    assert found["objects"] == 2 and found["first look, trees for rays included, s"] > 0
    assert 0 < found["read again, s"] < found["first read, s"]


@pytest.mark.usefixtures("two_threads")
def test_one_core_is_given_back() -> None:
    before = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else None
    with pytest.raises(KeyError), benchmark.one_core():
        assert torch.get_num_threads() == 1
        if before is not None:
            assert len(os.sched_getaffinity(0)) == 1
        raise KeyError
    assert torch.get_num_threads() == 2
    if before is not None:
        assert os.sched_getaffinity(0) == before


def test_a_load_builds_the_object(objects: list[ArticulatedObject]) -> None:
    found = benchmark.loading(objects, OPTIONS, silent)
    assert found["objects"] == 2
    assert found["load again, slowest object, ms"] >= found["load again, ms"] > 1, "else it takes microseconds"


def test_first_loads_are_told_from_later_ones(
    objects: list[ArticulatedObject], monkeypatch: pytest.MonkeyPatch
) -> None:
    class Slow:
        """Objects that take 40 and 80 ms, then 10 and 20, then 5 and 30."""

        def __init__(self) -> None:
            self.times = iter((40, 80, 10, 20, 5, 30))

        def reset(self) -> None:
            time.sleep(next(self.times) / 1000)

        def close(self) -> None:
            pass

    monkeypatch.setattr(benchmark, "make_env", lambda *_: Slow())
    found = benchmark.loading(objects, OPTIONS, silent)
    assert 60 <= found["first load, ms"] < 100
    assert 12.5 <= found["load again, ms"] < 40 and 20 <= found["load again, slowest object, ms"] < 60


def test_random_actions_leave_numbers_and_memory_alone(objects: list[ArticulatedObject]) -> None:
    found = benchmark.soak(objects, OPTIONS, steps=200, seed=0, progress=silent)
    assert found["steps"] == 200 and found["entries that are not finite"] == 0
    assert 0.9 < found["memory after / before"] < 1.1


@pytest.mark.slow
@pytest.mark.alone
def test_workers_are_compared_without_their_start(objects: list[ArticulatedObject]) -> None:
    scheduled, _ = schedule([(obj, "") for obj in objects], SampleOptions(points=128), seed=0)
    found = benchmark.worker_scaling(objects, 3 * scheduled, OPTIONS, rounds=1, progress=silent)
    assert found["trials"] == 3 * len(scheduled)
    assert found["two workers / one"] == pytest.approx(
        found["two workers, trials/s"] / found["one worker, trials/s"], rel=1e-6
    )
