"""The page that compares several runs, and the table of its numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import plotly.graph_objects as go

from fb3d_rl.errors import UserError
from fb3d_rl.evaluation import comparison, tables
from fb3d_rl.evaluation.comparison import Comparison, Group
from fb3d_rl.evaluation.comparison_tables import (
    show_difference,
    show_labels,
    show_seeds,
    show_share,
    show_value,
    write_csv,
)
from fb3d_rl.evaluation.tables import CONTACT, DISTANCE, FLOW, SUCCESS
from fb3d_rl.report import curves, failure_charts, page
from fb3d_rl.report.blocks import COPIED, FACTS, bars, broken, effort, named, terms
from fb3d_rl.report.gallery import films, gallery
from fb3d_rl.report.page import Block, Cell, Facts, Figure, Grid, Heading, Note, Row, Section, Shown, Table
from fb3d_rl.rollout.rows import TrialRow


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
    sections = [
        Section("Results", [*_entry_table(found, colors), *_split_entries(found, colors)]),
        Section("Side by side", _entry_bars(found, colors)),
        Section("How trials ended", _ends(found)),
        Section("What it took", effort(found.numbers, colors)),
        Section("Differences on the same trials", _difference_tables(found, colors)),
        Section("Success by category", _entry_categories(found, colors)),
        Section("Trials", _trials(found, colors)),
        Section("Learning curves", learned),
        Section("Flow", _flow_table(found)),
        Section("Training", curves.training(steps, skip=curves.OVER_LABELS if learned else ())),
        Section("How the numbers come about", [_told(found)]),
        Section("What was run", [block for group in found.groups for block in _group_facts(group)]),
    ]
    page.write(out, "Comparison · fb3d_rl", _title(found), _left_out(unfinished), sections)
    try:
        write_csv(found, out.with_suffix(".csv"))
    except OSError as error:
        raise UserError(f"Cannot write {out.with_suffix('.csv')}: {error.strerror}.") from error
    return out


def _title(found: Comparison) -> str:
    count = sum(len(group.names) for group in found.groups)
    return f"Comparison of {count} run{'s' * (count != 1)}"


def _left_out(unfinished: Sequence[Path]) -> list[Block]:
    names = ", ".join(path.name for path in unfinished)
    return [Note(f"Left out, not finished (no summary.json): {names}", wrong=True)] if unfinished else []


def _entry_table(found: Comparison, colors: Mapping[str, str], split: str = "") -> list[Block]:
    """A row per policy; of one split, or of all trials."""
    numbers = found.numbers["by_split"][split] if split else found.numbers
    entries = [entry for entry in found.entries if f"{entry.label}/n" in numbers]
    if not entries:
        return []
    several = not split and any(len(entry.seeds) > 1 for entry in entries)
    labelled = not split and any(entry.labels is not None for entry in entries)
    head = ["policy", "success", "success, class mean"] + ["success, range over seeds"] * several
    head += ["contact", "normalized distance"] + ["labels", "expert steps"] * labelled
    rows = []
    for entry in entries:
        cells = [
            named(entry.label, colors[entry.label]),
            Cell(*show_value(entry, numbers, SUCCESS)),
            Cell(*show_value(entry, numbers, SUCCESS, "_class_mean")),
        ]
        if several:
            cells.append(Cell(SUCCESS.show_interval(entry.seed_range(SUCCESS)) or "–"))
        cells += [Cell(*show_value(entry, numbers, metric)) for metric in (CONTACT, DISTANCE)]
        if labelled:
            cells.append(Cell(show_labels(entry.labels)))
            cells.append(Cell(show_share(entry.expert_share)))
        cells += [Cell(str(numbers[f"{entry.label}/{key}"])) for key in ("n", "n_objects")]
        rows.append(Row([*cells, Cell(show_seeds(entry))]))
    note = Note("Small print: 95 % intervals with objects as the unit, see below.")
    return [*[note] * (not split), Table.plain([*head, "trials", "objects", "seeds"], rows)]


def _split_entries(found: Comparison, colors: Mapping[str, str]) -> list[Block]:
    splits = found.numbers.get("by_split", {})
    return [block for name in splits for block in (Heading(f"Split {name}"), *_entry_table(found, colors, name))]


def _entry_bars(found: Comparison, colors: Mapping[str, str]) -> list[Block]:
    """Instance means in the policies' colours."""
    figures = []
    lines = max((1 + broken(entry.label).count("<br>") for entry in found.entries), default=1)
    for metric in (SUCCESS, DISTANCE) if found.entries else ():
        plot = go.Figure()
        for entry in found.entries:
            key = f"{entry.label}/{metric.key}"
            value = (found.numbers.get(key), found.numbers.get(f"{key}_ci95"))
            bars(plot, entry.label, colors[entry.label], [entry.label], [value])
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
        figures.append(Figure.of(metric.key, plot))
    return [Grid(figures)] if figures else []


def _difference_tables(found: Comparison, colors: Mapping[str, str]) -> list[Block]:
    rows: dict[str, list[Row]] = {}
    for three in comparison.by_pair(found):
        label = three[0].entry.label
        cells = [Cell(*show_difference(d.metric, d.means)) for d in three]
        row = Row([named(label, colors[label]), Cell(str(three[0].n)), *cells])
        rows.setdefault(three[0].baseline.label, []).append(row)
    head = ("policy", "trials", *(m.label + ", points" * m.percent for m in comparison.DIFFERENCES))
    return [block for name, of in rows.items() for block in (Heading(f"Minus {name}"), Table.plain(head, of))]


def _entry_categories(found: Comparison, colors: Mapping[str, str]) -> list[Block]:
    if not found.entries:
        return []
    rows = []
    for category, values in found.numbers["by_category"].items():
        objects = {(r.category, r.object) for e in found.entries for r in e.rows.values() if r.category == category}
        cells = [Cell(*show_value(entry, values, SUCCESS)) for entry in found.entries]
        rows.append(Row([Cell(category, word=True), Cell(str(len(objects))), *cells]))
    labels = [Cell(entry.label, color=colors[entry.label]) for entry in found.entries]
    return [Table([[Cell("category", word=True), Cell("objects"), *labels]], [rows])]


def _flow_table(found: Comparison) -> list[Block]:
    """A row per group that measured a flow network, all seeds together."""
    table = []
    for group in found.groups:
        rows = [row for run in group.runs for row in run.flow]
        if not rows:
            continue
        cells = [Cell(str(sum(bool(run.flow) for run in group.runs))), Cell(str(len(rows)))]
        for metric in FLOW:
            measured = tables.measure(rows, metric)
            cells.append(Cell(metric.show(measured.instance), metric.show_interval(measured.instance_ci95)))
            cells.append(Cell(metric.show(measured.class_), metric.show_interval(measured.class_ci95)))
        table.append(Row([Cell(group.label, word=True), *cells]))
    names = (metric.label.removeprefix("flow ") for metric in FLOW)
    head = ["run", "seeds", "clouds", *(cell for name in names for cell in (name, f"{name}, class mean"))]
    return [Table.plain(head, table)] if table else []


def _told(found: Comparison) -> Facts:
    labelled = any(entry.labels is not None for entry in found.entries)
    read = terms([run.summary for group in found.groups for run in group.runs])
    return Facts([*read, *(entry for entry in comparison.METHOD if entry[0] != "Labels" or labelled)])


def _group_facts(group: Group) -> list[Block]:
    """The facts of the runs of each group; those on which they agree are listed once."""
    facts: list[tuple[str, object]] = [("Runs", ", ".join(group.names))]
    for key, label in FACTS.items():
        values = dict.fromkeys(str(run.summary[key]) for run in group.runs if run.summary.get(key) not in (None, ""))
        if label in COPIED:
            facts += [(label, value) for value in values]
        elif values:
            facts.append((label, ", ".join(values) if key in ("seed", "git_revision") else " | ".join(values)))
    return [Heading(group.label), Facts(facts, COPIED)]


def _ends(found: Comparison) -> list[Block]:
    return failure_charts.blocks({entry.label: list(entry.rows.values()) for entry in found.entries})


def _trials(found: Comparison, colors: Mapping[str, str]) -> list[Block]:
    """The trials of all entries, those on the same part beside each other."""
    filmed = {
        (run.path, *_about(run.seed, row)): path
        for group in found.groups
        for run in group.runs
        for row, path in films(run).items()
    }
    shown = []
    for entry in found.entries:
        for (seed, *_), row in entry.rows.items():
            paths = (filmed.get((run.path, *_about(seed, row))) for group in entry.groups for run in group.runs)
            film = next((path for path in paths if path is not None), None)
            shown.append(Shown(row, entry.label, colors[entry.label], film, seed))
    place = list(colors).index
    shown.sort(key=lambda trial: (*_part(trial), place(trial.policy)))
    return gallery(shown)


def _about(seed: int | None, row: TrialRow) -> tuple[object, ...]:
    """The entries that identify a trial of a run."""
    return seed, row.policy, row.split, row.category, row.object, row.link, row.seed


def _part(trial: Shown) -> tuple[object, ...]:
    row = trial.row
    return -1 if trial.seed is None else trial.seed, row.category, row.object, row.link, row.seed
