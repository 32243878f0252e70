"""Objects and scripted motions for the tests of the environment."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import Tensor

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.assets.partnet_mobility import load_object
from fb3d_rl.env.options import EnvOptions, GripperOptions, default_trial
from fb3d_rl.env.task import OpenArticulatedEnv
from fb3d_rl.kinematics.opening import openable_links

POINTS = 256


@pytest.fixture(scope="session")
def env(objects: dict[str, ArticulatedObject]) -> OpenArticulatedEnv:
    """One environment for all objects; every test resets it."""
    return OpenArticulatedEnv(objects.values(), EnvOptions(points=POINTS))


@pytest.fixture(scope="session")
def real_objects() -> list[ArticulatedObject]:
    """A few objects of the real dataset, of which something opens."""
    root = os.environ.get("FB3D_PARTNET_MOBILITY")
    if not root:
        pytest.skip("FB3D_PARTNET_MOBILITY is unset; set it to the folder of PartNet-Mobility objects")
    loaded = [load_object(path.parent) for path in sorted(Path(root).glob("*/mobility.urdf"))[::20]]
    found = [obj for obj in loaded if openable_links(obj)]
    assert found, f"{root} holds no object that opens"
    return found


def links_called(obj: ArticulatedObject, semantic: str) -> list[int]:
    """Links of ``obj`` with that semantic name."""
    return [i for i, link in enumerate(obj.links) if link.semantic == semantic]


def velocity(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Tensor:
    """An action [1, 8] for hand velocities in m/s, at the default v_max."""
    return torch.tensor([[x, y, z, 0.0, 0.0, 0.0, 0.0, 0.0]]) / GripperOptions().v_max


def place_before(env: OpenArticulatedEnv, link: int, obs: dict[str, dict[str, Tensor]]) -> None:
    """Put the hand straight in front of the visible middle of ``link``, its tip 0.1 m away."""
    on_link = obs["observation"]["points"][0][obs["privileged"]["link"][0] == link]
    nearest = (on_link - on_link.mean(0)).norm(dim=-1).argmin()
    hand = torch.zeros(1, 8)
    hand[0, :3] = on_link[nearest] - torch.tensor([0.22, 0.0, 0.0])
    env.agent.robot.set_qpos(hand)


def step_until(
    env: OpenArticulatedEnv, action: Tensor, stop: Callable[[], bool], limit: int = 80
) -> tuple[bool, tuple]:
    """Repeat ``action`` until ``stop()``; whether it stopped, and the last step's result."""
    for _ in range(limit):
        result = env.step(action)
        if stop():
            return True, result
    return False, result


def start(env: OpenArticulatedEnv, obj: ArticulatedObject, link: int) -> dict[str, dict[str, Tensor]]:
    """Reset to the default trial of one link."""
    return env.reset(options={"trials": [default_trial(obj, link)]})[0]
