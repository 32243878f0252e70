"""The report of a run as one HTML file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import plotly.graph_objects as go

from fb3d_rl.assets.catalog import LOST_GEOMETRY
from fb3d_rl.evaluation import tables
from fb3d_rl.evaluation.runs import Run, read_run
from fb3d_rl.evaluation.tables import AXIS, CONTACT, DISTANCE, FLOW, HELD, MOTION_ONLY, PROPOSALS, SUCCESS, Metric
from fb3d_rl.report import clouds, curves, failure_charts, page
from fb3d_rl.report.blocks import COPIED, FACTS, bars, effort, terms
from fb3d_rl.report.gallery import films, gallery
from fb3d_rl.report.page import Block, Cards, Cell, Facts, Figure, Heading, Note, Row, Section, Shown, Source, Table
from fb3d_rl.report.robot_page import robot_tables
from fb3d_rl.report.umpnet_page import umpnet_tables
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
    sections = [
        Section("Results", _headline(numbers)),
        Section("The robot's trials, beside Tables IV and V", robot_tables(run.robot)),
        Section("In UMPNet's world, beside Tables II and III", umpnet_tables(run.path)),
        Section("Geometry left out while reading", _lost(numbers)),
        Section("Success by category", _success_bars(numbers)),
        Section("How trials ended", _ends(run.rows, policies, numbers.get("policy"))),
        Section("What it took", effort(numbers, colors)),
        Section("Trials", _trials(run, colors)),
        Section("True and predicted flow", clouds.viewer(run.clouds)),
        Section("Numbers by category", [*_category_table(numbers), *_split_table(numbers)]),
        Section("Learning curve", curves.learning_curve(run.log)),
        Section("Training", curves.training([("", "", run.log)], curves.once_a_round(run.log))),
        Section("Configuration", [Source(run.config)] if run.config else []),
    ]
    header = [Facts(_facts(numbers), COPIED)]
    return page.write(out or run_dir / "report.html", f"{name} · fb3d_rl", name, header, sections)


def _facts(numbers: Mapping[str, Any]) -> list[tuple[str, object]]:
    return [(label, numbers[key]) for key, label in FACTS.items() if numbers.get(key) not in (None, "")]


def _lost(numbers: Mapping[str, Any]) -> list[Block]:
    lost = numbers.get(LOST_GEOMETRY, {})
    if not lost:
        return []
    head = [Cell("object", word=True), Cell("what it lacks", word=True)]
    rows = [Row([Cell(name, word=True), Cell("\n".join(says), word=True)], mean=False) for name, says in lost.items()]
    note = Note("These objects are used without some of the shapes that their files describe.")
    return [note, Table([head], [rows], scroll=True)]


def _card(metric: Metric, numbers: Mapping[str, Any], prefix: str = "") -> tuple[str, str, list[str]]:
    key = prefix + metric.key
    interval = metric.show_interval(numbers.get(f"{key}_ci95"))
    class_ = metric.show(numbers.get(f"{key}_class_mean"))
    label = metric.label.removeprefix("flow ")
    more = [f"95 % interval {interval}"] * bool(interval) + [f"class mean {class_}"]
    return label[0].upper() + label[1:], metric.show(numbers.get(key)), more


def _headline(numbers: Mapping[str, Any]) -> list[Block]:
    blocks: list[Block] = []
    if tables.has_flow(numbers):
        blocks.append(Heading(f"Flow · {numbers['flow/n']} held-out clouds"))
        blocks.append(Cards([_card(metric, numbers) for metric in FLOW]))
        if tables.has_proposals(numbers):
            blocks.append(Heading("Several proposed flows"))
            blocks.append(Cards([_card(metric, numbers) for metric in (AXIS, *PROPOSALS)]))
    for policy in tables.policies_of(numbers):
        prefix = f"{policy}/"
        counts = f"{numbers[prefix + 'n']} trials on {numbers[prefix + 'n_objects']} objects"
        if numbers[prefix + "n_error"]:
            counts += f", {numbers[prefix + 'n_error']} crashed"
        blocks.append(Heading(f"{policy} · {counts}"))
        shown = [SUCCESS, *([HELD] if policy in tables.unmasked(numbers) else []), CONTACT, DISTANCE, MOTION_ONLY]
        blocks.append(Cards([_card(m, numbers, prefix) for m in shown]))
    if not blocks:
        return []
    note = tables.trainings(numbers)
    return [*blocks, *[Note(note)] * bool(note), Facts(terms([numbers]))]


def _success_bars(numbers: Mapping[str, Any]) -> list[Block]:
    names = tables.policies_of(numbers)
    if not names:
        return []
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
    return [Figure.of("success", plot)]


Columns: TypeAlias = tuple[str, str, Sequence[Metric]]
"""Title, key prefix and metrics of a group of columns."""


def _groups(numbers: Mapping[str, Any]) -> list[Columns]:
    trial = (CONTACT, SUCCESS, DISTANCE)
    groups: list[Columns] = [("flow", "", FLOW)] if tables.has_flow(numbers) else []
    return groups + [(policy, f"{policy}/", trial) for policy in tables.policies_of(numbers)]


def _category_table(numbers: Mapping[str, Any]) -> list[Block]:
    groups = _groups(numbers)
    if not groups:
        return []
    rows = [_table_row(name, values, groups) for name, values in numbers["by_category"].items()]
    means = [
        _table_row("class mean", numbers, groups, "_class_mean", mean=True),
        _table_row("instance mean", numbers, groups, mean=True),
    ]
    return [_grouped_table("category", groups, rows, means)]


def _split_table(numbers: Mapping[str, Any]) -> list[Block]:
    if "by_split" not in numbers:
        return []
    groups = _groups(numbers)
    rows = [
        _table_row(f"{name}, {label}", values, groups, suffix, mean=True)
        for name, values in numbers["by_split"].items()
        for label, suffix in (("class mean", "_class_mean"), ("instance mean", ""))
    ]
    return [Heading("By split"), _grouped_table("split", groups, rows)]


def _grouped_table(name: str, groups: Sequence[Columns], *bodies: Sequence[Row]) -> Table:
    top, below = [Cell(name, word=True, rows=2)], []
    policy = 0
    for title, prefix, metrics in groups:
        color = page.color(policy) if prefix else "var(--line)"
        policy += bool(prefix)
        top.append(Cell(title, first=True, color=color, columns=len(metrics) + bool(prefix)))
        labels = ["n"] * bool(prefix) + [metric.label.removeprefix("flow ") for metric in metrics]
        below += [Cell(label.replace(" ", "\n"), first=k == 0) for k, label in enumerate(labels)]
    return Table([top, below], bodies)


def _table_row(
    label: str, values: Mapping[str, Any], groups: Sequence[Columns], suffix: str = "", mean: bool = False
) -> Row:
    cells = [Cell(label, word=True)]
    for _, prefix, metrics in groups:
        shown = [(str(values.get(f"{prefix}n", 0)), "")] if prefix else []
        for metric in metrics:
            key = prefix + metric.key + suffix
            interval = metric.show_interval(values.get(f"{key}_ci95")) if mean else ""
            shown.append((metric.show(values.get(key)), interval))
        cells += [Cell(value, small, first=k == 0) for k, (value, small) in enumerate(shown)]
    return Row(cells, mean)


def _ends(rows: Sequence[TrialRow], policies: Sequence[str], own: object) -> list[Block]:
    """How the trials of each policy ended, and those of the run's own policy in categories where some failed."""
    by_policy = {policy: [row for row in rows if row.policy == policy] for policy in policies}
    blocks = failure_charts.blocks({policy: found for policy, found in by_policy.items() if found})
    mine = [row for row in rows if row.policy == own]
    names = sorted({row.category for row in mine if not row.success})
    if names:
        by_category = {name: [row for row in mine if row.category == name] for name in names}
        blocks.append(Heading(f"{own}, categories with failures"))
        blocks += failure_charts.bars("ends-by-category", by_category)
    return blocks


def _trials(run: Run, colors: Mapping[str, str]) -> list[Block]:
    filmed = films(run)
    place = list(colors).index
    rows = sorted(run.rows, key=lambda row: (row.trial, place(row.policy)))
    return gallery([Shown(row, row.policy, colors[row.policy], filmed.get(row), run.seed) for row in rows])
