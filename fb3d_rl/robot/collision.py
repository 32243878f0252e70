"""How near a robot is to boxes, to a cloud of points and to itself, and whether it can move straight in joint space."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from fb3d_rl.errors import UserError
from fb3d_rl.robot.arm import Arm
from fb3d_rl.robot.capsules import segment_distance

Array = NDArray[np.float64]

STEP = 0.01
"""A motion is checked at states between which no point of the robot moves farther, m, or which are so free that nothing
can be touched between them."""

COARSE = 0.08
"""The same of the first states that are looked at, m."""

FAR = 0.3
"""Points of a cloud that are farther (m) are taken to be so far."""

SPACING = 0.5
"""Between the points of a capsule's segment whose distances are taken, in its radii."""

ALWAYS = 0.5
"""Bodies that overlap in so many of all joint states do so by their shape: they are not held to be in collision."""

STATES = 300
"""Joint states that are drawn to tell which bodies these are."""

BULGE = 1.02
"""How much longer than the straight way a point's way between two states can be."""


class Box(NamedTuple):
    """A box: T_base_box [4, 4] of its centre and its edges [3], m."""

    pose: Array
    size: Array


@dataclass(frozen=True, eq=False)
class Obstacles:
    """What a robot must not touch, in its base's frame.

    Attributes:
        boxes: of the cell.
        points: a cloud [P, 3] of what stands in it, m.
        radius: that each point fills, m: about the distance to its neighbours.
    """

    boxes: Sequence[Box] = ()
    points: Array = field(default_factory=lambda: np.zeros((0, 3)))
    radius: float = 0.01

    def __post_init__(self) -> None:
        if self.points.ndim != 2 or self.points.shape[1] != 3 or not np.isfinite(self.points).all():
            shape = "x".join(map(str, self.points.shape))
            raise UserError(f"a cloud of obstacles is an array [P, 3] of finite numbers (m); this one, {shape}, is not")

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self.points)

    def distance(self, points: Array) -> Array:
        """Distances [...] (m) of points [..., 3] from the nearest obstacle, at most FAR; negative inside a box."""
        nearest = np.full(points.shape[:-1], FAR)
        if len(self.points):
            nearest = np.minimum(nearest, self._tree.query(points, distance_upper_bound=FAR)[0] - self.radius)
        for box in self.boxes:
            nearest = np.minimum(nearest, box_distance(points, box))
        return nearest


def box_distance(points: Array, box: Box) -> Array:
    """Distances [...] of points [..., 3] from a box; negative inside, from its nearest face."""
    beyond = np.abs((points - box.pose[:3, 3]) @ box.pose[:3, :3]) - box.size / 2
    outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=-1)
    return np.asarray(outside + np.minimum(beyond.max(-1), 0.0))


class Clearance(NamedTuple):
    """How free B joint states are.

    Attributes:
        ends: of the robot's K bodies in the base's frame [B, K, 2, 3], m.
        world: from each body to the nearest obstacle [B, K], m; negative: in collision. Never more than the true
            distance, and less by 4 % of the body's radius at most where they touch.
        itself: between each pair of bodies that can touch [B, P], m.
    """

    ends: Array
    world: Array
    itself: Array

    @property
    def least(self) -> Array:
        """The least of a state's distances [B], m."""
        return np.minimum(self.world.min(1), self.itself.min(1, initial=FAR))


class Checker:
    """An arm among obstacles.

    Args:
        arm: its bodies. That of the base, which stands where it stands, may touch obstacles.
        obstacles: what it must not touch.
        margin: distance to keep from all of them, and of bodies from each other, m.
    """

    def __init__(self, arm: Arm, obstacles: Obstacles, margin: float = 0.005) -> None:
        self.arm, self.obstacles, self.margin = arm, obstacles, margin
        moving = np.flatnonzero(arm.links > 0)
        counts = 1 + np.ceil(
            np.linalg.norm(arm.ends[moving, 1] - arm.ends[moving, 0], axis=1) / (SPACING * arm.radii[moving])
        ).astype(int)
        self._moving = moving
        self._body = np.repeat(np.arange(len(moving)), counts)
        self._share = np.concatenate([np.linspace(0.0, 1.0, n) if n > 1 else np.zeros(1) for n in counts])
        lengths = np.linalg.norm(arm.ends[moving, 1] - arm.ends[moving, 0], axis=1)
        self._half = (lengths / np.maximum(counts - 1, 1) / 2)[self._body]
        self._first = np.concatenate([[0], np.cumsum(counts)[:-1]])
        self._pairs = _touching_pairs(arm)

    def clearance(self, q: Array) -> Clearance:
        """The clearance of joint states [B, J]; the margin is taken off all distances."""
        ends = bodies(self.arm, q)
        own = ends[:, self._moving][:, self._body]
        points = own[:, :, 0] + self._share[:, None] * (own[:, :, 1] - own[:, :, 0])
        apart = self.obstacles.distance(points)
        # The nearest point of an obstacle may be nearest to what lies between two of these, at a right angle.
        apart = np.where(apart > 0.0, np.sqrt(np.maximum(apart**2 - self._half**2, 0.0)), apart - self._half)
        world = np.full((len(q), len(self.arm.links)), FAR)
        world[:, self._moving] = np.minimum.reduceat(apart, self._first, axis=1) - self.arm.radii[self._moving]
        i, j = self._pairs.T
        itself = segment_distance(ends[:, i], ends[:, j]) - self.arm.radii[i] - self.arm.radii[j]
        return Clearance(ends, world - self.margin, itself - self.margin)

    def free(self, q: Array) -> NDArray[np.bool_]:
        """Whether joint states [B, J] are free of collisions, [B]."""
        return self.clearance(q).least >= 0.0

    def reach(self, start: Array, goal: Array) -> float:
        """How far the arm can move straight from a free joint state [J] to another one: the share of the way, 0 to 1.

        Each piece of the way is free: either no body comes as near to anything as it may move on the piece, or no
        point of the robot moves more than STEP on it and both of its ends are free.
        """
        shares = np.linspace(0.0, 1.0, 2 + int(np.linalg.norm(goal - start) * 0.5 / COARSE))
        state = self.clearance(start + shares[:, None] * (goal - start))
        while True:
            blocked = state.least < 0.0
            if blocked.any():
                last = max(int(blocked.argmax()), 1)  # what lies behind the first collision does not matter
                shares, state = shares[:last], Clearance(*(x[:last] for x in state))
            doubtful = self._doubtful(state)
            if not doubtful.any():
                return float(shares[-1])
            between = (shares[:-1] + shares[1:])[doubtful] / 2
            order = np.argsort(np.concatenate([shares, between]), kind="stable")
            more = self.clearance(start + between[:, None] * (goal - start))
            shares = np.concatenate([shares, between])[order]
            state = Clearance(*(np.concatenate([a, b])[order] for a, b in zip(state, more, strict=True)))

    def _doubtful(self, state: Clearance) -> NDArray[np.bool_]:
        """Which pieces between B states [B - 1] have to be looked at more closely."""
        moved = BULGE * np.linalg.norm(np.diff(state.ends, axis=0), axis=-1).max(-1)
        i, j = self._pairs.T
        unsure = (state.world[:-1] + state.world[1:] < moved).any(1)
        unsure |= (state.itself[:-1] + state.itself[1:] < moved[:, i] + moved[:, j]).any(1)
        most = moved.max(1)
        return (most > STEP) & (unsure | (most > 2 * COARSE))


def bodies(arm: Arm, q: Array) -> Array:
    """The ends of an arm's bodies in its base's frame [B, K, 2, 3] (m) at joint states [B, J]."""
    poses = arm.forward(torch.as_tensor(q)).numpy()[:, arm.links]
    return np.asarray(arm.ends @ poses[..., :3, :3].swapaxes(-1, -2) + poses[..., None, :3, 3])


@cache
def _touching_pairs(arm: Arm) -> NDArray[np.int64]:
    """Pairs [P, 2] of bodies that can touch: not of neighbouring links, nor always in touch."""
    i, j = np.triu_indices(len(arm.links), 1)
    links = np.sort(np.stack([arm.links[i], arm.links[j]], axis=1), axis=1)
    apart = np.array([b - a > 1 and (a, b) not in arm.tolerated for a, b in links.tolist()])
    i, j = i[apart], j[apart]
    lower, upper = arm.lower.numpy(), arm.upper.numpy()
    ends = bodies(arm, np.random.default_rng(0).uniform(lower, upper, (STATES, len(lower))))
    touching = segment_distance(ends[:, i], ends[:, j]) < arm.radii[i] + arm.radii[j]
    return np.stack([i, j], axis=1)[touching.mean(0) < ALWAYS]
