"""How an attempt moves and feels: force without bias, motions tracked by velocity, the guarded approach, the pull."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from fb3d_rl.geometry.transforms import alignment
from fb3d_rl.robot.arm import Arm
from fb3d_rl.robot.attempt import AttemptOptions, Ended, Reason
from fb3d_rl.robot.collision import Checker, Obstacles
from fb3d_rl.robot.driver import Driver, JointState
from fb3d_rl.robot.inverse import pose_error
from fb3d_rl.robot.seeing import Motion
from fb3d_rl.robot.timing import Motion as Timed
from fb3d_rl.robot.velocity import resolve, resolve_cup

Array = NDArray[np.float64]

TRACKING = 5.0
"""Velocity for each rad or m that the arm is off its way, 1/s."""

OFF_PATH = 0.15
"""Farther from a planned motion (rad) the arm does not follow it."""

ARRIVED = 0.01
"""At the goal, rad."""

LATE = 2.0
"""How long after its end a motion may take to arrive, s."""

WEAK = 0.3
"""Less than this share of the velocity that is asked for is left at a joint's limit."""

PATIENCE = 0.3
"""How long that may be so, s."""

MOVED = 0.02
"""A part has moved whose held point has come so far, m."""

FELT = 0.01
"""The direction that is felt is that of so much of the tip's way, m."""

TRUST = 0.4
"""Share by which a pull turns towards it."""

EASES = 0.5
"""A pull slows down above this share of the largest force."""

PROGRESS = 0.15
"""A pull that makes less than this share of its way is stuck."""


class Feeling:
    """The force at the tip: its bias is taken off, it is filtered, and its trace is kept.

    Args:
        driver: its wrench.
        cutoff: of the low-pass filter of first order, Hz.
    """

    def __init__(self, driver: Driver, cutoff: float) -> None:
        self._driver, self._cutoff = driver, cutoff
        self._bias = np.zeros(3)
        self._last: tuple[float, Array] | None = None
        self.trace: list[tuple[float, Array, Array]] = []
        """Time (s), force [3] (N) and tip [3] (m)."""

    def raw(self) -> Array:
        """The force [3] as the sensor tells it.

        Raises:
            Ended: it is not finite.
        """
        force = np.asarray(self._driver.wrench().force, dtype=np.float64)
        if force.shape != (3,) or not np.isfinite(force).all():
            raise Ended(Reason.BAD_FORCE, "the force at the tip is not three finite numbers; check the sensor")
        return force

    def zero(self, forces: list[Array]) -> None:
        """Take the mean of some forces as bias."""
        self._bias, self._last = np.mean(forces, axis=0), None

    def feel(self, time: float, tip: Array) -> Array:
        """The force [3] (N) now, filtered and without bias."""
        force = self.raw() - self._bias
        if self._last is not None:
            share = 1.0 - np.exp(-2.0 * np.pi * self._cutoff * max(time - self._last[0], 0.0))
            force = self._last[1] + share * (force - self._last[1])
        self._last = (time, force)
        self.trace.append((time, force, tip))
        return force


class Mover:
    """Moves an arm through a driver, and stops it whatever happens.

    Args:
        driver: the robot.
        arm: the arm.
        options: speeds and forces.
    """

    def __init__(self, driver: Driver, arm: Arm, options: AttemptOptions) -> None:
        self.driver, self.arm, self.options = driver, arm, options
        self.feeling = Feeling(driver, options.filter)
        self._itself = Checker(arm, Obstacles())
        self._weak_since: float | None = None

    def stop(self, steps: int = 1) -> None:
        """Command no velocity for so many control steps."""
        for _ in range(steps):
            self.driver.move(np.zeros(len(self.arm.joints)))

    def tip(self, state: JointState) -> Array:
        """T_base_tip [4, 4]."""
        return np.asarray(self.arm.tip(torch.as_tensor(state.position)).numpy())

    def along(self, motion: Timed) -> None:
        """Follow a motion in time, by velocity.

        Raises:
            Ended: the arm touches something, or does not follow.
        """
        self.settle()
        began, most = self.driver.joints().time, np.minimum(self.arm.velocity.numpy(), 2.0)
        while True:
            state = self.driver.joints()
            time = state.time - began
            wanted, speed = (
                np.array([np.interp(time, motion.times, x[:, j]) for j in range(x.shape[1])])
                for x in (motion.positions, motion.velocities)
            )
            off = wanted - state.position
            if np.linalg.norm(self.feeling.feel(state.time, self.tip(state)[:3, 3])) > self.options.most_force:
                raise Ended(
                    Reason.BUMPED,
                    f"the arm felt more than {self.options.most_force:g} N on its planned way and stopped: it touched "
                    f"something that is not in the cloud",
                )
            if np.abs(off).max() > OFF_PATH or time > motion.duration + LATE:
                raise Ended(
                    Reason.TRACKING,
                    f"a joint is {np.degrees(np.abs(off).max()):.0f} degrees off the planned motion; the arm stopped",
                )
            if time >= motion.duration and np.abs(off).max() < ARRIVED:
                break
            self.driver.move(np.clip(speed + TRACKING * off, -most, most))
        self.stop()

    def settle(self) -> None:
        """Stand still and take the force's bias.

        Raises:
            Ended: the force is not finite.
        """
        forces: list[Array] = []
        until = self.driver.joints().time + self.options.settle
        while not forces or self.driver.joints().time < until:
            self.stop()
            forces.append(self.feeling.raw())
        self.feeling.zero(forces)

    def twist(self, state: JointState, velocity: Array, turn: Array, exactly: bool = False) -> None:
        """One control step with a velocity (m/s) and an angular velocity (rad/s) of the tip [3].

        Where the arm cannot do all of it the cup tilts and twists, unless it is to be kept ``exactly``.

        Raises:
            Ended: joints at their limits have left little of it for a while.
        """
        q, asked = torch.as_tensor(state.position), torch.as_tensor(np.concatenate([velocity, turn]))
        if exactly:
            found = resolve(self.arm, q, asked, self._itself)
        else:
            found = resolve_cup(self.arm, q, asked[:3], asked[3:], self._itself)
        if found.share >= WEAK:
            self._weak_since = None
        elif self._weak_since is None:
            self._weak_since = state.time
        elif state.time - self._weak_since > PATIENCE:
            held = [name for name, there in zip(self.arm.joints, found.held.tolist(), strict=True) if there]
            what = f"joint {', '.join(held)} is at its limit" if held else "its joints cannot move the tip that way"
            if found.slowed < WEAK:
                what = "it would touch itself"
            raise Ended(Reason.JOINT_LIMITS, f"the arm cannot follow any further: {what}")
        self.driver.move(found.velocity.numpy())

    def touch(self, way: Array) -> Array:
        """The guarded approach (supplement, I.G): slowly against ``way`` [3] until the force passes the threshold.

        Returns:
            Where the tip is [3], m.

        Raises:
            Ended: nothing was touched, or something unexpected.
        """
        o = self.options
        self.stop(5)
        self.settle()
        self._weak_since = None
        state = self.driver.joints()
        start = self.tip(state)
        began = state.time
        while True:
            state = self.driver.joints()
            pose = self.tip(state)
            force = self.feeling.feel(state.time, pose[:3, 3])
            gone = float((start[:3, 3] - pose[:3, 3]) @ way)
            if force @ way > o.touch_force:
                self.stop(3)
                return np.asarray(pose[:3, 3])
            if np.linalg.norm(force) > o.most_force:
                raise Ended(
                    Reason.TOO_MUCH_FORCE,
                    f"{np.linalg.norm(force):.0f} N across the approach, more than the {o.most_force:g} N allowed",
                )
            if gone > o.approach_limit or state.time - began > 2.0 * o.approach_limit / o.approach_speed:
                raise Ended(
                    Reason.NO_TOUCH,
                    f"nothing was touched on {100 * max(gone, 0.0):.0f} cm of the approach; the object is elsewhere",
                )
            target = start.copy()
            target[:3, 3] -= gone * way
            error = pose_error(torch.as_tensor(pose), torch.as_tensor(target)).numpy()
            self.twist(state, -o.approach_speed * way + TRACKING * error[:3], TRACKING * error[3:])

    def off(self, way: float) -> None:
        """Move the tip straight back out of its cup's axis, by ``way`` (m) or as far as the arm can."""
        self._weak_since = None
        start, began = self.tip(self.driver.joints()), self.driver.joints().time
        speed = self.options.pull_speed
        while True:
            state = self.driver.joints()
            gone = float((start[:3, 3] - self.tip(state)[:3, 3]) @ start[:3, 2])
            if gone >= way or state.time - began > 2.0 * way / speed:
                break
            try:
                self.twist(state, -speed * start[:3, 2], np.zeros(3))
            except Ended:
                break
        self.stop()

    def hold(self) -> None:
        """Switch the suction on and wait for the vacuum.

        Raises:
            Ended: there is none in time.
        """
        until = self.driver.joints().time + self.options.vacuum_time
        while not self.driver.suction(True):
            if self.driver.joints().time >= until:
                raise Ended(
                    Reason.NO_VACUUM,
                    f"the cup has no vacuum {self.options.vacuum_time:g} s after it touched: it does not seal there",
                )
            self.stop()


class Pulled(NamedTuple):
    """How a pull went: the way of the held point (m), and whether somebody said that the part is open."""

    way: float
    opened: bool


Look = Callable[[Array, Array], "Motion | Array | None"]
"""From the force [3] and the tip's place [3] now: the part's motion there, or the tip's twist [6]; None if nothing new
is seen."""


class Pull:
    """Velocity execution (supplement, I.G): along the normalised flow at the held point, the cup turning with it.

    Between looks the motion that was seen last is carried on: of a part that turns the direction turns as it moves.
    What is felt corrects it: a pull yields to force across its direction, and turns towards the way that the tip has
    made.

    Args:
        mover: moves the arm.
        motion: of the part at the contact.
        look: sees it anew.
        opened: whether the part is open, if somebody can tell.
    """

    def __init__(self, mover: Mover, motion: Motion, look: Look, opened: Callable[[], bool] | None) -> None:
        self.mover, self.motion, self.look = mover, motion, look
        self.opened = opened or (lambda: False)
        self.twist: Array | None = None
        self.way = 0.0

    def run(self) -> Pulled:
        """Pull until the part is open, or the attempt ends.

        Raises:
            Ended: hold lost, joint limits, too much force, stuck, or out of time.
        """
        mover, o = self.mover, self.mover.options
        mover._weak_since = None  # noqa: SLF001
        state = mover.driver.joints()
        began = looked = state.time
        start = marked = mover.tip(state)[:3, 3]
        path: list[tuple[float, Array]] = [(state.time, start)]
        while True:
            state = mover.driver.joints()
            pose = mover.tip(state)
            tip = pose[:3, 3]
            force = mover.feeling.feel(state.time, tip)
            self.way = max(self.way, float(np.linalg.norm(tip - start)))
            path.append((state.time, tip))
            self._check(state, force, path, began)
            if self.opened():
                return Pulled(self.way, True)
            if state.time - looked >= o.look_every:
                mover.stop()
                self._see(force, tip, path)
                looked = mover.driver.joints().time
                continue
            if np.linalg.norm(tip - marked) > FELT:
                self._feel(marked, tip)
                marked = tip
            mover.twist(state, *self._command(pose, force, state.time - began), self.twist is not None)

    def _check(self, state: JointState, force: Array, path: list[tuple[float, Array]], began: float) -> None:
        o, size = self.mover.options, float(np.linalg.norm(force))
        moved = f"after {100 * self.way:.0f} cm"
        if not self.mover.driver.suction(True):
            self.mover.stop()
            raise Ended(Reason.LOST_HOLD, f"the cup lost its hold {moved}")
        if size > o.most_force:
            raise Ended(Reason.TOO_MUCH_FORCE, f"{size:.0f} N at the tip, more than {o.most_force:g} N, {moved}")
        if state.time - began > o.pull_time:
            raise Ended(Reason.PULL_TIME, f"the pull took longer than {o.pull_time:g} s; it stopped {moved}")
        while path and state.time - path[0][0] > o.stuck_time:
            path.pop(0)
        span = path[-1][0] - path[0][0]
        slow = float(np.linalg.norm(path[-1][1] - path[0][1])) < PROGRESS * o.pull_speed * span
        if span > 0.9 * o.stuck_time and slow:
            raise Ended(Reason.STUCK, f"the part does not move any further; it stopped {moved}")

    def _see(self, force: Array, tip: Array, path: list[tuple[float, Array]]) -> None:
        """Take over what a look shows, unless it is against what is felt."""
        seen = self.look(force, tip)
        path[:] = [(self.mover.driver.joints().time, tip)]
        if isinstance(seen, Motion):
            self.twist = None
            if self.way < MOVED or seen.velocity @ _unit(self.motion.of(tip)) > 0.5:
                self.motion = seen
        elif seen is not None:
            self.twist = np.asarray(seen, dtype=np.float64)

    def _feel(self, before: Array, tip: Array) -> None:
        """Turn towards the way that the tip has made."""
        felt = _unit(tip - before)
        along = _unit(self.motion.of((before + tip) / 2))
        if self.mover.options.yield_gain == 0.0 or felt @ along < 0.5:
            return
        turn = TRUST * alignment(torch.as_tensor(along), torch.as_tensor(felt)).numpy()
        now = _unit(self.motion.of(tip))
        self.motion = Motion(tip, _unit(now + np.cross(turn, now)), self.motion.turn)

    def _command(self, pose: Array, force: Array, time: float) -> tuple[Array, Array]:
        """Velocity (m/s) and angular velocity (rad/s) of the tip [3]."""
        o, tip = self.mover.options, pose[:3, 3]
        if self.twist is not None:
            fastest = float(np.linalg.norm(self.twist[:3])) / o.pull_speed
            return self.twist[:3] / max(fastest, 1.0), self.twist[3:] / max(fastest, 1.0)
        way = _unit(self.motion.of(tip))
        across = force - (force @ way) * way
        strained = max(-float(force @ way), 0.0) / o.most_force
        ease = np.clip((1.0 - strained) / (1.0 - EASES), 0.0, 1.0)
        speed = o.pull_speed * ease * min(1.0, 0.2 + time / 0.5)
        turn = o.turn_gain * alignment(torch.as_tensor(-pose[:3, 2]), torch.as_tensor(way)).numpy()
        return speed * way + o.yield_gain * across, turn


def _unit(vector: Array) -> Array:
    return np.asarray(vector / max(float(np.linalg.norm(vector)), 1e-12))
