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
from fb3d_rl.robot.inverse import SCALE, pose_error, precontact_poses, solve, solved
from fb3d_rl.robot.planning import distinct
from fb3d_rl.robot.seeing import Motion
from fb3d_rl.robot.workspace import cell
from fb3d_rl.seeds import derived

Array = NDArray[np.float64]

RADIUS = 0.006
"""Of the points of the object's cloud as obstacles, m: about half of their distance."""

MARGIN = 0.003
"""To keep from them, m."""

CONTACT = CUP_RADIUS + RADIUS + MARGIN + 0.004
"""On the last way the cup may touch what is this near to the contact, m."""

STEPS = 10
"""States of the last way that are checked; further ones are between them where the arm moves far."""

SLIDE, TURN = 0.3, 1.6
"""How far ahead a part is followed, m and rad."""

STRIDES = 24
"""States of that."""

ROUNDS = 3
"""Steps of the inverse kinematics between two states of a way."""

OFF = 0.004
"""A tip that is further from its way (m, or rad times SCALE) does not follow it."""

CLOSE = 0.95
"""Of the joint states those are kept that follow the part this share as far as the best one."""


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
    arm: Arm, here: Array, motion: Motion, cloud: Array, camera: Array, standoff: float, seed: int
) -> Reached:
    """Joint states from which to approach a contact.

    Args:
        arm: the arm.
        here: its joint state [J] now.
        motion: of the part at the contact ``motion.at``, which the cup faces.
        cloud: of the object [P, 3], m.
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
    boxes = cell(camera)
    free = Checker(arm, Obstacles(boxes, cloud, RADIUS), MARGIN).free(goals)
    if not free.any():
        raise Ended(
            Reason.GOAL_COLLISION,
            f"the arm would touch something {100 * standoff:.0f} cm before the contact, in all of the {len(goals)} "
            f"joint states found for it",
        )
    goals = goals[free]
    away = cloud[np.linalg.norm(cloud - motion.at, axis=1) > CONTACT]
    way_in = torch.linspace(0.0, standoff, STEPS + 1, dtype=torch.float64)[1:]
    start = torch.as_tensor(goals)
    first = arm.tip(start)
    targets = first.repeat(STEPS, 1, 1, 1)
    targets[..., :3, 3] -= way_in[:, None, None] * way
    q, on = followed(arm, start, targets)
    comes = on.all(0) & _clear(Checker(arm, Obstacles(boxes, away, RADIUS), MARGIN), q).all(0)
    if not bool(comes.any()):
        blocked = bool(on.all(0).any())
        what = "would touch something" if blocked else "comes to its joints' limits"
        raise Ended(
            Reason.APPROACH_COLLISION if blocked else Reason.UNREACHABLE,
            f"on the straight way to the contact the arm {what}, from all of the {len(goals)} joint states before it",
        )
    share = _follows(arm, q[-1][comes], targets[-1][comes], motion, Checker(arm, Obstacles(boxes), MARGIN))
    kept = share >= CLOSE * share.max()
    return Reached(goals[comes.numpy()][kept], poses, float(share.max()))


def _clear(checker: Checker, q: Tensor) -> Tensor:
    """Whether joint states [S, G, J] are free of collisions, [S, G]."""
    return torch.from_numpy(checker.free(q.flatten(0, 1).numpy())).view(q.shape[:2])


def _follows(arm: Arm, start: Tensor, touching: Tensor, motion: Motion, checker: Checker) -> Array:
    """Share [G] of a part's way ahead on which the tip follows it, from joint states [G, J] at the contact."""
    rate = float(np.linalg.norm(motion.turn))
    ahead = min(SLIDE, TURN / max(rate, 1e-6))
    times = torch.linspace(0.0, ahead, STRIDES + 1, dtype=torch.float64)[1:]
    velocity, turn = torch.as_tensor(motion.velocity), torch.as_tensor(motion.turn)
    turned, shift = screw(velocity.expand(STRIDES, 3), turn.expand(STRIDES, 3), times)
    contact = torch.as_tensor(motion.at)
    moved = rigid(turned, shift + contact - turned @ contact)
    q, on = followed(arm, start, moved[:, None] @ touching)
    return np.asarray((on & _clear(checker, q)).int().cumprod(0).sum(0).numpy() / STRIDES)


def followed(arm: Arm, start: Tensor, targets: Tensor) -> tuple[Tensor, Tensor]:
    """Joint states that follow ways of the tip, as far as the joints' limits let them.

    Args:
        arm: the arm.
        start: [G, J] rad.
        targets: T_base_tip [S, G, 4, 4], near each other.

    Returns:
        Joint states [S, G, J], and whether the tip is on its way [S, G].
    """
    q, states, on = start, [], []
    weight = torch.tensor([1.0] * 3 + [SCALE] * 3, dtype=q.dtype)
    eye = 1e-6 * torch.eye(6, dtype=q.dtype)
    for target in targets:
        for _ in range(ROUNDS):
            pose, jacobian = arm.pose_and_jacobian(q)
            j = weight[:, None] * jacobian
            error = (weight * pose_error(pose, target))[..., None]
            step = (j.mT @ solved(j @ j.mT + eye, error)).squeeze(-1)
            q = (q + step.clamp(-0.2, 0.2)).clamp(arm.lower, arm.upper)
        states.append(q)
        on.append((weight * pose_error(arm.tip(q), target)).norm(dim=-1) < OFF)
    return torch.stack(states), torch.stack(on)
