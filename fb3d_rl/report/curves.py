"""Learning and training curves as blocks of a report's page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import plotly.graph_objects as go

from fb3d_rl.evaluation import learning
from fb3d_rl.evaluation.learning import is_number
from fb3d_rl.report import page
from fb3d_rl.report.blocks import literal
from fb3d_rl.report.page import Block, Figure, Grid, Legend, Note

DASHES = ("solid", "dot", "dash")

LEARNING = {
    "success": {"val/success_rate": "validation", "collect/success_rate": "while collecting"},
    "contact": {"val/contact_rate": "validation", "collect/contact_rate": "while collecting"},
    "expert": {"collect/expert_share": "share of labels", "beta": "beta"},
    "loss": {"train/loss": "training", "val/loss": "validation"},
}
"""Panels of a run's learning curve: title -> key in the log -> what it is."""

OVER_LABELS = tuple(key for title, keys in LEARNING.items() if title != "loss" for key in keys)
"""Quantities that are drawn over labels, not steps; the loss is not, since it changes within a round."""


@dataclass(frozen=True)
class Line:
    """A line of a panel; ``low`` and ``high`` are the edges of its band."""

    name: str
    color: str
    x: Sequence[float]
    y: Sequence[float]
    low: Sequence[float] | None = None
    high: Sequence[float] | None = None
    dash: str = "solid"


def panel(id_: str, title: str, x_title: str, lines: Sequence[Line], *, legend: bool, percent: bool = False) -> Figure:
    """One small figure. A line of a single point becomes a dot with a bar; positive losses get a log axis."""
    plot = go.Figure()
    for line in lines:
        name, dots = literal(line.name), len(line.x) < 16
        trace: dict[str, Any] = {
            "x": list(line.x),
            "y": list(line.y),
            "name": name,
            "legendgroup": name,
            "line": {"color": line.color, "dash": line.dash, "width": 1.8},
            "marker": {"color": line.color, "size": 10 if len(line.x) == 1 else 5},
            "mode": "lines+markers" if dots else "lines",
        }
        if line.low is not None and line.high is not None:
            if len(line.x) == 1:
                up, down = line.high[0] - line.y[0], line.y[0] - line.low[0]
                trace["error_y"] = {"symmetric": False, "array": [up], "arrayminus": [down], "thickness": 1.8}
            else:
                plot.add_scatter(
                    x=[*line.x, *reversed(line.x)],
                    y=[*line.high, *reversed(line.low)],
                    fill="toself", fillcolor=line.color, opacity=0.16, mode="none", hoverinfo="skip",
                    legendgroup=name, showlegend=False,
                )  # fmt: skip
        plot.add_scatter(**trace)
    plot.update_layout(
        template="none",
        height=270,
        title={"text": literal(title), "font": {"size": 14}, "x": 0, "xanchor": "left", "xref": "container", "y": 0.97},
        margin={"l": 52, "r": 12, "t": 56 if legend else 36, "b": 42},
        showlegend=legend,
        legend={"orientation": "h", "x": 0, "y": 1, "yanchor": "bottom"},
        xaxis={"title": {"text": x_title}, "rangemode": "tozero"},
        yaxis={"tickformat": ".0%", "range": [-0.02, 1.02]} if percent else {},
    )
    if "loss" in title and all(value > 0 for line in lines for value in line.y):
        plot.update_yaxes(type="log", dtick="D2", tickformat="~g")
    elif not percent and all(value == 0 for line in lines for value in line.y):
        # By itself the axis would go below 0, where a count cannot be.
        plot.update_yaxes(range=[-0.02, 1.02])
    return Figure.of(id_, plot)


def training(logs: Sequence[tuple[str, str, Sequence[Mapping[str, Any]]]], skip: Sequence[str] = ()) -> list[Block]:
    """Curves over steps, a panel per quantity ("train/loss" and "val/loss" share the panel "loss").

    Args:
        logs: (name, colour, log) of each run; runs of one name share a colour. The colours of a single run tell
            its quantities' prefixes apart, those of several runs tell the runs apart.
        skip: keys that are shown elsewhere. Timings are left out.
    """
    several = len(logs) > 1
    panels: dict[str, list[Line]] = {}
    prefixes: list[str] = []
    for name, color, log in logs:
        points: dict[str, list[tuple[float, float]]] = {}
        for entry in log:
            for key, value in entry.items():
                prefix = key.rpartition("/")[0]
                wanted = prefix and prefix != "time" and key not in skip
                if wanted and is_number(value) and is_number(entry.get("step")):
                    points.setdefault(key, []).append((entry["step"], value))
        for key, pairs in points.items():
            prefix, _, quantity = key.rpartition("/")
            prefixes += [prefix] * (prefix not in prefixes)
            place = prefixes.index(prefix)
            line = Line(
                name if several else prefix,
                color if several else page.color(place),
                [step for step, _ in pairs],
                [value for _, value in pairs],
                dash=DASHES[place % len(DASHES)] if several else "solid",
            )
            panels.setdefault(quantity, []).append(line)
    panels = {name: lines for name, lines in panels.items() if any(len(line.x) > 1 for line in lines)}
    if not panels:
        return []
    figures = [
        panel(f"training-{i}", name.replace("_", " "), "step", lines, legend=not several and len(prefixes) > 1)
        for i, (name, lines) in enumerate(panels.items())
    ]
    head: list[Block] = []
    if several:
        head.append(Legend(list({name: color for name, color, _ in logs}.items())))
        if len(prefixes) > 1:
            dashes = ", ".join(f"{prefix} {DASHES[i % len(DASHES)]}" for i, prefix in enumerate(prefixes))
            head.append(Note(f"A line for each run; lines: {dashes}."))
    return [*head, Grid(figures)]


def once_a_round(log: Sequence[Mapping[str, Any]]) -> list[str]:
    """Keys of :func:`learning_curve` that are logged at most once a round, and so not drawn over steps, too."""
    count = len(learning.rounds(log))
    keys = [key for titled in LEARNING.values() for key in titled]
    return [key for key in keys if count > 1 and sum(is_number(row.get(key)) for row in log) <= count]


def learning_curve(log: Sequence[Mapping[str, Any]]) -> list[Block]:
    """The learning curve of a run of several rounds over labels; nothing for other runs."""
    if len(learning.rounds(log)) < 2:
        return []
    blocks = []
    for title, keys in LEARNING.items():
        found = {name: learning.curve([log], key) for key, name in keys.items()}
        lines = [
            Line(name, page.color(i), curve.labels, curve.mean)
            for i, (name, curve) in enumerate(found.items())
            if curve is not None
        ]
        if lines:
            blocks.append(panel(f"learning-{title}", title, "labels", lines, legend=True, percent=title != "loss"))
    return [Grid(blocks)] if blocks else []


def learning_curves(groups: Sequence[tuple[str, str, Sequence[Sequence[Mapping[str, Any]]]]]) -> list[Block]:
    """Success over labels and over rounds of groups of runs, their mean and the band from lowest to highest.

    Args:
        groups: (name, colour, logs of the runs) of each group; groups that count no labels are left out.
    """
    blocks = []
    shown: dict[str, str] = {}
    for k, (key, title) in enumerate(learning.SUCCESSES.items()):
        found = [(name, color, learning.curve(logs, key)) for name, color, logs in groups]
        known = [(name, color, curve) for name, color, curve in found if curve is not None]
        if not any(len(curve.rounds) > 1 for _, _, curve in known):
            continue
        shown |= {name: color for name, color, _ in known}
        for x_title in ("labels", "round"):
            lines = [
                Line(
                    name, color, c.labels if x_title == "labels" else c.rounds, c.mean, c.low, c.high,
                )
                for name, color, c in known
            ]  # fmt: skip
            blocks.append(panel(f"success-{k}-{x_title}", title, x_title, lines, legend=False, percent=True))
    if not blocks:
        return []
    note = "Mean over seeds; the band goes from the lowest to the highest seed."
    if any(len(learning.rounds(log)) == 1 for _, _, logs in groups for log in logs):
        note += " A dot: a single round."
    return [Legend(list(shown.items())), Note(note), Grid(blocks)]
