"""What flow samples train besides ArtFlowNet: projections, screws, directions; what is learned, and runs in small."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict, TensorDictBase

from fb3d_rl.algos.flow_network import FlowNetwork
from fb3d_rl.algos.flowbotpp import flowbotpp_objective
from fb3d_rl.algos.run import run_evaluation
from fb3d_rl.algos.run import run_training as run
from fb3d_rl.algos.screwnet import screw_loss, screw_objective
from fb3d_rl.algos.ump_di import direction_cosine
from fb3d_rl.algos.weights import load_trained
from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.camera.raycast import CameraOptions
from fb3d_rl.data.samples import SampleOptions, draw_sample
from fb3d_rl.errors import UserError
from fb3d_rl.kinematics.joint_screw import (
    JointScrew,
    flow_of_screw,
    projection_of_flow,
    screw_of_flow,
    screw_of_projection,
)
from fb3d_rl.models.artflownet import ArtFlowNet
from fb3d_rl.models.cloud_network import CloudNetwork
from fb3d_rl.models.flowbotpp import FlowProjectionNet
from fb3d_rl.models.screwnet import ScrewNet
from fb3d_rl.policies.flow_policy import FlowPolicyOptions
from fb3d_rl.policies.hand import VelocityLimits
from fb3d_rl.registry import REGISTRY, behind
from fb3d_rl.rollout.rows import read_trials
from fb3d_rl.scene.posed import Posed
from fb3d_rl.training.fit import fit
from fb3d_rl.training.options import FitOptions
from fb3d_rl.training.run_log import RunLog, read_rows

Config = Callable[[str, list[str]], Any]
KINDS: dict[str, FlowNetwork] = {
    name: behind(entry.algorithm) for name, entry in REGISTRY.items() if entry.options == REGISTRY["artflownet"].options
}
BASELINES = ["flowbotpp", "screwnet", "ump_di"]
GIVEN_CONTACT = {"ump_di"}
"""Policies of networks that may read the true flow, for where to touch."""
SMALL = [
    "experiment=smoke",
    "assets.categories=[Microwave]",
    "data.points=256",
    "data.workers=0",
    "camera.resolution=48",
    "evaluation.trials=1",
    "evaluation.expert=false",
]
TRAINING = [
    "algo.epochs=1.0",
    "algo.batch_size=4",
    "algo.neighbors=16",
    "algo.log_every=1",
    "algo.evaluate_every=2",
    "algo.checkpoint_every=2",
    "data.train_samples=16",
]
OPTIONS = FitOptions(
    steps=200, batch_size=2, lr=2e-3, schedule="one_cycle", clip_norm=1.0, rotate=False, log_every=1000
)


def network(name: str) -> CloudNetwork:
    return KINDS[name].network(neighbors=16, backbone="delayed", generator=torch.Generator().manual_seed(0))


@pytest.fixture(scope="module")
def door(procedural_objects: dict[str, ArticulatedObject]) -> TensorDictBase:
    """One cloud of a microwave, twice."""
    view = Posed(procedural_objects["Microwave"], CameraOptions(resolution=48))
    sample = draw_sample(view, SampleOptions(points=256, all_parts_share=0.0), np.random.default_rng(1))
    assert isinstance(sample, TensorDict)
    return sample.expand(2).clone()


def learned(name: str, samples: TensorDictBase) -> tuple[CloudNetwork, dict[str, float]]:
    """A network after 200 steps, and its numbers on what it has seen."""
    net, kind = network(name), KINDS[name]
    assert kind.objective is not None
    fit(net, samples, OPTIONS, objective=kind.objective(net, OPTIONS), progress=False)
    return net, {key: float(value.mean()) for key, value in kind.measure(net, samples, torch.device("cpu")).items()}


def test_screwnet_learns_one_cloud(door: TensorDictBase) -> None:
    net, numbers = learned("screwnet", door)
    assert numbers["rmse"] < 0.05 and numbers["cosine"] > 0.99
    observed = [door["observation", key] for key in ("points", "valid", "part_mask")]
    flow = net(*observed)
    assert not flow[~observed[2]].any()
    assert net.screw(*observed).revolute.all()
    nothing = net(observed[0], observed[1], torch.zeros_like(observed[2]))
    assert not nothing.any(), "no part, no flow"


def test_flow_and_projection_are_learned_on_one_cloud(door: TensorDictBase) -> None:
    net, numbers = learned("flowbotpp", door)
    assert numbers["cosine"] > 0.99 and numbers["projection_error"] < 0.05
    assert isinstance(net, FlowProjectionNet)
    points, valid, part = (door["observation", key] for key in ("points", "valid", "part_mask"))
    found, residual = screw_of_projection(points, *net.motions(points, valid, part), part)
    true, _ = screw_of_flow(points, door["privileged", "flow"], part)
    assert found.revolute.all() and residual.max() < 0.1
    assert (found.axis * true.axis).sum(-1).min() > 0.99, "within 8 degrees"


def loss_of(flow: torch.Tensor, projection: torch.Tensor, samples: TensorDictBase) -> float:
    """The loss of a network that answers with ``flow`` and ``projection``."""
    net = network("flowbotpp")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(net, "motions", lambda *_: (flow, projection))
        return float(flowbotpp_objective(net, OPTIONS)(samples, 0))


def test_the_loss_of_flow_and_projection_counts_what_is_wrong(door: TensorDictBase) -> None:
    points, valid, part = (door["observation", key] for key in ("points", "valid", "part_mask"))
    flow = door["privileged", "flow"]
    projection, turns = projection_of_flow(points, flow, part)
    assert turns.all() and not projection[~part].any()
    assert loss_of(flow, projection, door) == 0.0
    everywhere = torch.tensor([0.0, 0.0, 0.1])
    assert loss_of(flow + everywhere, projection, door) == pytest.approx(0.01)
    share = float(part.sum() / valid.sum())
    assert 0.1 < share < 0.9
    assert loss_of(flow, projection + everywhere, door) == pytest.approx(0.01 * (1 + share))
    off_part = projection + everywhere * ~part[..., None]
    assert loss_of(flow, off_part, door) == 0.0, "a projection counts on the part only"
    drawer = door.clone()
    slides = JointScrew(torch.zeros(2, dtype=torch.bool), torch.tensor([[1.0, 0, 0]]).expand(2, 3), torch.zeros(2, 3))
    drawer["privileged", "flow"] = flow_of_screw(slides, points, part)
    assert loss_of(drawer["privileged", "flow"], projection, drawer) == 0.0, "what slides has none"


def test_directions_are_learned_on_one_cloud(door: TensorDictBase) -> None:
    before = direction_cosine(network("ump_di").eval(), door, torch.device("cpu"))["cosine"]
    net, numbers = learned("ump_di", door)
    assert numbers["cosine"] > 0.97 > before.max()
    door = door[:1].clone()
    door["privileged", "flow"] = torch.zeros_like(door["privileged", "flow"])
    assert direction_cosine(net, door, torch.device("cpu"))["cosine"].isnan().all()


def test_the_screw_loss_is_zero_at_the_truth_and_counts_what_is_wrong(door: TensorDictBase) -> None:
    points, part = door["observation", "points"], door["observation", "part_mask"]
    target, _ = screw_of_flow(points, door["privileged", "flow"], part)
    sure, count = torch.full(part.shape, 50.0), part.shape[1]
    axis = target.axis[:, None].expand(-1, count, -1)
    along = target.origin[:, None] + 0.7 * axis  # any point on the axis will do
    assert screw_loss((sure, axis, along), target, points, part) < 1e-6
    reach = torch.linalg.cross(points - along, axis).norm(dim=-1)[part].max()
    side = torch.linalg.cross(target.axis, torch.tensor([[1.0, 2.0, 3.0]]).expand(2, 3))
    beside = along + 0.1 * reach * torch.nn.functional.normalize(side, dim=-1)[:, None]
    torch.testing.assert_close(screw_loss((sure, axis, beside), target, points, part), torch.tensor(0.01))
    torch.testing.assert_close(screw_loss((sure, -axis, along), target, points, part), torch.tensor(4.0))
    assert screw_loss((-sure, axis, along), target, points, part) > 40
    slides = target._replace(revolute=torch.zeros(2, dtype=torch.bool))
    assert screw_loss((-sure, axis, beside), slides, points, part) < 1e-6, "where it slides there is no origin"


def test_clouds_of_several_joints_are_no_labels(door: TensorDictBase) -> None:
    net = network("screwnet")
    mixed = door.clone()
    half = torch.arange(256) < 128
    mixed["privileged", "flow"][:, half] = mixed["privileged", "flow"][:, half].roll(1, -1)
    assert isinstance(net, ScrewNet)
    objective = screw_objective(net, OPTIONS)
    assert objective(mixed, 0).item() == 0.0 < objective(door, 0).item()


@pytest.mark.parametrize("name", KINDS)
def test_no_policy_of_a_network_sees_anything_privileged_but_those_named(name: str) -> None:
    policy = KINDS[name].policy(network(name), VelocityLimits(2.0, 3.0), FlowPolicyOptions())
    privileged = {key for key in policy.in_keys if key[0] == "privileged"}
    assert privileged == ({("privileged", "flow")} if name in GIVEN_CONTACT else set())


@pytest.mark.parametrize("name", BASELINES)
def test_the_part_mask_cannot_be_left_out(name: str, config: Config) -> None:
    with pytest.raises(UserError, match=r"algo\.part_mask_input=true"):
        config("train", [f"algo={name}", "algo.part_mask_input=false"])


@pytest.mark.slow
@pytest.mark.parametrize("name", BASELINES)
def test_a_run_in_small_is_resumed_and_evaluated_bit_for_bit(name: str, tmp_path: Path, config: Config) -> None:
    words = [f"algo={name}", *SMALL, *TRAINING]
    first, again = tmp_path / "first", tmp_path / "again"
    run(config("train", words), first)
    assert [row.policy for row in read_trials(first / "rows.csv")] == [name]
    summary = json.loads((first / "summary.json").read_text())
    assert ("flow/cosine" in summary) == KINDS[name].flow and "success_rate" in summary
    metrics = read_rows(first / "metrics.jsonl", times=False)
    assert any("val/cosine" in row for row in metrics)
    best = load_trained(first / "best.safetensors", KINDS[name].network)
    assert type(best) is KINDS[name].network

    write = RunLog.write

    def stop_at_three(log: RunLog, row: dict[str, object]) -> None:
        if row["step"] == 3:
            raise KeyboardInterrupt
        write(log, row)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(RunLog, "write", stop_at_three)
        with pytest.raises(KeyboardInterrupt):
            run(config("train", words), again)
    run(config("train", [*words, "resume=true"]), again)
    assert read_rows(again / "metrics.jsonl", times=False) == metrics
    assert (again / "rows.csv").read_bytes() == (first / "rows.csv").read_bytes()

    evaluated = tmp_path / "evaluated"
    run_evaluation(config("evaluate", [*SMALL, f"policy={name}", f"checkpoint={first / 'checkpoint.pt'}"]), evaluated)
    assert (evaluated / "rows.csv").read_bytes() == (first / "rows.csv").read_bytes()
    with pytest.raises(UserError, match=f"checkpoint of {name}, not of artflownet"):
        load_trained(first / "checkpoint.pt", ArtFlowNet)


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["no_mask", "no_mask_vpa", "any_mask"])
def test_the_paper_s_variants_of_artflownet_are_evaluated(variant: str, tmp_path: Path, config: Config) -> None:
    words = [f"algo=artflownet_{variant}", *SMALL, *TRAINING]
    mask = "target" if variant == "any_mask" else "none"
    assert [row.mask for row in run(config("train", words), tmp_path)] == [mask]
    net = load_trained(tmp_path / "checkpoint.pt", ArtFlowNet)
    assert net.part_mask_input == (variant == "any_mask")
    given = ["policy=artflownet", f"checkpoint={tmp_path / 'checkpoint.pt'}"]
    rows = run_evaluation(config("evaluate", [*SMALL, *given]), tmp_path / "evaluated")
    assert [(row.policy, row.status) for row in rows] == [("artflownet", "ok")]
    assert [row.mask for row in rows] == [mask]
    assert ("held_opened_rate" in json.loads((tmp_path / "evaluated" / "summary.json").read_text())) == (mask == "none")
    assert (tmp_path / "evaluated" / "flow_rows_all_parts.csv").is_file()
