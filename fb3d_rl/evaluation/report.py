"""Reports: one HTML file for a run, one for the comparison of several."""

from __future__ import annotations

import textwrap
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from fb3d_rl.contract import UserError
from fb3d_rl.evaluation import comparison, curves, page, tables
from fb3d_rl.evaluation.comparison import Comparison, Group
from fb3d_rl.evaluation.page import text
from fb3d_rl.evaluation.rows import TrialRow, policies
from fb3d_rl.evaluation.runs import CLOUD_ARRAYS, read_run
from fb3d_rl.evaluation.tables import CONTACT, DISTANCE, FLOW, MOTION_ONLY, SUCCESS, Metric
from fb3d_rl.files import write_text

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
_VIDEO_BYTES = 6_000_000
"""Videos inside the page: base64 makes a third more of it."""

_ARROWS = 160
"""Arrows per cloud: more hide the shape."""


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
        + page.section("Learning curve", curves.learning_curve(run.log))
        + page.section("Training", curves.training([("", "", run.log)], curves.once_a_round(run.log)))
        + page.section("Success by category", _success_bars(numbers))
        + page.section("Numbers by category", _category_table(numbers), _split_table(numbers))
        + page.section("True and predicted flow", _viewer(run.clouds))
        + page.section("Videos", _videos(run_dir / "videos"))
        + page.section("Failed trials", _failures(run.rows))
        + page.section("Configuration", f'<pre class="panel">{text(run.config)}</pre>' if run.config else "")
    )
    return _write(out or run_dir / "report.html", f"{name} · fb3d_rl", body)


def write_comparison(found: Comparison, out: Path, unfinished: Sequence[Path] = ()) -> Path:
    """Write a comparison as one HTML file that needs no network, and its numbers beside it as a CSV file.

    Args:
        found: the comparison.
        out: the HTML file; the table has the same name with .csv in the end.
        unfinished: folders of runs that are not part of it, named on the page.

    Returns:
        ``out``.

    Raises:
        UserError: ``out`` cannot be written.
    """
    labels = [entry.label for entry in found.entries]
    labels += [group.label for group in found.groups if group.label not in labels]
    colors = {label: page.color(i) for i, label in enumerate(labels)}
    logs = [(group.label, colors[group.label], [run.log for run in group.runs]) for group in found.groups]
    learned = curves.learning_curves(logs)
    steps = [(name, color, log) for name, color, of_runs in logs for log in of_runs]
    body = (
        f"<header><h1>{_title(found)}</h1>{_left_out(unfinished)}</header>"
        + page.section("Results", _entry_table(found, colors), _split_entries(found, colors))
        + page.section("Side by side", _entry_bars(found, colors))
        + page.section("Differences on the same trials", _difference_tables(found, colors))
        + page.section("Learning curves", learned)
        + page.section("Success by category", _entry_categories(found, colors))
        + page.section("Flow", _flow_table(found))
        + page.section("Training", curves.training(steps, skip=curves.OVER_LABELS if learned else ()))
        + page.section("How the numbers come about", _told(found))
        + page.section("What was run", *map(_group_facts, found.groups))
    )
    _write(out, "Comparison · fb3d_rl", body)
    try:
        comparison.write_csv(found, out.with_suffix(".csv"))
    except OSError as error:
        raise UserError(f"Cannot write {out.with_suffix('.csv')}: {error.strerror}.") from error
    return out


def _write(path: Path, title: str, body: str) -> Path:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text(path, page.page(title, body))
    except OSError as error:
        raise UserError(f"Cannot write {path}: {error.strerror}.") from error
    return path


def _facts(numbers: Mapping[str, Any]) -> list[tuple[str, object]]:
    return [(label, numbers[key]) for key, label in _FACTS.items() if numbers.get(key) not in (None, "")]


def _terms(summaries: Sequence[Mapping[str, Any]]) -> list[tuple[str, object]]:
    """How to read the numbers that ``summaries`` have."""
    names = {name for numbers in summaries for name in tables.policies_of(numbers)}
    told = {
        "Flow": any(map(tables.has_flow, summaries)),
        "Normalized distance": bool(names),
        "Success": bool(names),
        "Contact": bool(names),
        "Expert": "expert" in names,
    }
    return [(term, meaning) for term, meaning in READING if told.get(term, True)]


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
    return "".join(blocks) + page.facts(_terms([numbers]))


def _bars(plot: go.Figure, name: str, color: str, labels: Sequence[str], cells: Sequence[tuple[Any, Any]]) -> None:
    """Horizontal dots with intervals; ``cells`` are (value, interval), both may be None."""
    known = [(label, value, ends) for label, (value, ends) in zip(labels, cells, strict=True) if value is not None]
    ends = [interval if interval is not None else (value, value) for _, value, interval in known]
    plot.add_bar(
        orientation="h",
        name=text(name),
        marker={"color": color, "opacity": 0.5},
        y=[text(label).replace("\n", "<br>") for label, _, _ in known],
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
        _bars(plot, policy, page.color(i), categories, cells)
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
        color = page.color(policy) if prefix else "var(--line)"
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
    samples = zip(*(clouds[name] for name in CLOUD_ARRAYS), strict=True)
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


def _videos(folder: Path) -> str:
    """The videos of a run inside the page, as many as :data:`_VIDEO_BYTES` hold."""
    blocks, left = [], _VIDEO_BYTES
    paths = sorted(folder.glob("*.mp4"))
    for path in paths:
        left -= path.stat().st_size
        if left >= 0:
            blocks.append(page.video(path.stem, path.read_bytes()))
    more = len(paths) - len(blocks)
    note = f'<p class="soft">{more} more in the folder videos/.</p>' if more else ""
    return (page.grid(blocks, "small") if blocks else "") + note


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


# ------------------------------------------------------------------------------------------------------ comparison


def _title(found: Comparison) -> str:
    count = sum(len(group.names) for group in found.groups)
    return f"Comparison of {count} run{'s' * (count != 1)}"


def _left_out(unfinished: Sequence[Path]) -> str:
    if not unfinished:
        return ""
    names = ", ".join(path.name for path in unfinished)
    return f'<p class="error">Left out, not finished (no summary.json): {text(names)}</p>'


def _cell(value: str, small: str = "") -> str:
    return f"<td>{value}<small>{small}</small></td>"


def _plain_table(head: Sequence[str], body: str) -> str:
    """A table of which the first column is text."""
    first, *others = head
    cells = f'<th class="text">{text(first)}</th>' + "".join(f"<th>{text(name)}</th>" for name in others)
    return f'<div class="panel wide"><table><thead><tr>{cells}</tr></thead><tbody>{body}</tbody></table></div>'


def _named(label: str, colors: Mapping[str, str]) -> str:
    return f'<td class="text named">{page.swatch(colors[label])}{text(label)}</td>'


def _entry_table(found: Comparison, colors: Mapping[str, str], split: str = "") -> str:
    """A row per policy; of one split, or of all trials."""
    numbers = found.numbers["by_split"][split] if split else found.numbers
    entries = [entry for entry in found.entries if f"{entry.label}/n" in numbers]
    if not entries:
        return ""
    several = not split and any(len(entry.seeds) > 1 for entry in entries)
    labelled = not split and any(entry.labels is not None for entry in entries)
    head = ["policy", "success", "success, class mean"] + ["success, range over seeds"] * several
    head += ["contact", "normalized distance"] + ["labels", "expert steps"] * labelled
    body = ""
    for entry in entries:
        body += f'<tr class="mean">{_named(entry.label, colors)}'
        body += _cell(*comparison.cells(entry, numbers, SUCCESS))
        body += _cell(*comparison.cells(entry, numbers, SUCCESS, "_class_mean"))
        if several:
            body += _cell(SUCCESS.show_interval(entry.seed_range(SUCCESS)) or "–")
        body += _cell(*comparison.cells(entry, numbers, CONTACT)) + _cell(*comparison.cells(entry, numbers, DISTANCE))
        if labelled:
            body += _cell(comparison.show_labels(entry.labels)) + _cell(comparison.show_share(entry.expert_share))
        body += "".join(f"<td>{numbers[f'{entry.label}/{key}']}</td>" for key in ("n", "n_objects"))
        body += f"<td>{text(comparison.show_seeds(entry))}</td>"
        body += "</tr>"
    note = "" if split else '<p class="soft">Small print: 95 % intervals from resampling objects, see below.</p>'
    return note + _plain_table([*head, "trials", "objects", "seeds"], body)


def _split_entries(found: Comparison, colors: Mapping[str, str]) -> str:
    splits = found.numbers.get("by_split", {})
    return "".join(f"<h3>Split {text(name)}</h3>{_entry_table(found, colors, name)}" for name in splits)


def _entry_bars(found: Comparison, colors: Mapping[str, str]) -> str:
    """Instance means in the policies' colours."""
    blocks = []
    lines = max((1 + _broken(entry.label).count("\n") for entry in found.entries), default=1)
    for metric in (SUCCESS, DISTANCE) if found.entries else ():
        plot = go.Figure()
        for entry in found.entries:
            key = f"{entry.label}/{metric.key}"
            value = (found.numbers.get(key), found.numbers.get(f"{key}_ci95"))
            _bars(plot, entry.label, colors[entry.label], [_broken(entry.label)], [value])
        plot.update_layout(
            template="none",
            barmode="overlay",
            bargap=0.4,
            height=70 + max(34, 10 + 16 * lines) * len(found.entries),
            margin={"l": 8, "r": 16, "t": 12, "b": 40},
            showlegend=False,
            xaxis={
                "tickformat": ".0%" if metric.percent else ".1f",
                "rangemode": "tozero",
                "title": {"text": f"{metric.label}, with 95 % interval"},
            },
            yaxis={"autorange": "reversed", "automargin": True, "ticksuffix": "  "},
        )
        if metric.percent:
            plot.update_xaxes(range=[0, 1.02])
        blocks.append(page.figure(metric.key, plot))
    return page.grid(blocks) if blocks else ""


def _broken(label: str) -> str:
    """A long label on several lines, which leaves the bars their room on a phone."""
    return "\n".join(textwrap.wrap(label, 27))


def _difference_tables(found: Comparison, colors: Mapping[str, str]) -> str:
    bodies: dict[str, str] = {}
    for three in comparison.by_pair(found):
        row = f'<tr class="mean">{_named(three[0].entry.label, colors)}{_cell(str(three[0].n))}'
        row += "".join(_cell(*comparison.show_difference(d.metric, d.means)) for d in three)
        bodies[three[0].baseline.label] = bodies.get(three[0].baseline.label, "") + row + "</tr>"
    head = ("policy", "trials", *(m.label + ", points" * m.percent for m in comparison.DIFFERENCES))
    return "".join(f"<h3>Minus {text(name)}</h3>{_plain_table(head, body)}" for name, body in bodies.items())


def _entry_categories(found: Comparison, colors: Mapping[str, str]) -> str:
    if not found.entries:
        return ""
    body = ""
    for category, values in found.numbers["by_category"].items():
        shown = (comparison.cells(entry, values, SUCCESS) for entry in found.entries)
        objects = {(r.category, r.object) for e in found.entries for r in e.rows.values() if r.category == category}
        cells = _cell(str(len(objects))) + "".join(_cell(*cell) for cell in shown)
        body += f'<tr class="mean"><td class="text">{text(category)}</td>{cells}</tr>'
    head = "".join(
        f'<th class="group" style="--swatch:{colors[entry.label]}">{text(entry.label)}</th>' for entry in found.entries
    )
    head = f'<th class="text">category</th><th>objects</th>{head}'
    return f'<div class="panel wide"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def _flow_table(found: Comparison) -> str:
    """A row per group that measured a flow network, all seeds together."""
    body = ""
    for group in found.groups:
        rows = [row for run in group.runs for row in run.flow]
        if not rows:
            continue
        cells = _cell(str(sum(bool(run.flow) for run in group.runs))) + _cell(str(len(rows)))
        for metric in FLOW:
            measured = tables.measure(rows, metric)
            cells += _cell(metric.show(measured.instance), metric.show_interval(measured.instance_ci95))
            cells += _cell(metric.show(measured.class_), metric.show_interval(measured.class_ci95))
        body += f'<tr class="mean"><td class="text">{text(group.label)}</td>{cells}</tr>'
    names = (metric.label.removeprefix("flow ") for metric in FLOW)
    head = ["run", "seeds", "clouds", *(cell for name in names for cell in (name, f"{name}, class mean"))]
    return _plain_table(head, body) if body else ""


def _told(found: Comparison) -> str:
    labelled = any(entry.labels is not None for entry in found.entries)
    terms = _terms([run.summary for group in found.groups for run in group.runs])
    return page.facts([*terms, *(entry for entry in comparison.METHOD if entry[0] != "Labels" or labelled)])


def _group_facts(group: Group) -> str:
    """What was run, told once where all runs of the group agree."""
    facts: list[tuple[str, object]] = [("Runs", ", ".join(group.names))]
    for key, label in _FACTS.items():
        values = dict.fromkeys(str(run.summary[key]) for run in group.runs if run.summary.get(key) not in (None, ""))
        if values:
            facts.append((label, ", ".join(values) if key in ("seed", "git_revision") else " | ".join(values)))
    return f"<h3>{text(group.label)}</h3>{page.facts(facts)}"
