"""The schedule of an evaluation."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fb3d_rl.assets import procedural
from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.assets.partnet_mobility import load_object
from fb3d_rl.camera.raycast import CameraOptions
from fb3d_rl.data.samples import MIN_VISIBLE, ObjectView, SampleOptions
from fb3d_rl.evaluation.trials import schedule
from fb3d_rl.flow.opening import openable_links

OPTIONS = SampleOptions(points=300, camera=CameraOptions(resolution=48))


@pytest.fixture(scope="module")
def objects(tmp_path_factory: pytest.TempPathFactory) -> list[tuple[ArticulatedObject, str]]:
    out: Path = tmp_path_factory.mktemp("objects")
    ids = procedural.generate(out, ["StorageFurniture", "KitchenPot", "Microwave"], 2, 5)
    return [(load_object(out / name), "train_test") for name in ids]


def test_one_trial_for_every_part_that_opens_and_shows(objects: list[tuple[ArticulatedObject, str]]) -> None:
    trials, hidden = schedule(objects, OPTIONS, seed=0)
    assert len(trials) + hidden == sum(len(openable_links(obj)) for obj, _ in objects)
    by_id = {obj.id: obj for obj, _ in objects}
    for item in trials:
        view = ObjectView(by_id[item.trial.object], OPTIONS.camera)
        _, links = view.cloud(
            np.array(item.trial.start), item.trial.view, OPTIONS.points, np.random.default_rng(item.trial.seed)
        )
        assert np.isin(links, view.obj.descendants(item.trial.link)).sum() >= MIN_VISIBLE // 2


def test_a_trial_depends_on_the_seed_and_its_object_alone(objects: list[tuple[ArticulatedObject, str]]) -> None:
    everything, _ = schedule(objects, OPTIONS, seed=0)
    assert schedule(objects, OPTIONS, seed=0)[0] == everything
    alone, _ = schedule(objects[:1], OPTIONS, seed=0)
    assert alone == [item for item in everything if item.trial.object == objects[0][0].id]
    assert [t.trial.view for t in schedule(objects, OPTIONS, seed=1)[0]] != [t.trial.view for t in everything]


def test_a_limit_takes_the_categories_in_turn(objects: list[tuple[ArticulatedObject, str]]) -> None:
    trials, _ = schedule(objects, OPTIONS, seed=0, limit=3)
    assert {item.category for item in trials} == {"StorageFurniture", "KitchenPot", "Microwave"}
    assert len(trials) == 3
