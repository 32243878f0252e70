"""DAgger's mixing: with which probability beta the expert acts in a round (Ross, Gordon, Bagnell 2011, section 3)."""

from __future__ import annotations

from typing import Literal, get_args

from fb3d_rl.errors import UserError

Schedule = Literal["constant", "linear", "exponential", "first"]
SCHEDULES: tuple[str, ...] = get_args(Schedule)


def beta(schedule: str, index: int, value: float = 1.0, rounds: int = 10, base: float = 0.5) -> float:
    """The expert's share in round ``index``.

    Args:
        schedule: "constant": ``value``; "linear": 1 - i / ``rounds``, 0 from round ``rounds`` on; "exponential":
            ``base``^i; "first": 1 in round 0, then 0, the paper's parameter-free choice.
        index: the round i, counted from 0.
        value: of "constant", 0 to 1.
        rounds: of "linear", at least 1.
        base: p of "exponential", 0 to 1.

    Raises:
        UserError: the schedule is unknown or its option out of range.
        ValueError: ``index`` is negative.
    """
    if index < 0:
        raise ValueError(f"round {index} is negative")
    if schedule == "constant":
        return _share("value", value)
    if schedule == "linear":
        if rounds < 1:
            raise UserError(f"the linear beta schedule needs rounds of 1 or more, not {rounds}")
        return max(0.0, 1.0 - index / rounds)
    if schedule == "exponential":
        return _share("base", base) ** index
    if schedule == "first":
        return 1.0 if index == 0 else 0.0
    raise UserError(f"the beta schedule {schedule} is unknown; choose from {', '.join(SCHEDULES)}")


def _share(option: str, value: float) -> float:
    if not 0.0 <= value <= 1.0:
        raise UserError(f"{option}={value} of the beta schedule is out of range; give a number from 0 to 1")
    return float(value)
