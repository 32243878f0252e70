"""The page of a plan: the cloud with the arrows of its flow, contact point and approach, for each hypothesis."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fb3d_rl.predict.plan import Hypothesis, Plan
from fb3d_rl.predict.results import UNITS, VECTORS
from fb3d_rl.report.page import Block, Choice, Facts, Figure, Legend, Note, Picker, Section, write

POINTS = 12_000
"""Points of the largest cloud that a page shows in full."""

ARROWS = 120
"""Arrows of the flow."""

COLORS = {"object": "#98a2b3", "left out": "#cbb79b", "part": "#3b7dd8", "flow": "#e0782f", "gripper": "#1f8a63"}
"""Of what a figure shows."""


def sentence(plan: Plan, remarks: Sequence[str] = ()) -> str:
    """What a plan says, and what was recognised and guessed (``remarks`` in the file), in one sentence."""
    best = plan.hypotheses[0]
    point, pull, before = (_triple(x) for x in (best.contact_point, best.pull, best.precontact_point))
    sure = f" (probability {best.probability:.0%} of {len(plan.hypotheses)})" if len(plan.hypotheses) > 1 else ""
    guessed = "".join(f"; {remark}" for remark in (*remarks, *plan.remarks))
    return f"touch {point} m, coming from {before} m, and pull along {pull}{sure}{guessed}"


def write_page(path: Path, plan: Plan, cloud: Path, remarks: Sequence[str]) -> None:
    """Write the page of a plan.

    Args:
        path: the file, .html.
        plan: what it shows.
        cloud: the file of the cloud.
        remarks: what was recognised in that file.
    """
    views = [
        (f"hypothesis {k}: {one.probability:.0%}", Figure(f"hypothesis-{k}", _figure(plan, one)))
        for k, one in enumerate(plan.hypotheses, 1)
    ]
    shown: list[Block] = [Legend([(name, COLORS[name]) for name in COLORS if name != "part" or plan.part is not None])]
    shown.append(views[0][1] if len(views) == 1 else Choice("show", views))
    shown.append(Picker("mask=box:"))
    best = plan.hypotheses[0]
    facts = [(name.replace("_", " "), f"{_numbers(getattr(best, name))}  {UNITS[name]}") for name in VECTORS]
    said = sentence(plan, remarks)
    header: list[Block] = [Note(f"{said[0].upper()}{said[1:]}.")]
    sections = [Section("Flow and contact", shown), Section("Plan, in the frame of the cloud", [Facts(facts)])]
    write(path, f"Plan for {cloud.name}", f"How to open {cloud.name}", header, sections)


def _figure(plan: Plan, one: Hypothesis) -> dict[str, Any]:
    """A plotly figure of one hypothesis."""
    step = max(1, len(plan.points) // POINTS)
    rows = np.arange(0, len(plan.points), step)
    rows = rows[np.isfinite(plan.points[rows]).all(1)]
    points, inside = plan.points[rows], plan.foreground[rows]
    part = np.zeros(len(rows), dtype=bool) if plan.part is None else plan.part[rows] & inside
    object_ = points[inside]
    size = float(np.linalg.norm(np.ptp(object_, axis=0)))
    traces = [
        _dots(points[~inside], COLORS["left out"], 1.5, "left out"),
        _dots(object_[~part[inside]], COLORS["object"], 2.0, "object"),
        _dots(points[part], COLORS["part"], 2.5, "part"),
    ]
    flow = one.flow[rows]
    moving = np.flatnonzero(np.linalg.norm(flow, axis=1) > 0.1)
    moving = moving[np.unique(np.linspace(0, len(moving) - 1, ARROWS).astype(int))] if len(moving) else moving
    traces += _arrows(points[moving], 0.12 * size * flow[moving], COLORS["flow"], 0.02 * size, 3)
    ways = one.contact_point - one.precontact_point
    reach = max(1.0, 0.2 * size / float(np.linalg.norm(ways)))
    start = (one.contact_point - reach * ways)[None]
    traces += _arrows(start, reach * ways[None], COLORS["gripper"], 0.06 * size, 10)
    low, high = object_.min(0) - 0.15 * size, object_.max(0) + 0.15 * size
    hidden = {"showticklabels": False, "title": {"text": ""}, "showspikes": False, "zeroline": False}
    axes = {
        f"{axis}axis": {**hidden, "showgrid": False, "showbackground": False, "range": [float(low[k]), float(high[k])]}
        for k, axis in enumerate("xyz")
    }
    aspect = (high - low) / float((high - low).max())
    up, towards = plan.T_world_cloud[2, :3], plan.camera - object_.mean(0)
    eye = 1.75 * towards / float(np.linalg.norm(towards))
    view = {"eye": _named(eye), "up": _named(up)}
    scene = {**axes, "aspectmode": "manual", "aspectratio": _named(1.2 * aspect), "camera": view, "dragmode": "orbit"}
    margin = {"l": 0, "r": 0, "t": 0, "b": 0}
    return {"data": traces, "layout": {"height": 560, "margin": margin, "showlegend": False, "scene": scene}}


def _dots(points: NDArray[Any], color: str, size: float, name: str) -> dict[str, Any]:
    x, y, z = _columns(points)
    hover = "%{x:.3f}, %{y:.3f}, %{z:.3f} m"
    marker = {"size": size, "color": color}
    return {"type": "scatter3d", "mode": "markers", "x": x, "y": y, "z": z, "marker": marker, "name": name,
            "hovertemplate": hover}  # fmt: skip


def _arrows(starts: NDArray[Any], ways: NDArray[Any], color: str, head: float, width: float) -> list[dict[str, Any]]:
    """Shafts as one broken line, heads as cones of one length (m)."""
    ends = starts + ways
    gaps = np.full_like(ends, np.nan)
    x, y, z = _columns(np.stack([starts, ends, gaps], axis=1).reshape(-1, 3))
    shafts = {"type": "scatter3d", "mode": "lines", "x": x, "y": y, "z": z, "line": {"color": color, "width": width},
              "hoverinfo": "skip"}  # fmt: skip
    units = head * ways / np.linalg.norm(ways, axis=1, keepdims=True).clip(1e-9)
    (x, y, z), (u, v, w) = _columns(ends), _columns(units)
    heads = {"type": "cone", "x": x, "y": y, "z": z, "u": u, "v": v, "w": w, "anchor": "center", "sizemode": "raw",
             "sizeref": 1, "showscale": False, "colorscale": [[0, color], [1, color]], "hoverinfo": "skip",
             "lighting": {"ambient": 0.9, "diffuse": 0.2, "specular": 0}}  # fmt: skip
    return [shafts, heads]


def _columns(values: NDArray[Any]) -> list[list[float | None]]:
    rounded = np.round(values.astype(np.float64), 5)
    return [[None if x != x else x for x in column] for column in rounded.T.tolist()]


def _named(values: NDArray[Any]) -> dict[str, float]:
    return dict(zip("xyz", (float(x) for x in values), strict=True))


def _triple(values: NDArray[Any]) -> str:
    return "(" + ", ".join(f"{x:.3f}" for x in values + 0.0) + ")"


def _numbers(values: NDArray[Any]) -> str:
    return ", ".join(f"{x:.4f}" for x in values.reshape(-1) + 0.0)
