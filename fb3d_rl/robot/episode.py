"""One attempt to open a part, through a driver only (supplement, I.D to I.G)."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from fb3d_rl.errors import UserError
from fb3d_rl.perception.suction import choose_place
from fb3d_rl.robot.arm import Arm
from fb3d_rl.robot.attempt import Attempt, AttemptOptions, Ended, Learns, Predictor, Puller, Reason
from fb3d_rl.robot.collision import Checker
from fb3d_rl.robot.driver import Driver
from fb3d_rl.robot.motion import MOVED, Mover, Pull
from fb3d_rl.robot.planning import Failure, plan
from fb3d_rl.robot.reach import MARGIN, Reached, before_contact, obstacles_of
from fb3d_rl.robot.seeing import Motion, Seen, look, motion_at, predicted, spread
from fb3d_rl.robot.sight import ArmSight
from fb3d_rl.robot.timing import Motion as Timed
from fb3d_rl.robot.timing import timed
from fb3d_rl.rollout.worker import denormals
from fb3d_rl.seeds import derived

Array = NDArray[np.float64]

STOPS = 10
"""Control steps for which an arm is told to stand still at the end."""

PART = 0.2
"""A point is the part's whose flow has this share of the largest."""

ENOUGH = 0.95
"""A contact is good from which the arm can follow so much of the part's way ahead."""

AGAIN = {Reason.NO_TOUCH, Reason.NO_VACUUM, Reason.LOST_HOLD, Reason.TOO_MUCH_FORCE, Reason.STUCK, Reason.JOINT_LIMITS}
"""Ends of a grip after which another may do better."""

_PLANNING = {
    Failure.START_LIMITS: Reason.START_LIMITS,
    Failure.START: Reason.START_COLLISION,
    Failure.UNREACHABLE: Reason.UNREACHABLE,
    Failure.GOAL: Reason.GOAL_COLLISION,
    Failure.TIMEOUT: Reason.TIMEOUT,
}


def attempt(
    driver: Driver,
    arm: Arm,
    camera: Array,
    predictor: Predictor,
    options: AttemptOptions | None = None,
    seed: int = 0,
    puller: Puller | None = None,
    opened: Callable[[], bool] | None = None,
    say: Callable[[str], None] | None = None,
) -> Attempt:
    """See what opens, plan, approach, touch, hold and pull; the arm stands still afterwards, its suction off.

    Nothing raises but a fault of the program: whatever goes wrong is the attempt's reason and sentence.

    Args:
        driver: the robot, the simulated cell or a recording.
        arm: the arm that the driver moves.
        camera: T_base_camera [4, 4] of the calibration.
        predictor: the flow of what is seen, such as a network's; asked once before the contact and in a pull.
        options: speeds, forces and times.
        seed: of all that is drawn; the same driver answers and seed give the same commands.
        puller: asked in a pull in place of the predictor.
        opened: asked in a pull whether the part is open, which ends the attempt.
        say: gets a line for each stage.
    """
    made = _Run(driver, arm, camera, predictor, options or AttemptOptions(), seed, puller, opened, say)
    with denormals(flushed=False):
        return made.run()


class _Run:
    """An attempt while it runs."""

    def __init__(
        self,
        driver: Driver,
        arm: Arm,
        camera: Array,
        predictor: Predictor,
        options: AttemptOptions,
        seed: int,
        puller: Puller | None,
        opened: Callable[[], bool] | None,
        say: Callable[[str], None] | None,
    ) -> None:
        self.driver, self.arm, self.camera, self.options, self.seed = driver, arm, camera, options, seed
        self.predictor, self.puller, self.opened = predictor, puller, opened
        self.say = say or (lambda line: None)
        self.sight, self.mover = ArmSight(arm), Mover(driver, arm, options)
        self.rng = np.random.default_rng(derived(seed, "attempt"))
        self.result: dict[str, Any] = {"grips": 0}
        self.seconds: dict[str, float] = {}
        self.bad_places: list[Array] = []
        """Where the cup did not hold, m."""

    def run(self) -> Attempt:
        """Make the attempt."""
        reason, sentence = None, "the part is open"
        try:
            self._attempts()
        except Ended as end:
            reason, sentence = end.reason, end.sentence
        except UserError as error:
            reason, sentence = Reason.DRIVER, str(error)
        finally:
            with contextlib.suppress(Exception):  # the driver may be what has failed
                self.mover.stop(STOPS)
            with contextlib.suppress(Exception):
                self.driver.suction(False)
        if reason is not None and self.opened is not None and self.result.get("moved"):
            self.result["opened"] = self.opened()
            reason = None if self.result["opened"] else reason
        self.say(sentence)
        trace = self.mover.feeling.trace
        return Attempt(
            **self.result,
            reason=reason,
            sentence=sentence,
            seconds=self.seconds,
            times=np.array([row[0] for row in trace]),
            forces=np.array([row[1] for row in trace]).reshape(-1, 3),
            tips=np.array([row[2] for row in trace]).reshape(-1, 3),
        )

    @contextlib.contextmanager
    def _timed(self, name: str, clock: Callable[[], float] = time.perf_counter) -> Iterator[None]:
        began = clock()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + clock() - began

    def _now(self) -> float:
        return self.driver.joints().time

    def _attempts(self) -> None:
        """Grip until the part is open."""
        home = self.driver.joints().position
        while True:
            try:
                return self._attempt()
            except Ended as end:
                if end.reason not in AGAIN or self.result["grips"] >= self.options.grips or self._is_open():
                    raise
                failed = end
            self.say(f"{failed.sentence}; the arm goes back for another grip")
            try:
                self._back(home)
            except Ended:
                raise failed from None  # why the grip ended says more

    def _is_open(self) -> bool:
        return self.opened is not None and self.opened()

    def _back(self, home: Array) -> None:
        """Let go, move off the object, and return to where the attempt began."""
        self.mover.stop(STOPS)
        self.driver.suction(False)
        with self._timed("way", self._now):
            self.mover.off(self.options.standoff)
            seen = self._look(dense=True)
            pose = self.arm.tip(torch.as_tensor(home))[None]
            self.mover.along(self._way(seen, Reached(home[None], pose, 1.0)))

    def _attempt(self) -> None:
        seen = self._look(dense=True)
        self.say(f"saw {len(seen.dense)} points of an object")
        with self._timed("predicting"):
            flow = predicted(self.predictor, seen.observation)
        motion, way = self._plan(seen, flow)
        with self._timed("way", self._now):
            self.mover.along(way)
        self.result["grips"] += 1
        with self._timed("approach", self._now):
            try:
                felt = self.mover.touch(motion.velocity)
                self.result |= {"touched": True, "felt": felt}
                off = 1000 * float(np.linalg.norm(felt - motion.at))
                self.say(f"touched, {off:.0f} mm from the contact that was chosen")
                self.mover.hold()
            except Ended:
                self.bad_places.append(motion.at)
                raise
        self.result["sealed"] = True
        self.say("the cup holds")
        pull = Pull(self.mover, Motion(felt, motion.velocity, motion.turn), self._look_again, self.opened)
        try:
            with self._timed("pull", self._now):
                pulled = pull.run()
        except Ended:
            if pull.way < MOVED and isinstance(self.predictor, Learns):
                self.predictor.refute(felt, motion.velocity)
            raise
        finally:
            way_before, moved_before = self.result.get("way", 0.0), self.result.get("moved", False)
            self.result |= {"way": max(way_before, pull.way), "moved": moved_before or pull.way >= MOVED}
        self.result["opened"] = pulled.opened

    def _look(self, dense: bool, holding: bool = False, force: Array | None = None) -> Seen:
        try:
            with self._timed("looking"):
                o, known = self.options, (self.driver, self.sight, self.camera)
                pictures = 1 if holding else o.pictures
                seen = look(*known, o.points, self.rng, holding, force, dense, o.deviations, pictures)
        except Ended as end:
            self.result.setdefault("seen", end.reason == Reason.NO_OBJECT)
            raise
        self.result |= {"seen": True, "segmented": True}
        return seen

    def _plan(self, seen: Seen, flow: Array) -> tuple[Motion, Timed]:
        """A contact, the part's motion there, and a way to before it.

        The first of the best contacts is taken from which the arm can follow the part far enough, else the one from
        which it follows it furthest.
        """
        dense = spread(seen.dense, seen.observation, flow)
        size = np.linalg.norm(dense, axis=1)
        # What does not move is none of the part: where a door lies flush in its frame, its border is a rim.
        part = size > PART * size.max()
        for place in self.bad_places:
            dense = np.where(np.linalg.norm(seen.dense - place, axis=1)[:, None] > self.options.apart, dense, 0.0)
        found: list[tuple[Motion, Reached]] = []
        failed: Ended | None = None
        for _ in range(self.options.contacts):
            try:
                motion = self._contact(seen, flow, dense, part)
                with self._timed("planning"):
                    found.append((motion, self._reached(seen, motion, part)))
                if found[-1][1].follows >= ENOUGH:
                    break
            except Ended as end:
                failed = failed or end
                if end.reason == Reason.NO_PLACE:
                    break
            away = np.linalg.norm(seen.dense - motion.at, axis=1) > self.options.apart
            dense = np.where(away[:, None], dense, 0.0)
        for motion, reached in sorted(found, key=lambda pair: -min(pair[1].follows, ENOUGH)):
            try:
                with self._timed("planning"):
                    way = self._way(seen, reached)
            except Ended as end:
                failed = failed or end
                continue
            self.result |= {"planned": True, "contact": motion.at}
            x, y, z = motion.at
            turns = "turn" if np.linalg.norm(motion.turn) > 0.5 else "slide"
            self.say(f"the part seems to {turns}; planned {way.duration:.1f} s to ({x:.3f}, {y:.3f}, {z:.3f}) m")
            return motion, way
        assert failed is not None
        raise failed

    def _contact(self, seen: Seen, flow: Array, dense: Array, part: NDArray[np.bool_]) -> Motion:
        """Where to touch, and how the part moves there."""
        with self._timed("choosing"):
            rows = np.flatnonzero(part)
            place = None
            if dense.any():
                points, moves = seen.dense[rows], dense[rows]
                place = choose_place(points, moves, self.camera[:3, 3], self.options.cup, self.options.place)
        if place is None:
            raise Ended(Reason.NO_PLACE, "nowhere on what moves is there room for the cup: all is too curved or a rim")
        row = rows[place.row]
        contact = seen.dense[row]
        self.result.setdefault("contact", contact)
        motion = motion_at(seen.observation.points, flow, contact)
        if motion is None:
            motion = Motion(contact, dense[row] / np.linalg.norm(dense[row]), np.zeros(3))
        return motion

    def _reached(self, seen: Seen, motion: Motion, part: NDArray[np.bool_]) -> Reached:
        """Joint states before a contact."""
        here = self.driver.joints().position
        standoff = self.options.standoff
        return before_contact(self.arm, here, motion, seen.dense, part, self.camera[:3, 3], standoff, self.seed)

    def _way(self, seen: Seen, reached: Reached) -> Timed:
        """A motion to one of these joint states."""
        here = self.driver.joints().position
        obstacles = obstacles_of(seen.dense, self.camera[:3, 3])
        found = plan(self.arm, obstacles, here, reached.poses, self.seed, margin=MARGIN, goals=reached.goals)
        if found.path is None:
            raise Ended(_PLANNING[found.failure or Failure.TIMEOUT], found.reason)
        return timed(self.arm, found.path, Checker(self.arm, obstacles, MARGIN))

    def _look_again(self, force: Array, tip: Array) -> Motion | Array | None:
        """The part's motion at the held point as it is seen now; None where the arm hides the part."""
        try:
            seen = self._look(dense=False, holding=True, force=force)
            with self._timed("predicting"):
                if self.puller is not None:
                    return np.asarray(self.puller(seen.observation), dtype=np.float64)
                flow = predicted(self.predictor, seen.observation)
        except Ended as end:
            if end.reason in (Reason.NO_OBJECT, Reason.NO_FLOW):
                return None
            raise
        return motion_at(seen.observation.points, flow, tip)
