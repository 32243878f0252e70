"""A plan: the network's flow and the policy's choice, whatever the frame, the scale and the surroundings."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import fb3d_rl
from fb3d_rl.errors import UserError
from fb3d_rl.geometry.transforms import quaternion_to_matrix
from fb3d_rl.models.artflownet import ArtFlowNet, Hypotheses
from fb3d_rl.policies.contact import choose_contact
from fb3d_rl.policies.options import ContactOptions

See = Callable[..., Any]


def _rotation(seed: int) -> Any:
    q = torch.randn(4, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return quaternion_to_matrix(q).numpy()


def test_flow_and_contact_are_those_of_network_and_policy(see: See, net: ArtFlowNet) -> None:
    seen = see()
    points, part = seen.points[:1200], seen.part[:1200]
    points[:, 2] -= points[:, 2].min()  # the ground is at 0
    found = fb3d_rl.plan(points, part, seen.camera, model=net)
    flow = net.predict(points, part)
    np.testing.assert_allclose(found.flow, flow, atol=1e-6)
    assert found.foreground.all() and found.scale == 1 and not found.remarks
    tensors = [torch.from_numpy(x)[None] for x in (points, part, flow * part[:, None], seen.camera.astype(np.float32))]
    chosen, _ = choose_contact(
        tensors[0], torch.ones_like(tensors[1]), tensors[1], tensors[2], tensors[3], torch.zeros(1, 3),
        torch.tensor([[-1.0, 0, 0]]), torch.zeros_like(tensors[1]), ContactOptions(near=0.0, turning=0.0),
    )  # fmt: skip
    np.testing.assert_allclose(found.contact_point, chosen.point[0], atol=1e-6)
    np.testing.assert_allclose(found.pull, chosen.flow[0], atol=1e-6)
    np.testing.assert_allclose(found.standoff, chosen.standoff[0], atol=1e-6)
    np.testing.assert_allclose(found.precontact_point, found.contact_point + 0.1 * found.standoff, atol=1e-6)
    np.testing.assert_allclose(quaternion_to_matrix(torch.from_numpy(found.quaternion)), found.rotation, atol=1e-9)
    np.testing.assert_allclose(found.rotation @ [-1, 0, 0], found.standoff, atol=1e-5)  # the hand is behind the tip


@pytest.mark.parametrize("seed", [0, 1])
def test_the_plan_turns_moves_and_scales_with_the_cloud(see: See, net: ArtFlowNet, seed: int) -> None:
    seen = see()
    points, part = seen.points[:1200].astype(np.float64), seen.part[:1200]
    before = fb3d_rl.plan(points, part, seen.camera, model=net)
    turn, shift = _rotation(seed), np.array([3.0, -200.0, 0.5])
    front, up = turn @ [-1.0, 0, 0], turn @ [0, 0, 1.0]
    after = fb3d_rl.plan(points @ turn.T + shift, part, turn @ seen.camera + shift, model=net, up=up, front=front)
    cosine = (after.flow @ turn * before.flow).sum(1)[part] / np.linalg.norm(before.flow, axis=1)[part] ** 2
    assert np.median(np.abs(cosine - 1)) < 1e-3
    np.testing.assert_allclose(turn.T @ after.pull, before.pull, atol=0.02)
    world = points @ turn.T + shift
    upright = world @ after.T_world_cloud[:3, :3].T + after.T_world_cloud[:3, 3]
    assert upright[:, 2].min() == pytest.approx(0.0, abs=1e-4)
    assert np.abs(np.linalg.norm(world - after.contact_point, axis=1)).min() < 1e-4, "a point of the cloud"
    small = fb3d_rl.plan(0.2 * points, part, 0.2 * seen.camera, model=net)
    likeness = torch.cosine_similarity(*(torch.from_numpy(x.flow)[torch.from_numpy(part)] for x in (small, before)))
    assert small.scale > 3 and likeness.median() > 0.95
    np.testing.assert_allclose(small.precontact_point - small.contact_point, 0.1 * small.standoff, atol=1e-6)


def test_a_table_and_a_wall_are_left_out(see: See, net: ArtFlowNet) -> None:
    seen = see()
    points, part = seen.points[:4000], seen.part[:4000]
    rng = np.random.default_rng(0)
    table = np.c_[rng.uniform(-2.5, 2.5, (4000, 2)), rng.normal(size=4000) * 0.002]
    table = table[np.abs(table[:, :2]).max(1) > 0.8] + [0, 0, points[:, 2].min() - 0.02]
    wall = np.c_[np.full(2000, 6.0), rng.uniform(-3, 3, (2000, 1)), rng.uniform(0, 3, (2000, 1))]
    scene, marks = np.concatenate([points, table, wall]), np.r_[part, np.zeros(len(table) + len(wall), bool)]
    tilted = _rotation(0)
    up = tilted @ [0.1, -0.1, 1.0]  # eight degrees off
    found = fb3d_rl.plan(scene @ tilted.T, marks, tilted @ seen.camera, model=net, up=up, far=7.0)
    assert found.foreground[: len(points)].mean() > 0.93 and found.foreground[len(points) :].mean() < 0.02
    np.testing.assert_allclose(found.T_world_cloud[2, :3], tilted @ [0, 0, 1.0], atol=0.01)
    assert "support plane" in " ".join(found.remarks)
    bare = fb3d_rl.plan(points, part, seen.camera, model=net)
    np.testing.assert_allclose(tilted.T @ found.pull, bare.pull, atol=0.25)


def test_without_a_mask_and_with_several_hypotheses(see: See) -> None:
    seen = see()
    several = ArtFlowNet(neighbors=16, hypotheses=3, generator=torch.Generator().manual_seed(0)).eval()
    found = fb3d_rl.plan(seen.points[:1200], None, seen.camera, model=several)
    probabilities = [one.probability for one in found.hypotheses]
    assert sum(probabilities) == pytest.approx(1) and probabilities == sorted(probabilities, reverse=True)
    assert len(found.hypotheses) == 3 and found.part is None and "no mask" in " ".join(found.remarks)
    for one in found.hypotheses:
        assert np.linalg.norm(one.pull) == pytest.approx(1, abs=1e-5)
        nearest = np.linalg.norm(found.points - one.contact_point, axis=1).argmin()
        flow = one.flow[nearest] / np.linalg.norm(one.flow[nearest])
        np.testing.assert_allclose(one.pull, flow, atol=1e-4)


def test_a_hypothesis_in_which_nothing_moves_is_left_out(see: See) -> None:
    seen = see()
    several = ArtFlowNet(neighbors=16, hypotheses=3, generator=torch.Generator().manual_seed(0)).eval()
    whole = several.propose

    def still(*clouds: torch.Tensor) -> Hypotheses:
        found = whole(*clouds)
        found.flows[:, 1] = 0.0
        return found

    several.propose = still  # type: ignore[method-assign]
    assert len(fb3d_rl.plan(seen.points[:1200], seen.part[:1200], seen.camera, model=several).hypotheses) == 2


def test_a_tool_that_is_near_a_point_prefers_it(see: See, net: ArtFlowNet) -> None:
    seen = see("StorageFurniture")
    points, part = seen.points[:1200], seen.part[:1200]
    anywhere = fb3d_rl.plan(points, part, seen.camera, model=net).contact_point
    goals = points[part][[points[part][:, 2].argmax(), points[part][:, 2].argmin()]]
    away = goals[np.linalg.norm(goals - anywhere, axis=1).argmax()]
    tool = [*(away + [-0.2, 0, 0]), 1, 0, 0, 0]
    near = fb3d_rl.plan(points, part, seen.camera, model=net, tool_pose=tool).contact_point
    assert np.linalg.norm(near - away) < np.linalg.norm(anywhere - away)


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"points": np.full((9, 3), np.nan)}, "finite"), ({"points": np.zeros((0, 3))}, "finite"),
        ({"points": np.zeros((9, 3))}, "same"), ({"up": "w"}, "up=w"), ({"up": [0, 0, 0]}, "up is 0"),
        ({"camera": [1, 2]}, "camera"), ({"camera": np.eye(3)}, "camera"), ({"tool_pose": [1, 2, 3]}, "tool_pose"),
        ({"ground": 50.0}, "support"), ({"far": 0.1}, "far"), ({"front": "z"}, "level"),
        ({"mask": np.zeros(300)}, "no point"), ({"model": "nowhere.safetensors"}, "nowhere"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_one_sentence(see: See, net: ArtFlowNet, change: dict[str, Any], word: str) -> None:
    seen = see()
    given: dict[str, Any] = {"points": seen.points[:300], "mask": seen.part[:300], "camera": seen.camera, "model": net}
    if "points" in change:
        given["mask"] = np.ones(len(change["points"]))
    with pytest.raises(UserError, match=word):
        fb3d_rl.plan(**(given | change))


HUGE = """
import resource, sys, time
import numpy as np
import fb3d_rl
from fb3d_rl.models.artflownet import ArtFlowNet, Hypotheses
net = ArtFlowNet.from_pretrained()
rng = np.random.default_rng(0)
points = rng.random((10_000_000, 3), dtype=np.float32)
points[:, 2] = 0.3 * np.sin(5 * points[:, 0]) + 1
mask = points[:, 1] > 0.5
net.predict(points[:100], mask[:100])
for work in (lambda: net.predict(points, mask), lambda: fb3d_rl.plan(points, mask, model=net).flow):
    start = time.process_time()
    flow = work()
    seconds = time.process_time() - start
    assert flow.shape == points.shape and np.isfinite(flow).all() and (np.abs(flow).max(1) > 0).all()
    print(seconds, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20)
"""


@pytest.mark.slow
@pytest.mark.alone
def test_ten_million_points(tmp_path: Path) -> None:
    root = Path(__file__).resolve().parents[2]
    done = subprocess.run([sys.executable, "-c", HUGE], cwd=root, capture_output=True, text=True, check=True)
    for line in done.stdout.splitlines():
        seconds, gib = map(float, line.split())
        assert seconds < 20 and gib < 4, line  # of both cores together
