"""Options of an evaluation."""

from __future__ import annotations

from dataclasses import dataclass

from fb3d_rl.options import option
from fb3d_rl.rollout.options import ScheduleOptions

PROTOCOLS: dict[str, str] = {
    "task": "",
    "umpnet": "fb3d_rl.algos.umpnet:run",
    "robot": "fb3d_rl.algos.robot:run",
}
"""Protocols by name, as "module:function" where trials are their own: ``function(cfg, out)`` returns the rows."""


@dataclass(frozen=True)
class EvaluationOptions(ScheduleOptions):
    """Which trials are run and shown; conf/protocol/ sets how they start, their goal and their repetitions."""

    protocol: str = option(
        "task",
        "whose trials: the simulated task's, or a protocol's with a world of its own, which launch/evaluate.py runs",
        among=PROTOCOLS,
    )
    trials: int | None = option(
        40,
        "at most this many trials, spread over the categories; null: all visible openable parts; 0: none, which needs "
        "no simulator",
        within="[0, inf)",
    )
    expert: bool = option(True, "also run the expert on the same trials")
    clouds: int = option(8, "clouds shown in the report", within="[0, inf)")
    videos: int = option(
        2,
        "trials filmed with every policy, spread over the categories, half of them failures if there are any; a video "
        "takes some ten seconds",
        within="[0, inf)",
    )
    decision_seconds: float | None = option(
        60.0,
        "a trial whose policy takes longer for one decision ends there; null: no limit",
        "s",
        "(0, inf)",
    )
