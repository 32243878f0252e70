from __future__ import annotations

import numpy as np
import pytest
import torch

from fb3d_rl.geometry.transforms import alignment, rotate
from fb3d_rl.robot.arm import panda, sawyer
from fb3d_rl.robot.inverse import pose_error, precontact_poses, rotation_vector, solve

ARMS = pytest.mark.parametrize("arm", [sawyer, panda], ids=["sawyer", "panda"])


@ARMS
def test_poses_of_joint_states_are_reached_within_the_limits(arm) -> None:
    arm = arm()
    q = torch.as_tensor(np.random.default_rng(3).uniform(arm.lower, arm.upper, (40, 7)))
    targets = arm.tip(q)
    found = solve(arm, targets, arm.home, starts=24)
    assert found.reached.any(1).float().mean() >= 0.95
    assert bool(arm.within(found.q).all())
    error = pose_error(arm.tip(found.q), targets[:, None].expand(-1, 24, -1, -1))[found.reached]
    assert float(error[:, :3].norm(dim=-1).max()) < 1e-3
    assert float(error[:, 3:].norm(dim=-1).max()) < 1e-2
    assert found.reason() is None


def test_the_same_seed_gives_the_same_joint_states_and_another_one_others() -> None:
    arm = sawyer()
    targets = arm.tip(arm.home + 0.3)[None]
    first, again, other = (solve(arm, targets, seed=seed).q for seed in (0, 0, 1))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_the_middle_of_the_limits_is_preferred() -> None:
    arm = sawyer()
    start = torch.tensor([0.2, -1.0, 2.5, 1.5, -0.5, 1.0, 0.3], dtype=torch.float64)
    target = arm.tip(start)
    target[:3, 3] += 0.02
    found = solve(arm, target[None], start, starts=1)
    middle = (arm.lower + arm.upper) / 2
    assert bool(found.reached.all())
    plain = start + torch.linalg.pinv(arm.jacobian(start)) @ pose_error(arm.tip(start), target)
    assert float((found.q[0, 0] - middle).norm()) < float((plain - middle).norm())


def test_a_pose_beyond_reach_says_how_far_the_arm_stays_away() -> None:
    arm = sawyer()
    far = torch.eye(4, dtype=torch.float64)
    far[:3, 3] = torch.tensor([2.5, 0.0, 0.5])
    found = solve(arm, far[None])
    assert not bool(found.reached.any())
    assert "cm and" in str(found.reason())
    assert float(found.position_error.min()) > 1.0


def test_rotation_vectors_undo_rotations() -> None:
    vectors = torch.tensor([[0.0, 0.0, 0.0], [1e-6, 0, 0], [0.3, -1.0, 0.4], [0.0, 3.14, 0.0]], dtype=torch.float64)
    eye = torch.eye(3, dtype=torch.float64)
    matrices = torch.stack([rotate(eye, vector[None]).mT for vector in vectors])
    torch.testing.assert_close(rotation_vector(matrices), vectors, atol=1e-9, rtol=0.0)


def test_the_cup_faces_the_point_against_the_flow_ten_centimetres_off() -> None:
    tip = sawyer().tip(sawyer().home)
    point = torch.tensor([0.7, 0.1, 0.3])
    flow = torch.tensor([-2.0, 0.4, 0.6])
    poses = precontact_poses(point, flow, tip)
    way = (flow / flow.norm()).double()
    for pose in poses:
        torch.testing.assert_close(pose[:3, 2], -way, atol=1e-6, rtol=0.0)
        torch.testing.assert_close(pose[:3, 3], point.double() + 0.1 * way, atol=1e-6, rtol=0.0)
        torch.testing.assert_close(pose[:3, :3] @ pose[:3, :3].mT, torch.eye(3).double(), atol=1e-9, rtol=0.0)
        assert float(torch.linalg.det(pose[:3, :3])) > 0.0
    angles = rotation_vector(poses[:, :3, :3] @ tip[:3, :3].mT).norm(dim=-1)
    assert int(angles.argmin()) == 0
    assert float(angles[0]) == pytest.approx(float(alignment(tip[:3, 2], -way).norm()), abs=1e-6)
    turned = rotation_vector(poses[1:, :3, :3] @ poses[:-1, :3, :3].mT)
    torch.testing.assert_close(turned, (way * torch.pi / 4).expand(7, 3), atol=1e-6, rtol=0.0)
