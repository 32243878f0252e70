"""Paths around obstacles in joint space: RRTConnect (Kuffner and LaValle, ICRA 2000) to the poses before a contact."""

from __future__ import annotations

import time
from dataclasses import dataclass
from enum import Enum

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from fb3d_rl.errors import UserError
from fb3d_rl.robot.arm import Arm
from fb3d_rl.robot.collision import Checker, Obstacles
from fb3d_rl.robot.inverse import STARTS, Solutions, pose_error, solve
from fb3d_rl.seeds import derived

Array = NDArray[np.float64]

STRIDE = 0.8
"""Longest edge that a tree grows by towards a drawn state, rad (Euclidean norm)."""

STRAIGHT = 4
"""To so many goals the straight way is tried first."""

NEAR = 1e-3
"""An edge shorter than this (rad) is none."""

NODES = 4000
"""Most joint states in both trees."""

SHORTCUTS = 60
"""How often a shorter way between two points of the path is tried."""

SEARCHES = (STARTS, 2 * STARTS, 4 * STARTS)
"""Inverse kinematics is tried from so many starts, others each time, until a joint state is free."""


class Failure(str, Enum):
    """Why there is no plan; a trial's row and the counts of failures have the value."""

    START_LIMITS = "start beyond limits"
    START = "start in collision"
    UNREACHABLE = "unreachable"
    GOAL = "goal in collision"
    TIMEOUT = "timeout"


@dataclass(frozen=True)
class Plan:
    """A path, or why there is none.

    Attributes:
        path: joint states [K, J] (rad) with straight pieces between them, from the start on; None without a plan.
        failure: why there is none.
        reason: the same in one sentence.
        goal: which of the poses the path leads to.
        nodes: joint states that the search looked at.
        seconds: that it took.
    """

    path: Array | None
    failure: Failure | None = None
    reason: str = ""
    goal: int = -1
    nodes: int = 0
    seconds: float = 0.0


def plan(
    arm: Arm,
    obstacles: Obstacles,
    start: Tensor | Array,
    poses: Tensor,
    seed: int = 0,
    timeout: float = 10.0,
    margin: float = 0.005,
    goals: Array | None = None,
) -> Plan:
    """A path to any of several poses of the tip that touches nothing; the same for the same arguments and seed.

    Only where the search is ended by ``timeout`` does it depend on the machine.

    Args:
        arm: the arm.
        obstacles: in its base's frame.
        start: joint state [J], rad.
        poses: T_base_tip [R, 4, 4], for example of :func:`~fb3d_rl.robot.inverse.precontact_poses`.
        seed: of all that is drawn.
        timeout: for the search, s.
        margin: to keep from everything, m; given up where the start is nearer than that, but free.
        goals: joint states [G, J] that bring the tip to one of the poses, the preferred first; searched unless given.

    Raises:
        UserError: a number is not finite.
    """
    began = time.monotonic()
    here = np.asarray(start, dtype=np.float64)
    if not (np.isfinite(here).all() and bool(torch.isfinite(poses).all())):
        raise UserError("the arm's joint state, or a pose that it is to go to, is not finite")
    result = _planned(arm, obstacles, here, poses, seed, began + timeout, margin, goals)
    return Plan(**{**vars(result), "seconds": time.monotonic() - began})


def _planned(
    arm: Arm,
    obstacles: Obstacles,
    here: Array,
    poses: Tensor,
    seed: int,
    deadline: float,
    margin: float,
    given: Array | None,
) -> Plan:
    if not bool(arm.within(torch.as_tensor(here))):
        return Plan(None, Failure.START_LIMITS, "the arm's joint state is beyond its limits; bring it back within them")
    touching = -float(Checker(arm, obstacles, 0.0).clearance(here[None]).least[0])
    if touching > 0:
        sentence = f"the arm is in collision where it starts, by {100 * touching:.1f} cm; move it away by hand"
        return Plan(None, Failure.START, sentence)
    checker = Checker(arm, obstacles, min(margin, -touching))
    if given is not None:
        return _to_goals(arm, checker, here, given, poses, seed, deadline)
    for search, starts in enumerate(SEARCHES):
        solutions = solve(arm, poses, torch.as_tensor(here), starts, derived(seed, "inverse", search))
        goals = distinct(solutions, here)
        free = checker.free(goals) if len(goals) else np.zeros(0, dtype=bool)
        if free.any():
            return _to_goals(arm, checker, here, goals[free], poses, seed, deadline)
    if (why := solutions.reason()) is not None:
        return Plan(None, Failure.UNREACHABLE, why)
    sentence = f"the arm would touch something at its goal, in all of the {len(goals)} joint states found for it"
    return Plan(None, Failure.GOAL, sentence)


def _to_goals(arm: Arm, checker: Checker, here: Array, goals: Array, poses: Tensor, seed: int, deadline: float) -> Plan:
    """The plan to any of some joint states [G, J]."""
    rng = np.random.default_rng(derived(seed, "path"))
    trees = _Tree(here[None]), _Tree(goals)
    path = _connect(arm, checker, trees, rng, deadline)
    nodes = sum(len(tree) for tree in trees)
    if path is None:
        sentence = f"no way to the goal was found within the time and {NODES} joint states; {nodes} were looked at"
        return Plan(None, Failure.TIMEOUT, sentence, nodes=nodes)
    off = pose_error(arm.tip(torch.as_tensor(path[-1])).expand_as(poses), poses)
    return Plan(_shortened(checker, path, rng), goal=int(off.norm(dim=-1).argmin()), nodes=nodes)


def distinct(solutions: Solutions, here: Array) -> Array:
    """Joint states [G, J] that reach a pose, the nearest to ``here`` [J] first."""
    q = solutions.q[solutions.reached].numpy()
    order = np.linalg.norm(q - here, axis=1).argsort(kind="stable")
    kept: list[int] = []
    for i in order:
        if all(np.abs(q[i] - q[k]).max() > 0.05 for k in kept):
            kept.append(int(i))
    return np.asarray(q[kept])


class _Tree:
    """Joint states, each with the one that it was reached from; the first ones are roots."""

    def __init__(self, roots: Array) -> None:
        self.states = np.zeros((NODES + len(roots) + 1, roots.shape[1]))
        self.states[: len(roots)] = roots
        self.parents = [-1] * len(roots)

    def __len__(self) -> int:
        return len(self.parents)

    def add(self, state: Array, parent: int) -> int:
        self.states[len(self.parents)] = state
        self.parents.append(parent)
        return len(self.parents) - 1

    def nearest(self, state: Array) -> int:
        return int(np.square(self.states[: len(self)] - state).sum(1).argmin())

    def branch(self, node: int) -> list[Array]:
        """The states from a root to ``node``."""
        states = []
        while node >= 0:
            states.append(self.states[node])
            node = self.parents[node]
        return states[::-1]


def _connect(
    arm: Arm, checker: Checker, trees: tuple[_Tree, _Tree], rng: np.random.Generator, deadline: float
) -> Array | None:
    """The path [K, J] from a root of the first tree to one of the second; None if none is found in time."""
    forth, back = trees
    for goal in back.states[: min(len(back), STRAIGHT)]:  # the nearest ones
        node, met = _grow(checker, forth, 0, goal, np.inf)
        if met:
            return np.stack(forth.branch(node))
    growing, other = forth, back
    lower, upper = arm.lower.numpy(), arm.upper.numpy()
    while len(forth) + len(back) < NODES and time.monotonic() < deadline:
        target = rng.uniform(lower, upper)
        node, _ = _grow(checker, growing, growing.nearest(target), target, STRIDE)
        if node >= 0:
            aim = growing.states[node]
            met_node, met_all = _grow(checker, other, other.nearest(aim), aim, np.inf)
            if met_all:
                ways = growing.branch(node), other.branch(met_node)
                first, second = ways if growing is forth else ways[::-1]
                return np.stack([*first, *second[::-1][1:]])
        growing, other = other, growing
    return None


def _grow(checker: Checker, tree: _Tree, node: int, aim: Array, most: float) -> tuple[int, bool]:
    """Grow a tree from one of its nodes towards ``aim``, as far as the way is free and no farther than ``most``.

    Returns:
        The new node, -1 if there is none; and whether ``aim`` is reached.
    """
    start = tree.states[node]
    distance = float(np.linalg.norm(aim - start))
    if distance < NEAR:
        return node, True
    goal = aim if distance <= most else start + most / distance * (aim - start)
    share = checker.reach(start, goal)
    if share * min(distance, most) < NEAR:
        return -1, False
    if share == 1.0:
        return tree.add(goal, node), goal is aim
    return tree.add(start + share * (goal - start), node), False


def _shortened(checker: Checker, path: Array, rng: np.random.Generator) -> Array:
    """The path with detours cut: straight pieces between two points of it that are free, as they turn up."""
    for _ in range(SHORTCUTS):
        if len(path) <= 2:
            break
        along = np.concatenate([[0.0], np.linalg.norm(np.diff(path, axis=0), axis=1).cumsum()])
        a, b = np.sort(rng.uniform(0.0, along[-1], 2))
        i, j = np.searchsorted(along, a, side="right") - 1, np.searchsorted(along, b, side="right") - 1
        if i == j:
            continue
        ends = [np.array([np.interp(s, along, path[:, k]) for k in range(path.shape[1])]) for s in (a, b)]
        if checker.reach(*ends) == 1.0:
            path = np.stack([*path[: i + 1], *ends, *path[j + 1 :]])
    keep, last = [0], len(path) - 1
    while keep[-1] < last:  # corners that can be left out
        here = keep[-1]
        keep.append(
            next(k for k in range(last, here, -1) if k == here + 1 or checker.reach(path[here], path[k]) == 1.0)
        )
    return path[keep]
