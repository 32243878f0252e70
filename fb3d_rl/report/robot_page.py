"""The robot's trials on a run's page: a table of objects for each policy, and where trials fail."""

from __future__ import annotations

from collections.abc import Sequence

from fb3d_rl.evaluation.published import SLIPS
from fb3d_rl.evaluation.robot_tables import HEAD, SUMMARY, Line, lines, policies, printed, reached, reasons
from fb3d_rl.report.page import Block, Cell, Heading, Note, Row, Table
from fb3d_rl.robot.attempt import STAGES
from fb3d_rl.robot.rows import RobotRow


def robot_tables(rows: Sequence[RobotRow]) -> list[Block]:
    """Tables IV and V of the supplement with a run's rows and, in small print, 95 % intervals; nothing without rows."""
    blocks: list[Block] = []
    for policy, own in policies(rows).items():
        number, theirs = printed(policy)
        blocks += [Heading(f"{policy}, beside Table {number}"), _objects(lines(own), theirs)]
    if not rows:
        return []
    head = ("policy", "trials", *STAGES, "failures")
    stages = [
        Row([Cell(policy, word=True), *map(Cell, (str(len(own)), *map(str, reached(own)), reasons(own)))], mean=False)
        for policy, own in policies(rows).items()
    ]
    return [*blocks, Heading("Trials that passed each stage"), Table.plain(head, stages), Note(SLIPS)]


def _objects(own: Sequence[Line], theirs: dict[str, tuple[str, ...]]) -> Table:
    """The objects and, below, the summary; ours and what is printed side by side."""
    above = [Cell("", columns=2), Cell("here", columns=len(HEAD), first=True)]
    above.append(Cell("printed", columns=len(HEAD), first=True))
    names = [Cell("Object ID", word=True), Cell("Object Category", word=True)]
    names += [Cell(name, first=i == 0) for _ in range(2) for i, name in enumerate(HEAD)]
    bodies: list[list[Row]] = [[], []]
    for line in own:
        success, contact, distance = line.intervals()
        pairs = zip(line.cells(), ("", success, contact, distance, ""), strict=True)
        cells = [Cell(line.name, word=True), Cell(line.category, word=True)]
        cells += [Cell(text, more, first=i == 0) for i, (text, more) in enumerate(pairs)]
        there = theirs.get(line.name, ("",) * len(HEAD))
        cells += [Cell(text, first=i == 0) for i, text in enumerate(there)]
        bodies[line.name == SUMMARY].append(Row(cells, mean=line.name == SUMMARY))
    return Table([above, names], bodies)
