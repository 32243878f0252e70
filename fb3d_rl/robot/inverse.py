"""Inverse kinematics: joint states that bring the tip to a pose, by damped least squares from several starts."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from fb3d_rl.errors import UserError
from fb3d_rl.geometry.transforms import alignment, matrix_to_quaternion, normalize, rigid, rotate
from fb3d_rl.robot.arm import Arm

STARTS = 12
"""Joint states that each search starts from."""

ROUNDS = 80
"""Most steps of a search."""

CLOSE = (1e-4, 1e-3)
"""A pose is reached within so many m and rad."""

STRIDE = 0.4
"""The most that a joint moves in one step, rad."""

CENTRING = 0.05
"""How far a step goes towards the middle of the joints' limits, as far as that leaves the tip where it is."""

SCALE = 0.2
"""An error of 1 rad weighs as much as one of so many m."""


class Solutions(NamedTuple):
    """Joint states for R poses from S starts.

    Attributes:
        q: [R, S, J] within the limits, rad.
        reached: whether the tip gets to its pose, [R, S] bool.
        position_error: [R, S], m.
        rotation_error: [R, S], rad.
    """

    q: Tensor
    reached: Tensor
    position_error: Tensor
    rotation_error: Tensor

    def reason(self) -> str | None:
        """Why none of the poses is reached, in one sentence; None if one is."""
        if bool(self.reached.any()):
            return None
        best = int((self.position_error + SCALE * self.rotation_error).argmin())
        off, turned = float(self.position_error.flatten()[best]), float(self.rotation_error.flatten()[best])
        return (
            f"the arm cannot bring its tip to the pose: within its joint limits it stays {100 * off:.1f} cm and "
            f"{np.degrees(turned):.0f} degrees away from it"
        )


def rotation_vector(rotation: Tensor) -> Tensor:
    """Rotation vectors [..., 3] (rad, angle at most pi) of rotation matrices [..., 3, 3]."""
    quaternion = matrix_to_quaternion(rotation)
    sine = quaternion[..., 1:].norm(dim=-1, keepdim=True)
    return 2 * torch.atan2(sine, quaternion[..., :1]) * normalize(quaternion[..., 1:])


def pose_error(pose: Tensor, target: Tensor) -> Tensor:
    """The way [..., 6] from a pose to another one [..., 4, 4]: m, then the rotation vector in the base's axes (rad)."""
    turn = target[..., :3, :3] @ pose[..., :3, :3].mT
    return torch.cat([target[..., :3, 3] - pose[..., :3, 3], rotation_vector(turn)], dim=-1)


def precontact_poses(point: Tensor, flow: Tensor, tip: Tensor, distance: float = 0.1, rolls: int = 8) -> Tensor:
    """Poses of the tip before a contact (supplement I.F, I.G): off the point along the flow, the cup facing against it.

    Args:
        point: [3] m.
        flow: [3] of any length but 0.
        tip: T_base_tip [4, 4] now.
        distance: from the point, m.
        rolls: how many poses. The cup is round, so that each turn about its axis serves.

    Returns:
        T_base_tip [rolls, 4, 4]. The first is turned as little as possible, as the supplement has it; the others follow
        turned on about the flow.

    Raises:
        UserError: the flow is 0, or a number is not finite.
    """
    if not (bool(torch.isfinite(flow).all() & torch.isfinite(point).all()) and bool(flow.any())):
        raise UserError("the flow at the contact is 0, or it or the contact is not finite: there is no way to approach")
    way = normalize(flow.to(tip))
    turn = alignment(tip[:3, 2], -way)
    facing = rotate(tip[:3, :3].mT, turn[None]).mT
    angles = torch.arange(rolls, dtype=tip.dtype) * (2 * torch.pi / rolls)
    rotations = rotate(facing.mT[None], (angles[:, None] * way)[:, None]).mT
    return rigid(rotations, (point.to(tip) + distance * way).expand(rolls, 3))


def solve(arm: Arm, targets: Tensor, start: Tensor | None = None, starts: int = STARTS, seed: int = 0) -> Solutions:
    """Joint states for poses of the tip.

    The search (Levenberg-Marquardt, damped by the error left as Sugihara's, IEEE T-RO 2011) starts from a given joint
    state, the arm's home and random ones, keeps the limits by stopping joints at them, and goes to the middle of the
    limits as far as the tip allows. It ends when a third of all has arrived.

    Args:
        arm: the arm.
        targets: T_base_tip [R, 4, 4].
        start: the joint state [J] now.
        starts: how many joint states to start from.
        seed: of the random ones; the same for all poses.
    """
    limits = arm.lower.numpy(), arm.upper.numpy()
    drawn = torch.as_tensor(np.random.default_rng(seed).uniform(*limits, (starts, len(arm.lower))))
    known = torch.stack([arm.home] if start is None else [start.to(arm.home), arm.home])[:starts]
    begin = torch.cat([known, drawn])[:starts]
    target = targets.to(arm.home).repeat_interleave(starts, 0)
    q = begin.repeat(len(targets), 1)
    middle, weight = (arm.lower + arm.upper) / 2, torch.tensor([1.0] * 3 + [SCALE] * 3, dtype=q.dtype)
    for _ in range(ROUNDS):
        pose, jacobian = arm.pose_and_jacobian(q)
        error = pose_error(pose, target)
        arrived = _close(error)
        if arrived.float().mean() >= 1 / 3 and bool(arrived.view(len(targets), -1).any(1).all()):
            break
        e, j = weight * error, weight[:, None] * jacobian
        damping = 0.5 * e.square().sum(-1, keepdim=True) + 1e-6
        lever = solved(j @ j.mT + torch.diag_embed(damping.expand(-1, 6)), j).mT  # [R S, J, 6]
        centring = CENTRING * (middle - q)
        step = (lever @ (e - (j @ centring[..., None]).squeeze(-1))[..., None]).squeeze(-1) + centring
        step = step * (STRIDE / step.abs().amax(-1, keepdim=True).clamp_min(STRIDE))
        q = torch.where(arrived[:, None], q, (q + step).clamp(arm.lower, arm.upper))
    error = pose_error(arm.tip(q), target)
    shape = (len(targets), starts)
    return Solutions(
        q.view(*shape, -1),
        _close(error).view(shape),
        error[:, :3].norm(dim=-1).view(shape),
        error[:, 3:].norm(dim=-1).view(shape),
    )


def solved(matrices: Tensor, sides: Tensor) -> Tensor:
    """Solutions of many small systems; NumPy's, since torch's wait for their threads on a busy machine."""
    return torch.from_numpy(np.linalg.solve(matrices.numpy(), sides.numpy()))


def _close(error: Tensor) -> Tensor:
    return (error[..., :3].norm(dim=-1) <= CLOSE[0]) & (error[..., 3:].norm(dim=-1) <= CLOSE[1])
