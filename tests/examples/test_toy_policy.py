"""A policy from outside the package: an entry in the registry, and the command's own function evaluates it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase

from fb3d_rl.algos.run import run_evaluation
from fb3d_rl.policies.flow_policy import FlowPolicyOptions
from fb3d_rl.policies.hand import VelocityLimits, hand_axis, joint_velocities
from fb3d_rl.policies.policy import Policy
from fb3d_rl.registry import REGISTRY, Access, Entry
from fb3d_rl.rollout.rows import read_trials

LIMITS = VelocityLimits(linear=2.0, angular=3.0)

# ------------------------------------------------------------------------------------------------------------- the toy


class TouchAndPull(Policy):
    """Moves the tip to the nearest visible point of the part, and once suction holds it, straight back."""

    in_keys = [("observation", key) for key in ("points", "valid", "part_mask", "qpos", "tool_pose", "attached")]
    out_keys = ["action"]

    def __init__(self, limits: VelocityLimits, speed: float = 0.5) -> None:
        super().__init__()
        self.limits, self.speed = limits, speed

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        obs = tensordict["observation"]
        way = obs["points"] - obs["tool_pose"][:, None, :3]
        distance = way.norm(dim=-1).masked_fill(~(obs["part_mask"] & obs["valid"]), torch.inf)
        nearest = way[torch.arange(len(way)), distance.argmin(-1)]
        back = hand_axis(obs["tool_pose"])
        seen = distance.isfinite().any(-1, keepdim=True)
        there = torch.where(seen, torch.nn.functional.normalize(nearest, dim=-1), 0.0)
        velocity = self.speed * torch.where(obs["attached"], back, there)
        tensordict["action"] = joint_velocities(obs, back, velocity, torch.zeros_like(velocity), self.limits)
        return tensordict


def make(limits: VelocityLimits, options: FlowPolicyOptions) -> TouchAndPull:
    return TouchAndPull(limits)


# ----------------------------------------------------------------------------------------------------------- its tests


def test_it_goes_to_the_nearest_valid_point_of_the_part_and_back_once_it_holds_it() -> None:
    observation = {
        "points": torch.tensor([[1.0, 0, 0], [0, 0, 0.2], [0, 0.1, 0], [0, 3, 0]]).expand(3, 4, 3),
        "valid": torch.tensor([True, True, False, True]).expand(3, 4),
        "part_mask": torch.tensor([[True, False, True, True]] * 2 + [[False, False, True, False]]),
        "qpos": torch.zeros(3, 8),
        "tool_pose": torch.tensor([0.0, 0, 0, 1, 0, 0, 0]).expand(3, 7),
        "attached": torch.tensor([[False], [True], [False]]),
    }
    action = make(LIMITS, FlowPolicyOptions())(TensorDict({"observation": observation}, batch_size=[3]))["action"]
    expected = torch.zeros(3, 8)
    expected[0, 0], expected[1, 0] = 0.25, -0.25  # 0.5 of 2 m/s; the third sees no point of the part and stays
    torch.testing.assert_close(action, expected)


def test_it_is_evaluated_by_its_name(
    tmp_path: Path, config: Callable[[str, list[str]], Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(REGISTRY, "touch_and_pull", Entry({"": Access("nothing")}, act=f"{__name__}:make"))
    words = ["experiment=smoke", "assets.categories=[StorageFurniture]", "policy.name=touch_and_pull"]
    words += ["evaluation.trials=1", "evaluation.expert=false"]
    words += ["data.points=128", "camera.resolution=32", "env.horizon=60"]
    rows = run_evaluation(config("evaluate", words), tmp_path)
    assert read_trials(tmp_path / "rows.csv") == rows
    assert [(row.policy, row.status, row.mask) for row in rows] == [("touch_and_pull", "ok", "target")]
    assert rows[0].contact, "suction held the part"
