"""What the report of a run and a comparison have in common."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import plotly.graph_objects as go

from fb3d_rl.errors import UserError
from fb3d_rl.evaluation import tables
from fb3d_rl.files import write_text
from fb3d_rl.report import page
from fb3d_rl.report.page import text

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
"""Facts of a summary that pages tell, with their names."""

COPIED = (FACTS["command"],)
"""Facts that one may want to copy."""


def write(path: Path, title: str, body: str) -> Path:
    """Write a page.

    Raises:
        UserError: it cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text(path, page.page(title, body))
    except OSError as error:
        raise UserError(f"Cannot write {path}: {error.strerror}.") from error
    return path


def terms(summaries: Sequence[Mapping[str, Any]]) -> list[tuple[str, object]]:
    """How to read the numbers that ``summaries`` have."""
    names = {name for numbers in summaries for name in tables.policies_of(numbers)}
    told = {
        "Flow": any(map(tables.has_flow, summaries)),
        "Normalized distance": bool(names),
        "Success": bool(names),
        "Contact": bool(names),
        "What it took": any(tables.effort_of(numbers, tables.policies_of(numbers)) for numbers in summaries),
        "Expert": "expert" in names,
    }
    return [(term, meaning) for term, meaning in READING if told.get(term, True)]


def effort(numbers: Mapping[str, Any], colors: Mapping[str, str]) -> str:
    """What the trials of each policy took; nothing where no policy in ``colors`` has such numbers."""
    shown = (*tables.EFFORT, tables.DECISION)
    body = ""
    for name in tables.effort_of(numbers, list(colors)):
        body += f'<tr class="mean">{page.named(name, colors[name])}'
        for metric in shown:
            key = f"{name}/{metric.key}"
            body += page.cell(metric.show(numbers.get(key)), metric.show_interval(numbers.get(f"{key}_ci95")))
        body += "</tr>"
    return page.plain_table(["policy", *(metric.label for metric in shown)], body) if body else ""


def broken(label: str) -> str:
    """A label of a figure, long ones on several lines, which leaves the bars their room on a phone."""
    return "<br>".join(map(text, textwrap.wrap(label, 27)))


def bars(plot: go.Figure, name: str, color: str, labels: Sequence[str], cells: Sequence[tuple[Any, Any]]) -> None:
    """Horizontal dots with intervals; ``cells`` are (value, interval), both may be None."""
    known = [(label, value, ends) for label, (value, ends) in zip(labels, cells, strict=True) if value is not None]
    ends = [interval if interval is not None else (value, value) for _, value, interval in known]
    plot.add_bar(
        orientation="h",
        name=text(name),
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
        hovertemplate="%{y}: %{x:.2f}<extra>" + text(name) + "</extra>",
    )
