"""Baselines that learn nothing: random actions that repeat, and normals that face the camera."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict

from fb3d_rl.algos.run import run_evaluation
from fb3d_rl.policies.baselines import NormalFlow, RandomPolicy, normal_policy
from fb3d_rl.policies.hand import VelocityLimits
from fb3d_rl.rollout.rows import read_trials

Config = Callable[[str, list[str]], Any]
SMALL = [
    "experiment=smoke",
    "assets.categories=[Microwave,KitchenPot]",
    "data.points=256",
    "camera.resolution=48",
    "evaluation.trials=2",
]


def test_random_actions_repeat_and_differ_between_trials_and_steps() -> None:
    seed, step = torch.meshgrid(torch.arange(20) + 1_000_000, torch.arange(50), indexing="ij")
    td = TensorDict({"seed": seed.reshape(-1, 1), "elapsed_steps": step.reshape(-1, 1)}, batch_size=[1000])
    actions = RandomPolicy()(td.clone())["action"]
    order = torch.randperm(1000, generator=torch.Generator().manual_seed(0))
    assert torch.equal(RandomPolicy()(td[order])["action"], actions[order]), "nor does the place in the batch count"
    assert actions.dtype == torch.float32 and len(actions.unique()) > 7900, "no two are alike"
    assert actions.min() >= -1 and actions.max() <= 1 and actions.mean().abs() < 0.03
    assert abs(float(actions.var()) - 1 / 3) < 0.02, "uniform"


def dome(camera: torch.Tensor) -> TensorDict:
    """The upper half of a unit sphere, of which the part is what lies at x > 0, with padding that holds anything."""
    points = torch.nn.functional.normalize(torch.randn(1, 800, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    points[..., 2] = points[..., 2].abs()
    valid = torch.arange(800)[None] < 700
    observation = {
        "points": points.masked_fill(~valid[..., None], 7.0),
        "valid": valid,
        "part_mask": points[..., 0] > 0,
        "camera_position": camera[None],
    }
    return TensorDict({"observation": observation}, batch_size=[1])


def test_the_normal_s_flow_is_unit_normals_towards_the_camera_on_the_part_alone() -> None:
    camera = torch.tensor([6.0, 1.0, 9.0])
    td = NormalFlow(12)(dome(camera))
    flow, points = td["prediction", "flow"][0], td["observation", "points"][0]
    part = (td["observation", "part_mask"] & td["observation", "valid"])[0]
    assert part.sum() > 200 and not flow[~part].any()
    torch.testing.assert_close(flow[part].norm(dim=-1), torch.ones(int(part.sum())))
    assert (((camera - points[part]) * flow[part]).sum(-1) > 0).all()
    faces = part & (((camera - points) * points).sum(-1) > 0.2)  # a sphere's outward normal is the point itself
    assert (flow[faces] * points[faces]).sum(-1).mean() > 0.97
    inside = NormalFlow(12)(dome(0.1 * camera / camera.norm()))["prediction", "flow"][0]
    assert (inside[faces] * points[faces]).sum(-1).mean() < -0.9, "seen from within they point inwards"


def test_neither_sees_anything_privileged() -> None:
    for policy in (RandomPolicy(), normal_policy(VelocityLimits(2.0, 3.0))):
        assert not [key for key in policy.in_keys if "privileged" in key]


@pytest.mark.slow
def test_baselines_are_evaluated_and_random_ones_repeat_in_workers(tmp_path: Path, config: Config) -> None:
    rows = {}
    for name, words in {
        "random": [],
        "again": ["collector=process", "collector.workers=2", "evaluation.expert=false"],
        "normal": ["evaluation.expert=false"],
    }.items():
        policy = "normal" if name == "normal" else "random"
        run_evaluation(config("evaluate", [*SMALL, f"policy={policy}", *words]), tmp_path / name)
        rows[name] = [row for row in read_trials(tmp_path / name / "rows.csv") if row.policy != "expert"]
        assert [row.policy for row in rows[name]] == [policy] * 2
        assert all(row.status == "ok" for row in rows[name])
    assert rows["again"] == rows["random"]
    assert any(row.contact for row in rows["normal"])
