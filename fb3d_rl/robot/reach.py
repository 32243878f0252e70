"""Which joint states before a contact are worth planning to: from which the tip comes straight to the contact without
touching anything, and can then follow the part furthest.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from fb3d_rl.geometry.rigid_motion import screw
from fb3d_rl.geometry.transforms import rigid
from fb3d_rl.robot.arm import CUP_RADIUS, Arm
from fb3d_rl.robot.attempt import Ended, Reason
from fb3d_rl.robot.collision import Checker, Obstacles
from fb3d_rl.robot.inverse import pose_error, precontact_poses, solve
from fb3d_rl.robot.planning import distinct
from fb3d_rl.robot.seeing import Motion
from fb3d_rl.robot.velocity import by_priority, cup_errors, cup_tasks
from fb3d_rl.robot.workspace import cell
from fb3d_rl.seeds import derived

Array = NDArray[np.float64]

SPACING, RADIUS, MARGIN = 0.01, 0.006, 0.003
"""Distance of the points of the object's cloud as obstacles, their radius, and what the arm keeps from them, m."""

FINE = 0.4
"""All three are smaller by this factor near the contact, on the last way to it."""

NEAR = 0.12
"""So near, m: as far as cup and gripper reach."""

CONTACT = CUP_RADIUS + FINE * (RADIUS + MARGIN) + 0.004
"""On the last way the cup may touch what is this near to the contact, m."""

STEPS = 10
"""States of the last way that are checked; further ones are between them where the arm moves far."""

SLIDE, TURN = 0.3, 1.6
"""How far ahead a part is followed, m and rad."""

STRIDES = 24
"""States of that."""

ROUNDS = 3
"""Steps of the inverse kinematics between two states of a way."""

ROUND = 0.2
"""The time that one of them stands for, s: how far joints come to the middle of their limits."""

OFF = 0.003
"""A tip that is further from its way (m) does not follow it."""

TILT = 0.5
"""Nor does a cup that is tilted more, rad; its bellows bear that."""

STRAIGHT = 0.05
"""On the last way to the contact it is tilted by less, rad."""

CLOSE = 0.95
"""Of the joint states those are kept that follow the part this share as far as the best one."""


def thinned(points: Array, spacing: float) -> Array:
    """The first of the points [P, 3] in each cube of an edge of ``spacing`` m."""
    return points[np.sort(np.unique(np.round(points / spacing), axis=0, return_index=True)[1])]


def obstacles_of(cloud: Array, camera: Array) -> Obstacles:
    """Cell and object as obstacles, of the object's dense cloud [P, 3] and the camera's place [3], m."""
    return Obstacles(cell(camera), thinned(cloud, SPACING), RADIUS)


class Reached(NamedTuple):
    """Joint states before a contact.

    Attributes:
        goals: [G, J] rad, those nearest to the present one first.
        poses: T_base_tip [8, 4, 4] before the contact that they reach.
        follows: share of the part's way ahead that the best of them follow.
    """

    goals: Array
    poses: Tensor
    follows: float


def before_contact(
    arm: Arm,
    here: Array,
    motion: Motion,
    cloud: Array,
    part: NDArray[np.bool_],
    camera: Array,
    standoff: float,
    seed: int,
) -> Reached:
    """Joint states from which to approach a contact.

    Args:
        arm: the arm.
        here: its joint state [J] now.
        motion: of the part at the contact ``motion.at``, which the cup faces.
        cloud: of the object [P, 3], m.
        part: which of its points [P] move with the part.
        camera: where the camera is [3], m.
        standoff: distance from the contact, m.
        seed: of the inverse kinematics.

    Raises:
        Ended: there is none.
    """
    contact, way = torch.as_tensor(motion.at), torch.as_tensor(motion.velocity)
    poses = precontact_poses(contact, way, arm.tip(torch.as_tensor(here)), standoff)
    solutions = solve(arm, poses, torch.as_tensor(here), seed=derived(seed, "before"))
    goals = distinct(solutions, here)
    if not len(goals):
        raise Ended(Reason.UNREACHABLE, str(solutions.reason()))
    free = Checker(arm, obstacles_of(cloud, camera), MARGIN).free(goals)
    if not free.any():
        raise Ended(
            Reason.GOAL_COLLISION,
            f"the arm would touch something {100 * standoff:.0f} cm before the contact, in all of the {len(goals)} "
            f"joint states found for it",
        )
    goals = goals[free]
    distance = np.linalg.norm(cloud - motion.at, axis=1)
    near = thinned(cloud[(distance < NEAR) & (distance > CONTACT)], FINE * SPACING)
    way_in = torch.linspace(0.0, standoff, STEPS + 1, dtype=torch.float64)[1:]
    start = torch.as_tensor(goals)
    first = arm.tip(start)
    targets = first.repeat(STEPS, 1, 1, 1)
    targets[..., :3, 3] -= way_in[:, None, None] * way
    q, on = followed(arm, start, targets)
    straight = on.all(0) & (_tilt(arm.tip(q), -way) < STRAIGHT).all(0)
    clear = [
        Checker(arm, obstacles_of(cloud[distance >= NEAR], camera), MARGIN),
        Checker(arm, Obstacles((), near, FINE * RADIUS), FINE * MARGIN),
    ]
    comes = straight & torch.stack([_clear(checker, q) for checker in clear]).all(0).all(0)
    if not bool(comes.any()):
        blocked = bool(straight.any())
        what = "would touch something" if blocked else "comes to its joints' limits"
        raise Ended(
            Reason.APPROACH_COLLISION if blocked else Reason.UNREACHABLE,
            f"on the straight way to the contact the arm {what}, from all of the {len(goals)} joint states before it",
        )
    standing = Checker(arm, obstacles_of(cloud[~part], camera), MARGIN)
    share = _follows(arm, q[-1][comes], motion, standing, thinned(cloud[part & (distance > NEAR / 2)], SPACING))
    kept = share >= CLOSE * share.max()
    return Reached(goals[comes.numpy()][kept], poses, float(share.max()))


def _tilt(poses: Tensor, way: Tensor) -> Tensor:
    """Angles [...] (rad) between the cup's axes at T_base_tip [..., 4, 4] and unit directions [..., 3]."""
    return (poses[..., :3, 2] * way).sum(-1).clamp(-1.0, 1.0).arccos()


def _clear(checker: Checker, q: Tensor) -> Tensor:
    """Whether joint states [S, G, J] are free of collisions, [S, G]."""
    return torch.from_numpy(checker.free(q.flatten(0, 1).numpy())).view(q.shape[:2])


def _follows(arm: Arm, start: Tensor, motion: Motion, standing: Checker, part: Array) -> Array:
    """Share [G] of a part's way ahead on which the arm follows it and touches neither what stands nor the part.

    Args:
        arm: the arm.
        start: joint states [G, J] at the contact.
        motion: of the part.
        standing: checks what does not move.
        part: the part's cloud [P, 3] (m) now, without the surroundings of the contact.
    """
    rate = float(np.linalg.norm(motion.turn))
    ahead = min(SLIDE, TURN / max(rate, 1e-6))
    times = torch.linspace(0.0, ahead, STRIDES + 1, dtype=torch.float64)[1:]
    velocity, turn = torch.as_tensor(motion.velocity), torch.as_tensor(motion.turn)
    turned, shift = screw(velocity.expand(STRIDES, 3), turn.expand(STRIDES, 3), times)
    contact = torch.as_tensor(motion.at)
    moved = rigid(turned, shift + contact - turned @ contact)
    q, on = followed(arm, start, moved[:, None] @ arm.tip(start))
    on = on & _clear(standing, q)
    for step, pose in enumerate(moved.numpy()):
        there = Obstacles((), part @ pose[:3, :3].T + pose[:3, 3], RADIUS)
        on[step] &= torch.from_numpy(Checker(arm, there, MARGIN).free(q[step].numpy()))
    return np.asarray(on.int().cumprod(0).sum(0).numpy() / STRIDES)


def followed(arm: Arm, start: Tensor, targets: Tensor) -> tuple[Tensor, Tensor]:
    """Joint states in which a cup follows ways of the tip as :func:`~fb3d_rl.robot.velocity.resolve_cup` does.

    Args:
        arm: the arm.
        start: [G, J] rad.
        targets: T_base_tip [S, G, 4, 4], near each other.

    Returns:
        Joint states [S, G, J], and whether the tip is on its way and the cup tilted by no more than it bears [S, G].
    """
    q, states, on = start, [], []
    for target in targets:
        for _ in range(ROUNDS):
            pose, tasks, rest = cup_tasks(arm, q)
            error = pose_error(pose, target)
            todo = cup_errors(pose, error[:, :3], error[:, 3:])
            step = by_priority(tasks, todo, ROUND * rest, torch.ones_like(q, dtype=torch.bool))
            free = (q + step >= arm.lower) & (q + step <= arm.upper)
            if not bool(free.all()):
                step = by_priority(tasks, todo, ROUND * rest, free)
            q = (q + step.clamp(-0.2, 0.2)).clamp(arm.lower, arm.upper)
        states.append(q)
        pose = arm.tip(q)
        off = (pose[:, :3, 3] - target[:, :3, 3]).norm(dim=-1)
        on.append((off < OFF) & (_tilt(pose, target[:, :3, 2]) < TILT))
    return torch.stack(states), torch.stack(on)
