"""A row for each trial of the robot, robot.csv, and what the tables of all policies read of it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from fb3d_rl.robot.attempt import STAGES
from fb3d_rl.rollout.rows import CRASHED, LOST, NEVER_HELD, NEVER_TOUCHED, STUCK, TIMED_OUT, TrialRow, read, write

FILE = "robot.csv"

SPLIT = "table_1"
"""Of the objects of the supplement's Table I."""

RATE = 100
"""Control steps per second of the cell."""


@dataclass(frozen=True)
class RobotRow:
    """One trial. The defaults describe one in which nothing was achieved.

    Attributes:
        trial: index in the schedule, shared by all policies.
        policy: "expert", "artflownet", ...
        object: its name in Table I.
        category: PartNet-Mobility's.
        joint_type: "revolute" or "prismatic".
        repeat: which of the object's trials.
        seed: of what is drawn in the trial.
        x: of the object on the table, m.
        y: likewise.
        turn: of its front from the robot, degrees.
        calibration_deg: turn by which the session's calibration is off, degrees.
        calibration_mm: way by which it is off at the camera, mm.
        status: "error" for a trial that crashed.
        error: the exception or death that ended it.
        seen: whether there was a picture; this and the next six are the stages of an attempt.
        segmented: whether there was an object in it.
        planned: whether there was a flow, a place for the cup and a way to it.
        touched: whether the guarded approach felt the object.
        sealed: whether the cup held; the contact success.
        moved: whether the held point moved by 2 cm.
        opened: whether it was open by more than 90 % of its range at the end; the success.
        reason: why the attempt ended before that, in a word that can be counted.
        sentence: the same for people.
        cup: the terms of :class:`~fb3d_rl.perception.suction.Seal` that kept the cup from holding, or tore it off.
        distance: share of the opening that is left, |q_goal - q| / |q_goal - q_start|.
        way: how far the held point moved, m.
        off: how far the touch was from the chosen contact, m; -1 without a touch.
        force: largest force at the tip, N.
        grips: how many times the arm went to touch.
        seconds: of the robot's clock, s.
        wall: what the trial took on the machine, s of the processor; not the same in two runs.
        key: what the trial is; :func:`fb3d_rl.robot.trials.key_of`.
        policy_digest: what the policy is (:func:`fb3d_rl.policies.digest.policy_digest`).
        mask: whether the policy saw which points are the part's, "target" or "none".
    """

    trial: int
    policy: str
    object: str
    category: str
    joint_type: str
    repeat: int
    seed: int
    x: float
    y: float
    turn: float
    calibration_deg: float
    calibration_mm: float
    status: str = "ok"
    error: str = ""
    seen: bool = False
    segmented: bool = False
    planned: bool = False
    touched: bool = False
    sealed: bool = False
    moved: bool = False
    opened: bool = False
    reason: str = ""
    sentence: str = ""
    cup: str = ""
    distance: float = 1.0
    way: float = 0.0
    off: float = -1.0
    force: float = 0.0
    grips: int = 0
    seconds: float = 0.0
    wall: float = 0.0
    key: str = ""
    policy_digest: str = ""
    mask: str = ""

    @property
    def failed(self) -> str:
        """The first stage that did not go well; "" if all did."""
        return next((stage for stage in STAGES if not getattr(self, stage)), "")

    def as_trial(self) -> TrialRow:
        """The row as the floating gripper's trials have it, for summaries, reports and comparisons."""
        crashed = self.status == "error"
        return TrialRow(
            trial=self.trial, policy=self.policy, object=self.object, category=self.category, split=SPLIT,
            link="", semantic="", joint_type=self.joint_type, seed=self.seed,
            status="error" if crashed else "ok", error=self.error, steps=round(RATE * self.seconds),
            contact=self.sealed, success=self.opened, normalized_distance=self.distance,
            failure="" if self.opened else CRASHED if crashed else _failure(self), repeat=self.repeat,
            seconds=self.seconds, key=self.key, policy_digest=self.policy_digest, mask=self.mask,
            held_opened=self.opened,
        )  # fmt: skip


def _failure(row: RobotRow) -> str:
    """Why a part was not opened, in the words of :mod:`fb3d_rl.rollout.rows`."""
    if not row.sealed:
        return NEVER_HELD if row.touched else NEVER_TOUCHED
    return {"lost hold": LOST, "pull time": TIMED_OUT}.get(row.reason, STUCK)


def write_robot(path: Path, rows: list[RobotRow]) -> None:
    """Write ``robot.csv`` atomically."""
    write(path, rows, RobotRow)


def read_robot(path: Path) -> list[RobotRow]:
    """Read ``robot.csv``.

    Raises:
        UserError: the file is missing, has other columns or a value of the wrong type.
    """
    return read(path, RobotRow)
