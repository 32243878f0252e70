"""Joint velocities for a velocity of the tip (supplement I.G): damped, within limits, clear of the robot itself."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from fb3d_rl.errors import UserError
from fb3d_rl.robot.arm import SPEED, Arm
from fb3d_rl.robot.collision import Checker

SINGULAR = 0.05
"""Below this singular value of the Jacobian (angular velocities weighed by LEVER) the motion is damped."""

DAMPING = 0.05
"""Of a direction in which the tip cannot move at all."""

LEVER = 0.2
"""An angular velocity of 1 rad/s weighs as much as a velocity of so many m/s."""

BRAKE = 4.0
"""A joint approaches its limit, and a body another one, by this share of what is left, 1/s."""

AHEAD = 0.02
"""How far ahead distances between bodies are looked at, s."""

HELD = 0.01
"""A joint that is nearer to its limit (rad) than this and pushed towards it is held."""


CENTRING = 0.5
"""Joints go to the middle of their limits by this share of the way, 1/s, as far as a cup's motion leaves a choice."""

SOFT = (1e-4, 2e-3)
"""Added to the squares of the Jacobians' singular values for a cup: m^2 for its place, and for its turns."""


class Resolved(NamedTuple):
    """Joint velocities and what limits them.

    Attributes:
        velocity: [J], rad/s.
        share: how much of the velocity asked for the tip gets in its direction, 1 for all of it.
        held: joints [J] bool that stand at a limit and would have to go beyond it.
        slowed: the share, 0 to 1, that is left of the velocity so that bodies of the robot keep apart.
    """

    velocity: Tensor
    share: float
    held: Tensor
    slowed: float


def resolve(arm: Arm, q: Tensor, twist: Tensor, checker: Checker | None = None, speed: float = SPEED) -> Resolved:
    """Joint velocities that move the tip as asked, as far as the arm can.

    Joints near a limit slow down towards it, and the others take over what they can; if one would be too fast, all are
    slowed, so that the tip keeps its direction.

    Args:
        arm: the arm.
        q: joint state [J], rad.
        twist: velocity (m/s) and angular velocity (rad/s) of the tip in the base's axes [6].
        checker: what bodies must not come near; of its obstacles only the robot itself counts.
        speed: limit for all joints beside their own, rad/s.

    Raises:
        UserError: a number is not finite.
    """
    q, twist = q.to(arm.home), twist.to(arm.home)
    if not bool(torch.isfinite(torch.cat([q, twist])).all()):
        raise UserError("the arm's joint state, or the velocity that is asked of its tip, is not finite; stop the arm")
    weight = torch.tensor([1.0] * 3 + [LEVER] * 3, dtype=q.dtype)
    jacobian = arm.jacobian(q)
    least = (BRAKE * (arm.lower - q)).clamp_max(0.0)
    most = (BRAKE * (arm.upper - q)).clamp_min(0.0)
    velocity = torch.zeros_like(q)
    fixed = torch.zeros_like(q, dtype=torch.bool)
    for _ in range(len(q)):
        rest = weight * (twist - jacobian[:, fixed] @ velocity[fixed])
        velocity[~fixed] = _damped(weight[:, None] * jacobian[:, ~fixed], rest)
        beyond = (velocity < least - 1e-12) | (velocity > most + 1e-12)
        if not bool((beyond & ~fixed).any()):
            break
        velocity = torch.minimum(torch.maximum(velocity, least), most)
        fixed |= beyond
    held = fixed & (torch.minimum(q - arm.lower, arm.upper - q) < HELD)
    fastest = float((velocity.abs() / arm.velocity.clamp_max(speed)).max())
    velocity = velocity / max(fastest, 1.0)
    slowed = 1.0 if checker is None else _slowed(checker, q, velocity)
    velocity = slowed * velocity
    asked = weight * twist
    share = float((weight * (jacobian @ velocity)) @ asked / (asked @ asked).clamp_min(1e-12))
    return Resolved(velocity, share, held, slowed)


def resolve_cup(
    arm: Arm, q: Tensor, velocity: Tensor, turn: Tensor, checker: Checker | None = None, speed: float = SPEED
) -> Resolved:
    """Joint velocities that move a cup as asked: its place first, then its tilt, then its turn about its own axis.

    Bellows bear some tilt, and a lip some twist, so that an arm follows a part farther than :func:`resolve` does. What
    is left of the choice brings the joints to the middle of their limits.

    Args:
        arm: the arm.
        q: joint state [J], rad.
        velocity: of the tip in the base's axes [3], m/s.
        turn: its angular velocity [3], rad/s.
        checker: as of :func:`resolve`.
        speed: likewise.

    Returns:
        The share is that of ``velocity``.

    Raises:
        UserError: a number is not finite.
    """
    q, velocity, turn = (x.to(arm.home) for x in (q, velocity, turn))
    if not bool(torch.isfinite(torch.cat([q, velocity, turn])).all()):
        raise UserError("the arm's joint state, or the velocity that is asked of its tip, is not finite; stop the arm")
    pose, tasks, rest = cup_tasks(arm, q[None])
    asked = cup_errors(pose, velocity[None], turn[None])
    least = (BRAKE * (arm.lower - q)).clamp_max(0.0)
    most = (BRAKE * (arm.upper - q)).clamp_min(0.0)
    found, fixed = torch.zeros_like(q), torch.zeros_like(q, dtype=torch.bool)
    for _ in range(len(q)):
        left = torch.where(fixed, found, 0.0)
        todo = [x - task @ left for x, task in zip(asked, tasks, strict=True)]
        found = torch.where(fixed, left, by_priority(tasks, todo, rest, ~fixed[None])[0])
        beyond = ~fixed & ((found < least - 1e-12) | (found > most + 1e-12))
        if not bool(beyond.any()):
            break
        found, fixed = torch.minimum(torch.maximum(found, least), most), fixed | beyond
    # What is too fast gives up the tilt before the place.
    left = torch.where(fixed, found, 0.0)
    todo = [asked[0] - tasks[0] @ left]
    bare = torch.where(fixed, left, by_priority(tasks[:1], todo, torch.zeros_like(rest), ~fixed[None])[0])
    fastest = arm.velocity.clamp_max(speed)
    room = (fastest - bare.abs()).clamp_min(0.0) / (found - bare).abs().clamp_min(1e-12)
    found = bare + min(1.0, float(room.min())) * (found - bare)
    held = fixed & (torch.minimum(q - arm.lower, arm.upper - q) < HELD)
    found = found / max(float((found.abs() / fastest).max()), 1.0)
    slowed = 1.0 if checker is None else _slowed(checker, q, found)
    found = slowed * found
    share = float(((tasks[0][0] @ found) @ velocity) / (velocity @ velocity).clamp_min(1e-12))
    return Resolved(found, share, held, slowed)


def cup_tasks(arm: Arm, q: Tensor) -> tuple[Tensor, list[Tensor], Tensor]:
    """What counts of a cup's motion, at joint states [B, J].

    Returns:
        T_base_tip [B, 4, 4]; Jacobians of its place [B, 3, J], its tilt about its own x and y [B, 2, J] and its turn
        about its own axis [B, 1, J]; and joint velocities [B, J] to the middle of the limits.
    """
    pose, jacobian = arm.pose_and_jacobian(q)
    own = pose[:, :3, :3].mT @ jacobian[:, 3:]
    middle = (arm.lower + arm.upper) / 2
    return pose, [jacobian[:, :3], own[:, :2], own[:, 2:]], CENTRING * (middle - q)


def cup_errors(pose: Tensor, velocity: Tensor, turn: Tensor) -> list[Tensor]:
    """A velocity and an angular velocity [B, 3] of the tip at T_base_tip [B, 4, 4], as the tasks of cup_tasks."""
    own = (pose[:, :3, :3].mT @ turn[..., None]).squeeze(-1)
    return [velocity, own[:, :2], own[:, 2:]]


def by_priority(tasks: Sequence[Tensor], wanted: Sequence[Tensor], rest: Tensor, free: Tensor) -> Tensor:
    """Joint steps [B, J] that fulfil tasks in turn, each as far as those before it leave a choice.

    Args:
        tasks: Jacobians [B, K, J].
        wanted: what each of them times the steps is to be [B, K].
        rest: the steps that are preferred, [B, J].
        free: joints [B, J] that may move.
    """
    step = torch.zeros_like(rest)
    null = torch.diag_embed(free.to(rest))
    for task, goal in zip(tasks, wanted, strict=True):
        within = task @ null
        square = (within @ within.mT).numpy() + SOFT[task is not tasks[0]] * np.eye(task.shape[-2])
        inverse = within.mT @ torch.from_numpy(np.linalg.inv(square))
        step = step + (null @ inverse @ (goal - (task @ step[..., None]).squeeze(-1))[..., None]).squeeze(-1)
        null = null - null @ inverse @ within
    return step + (null @ rest[..., None]).squeeze(-1)


def _damped(jacobian: Tensor, twist: Tensor) -> Tensor:
    """Least-squares joint velocities [J] for a twist [6], damped where the Jacobian [6, J] is nearly singular."""
    if jacobian.shape[1] == 0:
        return twist.new_zeros(0)
    u, size, vh = torch.linalg.svd(jacobian, full_matrices=False)
    damping = DAMPING**2 * (1.0 - (size / SINGULAR).clamp_max(1.0).square())
    return vh.mT @ (size / (size.square() + damping).clamp_min(1e-12) * (u.mT @ twist))


def _slowed(checker: Checker, q: Tensor, velocity: Tensor) -> float:
    """How much of joint velocities [J] leaves each pair of bodies its distance, or approaches it gently."""
    now, then = checker.clearance(torch.stack([q, q + AHEAD * velocity]).numpy()).itself
    closing = (now - then) / AHEAD
    allowed = BRAKE * now.clip(0.0)
    return float(min(1.0, (allowed / closing.clip(1e-9))[closing > 1e-9].min(initial=1.0)))
