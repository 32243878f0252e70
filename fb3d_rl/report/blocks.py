"""What the report of a run and a comparison have in common."""

from __future__ import annotations

import html
import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import plotly.graph_objects as go

from fb3d_rl.evaluation import tables
from fb3d_rl.report.page import Block, Cell, Row, Table

READING = (
    ("Flow", "direction and relative size of each visible point's motion when the part opens a little; the "
     "largest in a cloud is 1. Cosine (1 is perfect), RMSE and magnitude error (0 is perfect) are over the "
     "points that move."),
    ("Normalized distance", "share of the way to fully open that is left at the end: 0 open, 1 unmoved."),
    ("Success", "normalized distance below 0.1. A trial that crashed counts as a failure."),
    ("Contact", "suction held the part to open; motion-only success is success among these trials."),
    ("What it took", "steps and simulated seconds until success are means over the trials that succeeded, the way of "
     "the gripper's tip and how often it lost its hold over all; the wall time of a decision is the median on the "
     "machine of the run."),
    ("Expert", "follows the true flow: what a policy could reach with perfect predictions."),
    ("Numbers", "means over objects with a 95 % interval; class means are over categories."),
)  # fmt: skip
"""How to read the numbers: (term, meaning)."""

FACTS = {
    "command": "Command",
    "policy": "Policy",
    "checkpoint": "Checkpoint",
    "split": "Split",
    "seed": "Seed",
    "git_revision": "Revision",
    "machine": "Machine",
    "device": "Device",
    "started": "Started",
    "finished": "Finished",
}
"""Facts of a summary that pages show, with their names."""

COPIED = (FACTS["command"],)
"""Facts that one may want to copy."""


def terms(summaries: Sequence[Mapping[str, Any]]) -> list[tuple[str, object]]:
    """How to read the numbers that ``summaries`` have."""
    names = {name for numbers in summaries for name in tables.policies_of(numbers)}
    has = {
        "Flow": any(map(tables.has_flow, summaries)),
        "Normalized distance": bool(names),
        "Success": bool(names),
        "Contact": bool(names),
        "What it took": any(tables.effort_of(numbers, tables.policies_of(numbers)) for numbers in summaries),
        "Expert": "expert" in names,
    }
    return [(term, meaning) for term, meaning in READING if has.get(term, True)]


def effort(numbers: Mapping[str, Any], colors: Mapping[str, str]) -> list[Block]:
    """The effort of each policy's trials; nothing where no policy in ``colors`` has such numbers."""
    shown = (*tables.EFFORT, tables.DECISION)
    rows = []
    for name in tables.effort_of(numbers, list(colors)):
        keyed = [(metric, f"{name}/{metric.key}") for metric in shown]
        cells = [Cell(m.show(numbers.get(key)), m.show_interval(numbers.get(f"{key}_ci95"))) for m, key in keyed]
        rows.append(Row([named(name, colors[name]), *cells]))
    return [Table.plain(["policy", *(metric.label for metric in shown)], rows)] if rows else []


def named(name: str, color: str) -> Cell:
    """A cell with the name and the colour of a policy or run."""
    return Cell(name, word=True, color=color)


def literal(value: object) -> str:
    """A string from outside as a label of a figure: plotly.js takes a label's tags for its own."""
    return html.escape(str(value))


def broken(label: str) -> str:
    """A label of a figure, long ones on several lines, which leaves the bars their room on a phone."""
    return "<br>".join(map(literal, textwrap.wrap(label, 27)))


def bars(plot: go.Figure, name: str, color: str, labels: Sequence[str], cells: Sequence[tuple[Any, Any]]) -> None:
    """Horizontal dots with intervals; ``cells`` are (value, interval), both may be None."""
    known = [(label, value, ends) for label, (value, ends) in zip(labels, cells, strict=True) if value is not None]
    ends = [interval if interval is not None else (value, value) for _, value, interval in known]
    plot.add_bar(
        orientation="h",
        name=literal(name),
        marker={"color": color, "opacity": 0.5},
        y=[broken(label) for label, _, _ in known],
        x=[value for _, value, _ in known],
        error_x={
            "type": "data",
            "symmetric": False,
            "array": [high - value for (_, value, _), (_, high) in zip(known, ends, strict=True)],
            "arrayminus": [value - low for (_, value, _), (low, _) in zip(known, ends, strict=True)],
            "color": color,
            "thickness": 1.8,
            "width": 3,
        },
        hovertemplate="%{y}: %{x:.2f}<extra>" + literal(name) + "</extra>",
    )
