"""The report of a run as one HTML file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import plotly.graph_objects as go

from fb3d_rl.assets.catalog import LOST_GEOMETRY
from fb3d_rl.evaluation import tables
from fb3d_rl.evaluation.runs import Run, read_run
from fb3d_rl.evaluation.tables import CONTACT, DISTANCE, FLOW, HELD, MOTION_ONLY, SUCCESS, Metric
from fb3d_rl.report import clouds, curves, failure_charts, page
from fb3d_rl.report.blocks import COPIED, FACTS, bars, effort, terms, write
from fb3d_rl.report.gallery import Shown, films, gallery
from fb3d_rl.report.page import text
from fb3d_rl.rollout.rows import TrialRow
from fb3d_rl.rollout.rows import policies as policies_in


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
    policies = list(dict.fromkeys([*tables.policies_of(numbers), *policies_in(run.rows)]))
    colors = {policy: page.color(i) for i, policy in enumerate(policies)}
    body = (
        f"<header><h1>{text(name)}</h1>{page.facts(_facts(numbers), COPIED)}</header>"
        + page.section("Results", _headline(numbers))
        + page.section("Geometry left out while reading", _lost(numbers))
        + page.section("Success by category", _success_bars(numbers))
        + page.section("How trials ended", _ends(run.rows, policies, numbers.get("policy")))
        + page.section("What it took", effort(numbers, colors))
        + page.section("Trials", _trials(run, colors))
        + page.section("True and predicted flow", clouds.viewer(run.clouds))
        + page.section("Numbers by category", _category_table(numbers), _split_table(numbers))
        + page.section("Learning curve", curves.learning_curve(run.log))
        + page.section("Training", curves.training([("", "", run.log)], curves.once_a_round(run.log)))
        + page.section("Configuration", f'<pre class="panel">{text(run.config)}</pre>' if run.config else "")
    )
    return write(out or run_dir / "report.html", f"{name} · fb3d_rl", body)


def _facts(numbers: Mapping[str, Any]) -> list[tuple[str, object]]:
    return [(label, numbers[key]) for key, label in FACTS.items() if numbers.get(key) not in (None, "")]


def _lost(numbers: Mapping[str, Any]) -> str:
    lost = numbers.get(LOST_GEOMETRY, {})
    rows = "".join(
        f'<tr><td class="text">{text(name)}</td><td class="text">{"<br>".join(map(text, remarks))}</td></tr>'
        for name, remarks in lost.items()
    )
    head = '<tr><th class="text">object</th><th class="text">what it lacks</th></tr>'
    says = "These objects are used without some of the shapes that their files describe."
    return f'<p class="soft">{says}</p>{page.table(head, rows, scroll=True)}' if rows else ""


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
        shown = [SUCCESS, *([HELD] if policy in tables.unmasked(numbers) else []), CONTACT, DISTANCE, MOTION_ONLY]
        blocks.append(page.cards(_card(m, numbers, prefix) for m in shown))
    if not blocks:
        return ""
    told = tables.trainings(numbers)
    return "".join(blocks) + f'<p class="soft">{text(told)}</p>' * bool(told) + page.facts(terms([numbers]))


def _success_bars(numbers: Mapping[str, Any]) -> str:
    names = tables.policies_of(numbers)
    if not names:
        return ""
    categories = [c for c, values in numbers["by_category"].items() if any(f"{p}/n" in values for p in names)]
    plot = go.Figure()
    for i, policy in enumerate(names):
        key = f"{policy}/{SUCCESS.key}"
        cells = [(v.get(key), v.get(f"{key}_ci95")) for v in (numbers["by_category"][c] for c in categories)]
        bars(plot, policy, page.color(i), categories, cells)
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
    head = f'<tr><th class="text" rowspan="2">{text(first)}</th>{top}</tr><tr>{below}</tr>'
    return page.table(head, *bodies)


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


def _ends(rows: Sequence[TrialRow], policies: Sequence[str], own: object) -> str:
    """How the trials of each policy ended, and those of the run's own policy in categories where some failed."""
    by_policy = {policy: [row for row in rows if row.policy == policy] for policy in policies}
    blocks = failure_charts.blocks({policy: found for policy, found in by_policy.items() if found})
    mine = [row for row in rows if row.policy == own]
    names = sorted({row.category for row in mine if not row.success})
    if names:
        by_category = {name: [row for row in mine if row.category == name] for name in names}
        title = f"{text(own)}, categories with failures"
        blocks += f"<h3>{title}</h3>{failure_charts.bars('ends-by-category', by_category)}"
    return blocks


def _trials(run: Run, colors: Mapping[str, str]) -> str:
    filmed = films(run)
    place = list(colors).index
    rows = sorted(run.rows, key=lambda row: (row.trial, place(row.policy)))
    return gallery([Shown(row, row.policy, colors[row.policy], filmed.get(row), run.seed) for row in rows])
