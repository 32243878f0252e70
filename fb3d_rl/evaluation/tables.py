"""From rows to numbers: a run's summary, its metrics, and the tables of it on a terminal.

An object's value is the mean over its trials (or flow samples); :mod:`fb3d_rl.evaluation.intervals` makes means and
intervals of objects' values.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table

from fb3d_rl.evaluation.intervals import UNBOUNDED, UNIT, Interval, Means, means
from fb3d_rl.registry import untrained
from fb3d_rl.rollout.rows import FlowRow, Row, TrialRow, own_policy, policies

_POSITIVE: Interval = (0.0, math.inf)


@dataclass(frozen=True)
class Metric:
    """A number of the report.

    Attributes:
        key: its name in the summary.
        label: its name for people.
        short: the same in at most 7 characters, for the terminal's table.
        percent: shown in percent, otherwise with ``decimals``.
        bounds: lowest and highest possible value.
        share: whether a trial's value is yes or no, so that the mean is a share.
        decimals: of a value that is not shown in percent.
    """

    key: str
    label: str
    short: str
    percent: bool = False
    bounds: Interval = UNBOUNDED
    share: bool = False
    decimals: int = 2

    def show(self, value: float | None) -> str:
        """``value`` for people; a dash where it is undefined."""
        if value is None:
            return "–"
        return f"{100 * value:.0f} %" if self.percent else f"{value:.{self.decimals}f}"

    def show_interval(self, interval: Sequence[float] | None) -> str:
        """An interval as "lo–hi"; empty where there is none."""
        if interval is None:
            return ""
        low, high = (f"{100 * x:.0f}" if self.percent else f"{x:.{self.decimals}f}" for x in interval)
        return f"{low} to {high}" if "-" in low + high else f"{low}–{high}"


FLOW = (
    Metric("flow/cosine", "flow cosine", "cosine", bounds=(-1.0, 1.0)),
    Metric("flow/rmse", "flow RMSE", "rmse", bounds=_POSITIVE),
    Metric("flow/magnitude_error", "flow magnitude error", "magn.", bounds=_POSITIVE),
)
AXIS = Metric("flow/axis_cosine", "flow |cosine|", "|cos.|", bounds=UNIT)
"""Without the sense of the motion. Rows of earlier versions lack it, as they do those of :data:`PROPOSALS`."""
PROPOSALS = (
    Metric("flow/best_cosine", "flow cosine, best of all proposals", "best", bounds=(-1.0, 1.0)),
    Metric("flow/probability", "probability of the prediction", "prob.", percent=True, bounds=UNIT),
    Metric("flow/hit", "prediction is the best proposal", "hit", percent=True, bounds=UNIT),
)
CONTACT = Metric("contact_rate", "contact", "contact", percent=True, bounds=UNIT, share=True)
SUCCESS = Metric("success_rate", "success", "success", percent=True, bounds=UNIT, share=True)
MOTION_ONLY = Metric("motion_only_success_rate", "motion-only success", "motion", percent=True, bounds=UNIT, share=True)
DISTANCE = Metric("normalized_distance", "normalized distance", "dist.", bounds=UNIT)
HELD = Metric("held_opened_rate", "opened what it held", "held", percent=True, bounds=UNIT, share=True)
"""Of policies without part mask: success with any part that suction held."""
TRIAL = (CONTACT, SUCCESS, MOTION_ONLY, DISTANCE)
STEPS = Metric("steps_to_success", "steps to success", "steps", bounds=_POSITIVE, decimals=0)
SECONDS = Metric("seconds_to_success", "simulated seconds to success", "seconds", bounds=_POSITIVE, decimals=1)
PATH = Metric("path_length", "way of the tip, m", "way", bounds=_POSITIVE)
LOST = Metric("times_lost", "times that hold was lost", "lost", bounds=_POSITIVE)
PULLS = Metric("pulls_until_moved", "pulls until the part moved the right way", "pulls", bounds=_POSITIVE)
"""Over the parts that did."""
EFFORT = (STEPS, SECONDS, PATH, LOST, PULLS)
"""The effort of trials; rows of earlier versions lack these numbers."""
CALLS = Metric("network_calls", "calls of the network", "calls", bounds=_POSITIVE, decimals=1)
"""Of policies that follow arcs; others call their network in each step."""
DECISION = Metric("time/decision_ms", "wall time of a decision, ms", "ms", decimals=1)
"""Median over the decisions of a run, on the machine that it ran on; rows do not hold it."""

_VALUES: dict[str, Callable[[Any], float | None]] = {
    "flow/cosine": lambda row: row.cosine,
    "flow/rmse": lambda row: row.rmse,
    "flow/magnitude_error": lambda row: row.magnitude_error,
    "flow/axis_cosine": lambda row: row.axis_cosine if row.axis_cosine >= 0 else None,
    "flow/best_cosine": lambda row: row.best_cosine if row.best_cosine >= -1 else None,
    "flow/probability": lambda row: row.probability if row.probability >= 0 else None,
    "flow/hit": lambda row: row.hit if row.hit >= 0 else None,
    "contact_rate": lambda row: float(row.contact),
    "success_rate": lambda row: float(row.success),
    "held_opened_rate": lambda row: float(row.held_opened) if row.mask == "none" else None,
    "motion_only_success_rate": lambda row: float(row.success) if row.contact else None,
    "normalized_distance": lambda row: row.normalized_distance,
    "steps_to_success": lambda row: float(row.steps) if row.success else None,
    "seconds_to_success": lambda row: row.seconds if row.success and row.seconds >= 0 else None,
    "path_length": lambda row: row.path_length if row.path_length >= 0 else None,
    "times_lost": lambda row: float(row.lost) if row.lost >= 0 else None,
    "pulls_until_moved": lambda row: float(row.pulls) if row.pulls >= 0 else None,
    "network_calls": lambda row: float(row.network_calls) if row.network_calls >= 0 else None,
}
"""What a row contributes to each metric; None: this row does not count."""


def _objects(values: Iterable[tuple[str, str, float | None]]) -> dict[tuple[str, str], float]:
    """Mean value of each (category, object), sorted: no result depends on the order of rows. None does not count."""
    collected: dict[tuple[str, str], list[float]] = {}
    for category, object_, value in values:
        if value is not None:
            collected.setdefault((category, object_), []).append(value)
    return {key: math.fsum(collected[key]) / len(collected[key]) for key in sorted(collected)}


def measure(rows: Iterable[TrialRow] | Iterable[FlowRow], metric: Metric) -> Means:
    """Means of ``metric`` over the objects of ``rows``, all rows of an object together."""
    value_of = _VALUES[metric.key]
    return means(_objects((row.category, row.object, value_of(row)) for row in rows), metric.bounds, metric.share)


def counted(rows: Iterable[TrialRow] | Iterable[FlowRow], metric: Metric) -> int:
    """Number of ``rows`` that have a value of ``metric``."""
    return sum(_VALUES[metric.key](row) is not None for row in rows)


def difference(pairs: Iterable[tuple[TrialRow, TrialRow]], metric: Metric) -> Means:
    """Means of the first row's minus the second row's value, over the objects of ``pairs``.

    An object's value is the mean over its pairs, so that what makes an object hard for both rows of a pair cancels.
    Where all objects are tied, the interval still bounds the share of other objects that could differ.

    Args:
        pairs: two policies' rows of one trial each; pairs of which either value is undefined do not count.
        metric: any of :data:`TRIAL`.

    Raises:
        ValueError: the rows of a pair are of two objects.
    """
    value_of = _VALUES[metric.key]
    values = []
    for row, other in pairs:
        if (row.category, row.object) != (other.category, other.object):
            raise ValueError(f"a pair of {row.category} {row.object} and {other.category} {other.object}")
        one, two = value_of(row), value_of(other)
        values.append((row.category, row.object, None if one is None or two is None else one - two))
    width = metric.bounds[1] - metric.bounds[0]
    return means(_objects(values), (-width, width))


def _measure(
    rows: Sequence[TrialRow] | Sequence[FlowRow], metrics: Sequence[Metric], prefix: str, classes: bool
) -> dict[str, Any]:
    out: dict[str, Any] = {}
    for metric in metrics:
        result = measure(rows, metric)
        key = prefix + metric.key
        out[key] = result.instance
        out[f"{key}_ci95"] = None if result.instance_ci95 is None else list(result.instance_ci95)
        if classes:
            out[f"{key}_class_mean"] = result.class_
            out[f"{key}_class_mean_ci95"] = None if result.class_ci95 is None else list(result.class_ci95)
    return out


def _aggregate(rows: Sequence[TrialRow], flow: Sequence[FlowRow], own: str | None, classes: bool) -> dict[str, Any]:
    out: dict[str, Any] = {}
    if flow:
        recorded = any(row.axis_cosine >= 0 for row in flow)
        out |= _measure(flow, FLOW + ((AXIS, *PROPOSALS) if recorded else ()), "", classes)
        out["flow/n"] = len(flow)
    for policy in policies(rows):
        of_policy = [row for row in rows if row.policy == policy]
        counts = {
            "n": len(of_policy),
            "n_objects": len({(row.category, row.object) for row in of_policy}),
            "n_error": sum(row.status == "error" for row in of_policy),
        }
        further = [HELD] if any(row.mask == "none" for row in of_policy) else []
        further += [CALLS] if any(row.network_calls >= 0 for row in of_policy) else []
        measured = _measure(of_policy, (*TRIAL, *further, *EFFORT), "", classes) | counts
        if policy == own:
            out |= measured
        out |= {f"{policy}/{key}": value for key, value in measured.items()}
    return out


def parts(rows: Iterable[Row], field: str) -> dict[str, list[Row]]:
    """The rows of each value of ``field``, in the order of these values."""
    found: dict[str, list[Row]] = {}
    for row in rows:
        found.setdefault(getattr(row, field), []).append(row)
    return dict(sorted(found.items()))


def summary(
    rows: Sequence[TrialRow], flow_rows: Sequence[FlowRow], extra: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """The content of ``summary.json``.

    Args:
        rows: trials of any number of policies.
        flow_rows: held-out flow samples, may be empty.
        extra: facts about the run ("seed", "git_revision", "command", ...), copied; ``extra["policy"]`` names
            the run's own policy, otherwise :func:`own_policy` chooses.

    Returns:
        A flat dict. Each metric m of :data:`FLOW`, :data:`TRIAL` and :data:`EFFORT` (and :data:`HELD`, of policies that
        see no part mask, and :data:`CALLS`, of those that follow arcs) has the keys "m" (instance mean),
        "m_ci95" ([lo, hi] or None), "m_class_mean" and "m_class_mean_ci95". Trial metrics and the counts "n"
        (scheduled trials), "n_objects" and "n_error" stand there for the run's own policy, and once more as
        "<policy>/..." for every policy. "by_category" (without class means) and, for more than one split,
        "by_split" hold the same keys for each category and split. Undefined means (motion-only success
        without any contact) are None.
    """
    facts = dict(extra or {})
    own = facts.get("policy") or own_policy(rows)
    out: dict[str, Any] = {**facts, "policy": own} if own else facts
    out |= _aggregate(rows, flow_rows, own, classes=True)

    def apart(field: str, classes: bool) -> dict[str, Any]:
        trials, clouds = parts(rows, field), parts(flow_rows, field)
        names = sorted({*trials, *clouds})
        return {name: _aggregate(trials.get(name, []), clouds.get(name, []), own, classes) for name in names}

    out["by_category"] = apart("category", False)
    by_split = apart("split", True)
    return out | {"by_split": by_split} if len(by_split) > 1 else out


def policies_of(numbers: Mapping[str, Any]) -> list[str]:
    """Names of the policies that a summary has trials of; the expert, an upper bound, comes first."""
    names = [key[: -len("/n")] for key in numbers if key.endswith("/n") and key != "flow/n"]
    return sorted(names, key=lambda name: name != "expert")


def has_flow(numbers: Mapping[str, Any]) -> bool:
    """Whether a summary has flow metrics."""
    return "flow/n" in numbers


def has_proposals(numbers: Mapping[str, Any]) -> bool:
    """Whether a summary is of a network that proposes several flows."""
    return has_flow(numbers) and (numbers.get("flow/probability") or 1.0) < 1.0


def trainings(numbers: Mapping[str, Any]) -> str:
    """A note on the number of trainings in a run's summary; empty where no policy was trained."""
    if not has_flow(numbers) and {*policies_of(numbers)} <= {*untrained()}:
        return ""
    return "One training (one seed) per trained policy: the intervals are for other objects, not for another training."


def effort_of(numbers: Mapping[str, Any], names: Sequence[str]) -> list[str]:
    """The policies among ``names`` whose effort a summary has."""
    keys = [metric.key for metric in (*EFFORT, DECISION)]
    return [name for name in names if any(numbers.get(f"{name}/{key}") is not None for key in keys)]


def titled(title: str, words: Sequence[str], numbers: Sequence[str]) -> Table:
    """A rich table without rows, with columns of words and then of numbers."""
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, show_edge=False, padding=(0, 1, 0, 0))
    for name in words:
        table.add_column(name, overflow="fold")
    for name in numbers:
        table.add_column(name, justify="right", overflow="fold")
    return table


def effort_table(numbers: Mapping[str, Any], names: Sequence[str]) -> Table:
    """The effort of trials, as a rich table with a row for each of the policies ``names``."""
    columns = ("steps", "seconds", "way of the tip, m", "times lost", "pulls until it moved", "ms a decision")
    table = titled("What it took, steps and seconds until success", ("policy",), columns)
    for name in names:
        table.add_row(name, *(m.show(numbers.get(f"{name}/{m.key}")) for m in (*EFFORT, DECISION)))
    return table


def unmasked(numbers: Mapping[str, Any]) -> list[str]:
    """The policies of a summary that saw no part mask."""
    return [name for name in policies_of(numbers) if numbers.get(f"{name}/{HELD.key}") is not None]


def unmasked_table(numbers: Mapping[str, Any], names: Sequence[str]) -> Table:
    """What the policies ``names`` opened that saw no part mask, as a rich table with a row for each."""
    table = titled("Without a part mask", ("policy",), ("opened the target", "95 %", "opened what it held", "95 %"))
    for name in names:
        keys = [(metric, f"{name}/{metric.key}") for metric in (SUCCESS, HELD)]
        cells = [(m.show(numbers.get(key)), m.show_interval(numbers.get(f"{key}_ci95"))) for m, key in keys]
        table.add_row(name, *(cell for pair in cells for cell in pair))
    return table


_POLICIES_PER_TABLE = 2


def tables(numbers: Mapping[str, Any]) -> list[Table]:
    """A summary as rich tables of at most 100 columns: one row per category, then class and instance mean.

    The flow and two policies fit side by side; further policies get tables of their own. The last one is the
    effort.
    """
    names = policies_of(numbers)
    chunks = [names[i : i + _POLICIES_PER_TABLE] for i in range(0, len(names), _POLICIES_PER_TABLE)]
    flow = has_flow(numbers)
    if not chunks and not flow:
        return []
    listed = [_table(numbers, chunk, flow and i == 0) for i, chunk in enumerate(chunks or [[]])]
    if unmasked(numbers):
        listed.append(unmasked_table(numbers, unmasked(numbers)))
    if has_proposals(numbers):
        listed.append(proposals_table(numbers))
    measured = effort_of(numbers, names)
    return [*listed, effort_table(numbers, measured)] if measured else listed


def proposals_table(numbers: Mapping[str, Any]) -> Table:
    """What the flows that a network proposes are worth: one row per metric, instance means with intervals."""
    table = titled("Several proposed flows", ("",), ("mean", "95 % interval"))
    for metric in (FLOW[0], AXIS, *PROPOSALS):
        table.add_row(
            metric.label, metric.show(numbers[metric.key]), metric.show_interval(numbers.get(f"{metric.key}_ci95"))
        )
    return table


def _table(numbers: Mapping[str, Any], names: Sequence[str], flow: bool) -> Table:
    # One wide row of tables under the policies' names, because rich has no headers that span columns. All
    # inner rows are one line high, so they line up.
    groups = [("flow", FLOW, "")] * flow + [(name, (CONTACT, SUCCESS, DISTANCE), f"{name}/") for name in names]
    labels = _inner()
    labels.add_column("category", no_wrap=True, min_width=13, max_width=16)
    inner = [_inner() for _ in groups]
    for table, (_, metrics, prefix) in zip(inner, groups, strict=True):
        if prefix:
            table.add_column("n", justify="right", no_wrap=True)
        for metric in metrics:
            table.add_column(metric.short, justify="right", no_wrap=True, min_width=len(metric.short))

    def add(label: str, values: Mapping[str, Any], suffix: str, interval: bool = False) -> None:
        labels.add_row(label)
        for table, (_, metrics, prefix) in zip(inner, groups, strict=True):
            cells = ["" if interval else str(values.get(f"{prefix}n", 0))] if prefix else []
            for metric in metrics:
                key = prefix + metric.key + suffix
                ends = metric.show_interval(values.get(f"{key}_ci95")).replace("0.", ".").replace(" to ", "–")
                cells.append(ends if interval else metric.show(values.get(key)))
            table.add_row(*cells)

    for category, values in numbers["by_category"].items():
        add(category, values, "")
    for table in (labels, *inner):
        table.add_section()
    for label, suffix in (("class mean", "_class_mean"), ("instance mean", "")):
        add(label, numbers, suffix)
        add("95 % interval", numbers, suffix, interval=True)
    outer = Table(title="Results on held-out objects", box=None, padding=(0, 2, 0, 0), pad_edge=False)
    outer.add_column("", no_wrap=True, min_width=13)
    for name, _, _ in groups:
        outer.add_column(name, justify="left", no_wrap=True)
    outer.add_row(labels, *inner)
    return outer


def _inner() -> Table:
    return Table(box=box.SIMPLE_HEAD, show_edge=False, padding=0, pad_edge=False)


def print_tables(listed: Iterable[Table], console: Console | None = None) -> Console:
    """Print tables, 100 columns wide where the output is not a terminal."""
    console = console or Console()
    if not console.is_terminal:
        console.width = max(console.width, 100)
    for table in listed:
        console.print(table)
    return console


def show(numbers: Mapping[str, Any], console: Console | None = None) -> None:
    """Print a summary's tables and what to know about them."""
    console = print_tables(tables(numbers), console)
    if note := trainings(numbers):
        console.print(note, style="dim", highlight=False)


def number_rows(results: Mapping[str, Mapping[str, Any]]) -> Iterator[tuple[str, str, str]]:
    """(benchmark, what, value) of each number, for a table."""
    for name, numbers in results.items():
        for key, value in numbers.items():
            if isinstance(value, float):
                yield name, key, f"{value:.3g}" if value < 100 else f"{value:.0f}"
            elif not isinstance(value, list):
                yield name, key, str(value)
