"""How trials end: their stages, and the reasons of failures."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence

from fb3d_rl.rollout.rows import (
    CRASHED,
    LOST,
    NEVER_HELD,
    NEVER_TOUCHED,
    STUCK,
    TIMED_OUT,
    TOO_SLOW,
    WRONG_WAY,
    TrialRow,
)

SUCCESS, SCHEDULED, TOUCHED, HELD = "success", "scheduled", "touched", "held"

NOT_FAR = "held, but not opened far enough"
"""The failure in rows of versions that did not distinguish stuck, wrong direction and timed out."""

ENDS = {
    SUCCESS: "#2f9e77",
    TIMED_OUT: "#dcb13c",
    NOT_FAR: "#c98b2b",
    STUCK: "#e0782f",
    WRONG_WAY: "#c2548f",
    LOST: "#8b63cf",
    NEVER_HELD: "#3b7dd8",
    NEVER_TOUCHED: "#4fa3b5",
    TOO_SLOW: "#9a7059",
    CRASHED: "#d1495b",
}
"""How trials end, from the best to the worst, with the colours of these ends."""

_FORMER = {"held at the end": NOT_FAR}
"""Ends under their names in early versions."""

_APART = (CRASHED, TOO_SLOW)
"""Ends after which the earlier stages are unknown."""


def end(row: TrialRow) -> str:
    """How a trial ended: "success", or why it failed.

    Rows of early versions also say how far the part was open ("lost hold, 34 % open"), which is left out here.
    """
    if row.success:
        return SUCCESS
    reason = re.sub(r", -?\d+ % open$", "", row.failure)
    return _FORMER.get(reason, reason) or (CRASHED if row.status == "error" else "no reason given")


def stages(row: TrialRow) -> tuple[str, ...]:
    """The stages of a trial from "scheduled" to its end."""
    last = end(row)
    if last in _APART:
        return SCHEDULED, last
    if row.contact:
        return SCHEDULED, TOUCHED, HELD, last
    if last in (SUCCESS, NEVER_HELD):
        return SCHEDULED, TOUCHED, last
    return SCHEDULED, last


def in_order(ends: Sequence[str]) -> dict[str, int]:
    """Each of ``ends`` with its count, from the best to the worst; unknown ends come last."""
    count = Counter(ends)
    known = [name for name in ENDS if name in count]
    return {name: count[name] for name in [*known, *sorted(count.keys() - ENDS.keys())]}
