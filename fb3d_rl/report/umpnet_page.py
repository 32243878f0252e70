"""The tables of a run in UMPNet's world, on the run's page."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import groupby
from pathlib import Path

from fb3d_rl.evaluation.umpnet import PAGE
from fb3d_rl.report.page import Block, Cell, Heading, Note, Row, Table


def umpnet_tables(folder: Path) -> list[Block]:
    """What the run folder's Markdown file of these tables shows; nothing without one."""
    path = folder / PAGE
    return list(_blocks(path.read_text(encoding="utf-8"))) if path.is_file() else []


def _blocks(text: str) -> Iterator[Block]:
    lines = [line for line in text.splitlines() if line and not line.startswith(("# ", "`"))]
    for tabular, group in groupby(lines, lambda line: line.startswith("|")):
        if tabular:
            head, _, *rows = ([cell.strip() for cell in line.strip("|").split("|")] for line in group)
            yield Table.plain(head, [_row(row) for row in rows])
        else:
            yield from (
                Heading(line[3:]) if line.startswith("## ") else Note(line.removeprefix("- ")) for line in group
            )


def _row(cells: list[str]) -> Row:
    """A row; what stands in brackets is small print, and a mean is bold in the file."""
    name, *values = cells
    split = [value.partition(" (") for value in values]
    shown = [Cell(value, more.rstrip(")")) for value, _, more in split]
    return Row([Cell(name.strip("*"), word=True), *shown], mean="mean" in name)
