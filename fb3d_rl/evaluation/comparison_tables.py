"""A comparison's numbers as a CSV file, as tables on a terminal, and as words for people."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from fb3d_rl.evaluation import tables
from fb3d_rl.evaluation.comparison import Comparison, Entry, by_pair
from fb3d_rl.evaluation.intervals import Means
from fb3d_rl.evaluation.tables import CONTACT, DECISION, DISTANCE, EFFORT, SUCCESS, TRIAL, Metric
from fb3d_rl.files import write_text
from fb3d_rl.rollout.rows import TrialRow

COLUMNS = ("policy", "seed", "split", "category", "metric", "value", "low", "high", "n")
"""Columns of comparison.csv."""


# --------------------------------------------------------------------------------------------------------- writing


def write_csv(comparison: Comparison, path: Path) -> None:
    """Write every number of the comparison as a tidy table with :data:`COLUMNS`.

    ``seed``, ``split`` and ``category`` are "all" or one of theirs. ``metric`` is a key of
    :data:`fb3d_rl.evaluation.tables.TRIAL` or :data:`~fb3d_rl.evaluation.tables.EFFORT`, with "_class_mean" the mean
    over categories, with "_minus_<policy>" the paired difference, or "labels", "expert_share" or the key of
    :data:`~fb3d_rl.evaluation.tables.DECISION`. ``low`` and ``high`` are the ends of the 95 % interval; ``n`` counts
    the trials that have a value.
    """
    out = io.StringIO(newline="")
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(COLUMNS)
    for entry in comparison.entries:
        writer.writerows(_csv_rows(entry))
    for d in comparison.differences:
        about = (d.entry.label, "all", "all", "all")
        writer.writerows(_means_rows(about, d.metric.key, f"_minus_{d.baseline.label}", d.means, d.n, classes=True))
    write_text(path, out.getvalue())


_CsvRow = tuple[object, ...]


def _csv_rows(entry: Entry) -> Iterator[_CsvRow]:
    everything = list(entry.rows.values())
    seeds: list[tuple[str, list[TrialRow]]] = [("all", everything)]
    if len(entry.seeds) > 1:
        seeds += [(str(seed), entry.of_seed(seed)) for seed in entry.seeds]
    metrics = TRIAL + tuple(metric for metric in EFFORT if tables.counted(everything, metric))
    for seed, of_seed in seeds:
        for split, of_split in _parts(of_seed, "split"):
            for category, rows in _parts(of_split, "category", single=True):
                for metric in metrics:
                    about = (entry.label, seed, split, category)
                    n, measured = tables.counted(rows, metric), tables.measure(rows, metric)
                    yield from _means_rows(about, metric.key, "", measured, n, classes=category == "all")
    for key, values, total in (
        ("labels", entry.facts("labels"), entry.labels),
        ("expert_share", entry.facts("expert_share"), entry.expert_share),
        (DECISION.key, entry.decision_times, entry.decision_ms),
    ):
        if total is not None:
            yield (entry.label, "all", "all", "all", key, total, "", "", "")
            for run, value in zip(entry.groups[0].runs if len(values) > 1 else [], values, strict=False):
                yield (entry.label, run.seed, "all", "all", key, _plain(value), "", "", "")


def _parts(rows: Sequence[TrialRow], field: str, single: bool = False) -> Iterator[tuple[str, list[TrialRow]]]:
    """All rows, then those of each value of ``field``, which is left out if there is but one unless ``single``."""
    yield "all", list(rows)
    found = tables.parts(rows, field)
    yield from found.items() if single or len(found) > 1 else ()


def _means_rows(
    about: tuple[str, str, str, str], key: str, suffix: str, found: Means, n: int, classes: bool
) -> Iterator[_CsvRow]:
    shown = [(key + suffix, found.instance, found.instance_ci95)]
    if classes:
        shown.append((f"{key}_class_mean{suffix}", found.class_, found.class_ci95))
    for name, value, interval in shown:
        yield (*about, name, _plain(value), *(interval or ("", "")), n)


def _plain(value: float | None) -> object:
    return "" if value is None else value


# -------------------------------------------------------------------------------------------------------- printing


def show_value(entry: Entry, numbers: Mapping[str, Any], metric: Metric, suffix: str = "") -> tuple[str, str]:
    """An entry's value and interval for people; ``numbers`` is a comparison's or one of its splits'."""
    key = f"{entry.label}/{metric.key}{suffix}"
    return metric.show(numbers.get(key)), metric.show_interval(numbers.get(f"{key}_ci95"))


def show_seeds(entry: Entry) -> str:
    """Seeds for people: "0, 2", "0–9"."""
    known = [seed for seed in entry.seeds if seed is not None]
    if len(known) > 3 and known == list(range(known[0], known[-1] + 1)):
        return f"{known[0]}–{known[-1]}"
    return ", ".join(map(str, known)) or "–"


def show_labels(value: float | None) -> str:
    """A number of labels for people."""
    return "–" if value is None else f"{value:,.0f}"


def show_share(value: float | None) -> str:
    """A share in percent for people."""
    return "–" if value is None else f"{100 * value:.0f} %"


def show_difference(metric: Metric, found: Means) -> tuple[str, str]:
    """A signed difference and its interval for people; percentages differ by points."""
    if found.instance is None:
        return "–", ""

    def signed(value: float) -> str:
        shown = f"{100 * value:+.0f}" if metric.percent else f"{value:+.2f}"
        return shown.replace("-", "\N{MINUS SIGN}") if float(shown) else shown[1:]

    interval = found.instance_ci95
    return signed(found.instance), "" if interval is None else f"{signed(interval[0])} to {signed(interval[1])}"


def show(comparison: Comparison, console: Console | None = None) -> None:
    """Print the comparison's tables."""
    tables.print_tables(_tables(comparison), console)


def _tables(comparison: Comparison) -> Iterator[Table]:
    splits: dict[str, Mapping[str, Any]] = {"": comparison.numbers, **comparison.numbers.get("by_split", {})}
    names = ("seeds", "n", "contact", "success", "95 %", "over seeds", "class", "dist.", "labels", "expert")
    for split, numbers in splits.items():
        title = f"Comparison, {split}" if split else "Comparison"
        table = tables.titled(title, ("policy",), names)
        for entry in comparison.entries:
            if f"{entry.label}/n" not in numbers:
                continue
            spread = None if split else entry.seed_range(SUCCESS)
            success, interval = show_value(entry, numbers, SUCCESS)
            table.add_row(
                entry.label,
                show_seeds(entry),
                str(numbers[f"{entry.label}/n"]),
                show_value(entry, numbers, CONTACT)[0],
                success,
                interval,
                SUCCESS.show_interval(spread),
                show_value(entry, numbers, SUCCESS, "_class_mean")[0],
                show_value(entry, numbers, DISTANCE)[0],
                show_labels(entry.labels),
                show_share(entry.expert_share),
            )
        if table.row_count:
            yield table
    measured = tables.effort_of(comparison.numbers, [entry.label for entry in comparison.entries])
    if measured:
        yield tables.effort_table(comparison.numbers, measured)
    table = tables.titled(
        "Differences on the same trials (success and contact in points)",
        ("policy", "minus"),
        ("n", "success", "95 %", "contact", "95 %", "dist.", "95 %"),
    )
    for three in by_pair(comparison):
        shown = (cell for d in three for cell in show_difference(d.metric, d.means))
        table.add_row(three[0].entry.label, three[0].baseline.label, str(three[0].n), *shown)
    if table.row_count:
        yield table
