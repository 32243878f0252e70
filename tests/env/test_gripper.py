"""The floating gripper obeys its velocities, and its frames are what the package's formulas say."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.assets.gripper import BODIES, HAND_LENGTH, TIP
from fb3d_rl.env.gripper import JOINTS
from fb3d_rl.env.task import OpenArticulatedEnv
from fb3d_rl.geometry.transforms import euler_xyz_jacobian, euler_xyz_to_matrix, quaternion_to_matrix

from .conftest import start


@pytest.fixture(autouse=True)
def _reset(env: OpenArticulatedEnv, objects: dict[str, ArticulatedObject]) -> None:
    start(env, objects["Table"], objects["Table"].movable[0])


def test_frames_are_an_euler_chain(env: OpenArticulatedEnv) -> None:
    assert [joint.name for joint in env.agent.robot.active_joints] == list(JOINTS)
    qpos = torch.tensor([[-2.0, 0.3, 1.1, 0.7, -0.4, 1.9, 0.0, 0.0]])
    env.agent.robot.set_qpos(qpos)
    rotation = euler_xyz_to_matrix(qpos[:, 3:6])
    tool = env.agent.tool_pose()
    torch.testing.assert_close(quaternion_to_matrix(tool[:, 3:]), rotation, atol=1e-5, rtol=0)
    torch.testing.assert_close(tool[:, :3], qpos[:, :3] + TIP * rotation[..., 0], atol=1e-5, rtol=0)
    assert (tool[:, 3] >= 0).all()


def test_the_hand_reaches_as_far_behind_its_tip_as_policies_think(env: OpenArticulatedEnv) -> None:
    hand = env.agent.robot.links_map[BODIES[0]]._objs[0]
    behind = [shape.local_pose.p[0] - shape.half_size[0] for shape in hand.collision_shapes]
    assert pytest.approx(TIP - min(behind), abs=1e-6) == HAND_LENGTH


@pytest.mark.parametrize("axis", range(6))
def test_commanded_velocity_is_kept(env: OpenArticulatedEnv, axis: int) -> None:
    limits = [env.options.gripper.v_max] * 3 + [env.options.gripper.w_max] * 3
    before = env.agent.robot.get_qpos().clone()
    action = torch.zeros(1, 8)
    action[0, axis] = -0.25
    for _ in range(10):
        obs, *_ = env.step(action)
    expected = torch.zeros(1, 8)
    expected[0, axis] = -0.25 * limits[axis]
    moved = obs["observation"]["qpos"] - before
    torch.testing.assert_close(moved, 10 * env.control_timestep * expected, atol=2e-3, rtol=0)
    torch.testing.assert_close(obs["observation"]["qvel"], expected, atol=2e-3, rtol=0)


def test_angular_velocity_follows_the_jacobian(env: OpenArticulatedEnv) -> None:
    qpos = torch.tensor([[-2.0, 0.0, 1.0, 0.5, -0.6, 0.9, 0.0, 0.0]])
    env.agent.robot.set_qpos(qpos)
    action = torch.tensor([[0.0, 0.0, 0.0, 0.2, -0.3, 0.4, 0.0, 0.0]])
    env.step(action)
    state = env.agent.robot.get_qpos()[0], env.agent.robot.get_qvel()[0]
    omega = torch.as_tensor(env.agent.robot.links_map["hand"]._objs[0].angular_velocity.copy())
    expected = euler_xyz_jacobian(state[0][3:6]) @ state[1][3:6]
    torch.testing.assert_close(omega, expected, atol=5e-3, rtol=0)


def test_gripper_floats_and_its_fingers_stay_closed(env: OpenArticulatedEnv) -> None:
    before = env.agent.robot.get_qpos().clone()
    for _ in range(20):
        obs, *_ = env.step(torch.zeros(1, 8))
    torch.testing.assert_close(obs["observation"]["qpos"], before, atol=1e-5, rtol=0)
    assert np.allclose(obs["observation"]["contact_force"], 0.0)


def test_drives_get_the_numbers_that_maniskill_gives_them(env: OpenArticulatedEnv) -> None:
    drives = [joint._objs[0] for joint in env.agent.robot.active_joints]

    def targets() -> list[float]:
        return [float(drive.drive_velocity_target.item()) for drive in drives]

    generator = torch.Generator().manual_seed(0)
    for _ in range(20):
        action = 2.4 * torch.rand(1, 8, generator=generator) - 1.2  # some of it out of range
        env.agent.controller.set_action(action)
        expected = targets()
        env.agent.set_action(torch.zeros(1, 8))
        assert targets() == [0.0] * 8
        env.agent.set_action(action)
        assert targets() == expected
