"""The schedule of an evaluation."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from fb3d_rl import procedural
from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.assets.partnet_mobility import load_object
from fb3d_rl.camera.raycast import CameraOptions
from fb3d_rl.data.samples import SampleOptions
from fb3d_rl.kinematics.opening import openable_links, opening_range
from fb3d_rl.rollout.trials import Scheduled, ScheduleOptions, schedule, trial_key
from fb3d_rl.scene.observer import MIN_VISIBLE, observe
from fb3d_rl.scene.posed import Posed

OPTIONS = SampleOptions(points=300, camera=CameraOptions(resolution=48))


@pytest.fixture(scope="module")
def objects(tmp_path_factory: pytest.TempPathFactory) -> list[tuple[ArticulatedObject, str]]:
    out: Path = tmp_path_factory.mktemp("objects")
    ids = procedural.generate(out, ["StorageFurniture", "KitchenPot", "Microwave"], 2, 5)
    return [(load_object(out / name), "train_test") for name in ids]


def test_one_trial_for_every_part_that_opens_and_shows(objects: list[tuple[ArticulatedObject, str]]) -> None:
    trials, hidden = schedule(objects, OPTIONS, seed=0)
    assert len(trials) + hidden == sum(len(openable_links(obj)) for obj, _ in objects) and len(trials) > hidden
    by_id = {obj.id: obj for obj, _ in objects}
    for item in trials:
        posed = Posed(by_id[item.trial.object], OPTIONS.camera)
        rng = np.random.default_rng(item.trial.seed)
        links = observe(posed, posed.poses(item.trial.start), item.trial.view, OPTIONS.points, rng).links
        assert np.isin(links, posed.obj.descendants(item.trial.link)).sum() >= MIN_VISIBLE // 2


def test_a_trial_depends_on_the_seed_and_its_object_alone(objects: list[tuple[ArticulatedObject, str]]) -> None:
    everything, _ = schedule(objects, OPTIONS, seed=0)
    assert schedule(objects, OPTIONS, seed=0)[0] == everything
    alone, _ = schedule(objects[:1], OPTIONS, seed=0)
    assert alone == [item for item in everything if item.trial.object == objects[0][0].id] != []
    assert [t.trial.view for t in schedule(objects, OPTIONS, seed=1)[0]] != [t.trial.view for t in everything]


def test_a_key_tells_all_that_a_trial_is(objects: list[tuple[ArticulatedObject, str]], tmp_path: Path) -> None:
    """Two rows of one key ran the same trial, wherever the object's folder lay; anything else gives another key."""
    obj = objects[0][0]
    trial = schedule(objects[:1], OPTIONS, seed=0)[0][0].trial
    key = trial_key(obj, trial, "target")
    moved = shutil.copytree(obj.urdf.parent, tmp_path / obj.id)
    assert trial_key(load_object(moved), replace(trial), "target") == key
    view = replace(trial.view, azimuth=trial.view.azimuth + 1e-9)
    start = (trial.start[0] + 1e-12, *trial.start[1:])
    others = [{"view": view}, {"start": start}, {"goal": 0.5}, {"seed": trial.seed + 1}, {"link": trial.link + 1}]
    keys = {
        trial_key(obj, replace(trial, **{name: value}), "target") for other in others for name, value in other.items()
    }
    semantics = moved / "semantics.txt"
    semantics.write_text(semantics.read_text() + "\n")
    keys |= {trial_key(obj, trial, "any"), trial_key(load_object(moved), trial, "target")}
    keys |= {trial_key(replace(obj, content=""), trial, "target")}  # made in memory: its links count
    assert len(keys | {key}) == len(others) + 4


def test_a_limit_takes_the_categories_in_turn(objects: list[tuple[ArticulatedObject, str]]) -> None:
    trials, _ = schedule(objects, OPTIONS, seed=0, limit=3)
    assert {item.category for item in trials} == {"StorageFurniture", "KitchenPot", "Microwave"}
    assert len(trials) == 3


def test_protocols_start_where_they_say(objects: list[tuple[ArticulatedObject, str]]) -> None:
    def fractions(how: ScheduleOptions) -> tuple[NDArray[np.float64], NDArray[np.float64], list[Scheduled]]:
        items, _ = schedule(objects, OPTIONS, seed=0, how=how)
        starts, goals = [], []
        for item in items:
            obj = next(obj for obj, _ in objects if obj.id == item.trial.object)
            closed, opened = opening_range(obj)
            j = obj.movable.index(item.trial.link)
            goal = opened[j] if item.trial.goal is None else item.trial.goal
            starts.append((item.trial.start[j] - closed[j]) / (opened[j] - closed[j]))
            goals.append((goal - closed[j]) / (opened[j] - closed[j]))
        return np.array(starts), np.array(goals), items

    start, goal, items = fractions(ScheduleOptions(start="closed", repeats=5))
    assert (start == 0).all() and (goal == 1).all()
    assert {item.repeat for item in items} == set(range(5))
    assert len({(item.trial.view, item.trial.seed) for item in items}) == len(items), "each has a view and seed"
    once, _ = schedule(objects, OPTIONS, seed=0, how=ScheduleOptions(start="closed"))
    assert [item for item in items if item.repeat == 0] == once
    start, goal, _ = fractions(ScheduleOptions(start="random", repeats=10))
    assert start.min() < 0.2 and 0.7 < start.max() <= 0.9 and (goal == 1).all()
    start, goal, _ = fractions(ScheduleOptions(goal="state", repeats=10))
    assert (abs(goal - start) > 0.299).all() and (goal > start).any() and (goal < start).any()
