"""One trial is seen alike wherever it is looked at: by the task, as a flow sample, and on the live page."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
import torch
from tensordict import TensorDictBase

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.assets.gripper import gripper_meshes
from fb3d_rl.camera.raycast import CameraOptions
from fb3d_rl.data.samples import SampleOptions, flow_sample
from fb3d_rl.env.options import EnvOptions, Trial
from fb3d_rl.env.torchrl_env import TrialEnv, make_env
from fb3d_rl.live.session import Session
from fb3d_rl.policies.flow_policy import FlowPolicyOptions
from fb3d_rl.rollout.trials import schedule
from fb3d_rl.scene.observer import observe
from fb3d_rl.scene.posed import Posed

POINTS = 300
CAMERA = CameraOptions(resolution=64)
SAMPLES = SampleOptions(points=POINTS, camera=CAMERA)
OPTIONS = EnvOptions(points=POINTS, camera=CAMERA)
KEYS = (
    ("observation", "points"),
    ("observation", "valid"),
    ("observation", "part_mask"),
    ("privileged", "flow"),
)


@pytest.fixture(scope="module", params=["StorageFurniture", "Microwave", "KitchenPot"])
def trial(
    request: pytest.FixtureRequest, procedural_objects: dict[str, ArticulatedObject]
) -> tuple[ArticulatedObject, Trial]:
    """A scheduled trial of an object's first part."""
    obj = procedural_objects[request.param]
    return obj, min((item.trial for item in schedule([(obj, "")], SAMPLES, seed=0)[0]), key=lambda trial: trial.link)


@pytest.fixture(scope="module")
def env(trial: tuple[ArticulatedObject, Trial]) -> Iterator[TrialEnv]:
    made = make_env([trial[0]], OPTIONS)
    yield made
    made.close()


def sample_of(obj: ArticulatedObject, trial: Trial) -> TensorDictBase:
    posed = Posed(obj, CAMERA)
    cloud = observe(posed, posed.poses(trial.start), trial.view, POINTS, trial.cloud_rng())
    assert cloud.shows(trial.link)
    return flow_sample(cloud, trial.link)


def test_the_live_page_shows_the_sample(trial: tuple[ArticulatedObject, Trial]) -> None:
    session = Session(trial[0], SAMPLES, OPTIONS, FlowPolicyOptions(), seed=0)
    session.set_part(trial[1].link)
    sample, moment = sample_of(*trial), session.moment
    valid = sample["observation", "valid"]
    np.testing.assert_array_equal(moment.points, sample["observation", "points"][valid].numpy())
    np.testing.assert_array_equal(moment.part, sample["observation", "part_mask"][valid].numpy())
    np.testing.assert_array_equal(moment.flows["true"], sample["privileged", "flow"][valid].numpy())


def test_the_task_sees_what_the_observer_makes_of_its_poses(
    trial: tuple[ArticulatedObject, Trial], env: TrialEnv
) -> None:
    obj, wanted = trial
    env.set_trials([wanted])
    first = env.reset()[0]
    posed = Posed(obj, CAMERA, gripper_meshes())
    cloud = observe(posed, env._task.stages[0].poses(), wanted.view, POINTS, wanted.cloud_rng())
    expected = flow_sample(cloud, wanted.link)
    for key in KEYS:
        assert torch.equal(first[key], expected[key]), key
    assert torch.equal(first["privileged", "link"], torch.from_numpy(cloud.links))


def test_the_task_sees_the_sample(trial: tuple[ArticulatedObject, Trial], env: TrialEnv) -> None:
    """But for the simulator's rounding of poses, as long as the gripper hides nothing."""
    env.set_trials([trial[1]])
    first, sample = env.reset()[0], sample_of(*trial)
    for key in KEYS:
        torch.testing.assert_close(first[key], sample[key], atol=2e-5, rtol=0)
