"""The two tables that an evaluation writes: a row per scheduled trial, a row per held-out flow sample.

Columns keep the order of the fields and floats are written with ``repr``, so reading gives equal rows back.
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import MISSING, astuple, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

from fb3d_rl.errors import UserError
from fb3d_rl.files import write_text

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

# Why a part was not opened.
NEVER_TOUCHED = "never touched the part"
"""The gripper met nothing."""
NEVER_HELD = "touched, but never held the part"
"""It met something, but suction never held the part."""
LOST = "lost hold"
"""Suction held the part, but not at the end."""
WRONG_WAY = "wrong direction"
"""Held at the end, farther from the goal than at the start (by more than 1 % of the way)."""
STUCK = "stuck"
"""Held at the end, and moved by less than 1 % of the way in the last second."""
TIMED_OUT = "timed out"
"""Held at the end and still moving."""
CRASHED = "crashed"
"""An exception or a dead process ended the trial."""
TOO_SLOW = "took too long"
"""One decision of the policy took longer than evaluation.decision_seconds."""


@dataclass(frozen=True)
class TrialRow:
    """One scheduled trial. The defaults describe a trial in which nothing was achieved.

    Attributes:
        trial: index in the schedule, shared by all policies.
        policy: "expert", "artflownet", ...
        object: the object's id; together with ``category`` the unit of the intervals.
        category: the object's category.
        split: the split that the object belongs to.
        link: name of the link to open.
        semantic: what the link is ("door", "drawer", ...).
        joint_type: "revolute", "continuous" or "prismatic".
        seed: of this trial.
        status: "error" for a trial that crashed.
        error: the exception or death that ended it; "" if it did not crash.
        steps: control steps taken.
        contact: suction held the target part.
        success: normalized distance below 0.1 at the end.
        normalized_distance: |q_goal - q| / |q_goal - q_start| at the end.
        attach_step: control step at which suction took hold, -1 if never.
        failure: why the part was not opened, one of this module's constants; "" on success.
        repeat: which of the repetitions of a protocol that has several.
        seconds: simulated time until success, else until the end, s; -1 if it was not recorded.
        path_length: length of the suction tip's path, m; -1 if it was not recorded.
        lost: how often the part was held and then was not; -1 if it was not recorded.
        key: what the trial is (:func:`fb3d_rl.rollout.trials.trial_key`); "" if it was not recorded.
        policy_digest: what the policy is (:func:`fb3d_rl.policies.digest.policy_digest`); "" if it was not recorded.
        mask: whether the policy saw which points are the part's, "target" or "none"; "" if it sees no points, or if it
            was not recorded.
        held_opened: at some time a part that suction had held was open, by the same rule from its own start: the target
            or, where suction holds any part, another one.
        pulls: how many pulls began until the part had moved the right way
            (:func:`fb3d_rl.rollout.pulls.pulls_until_moved`); -1 if it never did, or if it was not recorded.
        network_calls: how often a policy that follows arcs called its network (:mod:`fb3d_rl.policies.arc`); -1 for
            other policies, which call theirs in each step, or if it was not recorded.

    Raises:
        ValueError: a normalized distance that is not finite, or a crashed trial that claims contact, success, an
            opened part or a normalized distance other than 1: a crash counts as a failure.
    """

    trial: int
    policy: str
    object: str
    category: str
    split: str
    link: str
    semantic: str
    joint_type: str
    seed: int
    status: Literal["ok", "error"] = "ok"
    error: str = ""
    steps: int = 0
    contact: bool = False
    success: bool = False
    normalized_distance: float = 1.0
    attach_step: int = -1
    failure: str = ""
    repeat: int = 0
    seconds: float = -1.0
    path_length: float = -1.0
    lost: int = -1
    key: str = ""
    policy_digest: str = ""
    mask: str = ""
    held_opened: bool = False
    pulls: int = -1
    network_calls: int = -1

    def __post_init__(self) -> None:
        if self.status not in ("ok", "error"):
            raise ValueError(f'status is {self.status!r}, not "ok" or "error"')
        if not math.isfinite(self.normalized_distance):
            raise ValueError(f"normalized_distance is {self.normalized_distance}")
        claims = self.contact or self.success or self.held_opened or self.normalized_distance != 1.0
        if self.status == "error" and claims:
            raise ValueError("a crashed trial counts as a failure: no contact, no success, distance 1")


@dataclass(frozen=True)
class FlowRow:
    """Flow metrics of one held-out sample, over its moving points (samples without any are not scheduled).

    Attributes:
        object: the object's id.
        category: the object's category.
        split: the split that the object belongs to.
        link: name of the link that moves.
        cosine: mean cosine between predicted and true flow.
        rmse: mean L2 norm of the error, in units of the largest true flow of the cloud.
        magnitude_error: mean absolute difference of the two norms, same unit.
        axis_cosine: as ``cosine``, without the sense of the motion; -1 if it was not recorded, and so the next three
            (:func:`fb3d_rl.flow.metrics.hypothesis_metrics`).
        best_cosine: of the best of the proposed flows; -2 if it was not recorded, as -1 is a cosine.
        probability: that the network gave to its prediction.
        hit: 1 where the prediction was the best of the proposed flows, else 0.

    Raises:
        ValueError: a metric that is not finite.
    """

    object: str
    category: str
    split: str
    link: str
    cosine: float
    rmse: float
    magnitude_error: float
    axis_cosine: float = -1.0
    best_cosine: float = -2.0
    probability: float = -1.0
    hit: float = -1.0

    def __post_init__(self) -> None:
        for name in ("cosine", "rmse", "magnitude_error"):
            if not math.isfinite(getattr(self, name)):
                raise ValueError(f"{name} of {self.object} {self.link} is {getattr(self, name)}")


Row = TypeVar("Row", TrialRow, FlowRow)
Kind = TypeVar("Kind", bound="DataclassInstance")

_BOOLEANS = {"True": True, "False": False}


def write(path: Path, rows: Sequence[Kind], kind: type[Kind]) -> None:
    """Write rows, dataclasses of one kind, as CSV, atomically."""
    text = io.StringIO(newline="")
    writer = csv.writer(text)
    writer.writerow([field.name for field in fields(kind)])
    writer.writerows(astuple(row) for row in rows)  # csv writes floats with repr
    write_text(path, text.getvalue())


def read(path: Path, kind: type[Kind]) -> list[Kind]:
    """Read rows that :func:`write` wrote; columns that have defaults may be missing.

    Raises:
        UserError: the file is missing, has other columns or a value of the wrong type.
    """
    columns = {field.name: str(field.type) for field in fields(kind)}
    needed = [field.name for field in fields(kind) if field.default is MISSING]
    rows: list[Kind] = []
    try:
        with path.open(newline="", encoding="utf-8", errors="surrogateescape") as file:
            reader = csv.reader(file)
            header = next(reader, [])
            # Files of earlier versions lack newer columns, which have defaults.
            if header != [name for name in columns if name in header] or not set(needed) <= set(header):
                raise UserError(f"{path} is of another version: its columns must be {', '.join(columns)}.")
            for values in reader:
                pairs = zip(header, values, strict=True)
                rows.append(kind(**{name: _parse(value, columns[name]) for name, value in pairs}))
    except (OSError, ValueError, KeyError, csv.Error) as error:
        raise UserError(f"Cannot read {path}, row {len(rows) + 1}: {error}") from error
    return rows


def _parse(value: str, type_: str) -> Any:
    if type_ == "int":
        return int(value)
    if type_ == "float":
        return float(value)
    return _BOOLEANS[value] if type_ == "bool" else value


def write_trials(path: Path, rows: Sequence[TrialRow]) -> None:
    """Write ``rows.csv`` atomically."""
    write(path, rows, TrialRow)


def read_trials(path: Path) -> list[TrialRow]:
    """Read ``rows.csv``.

    Raises:
        UserError: the file is missing, has other columns or a value of the wrong type.
    """
    return read(path, TrialRow)


def write_flow(path: Path, rows: Sequence[FlowRow]) -> None:
    """Write ``flow_rows.csv`` atomically."""
    write(path, rows, FlowRow)


def read_flow(path: Path) -> list[FlowRow]:
    """Read ``flow_rows.csv``.

    Raises:
        UserError: the file is missing, has other columns or a value of the wrong type.
    """
    return read(path, FlowRow)


def film_name(row: TrialRow) -> str:
    """Name of the files of a trial's film, without their suffixes."""
    # The names come from files of other people and may hold any character.
    return re.sub(r"[^\w.-]", "_", f"{row.trial:03d}_{row.object}_{row.link}_{row.policy}", flags=re.ASCII)


def policies(rows: Iterable[TrialRow]) -> list[str]:
    """Names of the policies in ``rows``, in order of first appearance."""
    return list(dict.fromkeys(row.policy for row in rows))


def own_policy(rows: Iterable[TrialRow]) -> str | None:
    """The policy that a run is about: the first but the expert, else the expert; None without rows."""
    names = policies(rows)
    return next((name for name in names if name != "expert"), names[0] if names else None)
