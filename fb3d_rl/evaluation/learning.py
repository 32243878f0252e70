"""Rounds and learning curves over labels, from the log of a behaviour-cloning or DAgger run."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeGuard

LABELS, ROUND = "labels", "round"
SUCCESSES = {
    "val/success_rate": "validation success while training",
    "collect/success_rate": "success while collecting",
}
"""Learning curves: key in the log -> what it is."""


def is_number(value: object) -> TypeGuard[int | float]:
    """Whether a value of a log can be drawn."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def rounds(log: Iterable[Mapping[str, Any]]) -> list[dict[str, float]]:
    """The log's rows that count labels, one for each round: of a value that is logged several times, the last.

    A row without a "round" continues the round before it.
    """
    found: dict[float, dict[str, float]] = {}
    number = 0.0
    for row in log:
        if is_number(row.get(LABELS)):
            number = row[ROUND] if is_number(row.get(ROUND)) else number
            known = found.setdefault(number, {ROUND: number})
            known.update((key, value) for key, value in row.items() if is_number(value))
    return [found[key] for key in sorted(found)]


@dataclass(frozen=True)
class Curve:
    """A quantity over rounds: mean, lowest and highest of several runs.

    Attributes:
        rounds: number of each round.
        labels: labels used up to then, mean over the runs.
        mean: of the runs that have the round.
        low: the lowest run.
        high: the highest run.
    """

    rounds: list[float]
    labels: list[float]
    mean: list[float]
    low: list[float]
    high: list[float]


def curve(logs: Sequence[Iterable[Mapping[str, Any]]], key: str) -> Curve | None:
    """``key`` over the rounds of runs that differ in the seed; None if no run logs it."""
    found: dict[float, list[tuple[float, float]]] = {}
    for log in logs:
        for row in rounds(log):
            if key in row:
                found.setdefault(row[ROUND], []).append((row[LABELS], row[key]))
    if not found:
        return None
    numbers = sorted(found)
    values = [[value for _, value in found[number]] for number in numbers]
    return Curve(
        rounds=numbers,
        labels=[sum(labels for labels, _ in found[number]) / len(found[number]) for number in numbers],
        mean=[math.fsum(v) / len(v) for v in values],
        low=[min(v) for v in values],
        high=[max(v) for v in values],
    )
