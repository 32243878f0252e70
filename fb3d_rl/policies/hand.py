"""The hand's kinematics: linear and angular velocity in the world, to and from normalised joint velocities."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torch import Tensor

from fb3d_rl.contract import ACTION_DIM
from fb3d_rl.geometry.transforms import euler_xyz_jacobian, normalize


@dataclass(frozen=True)
class VelocityLimits:
    """What action 1 means, m/s and rad/s, and how long it lasts, s; has to be the gripper's."""

    linear: float
    angular: float
    period: float = 0.05


def hand_axis(tool_pose: Tensor) -> Tensor:
    """v_1 of I.F [..., 3]: from the suction tip to the hand, which is the tool frame's -x axis."""
    w, x, y, z = normalize(tool_pose[..., 3:]).unbind(-1)
    # The first column of the rotation matrix, turned round.
    return torch.stack([2 * (y * y + z * z) - 1, -2 * (x * y + w * z), 2 * (w * y - x * z)], dim=-1)


def across(hand: Tensor, vectors: Tensor) -> Tensor:
    """The part of vectors [..., 3] across unit hand axes [..., 3]; the spin about the axis is free."""
    return vectors - (hand * vectors).sum(-1, keepdim=True) * hand


def joint_velocities(
    obs: TensorDictBase, hand: Tensor, velocity: Tensor, angular: Tensor, limits: VelocityLimits
) -> Tensor:
    """Normalised joint velocities [E, 8] that move the tip at ``velocity`` and turn the hand at ``angular``.

    The hand's spin about its own axis is free, so only the axis is controlled: damped least squares on the part of the
    Euler Jacobian that turns it, which stays calm where the angles lock. The fingers stay as they are.

    Args:
        obs: the contract's "observation" group, of which qpos and tool_pose are read.
        hand: [E, 3] unit hand axes, see :func:`hand_axis`.
        velocity: [E, 3] m/s in the world.
        angular: [E, 3] rad/s in the world.
        limits: what action 1 means.
    """
    jacobian = euler_xyz_jacobian(obs["qpos"][..., 3:6])
    wanted = across(hand, angular)
    speed = torch.linalg.vector_norm(wanted, dim=-1, keepdim=True)
    wanted = wanted * (limits.angular / speed.clamp_min(1e-9)).clamp_max(1.0)
    turning = across(hand[..., None, :], jacobian.mT)  # one row for each of the three angles
    gram = turning @ turning.mT + 1e-2 * torch.eye(3, dtype=hand.dtype, device=hand.device)
    rates = torch.cholesky_solve(turning @ wanted[..., None], torch.linalg.cholesky(gram)).squeeze(-1)
    rates = rates.clamp(-limits.angular, limits.angular)
    omega = (jacobian @ rates[..., None]).squeeze(-1)
    lever = obs["tool_pose"][..., :3] - obs["qpos"][..., :3]
    linear = (velocity - torch.linalg.cross(omega, lever)) / limits.linear
    linear = linear / linear.abs().amax(-1, keepdim=True).clamp_min(1.0)
    fingers = torch.zeros(*rates.shape[:-1], ACTION_DIM - 6, dtype=rates.dtype, device=rates.device)
    return torch.cat([linear, rates / limits.angular, fingers], dim=-1)


def hand_velocities(obs: TensorDictBase, hand: Tensor, joints: Tensor) -> tuple[Tensor, Tensor]:
    """Tip velocity [..., 3] (m/s) and angular velocity of the hand axis [..., 3] (rad/s) of joint velocities.

    The inverse of :func:`joint_velocities`, up to its damping and the spin about the hand's axis, which is 0.

    Args:
        obs: the contract's "observation" group, of which qpos and tool_pose are read.
        hand: [..., 3] unit hand axes.
        joints: [..., 8] m/s and rad/s.
    """
    omega = (euler_xyz_jacobian(obs["qpos"][..., 3:6]) @ joints[..., 3:6, None]).squeeze(-1)
    lever = obs["tool_pose"][..., :3] - obs["qpos"][..., :3]
    velocity = joints[..., :3] + torch.linalg.cross(omega, lever)
    return velocity, across(hand, omega)
