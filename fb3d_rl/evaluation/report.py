"""Reports: one HTML file for a run, one for the comparison of several."""

from __future__ import annotations

import json
import math
import zipfile
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray
from plotly.subplots import make_subplots

from fb3d_rl.contract import UserError
from fb3d_rl.evaluation import page, tables
from fb3d_rl.evaluation.page import PALETTE, text
from fb3d_rl.evaluation.rows import TrialRow, policies, read_flow, read_trials, write_text
from fb3d_rl.evaluation.tables import CONTACT, DISTANCE, FLOW, MOTION_ONLY, SUCCESS, Metric

READING = (
    ("Flow", "direction and relative size of each visible point's motion when the part opens a little; the "
     "largest in a cloud is 1. Cosine (1 is perfect), RMSE and magnitude error (0 is perfect) are over the "
     "points that move."),
    ("Normalized distance", "share of the way to fully open that is left at the end: 0 open, 1 unmoved."),
    ("Success", "normalized distance below 0.1. A trial that crashed counts as a failure."),
    ("Contact", "suction held the part to open; motion-only success is success among these trials."),
    ("Expert", "follows the true flow: what a policy could reach with perfect predictions."),
    ("Numbers", "means over objects with a 95 % interval; class means are over categories."),
)  # fmt: skip
"""How to read the numbers: (term, meaning)."""

_FACTS = {
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
_ARROWS = 160
"""Arrows per cloud: more hide the shape."""

_CLOUD_ARRAYS = ("points", "valid", "part_mask", "flow_true", "flow_predicted", "title")
_FILES = ("config.yaml", "metrics.jsonl", "rows.csv", "flow_rows.csv", "summary.json", "clouds.npz")


@dataclass(frozen=True)
class Run:
    """What a run folder holds; everything that is missing is empty or None."""

    path: Path
    config: str
    log: list[dict[str, Any]]
    rows: list[TrialRow]
    summary: dict[str, Any]
    clouds: dict[str, NDArray[Any]] | None


def read_run(path: Path) -> Run:
    """Read a run folder. Without a ``summary.json`` the summary is computed from the rows.

    Raises:
        UserError: ``path`` is not a run folder, or one of its files cannot be read.
    """
    if not any((path / name).is_file() for name in _FILES):
        raise UserError(f"{path} is not a run folder: it holds none of {', '.join(_FILES)}.")
    has = {name: (path / name).is_file() for name in _FILES}
    rows = read_trials(path / "rows.csv") if has["rows.csv"] else []
    flow = read_flow(path / "flow_rows.csv") if has["flow_rows.csv"] else []
    return Run(
        path=path,
        config=_read_text(path / "config.yaml") if has["config.yaml"] else "",
        log=_read_log(path / "metrics.jsonl") if has["metrics.jsonl"] else [],
        rows=rows,
        summary=_read_summary(path / "summary.json") if has["summary.json"] else tables.summary(rows, flow),
        clouds=_read_clouds(path / "clouds.npz") if has["clouds.npz"] else None,
    )


def _read_text(path: Path) -> str:
    try:
        return path.read_text("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"Cannot read {path}: {error}") from error


def _read_summary(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(_read_text(path))
    except json.JSONDecodeError as error:
        raise UserError(f"Cannot read {path}: it is not valid JSON ({error}).") from error
    if not isinstance(content, dict) or not isinstance(content.get("by_category"), dict):
        raise UserError(f'Cannot read {path}: it is not a summary of a run (no "by_category").')
    return content


def _read_log(path: Path) -> list[dict[str, Any]]:
    lines = _read_text(path).split("\n")
    entries = []
    # The part after the last newline is empty, or a line that a killed run did not finish.
    for number, line in enumerate(lines[:-1], start=1):
        try:
            entry = json.loads(line)
        except json.JSONDecodeError as error:
            raise UserError(f"Cannot read {path}, line {number}: {error}") from error
        if not isinstance(entry, dict):
            raise UserError(f"Cannot read {path}, line {number}: it is not a JSON object.")
        entries.append(entry)
    return entries


def _read_clouds(path: Path) -> dict[str, NDArray[Any]]:
    try:
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in _CLOUD_ARRAYS}
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise UserError(f"Cannot read {path}: {error}") from error


def write_report(run_dir: Path, out: Path | None = None) -> Path:
    """Write the report of one run as a single HTML file that needs no network.

    Args:
        run_dir: the run folder; whatever it does not hold is left out.
        out: where to write, ``run_dir / "report.html"`` by default.

    Returns:
        Path of the report.

    Raises:
        UserError: not a run folder, or one of its files cannot be read.
    """
    run = read_run(run_dir)
    numbers = run.summary
    name = run_dir.resolve().name
    body = (
        f"<header><h1>{text(name)}</h1>{page.facts(_facts(numbers))}</header>"
        + page.section("Results", _headline(numbers))
        + page.section("Training", _curves("curves", {"": run.log}))
        + page.section("Success by category", _success_bars(numbers))
        + page.section("Numbers by category", _category_table(numbers), _split_table(numbers))
        + page.section("True and predicted flow", _viewer(run.clouds))
        + page.section("Failed trials", _failures(run.rows))
        + page.section("Configuration", f'<pre class="panel">{text(run.config)}</pre>' if run.config else "")
    )
    return _write(out or run_dir / "report.html", f"{name} · fb3d_rl", body)


def write_comparison(runs: Sequence[Path], out: Path) -> Path:
    """Write one HTML file that sets the headline numbers and curves of several runs side by side.

    Raises:
        UserError: one of ``runs`` is not a run folder, or one of its files cannot be read.
    """
    loaded = dict(zip(_labels(runs), (read_run(path) for path in runs), strict=True))
    summaries = [run.summary for run in loaded.values()]
    body = (
        f"<header><h1>Comparison of {len(runs)} runs</h1></header>"
        + page.section("Results", _comparison_table(loaded), _reading(summaries))
        + page.section("Side by side", _comparison_bars(loaded))
        + page.section("Training", _curves("curves", {name: run.log for name, run in loaded.items()}))
        + page.section("What was run", *(
            f"<h3>{text(name)}</h3>{page.facts(_facts(run.summary))}"
            for name, run in loaded.items()
            if _facts(run.summary)
        ))
    )  # fmt: skip
    return _write(out, "Comparison · fb3d_rl", body)


def _write(path: Path, title: str, body: str) -> Path:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text(path, page.page(title, body))
    except OSError as error:
        raise UserError(f"Cannot write {path}: {error.strerror}.") from error
    return path


def _labels(runs: Sequence[Path]) -> list[str]:
    """Shortest tails of the paths that tell the runs apart."""
    parts = [path.resolve().parts for path in runs]
    for length in range(1, max(map(len, parts)) + 1):
        labels = ["/".join(p[-length:]) for p in parts]
        if len(set(labels)) == len(labels):
            return labels
    raise UserError("The same run is given twice.")


def _facts(numbers: Mapping[str, Any]) -> list[tuple[str, object]]:
    return [(label, numbers[key]) for key, label in _FACTS.items() if numbers.get(key) not in (None, "")]


def _reading(summaries: Sequence[Mapping[str, Any]]) -> str:
    """How to read the numbers that ``summaries`` have."""
    names = {name for numbers in summaries for name in tables.policies_of(numbers)}
    told = {
        "Flow": any(map(tables.has_flow, summaries)),
        "Normalized distance": bool(names),
        "Success": bool(names),
        "Contact": bool(names),
        "Expert": "expert" in names,
    }
    return page.facts((term, meaning) for term, meaning in READING if told.get(term, True))


def _color(index: int) -> str:
    return PALETTE[index % len(PALETTE)]


def _card(metric: Metric, numbers: Mapping[str, Any], prefix: str = "") -> tuple[str, str, list[str]]:
    key = prefix + metric.key
    interval = metric.show_interval(numbers.get(f"{key}_ci95"))
    class_ = metric.show(numbers.get(f"{key}_class_mean"))
    label = metric.label.removeprefix("flow ")
    more = [f"95 % interval {interval}"] * bool(interval) + [f"class mean {class_}"]
    return label[0].upper() + label[1:], metric.show(numbers.get(key)), more


def _headline(numbers: Mapping[str, Any]) -> str:
    blocks = []
    if tables.has_flow(numbers):
        blocks.append(f"<h3>Flow · {numbers['flow/n']} held-out clouds</h3>")
        blocks.append(page.cards(_card(metric, numbers) for metric in FLOW))
    for policy in tables.policies_of(numbers):
        prefix = f"{policy}/"
        counts = f"{numbers[prefix + 'n']} trials on {numbers[prefix + 'n_objects']} objects"
        if numbers[prefix + "n_error"]:
            counts += f", {numbers[prefix + 'n_error']} crashed"
        blocks.append(f"<h3>{text(policy)} · {counts}</h3>")
        blocks.append(page.cards(_card(m, numbers, prefix) for m in (SUCCESS, CONTACT, DISTANCE, MOTION_ONLY)))
    if not blocks:
        return ""
    return "".join(blocks) + _reading([numbers])


def _curves(id_: str, logs: Mapping[str, Sequence[Mapping[str, Any]]]) -> str:
    """A panel per quantity ("train/loss" and "val/loss" share the panel "loss"), timings left out."""
    panels: dict[str, dict[str, list[tuple[float, float]]]] = {}
    for i, (run, log) in enumerate(logs.items()):
        for entry in log:
            for key, value in entry.items():
                group, _, name = key.rpartition("/")
                if not group or group == "time" or not _finite(value) or not _finite(entry.get("step")):
                    continue
                line = f"{i}\0{run}\0{group}"
                panels.setdefault(name, {}).setdefault(line, []).append((entry["step"], value))
    panels = {name: lines for name, lines in panels.items() if any(len(line) > 1 for line in lines.values())}
    if not panels:
        return ""
    columns = min(2, len(panels))
    count = math.ceil(len(panels) / columns)
    titles = [text(name.replace("_", " ")) for name in panels]
    plot = make_subplots(count, columns, subplot_titles=titles, vertical_spacing=0.3 / count)
    several = len(logs) > 1
    groups: list[str] = []
    shown: set[str] = set()
    for k, (name, lines) in enumerate(panels.items()):
        row, column = k // columns + 1, k % columns + 1
        for line, pairs in lines.items():
            index, run, group = line.split("\0")
            if group not in groups:
                groups.append(group)
            label = f"{run} {group}" if several else group
            plot.add_scatter(
                x=[step for step, _ in pairs],
                y=[value for _, value in pairs],
                name=text(label),
                legendgroup=text(label),
                showlegend=label not in shown,
                mode="lines",
                line={
                    "color": _color(int(index) if several else groups.index(group)),
                    "dash": ("solid", "dot", "dash")[groups.index(group) % 3] if several else "solid",
                    "width": 1.8,
                },
                row=row,
                col=column,
            )
            shown.add(label)
        plot.update_xaxes(title_text="step" if k >= len(panels) - columns else None, row=row, col=column)
        if "loss" in name and all(value > 0 for pairs in lines.values() for _, value in pairs):
            plot.update_yaxes(type="log", dtick="D2", tickformat="~g", row=row, col=column)
    plot.update_layout(
        template="none",
        height=90 + 240 * count,
        margin={"l": 50, "r": 16, "t": 64, "b": 44},
        legend={"orientation": "h", "yref": "container", "y": 1, "yanchor": "top"},
    )
    return page.figure(id_, plot)


def _finite(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _bars(plot: go.Figure, name: str, color: str, labels: Sequence[str], cells: Sequence[tuple[Any, Any]]) -> None:
    """Horizontal dots with intervals; ``cells`` are (value, interval), both may be None."""
    known = [(label, value, ends) for label, (value, ends) in zip(labels, cells, strict=True) if value is not None]
    ends = [interval if interval is not None else (value, value) for _, value, interval in known]
    plot.add_bar(
        orientation="h",
        name=text(name),
        marker={"color": color, "opacity": 0.5},
        y=[text(label) for label, _, _ in known],
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


def _success_bars(numbers: Mapping[str, Any]) -> str:
    names = tables.policies_of(numbers)
    if not names:
        return ""
    categories = [c for c, values in numbers["by_category"].items() if any(f"{p}/n" in values for p in names)]
    plot = go.Figure()
    for i, policy in enumerate(names):
        key = f"{policy}/{SUCCESS.key}"
        cells = [(v.get(key), v.get(f"{key}_ci95")) for v in (numbers["by_category"][c] for c in categories)]
        _bars(plot, policy, _color(i), categories, cells)
    plot.update_layout(
        template="none",
        barmode="group",
        bargap=0.3,
        height=90 + len(categories) * (10 + 13 * len(names)),
        margin={"l": 8, "r": 16, "t": 34, "b": 40},
        legend={"orientation": "h", "y": 1, "yanchor": "bottom", "traceorder": "normal"},
        xaxis={"tickformat": ".0%", "range": [0, 1.02], "title": {"text": "success, with 95 % interval"}},
        yaxis={"autorange": "reversed", "automargin": True, "ticksuffix": "  "},
    )
    return page.figure("success", plot)


def _groups(numbers: Mapping[str, Any]) -> list[tuple[str, str, tuple[Metric, ...]]]:
    """(title, key prefix, metrics) of each group of columns."""
    trial = (CONTACT, SUCCESS, DISTANCE)
    groups: list[tuple[str, str, tuple[Metric, ...]]] = [("flow", "", FLOW)] if tables.has_flow(numbers) else []
    return groups + [(policy, f"{policy}/", trial) for policy in tables.policies_of(numbers)]


def _category_table(numbers: Mapping[str, Any]) -> str:
    groups = _groups(numbers)
    if not groups:
        return ""
    body = "".join(_table_row(name, values, groups) for name, values in numbers["by_category"].items())
    means = _table_row("class mean", numbers, groups, "_class_mean", mean=True)
    means += _table_row("instance mean", numbers, groups, mean=True)
    return _grouped_table("category", groups, body, means)


def _split_table(numbers: Mapping[str, Any]) -> str:
    if "by_split" not in numbers:
        return ""
    groups = _groups(numbers)
    body = "".join(
        _table_row(f"{name}, {label}", values, groups, suffix, mean=True)
        for name, values in numbers["by_split"].items()
        for label, suffix in (("class mean", "_class_mean"), ("instance mean", ""))
    )
    return "<h3>By split</h3>" + _grouped_table("split", groups, body)


def _grouped_table(first: str, groups: Sequence[tuple[str, str, tuple[Metric, ...]]], *bodies: str) -> str:
    top, below = "", ""
    policy = 0
    for title, prefix, metrics in groups:
        color = _color(policy) if prefix else "var(--line)"
        policy += bool(prefix)
        span = len(metrics) + bool(prefix)
        top += f'<th class="group first" style="--swatch:{color}" colspan="{span}">{text(title)}</th>'
        labels = ["n"] * bool(prefix) + [metric.label.removeprefix("flow ") for metric in metrics]
        below += "".join(
            f"<th{' class=first' if k == 0 else ''}>{text(label).replace(' ', '<br>')}</th>"
            for k, label in enumerate(labels)
        )
    head = f'<thead><tr><th class="text" rowspan="2">{text(first)}</th>{top}</tr><tr>{below}</tr></thead>'
    content = "".join(f"<tbody>{body}</tbody>" for body in bodies)
    return f'<div class="panel wide"><table>{head}{content}</table></div>'


def _table_row(
    label: str,
    values: Mapping[str, Any],
    groups: Sequence[tuple[str, str, tuple[Metric, ...]]],
    suffix: str = "",
    mean: bool = False,
) -> str:
    cells = ""
    for _, prefix, metrics in groups:
        shown = [text(values.get(f"{prefix}n", 0))] if prefix else []
        for metric in metrics:
            key = prefix + metric.key + suffix
            interval = metric.show_interval(values.get(f"{key}_ci95"))
            small = f"<small>{interval}</small>" if mean else ""
            shown.append(metric.show(values.get(key)) + small)
        cells += "".join(f"<td{' class=first' if k == 0 else ''}>{cell}</td>" for k, cell in enumerate(shown))
    return f'<tr{" class=mean" if mean else ""}><td class="text">{text(label)}</td>{cells}</tr>'


def _viewer(clouds: Mapping[str, NDArray[Any]] | None) -> str:
    if clouds is None:
        return ""
    samples = zip(*(clouds[name] for name in _CLOUD_ARRAYS), strict=True)
    prepared = [_cloud(*sample) for sample in samples if sample[1].any()]
    if not prepared:
        return ""
    note = (
        "The same cloud twice; drag to turn, scroll to zoom. Arrows start at the same points on both sides, "
        "chosen among those that move or are predicted to move (flow above 0.1); arrows below 0.02 are "
        "left out."
    )
    return f'<p class="soft">{note}</p>' + page.viewer(prepared)


def _cloud(
    points: NDArray[np.float32],
    valid: NDArray[np.bool_],
    part_mask: NDArray[np.bool_],
    flow_true: NDArray[np.float32],
    flow_predicted: NDArray[np.float32],
    title: str,
) -> dict[str, Any]:
    """One cloud for :func:`page.viewer`; arrays [N, ...], padding dropped."""
    points, part = points[valid], part_mask[valid]
    true, predicted = flow_true[valid], flow_predicted[valid]
    low, high = points.min(0), points.max(0)
    size = 0.18 * float(np.linalg.norm(high - low))
    moving = np.flatnonzero((np.linalg.norm(true, axis=1) > 0) | (np.linalg.norm(predicted, axis=1) > 0.1))
    # Evenly through the cloud's order, so that a report is the same each time it is written.
    chosen = moving[np.unique(np.linspace(0, len(moving) - 1, _ARROWS).astype(int))] if len(moving) else moving

    def arrows(flow: NDArray[np.float32]) -> dict[str, list[list[float]]]:
        kept = chosen[np.linalg.norm(flow[chosen], axis=1) > 0.02]
        return {"start": _rounded(points[kept]), "vector": _rounded(flow[kept])}

    return {
        "title": str(title),
        "rest": _rounded(points[~part].T),
        "part": _rounded(points[part].T),
        "true": arrows(true),
        "predicted": arrows(predicted),
        "size": size,
        "box": _rounded(np.stack([low - 0.6 * size, high + 0.6 * size], axis=1)),
    }


def _rounded(values: NDArray[np.float32]) -> list[list[float]]:
    rounded: list[list[float]] = np.round(values.astype(np.float64), 4).tolist()
    return rounded


def _failures(rows: Sequence[TrialRow]) -> str:
    if not rows:
        return ""
    blocks = []
    for policy in policies(rows):
        of_policy = [row for row in rows if row.policy == policy]
        failed = [row for row in of_policy if not row.success]
        if not failed:
            blocks.append(f"<p>{text(policy)}: none of {len(of_policy)} trials failed.</p>")
            continue
        reasons = Counter(_reason(row) for row in failed).most_common()
        why = " · ".join(f"{text(reason)} {count}" for reason, count in reasons)
        body = "".join(_failure(row) for row in failed)
        head = "".join(
            f'<th class="{class_}">{label}</th>'
            for label, class_ in (
                ("trial", ""),
                ("object", "text"),
                ("category", "text"),
                ("split", "text"),
                ("part", "text"),
                ("why", "text"),
                ("distance", ""),
                ("steps", ""),
                ("seed", ""),
            )
        )
        blocks.append(
            f"<details open><summary>{text(policy)}: {len(failed)} of {len(of_policy)} trials failed"
            "</summary>"
            f'<p class="soft">{why}</p><div class="panel scroll"><table><thead><tr>{head}</tr></thead>'
            f"<tbody>{body}</tbody></table></div></details>"
        )
    return "".join(blocks)


def _reason(row: TrialRow) -> str:
    return row.failure or ("crashed" if row.status == "error" else "no reason given")


def _failure(row: TrialRow) -> str:
    part = f"{row.link} ({row.semantic}, {row.joint_type})"
    what = (row.object, row.category, row.split, part)
    why = text(_reason(row)) + (f'<br><span class="error">{text(row.error)}</span>' if row.error else "")
    cells = "".join(f'<td class="text">{text(value)}</td>' for value in what)
    return (
        f'<tr><td>{row.trial}</td>{cells}<td class="text wrap">{why}</td>'
        f"<td>{DISTANCE.show(row.normalized_distance)}</td><td>{row.steps}</td><td>{row.seed}</td></tr>"
    )


def _comparison_table(runs: Mapping[str, Run]) -> str:
    """A row per run and policy; a run without trials has one row."""
    metrics = (*FLOW, CONTACT, SUCCESS, DISTANCE, MOTION_ONLY)
    head = '<th class="text">run</th><th class="text">policy</th><th>n</th>'
    head += "".join(f"<th>{metric.label}</th>" for metric in metrics)
    body = ""
    for name, run in runs.items():
        for k, policy in enumerate(tables.policies_of(run.summary) or [""]):
            prefix = f"{policy}/"
            cells = f"<td>{text(run.summary.get(prefix + 'n', '–'))}</td>"
            for metric in metrics:
                key = metric.key if metric in FLOW else prefix + metric.key
                # The flow belongs to the run: it stands in the first of its rows only.
                hidden = metric in FLOW and k > 0
                value = "" if hidden else metric.show(run.summary.get(key))
                interval = "" if hidden else metric.show_interval(run.summary.get(f"{key}_ci95"))
                cells += f"<td>{value}<small>{interval}</small></td>"
            body += (
                f'<tr class="mean"><td class="text">{text(name) if k == 0 else ""}</td>'
                f'<td class="text">{text(policy)}</td>{cells}</tr>'
            )
    return f'<div class="panel wide"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def _comparison_bars(runs: Mapping[str, Run]) -> str:
    """Success of each run's policies and the flow's cosine, instance and class mean."""
    bars: dict[Metric, list[tuple[str, Mapping[str, Any], str]]] = {SUCCESS: [], DISTANCE: [], FLOW[0]: []}
    for name, run in runs.items():
        if tables.has_flow(run.summary):
            bars[FLOW[0]].append((name, run.summary, FLOW[0].key))
        for policy in tables.policies_of(run.summary):
            for metric in (SUCCESS, DISTANCE):
                bars[metric].append((f"{name} · {policy}", run.summary, f"{policy}/{metric.key}"))
    blocks = []
    for metric, entries in bars.items():
        if not entries:
            continue
        plot = go.Figure()
        labels = [label for label, _, _ in entries]
        for i, (title, suffix) in enumerate((("instance mean", ""), ("class mean", "_class_mean"))):
            cells = [(n.get(key + suffix), n.get(f"{key}{suffix}_ci95")) for _, n, key in entries]
            _bars(plot, title, _color(i), labels, cells)
        plot.update_layout(
            template="none",
            barmode="group",
            bargap=0.3,
            height=110 + 42 * len(entries),
            margin={"l": 8, "r": 16, "t": 34, "b": 40},
            legend={"orientation": "h", "y": 1, "yanchor": "bottom", "traceorder": "normal"},
            xaxis={
                "tickformat": ".0%" if metric.percent else ".2f",
                "title": {"text": f"{metric.label}, with 95 % interval"},
            },
            yaxis={"autorange": "reversed", "automargin": True, "ticksuffix": "  "},
        )
        blocks.append(page.figure(metric.key.replace("/", "-"), plot))
    return "".join(f'<div style="margin-bottom:12px">{block}</div>' for block in blocks)
