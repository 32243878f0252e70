"""UMPNet's world without a simulator: each pull as a sequence of equilibria, for many scenes at once.

The held point p can move along its path only: a line or a circle, with the tangent t per rad or m of the joint. In a
step of PyBullet's simulation each of the carriage's three motors is told to cover :data:`GAIN` of its rail's way to the
target, which asks for the velocity v; but as they are tied to one path they cannot all have their will. A motor that
has not pushes with all of its force F towards it, and the joint's own motor, by which PyBullet stands for friction,
against the motion with a torque or force of M at most. Forces along the path are in balance (gravity is 0, and speeds
are small): that is the condition for the joint's velocity s to be the least of

    F (|v_x - t_x s| + |v_y - t_y s| + |v_z - t_z s|) + M |s|,

a weighted median of v_x / t_x, v_y / t_y, v_z / t_z and 0. (The projection of v onto t, which would be the least of the
squares, is not it: a rail along the path wins over two across it, and a small part of a pull is lost in friction.)
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from fb3d_rl.camera.umpnet import BASE, TURN
from fb3d_rl.env.umpnet.scenes import Placed
from fb3d_rl.env.umpnet.world import GAIN, STEPS, STILL, STILLS, STROKE, Array

FRICTION = 240.0 / 1500.0
"""M / F: PyBullet's default motor of a joint resists with an impulse of 1 N s or N m s in a step of 1/240 s."""

SMALL = 1e-9
"""A rail across the path by less than this moves nothing."""


class Paths:
    """The paths of B held points: p(q) = centre + cos(q) along + sin(q) across + q slide, in UMPNet's world.

    Attributes:
        centre, along, across, slide: [B, 3] m; the middle two are 0 for a line, the last one for a circle.
        low, high: [B] the joint's limits, rad or m, measured from where p is ``centre`` or ``centre + along``.
    """

    def __init__(self, rows: Sequence[Array]) -> None:
        """Rows [14] of all of these, in this order."""
        table = torch.from_numpy(np.stack(rows))
        self.centre, self.along, self.across, self.slide = table[:, :12].unflatten(1, (4, 3)).unbind(1)
        self.low, self.high = table[:, 12], table[:, 13]

    def at(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Points and tangents [B, 3] (m, m per rad or m) at joint positions [B]."""
        cos, sin, q = q.cos()[:, None], q.sin()[:, None], q[:, None]
        point = self.centre + cos * self.along + sin * self.across + q * self.slide
        return point, cos * self.across - sin * self.along + self.slide


def balance(wanted: Tensor, tangent: Tensor) -> Tensor:
    """The joint's motion [B] in a step for ``wanted`` motions [B, 3] of the rails and the path's ``tangent`` [B, 3]."""
    weight = tangent.abs()
    weight = torch.cat([weight, weight.new_full((len(weight), 1), FRICTION)], dim=1)
    across = tangent.abs() < SMALL
    motion = torch.where(across, 0.0, wanted / tangent.masked_fill(across, 1.0))
    motion, order = torch.cat([motion, torch.zeros_like(motion[:, :1])], dim=1).sort(dim=1)
    below = weight.gather(1, order).cumsum(1)
    middle = (below < 0.5 * below[:, -1:]).sum(1, keepdim=True)
    return motion.gather(1, middle).squeeze(1)


def stroke(paths: Paths, start: Tensor, direction: Tensor, coarse: int = 1) -> Tensor:
    """Joint positions [B] after one pull.

    Args:
        paths: the held points' paths.
        start: joint positions [B] before it.
        direction: unit directions [B, 3] of UMPNet's world.
        coarse: so many of the simulation's steps are made at once, which is as many times as fast; the end of a pull is
            the same to some mm.
    """
    q, still = start.clone(), torch.zeros(len(start), dtype=torch.int64)
    target = paths.at(q)[0] + STROKE * direction
    for step in range(STEPS // coarse):
        point, tangent = paths.at(q)
        moved = (q + balance(coarse * GAIN * (target - point), tangent)).clamp(paths.low, paths.high)
        moved = torch.where(still < STILLS, moved, q)
        if step:  # PyBullet's first step has no earlier position to compare with
            still += (moved - q).abs() * tangent.norm(dim=1) < coarse * STILL
        q = moved
        if bool((still >= STILLS).all()):
            break
    return q


class Quasistatic:
    """A :class:`~fb3d_rl.env.umpnet.world.World`. Only the touched link's own joint moves, not those it hangs on."""

    def __init__(self, placed: Sequence[Placed]) -> None:
        self.placed = placed
        self.states = [one.start.copy() for one in placed]
        self._rows: dict[int, Array] = {}
        self._joints: dict[int, int] = {}
        self._zero: dict[int, float] = {}

    def touch(self, index: int, link: int, point: Array) -> None:
        """See :class:`World`."""
        placed, state = self.placed[index], self.states[index]
        obj, scale = placed.posed.obj, placed.scene.scale
        joint, pose = obj.movable.index(link), placed.posed.poses(state)[link]
        axis = TURN.T @ pose[:3, :3] @ obj.joint_of(link).axis
        here, pivot = (scale * TURN.T @ where + BASE for where in (point, pose[:3, 3]))
        nothing = np.zeros(3)
        if obj.joint_of(link).type == "prismatic":
            shape, unit = (here, nothing, nothing, axis), scale
        else:
            centre = pivot + axis * (axis @ (here - pivot))
            shape, unit = (centre, here - centre, np.cross(axis, here - centre), nothing), 1.0
        limits = (obj.limits[joint] - state[joint]) * unit
        limits = min(limits[0], 0.0), max(limits[1], 0.0)
        self._rows[index] = np.concatenate([*shape, limits])
        self._joints[index], self._zero[index] = joint, state[joint]

    def _unit(self, index: int) -> float:
        """Rad or m in UMPNet's world for one of a joint state."""
        return self.placed[index].scene.scale if self._rows[index][9:12].any() else 1.0

    def _position(self, index: int) -> float:
        """Of the held joint, on its path."""
        return float(self.states[index][self._joints[index]] - self._zero[index]) * self._unit(index)

    def held(self, index: int) -> Array:
        """See :class:`World`."""
        point = Paths([self._rows[index]]).at(torch.tensor([self._position(index)]).double())[0][0].numpy()
        return np.asarray(TURN @ (point - BASE) / self.placed[index].scene.scale)

    def pull(self, directions: Array) -> None:
        """See :class:`World`."""
        pulled = [index for index in self._rows if directions[index].any()]
        if not pulled:
            return
        start = torch.tensor([self._position(index) for index in pulled]).double()
        ways = torch.from_numpy(directions[pulled] @ TURN)
        ends = stroke(Paths([self._rows[index] for index in pulled]), start, ways)
        for index, end in zip(pulled, ends.tolist(), strict=True):
            self.states[index][self._joints[index]] = self._zero[index] + end / self._unit(index)

    def close(self) -> None:
        """See :class:`World`."""
