"""The robot's trials in the layout of the supplement's Tables IV and V, beside what is printed there."""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.table import Table

from fb3d_rl.evaluation.intervals import UNIT, Interval, means, wilson
from fb3d_rl.evaluation.published import PUBLISHED, SLIPS
from fb3d_rl.evaluation.tables import titled
from fb3d_rl.files import write_text
from fb3d_rl.robot.attempt import STAGES
from fb3d_rl.robot.rows import RobotRow

SUMMARY = "SUMMARY"

HEAD = ("Success/Total", "Success %", "Contact Success/Total", "Distance", "Motion-Only Success/Total")
"""The supplement's columns behind the object and its category."""


@dataclass(frozen=True)
class Line:
    """A row of such a table.

    Attributes:
        name: of the object, or :data:`SUMMARY`.
        category: "-" in the summary.
        success: trials that opened the part.
        total: trials.
        contact: trials in which the cup held.
        distance: mean share of the opening that was left.
        motion: successes and trials that count as motion-only: those with contact.
        success_ci95: 95 % interval of the success: Wilson's of an object's trials; of the summary that of a mean over
            objects, as trials of one object are alike.
        contact_ci95: of the contact success, likewise.
        distance_ci95: of the mean distance, of the summary alone.
    """

    name: str
    category: str
    success: int
    total: int
    contact: int
    distance: float
    motion: tuple[int, int]
    success_ci95: Interval | None = None
    contact_ci95: Interval | None = None
    distance_ci95: Interval | None = None

    def cells(self) -> tuple[str, ...]:
        """The cells below :data:`HEAD`."""
        return (
            f"{self.success}/{self.total}",
            f"{100 * self.success / self.total:.3g}%",
            f"{self.contact}/{self.total}",
            f"{self.distance:.3f}".removesuffix("0"),
            f"{self.motion[0]}/{self.motion[1]}",
        )

    def intervals(self) -> tuple[str, str, str]:
        """The intervals of success and contact (%) and of the distance."""
        shares = [f"{100 * i[0]:.0f}–{100 * i[1]:.0f}" if i else "" for i in (self.success_ci95, self.contact_ci95)]
        i = self.distance_ci95
        return shares[0], shares[1], f"{i[0]:.2f}–{i[1]:.2f}" if i else ""


def lines(rows: Sequence[RobotRow]) -> list[Line]:
    """The rows of one policy's table: its objects in the order of their trials, then the summary."""
    by_object: dict[str, list[RobotRow]] = {}
    for row in rows:
        by_object.setdefault(row.object, []).append(row)
    found = []
    for name, own in by_object.items():
        line = _line(name, own[0].category, own)
        ends = [wilson(count / line.total, line.total) for count in (line.success, line.contact)]
        success, contact = ((float(low), float(high)) for low, high in ends)
        found.append(Line(**{**vars(line), "success_ci95": success, "contact_ci95": contact}))
    whole = _line(SUMMARY, "-", rows)
    keyed = {(line.category, line.name): line for line in found}
    shares = [
        means({key: count(line) / line.total for key, line in keyed.items()}, UNIT, share=True).instance_ci95
        for count in (lambda line: line.success, lambda line: line.contact)
    ]
    distance = means({key: line.distance for key, line in keyed.items()}, UNIT).instance_ci95
    ends_of = {"success_ci95": shares[0], "contact_ci95": shares[1], "distance_ci95": distance}
    return [*found, Line(**{**vars(whole), **ends_of})]


def _line(name: str, category: str, rows: Sequence[RobotRow]) -> Line:
    contact = [row for row in rows if row.sealed]
    return Line(
        name=name,
        category=category,
        success=sum(row.opened for row in rows),
        total=len(rows),
        contact=len(contact),
        distance=sum(row.distance for row in rows) / len(rows),
        motion=(sum(row.opened for row in contact), len(contact)),
    )


def printed(policy: str) -> tuple[str, dict[str, tuple[str, ...]]]:
    """The published table that a policy's is set beside, IV or V, and its cells by the object's name."""
    table = "V" if policy.startswith(("bc", "dagger")) else "IV"
    cells = {}
    for name, (success, contact, distance, motion) in PUBLISHED["robot"]["values"][table].items():
        total = 70 if name == SUMMARY else 5
        line = Line(name, "", success, total, contact, distance, tuple(motion))
        cells[name] = line.cells()
    return table, cells


def policies(rows: Sequence[RobotRow]) -> dict[str, list[RobotRow]]:
    """The rows of each policy, in order of first appearance."""
    found: dict[str, list[RobotRow]] = {}
    for row in rows:
        found.setdefault(row.policy, []).append(row)
    return found


def reached(rows: Sequence[RobotRow]) -> list[int]:
    """How many trials passed each stage of :data:`~fb3d_rl.robot.attempt.STAGES`."""
    return [sum(getattr(row, stage) for row in rows) for stage in STAGES]


def reasons(rows: Sequence[RobotRow]) -> str:
    """Why trials failed and how often: "3 lost hold, 1 stuck"."""
    counts = Counter(row.reason for row in rows if not row.opened)
    return ", ".join(f"{count} {reason}" for reason, count in counts.most_common())


def trial_table(rows: Sequence[RobotRow], policy: str) -> Table:
    """A policy's table for the terminal."""
    numbers = ("success", "95 %", "contact", "distance", "motion-only", "printed: success", "contact", "distance")
    number, theirs = printed(policy)
    table = titled(f"{policy}, beside the supplement's Table {number}", ("object", "category"), numbers)
    for line in lines(policies(rows)[policy]):
        own, there = line.cells(), theirs.get(line.name, ("",) * len(HEAD))
        if line.name == SUMMARY:
            table.add_section()
        table.add_row(
            line.name, line.category, own[0], line.intervals()[0], own[2], own[3], own[4], there[0], there[2], there[3]
        )
    return table


def stage_table(rows: Sequence[RobotRow]) -> Table:
    """Where trials fail, for the terminal."""
    table = titled("Trials that passed each stage", ("policy",), ("trials", *STAGES, "failures"))
    for name, own in policies(rows).items():
        table.add_row(name, str(len(own)), *map(str, reached(own)), reasons(own))
    return table


def markdown(rows: Sequence[RobotRow]) -> str:
    """The page of all tables."""
    return "\n".join(_page(rows)) + "\n"


def _page(rows: Sequence[RobotRow]) -> Iterator[str]:
    first = rows[0]
    yield "# The robot's trials"
    yield ""
    yield (
        f"The 14 objects of the supplement's Table I, in simulation; a part is open if less than 10 % of its opening "
        f"is left, and the mean share that is left is the distance. The calibration is off by "
        f"{first.calibration_deg:.2f} degrees and {first.calibration_mm:.1f} mm. Intervals are 95 %: of an object for "
        "further trials of it, of the summary for other objects. The published columns are of real objects, which ours "
        "resemble in category and joint alone."
    )
    for policy, own in policies(rows).items():
        number, theirs = printed(policy)
        yield from ("", f"## {policy}, beside Table {number}", "")
        ours = ("Success, 95 % interval", "Contact, 95 % interval", "Distance, 95 % interval")
        yield _row("Object ID", "Object Category", *HEAD, *ours, *(f"published: {head}" for head in HEAD))
        yield "| --- |" + " --- |" * (1 + 2 * len(HEAD) + len(ours))
        for line in lines(own):
            there = theirs.get(line.name, ("",) * len(HEAD))
            yield _row(line.name, line.category, *line.cells(), *line.intervals(), *there)
    yield from ("", "## Where trials fail", "", "Trials that passed each stage, and why others did not.", "")
    yield _row("policy", "object", "trials", *STAGES, "failures")
    yield "| --- |" + " --- |" * (3 + len(STAGES))
    for policy, own in policies(rows).items():
        yield _row(policy, "**all**", str(len(own)), *map(str, reached(own)), reasons(own))
        for name in dict.fromkeys(row.object for row in own if not row.opened):
            those = [row for row in own if row.object == name]
            yield _row(policy, name, str(len(those)), *map(str, reached(those)), reasons(those))
    yield from ("", SLIPS)


def _row(*cells: str) -> str:
    return "| " + " | ".join(cells) + " |"


def write_tables(out: Path, rows: Sequence[RobotRow]) -> None:
    """Write robot_tables.md and robot_tables.csv below ``out``."""
    write_text(out / "robot_tables.md", markdown(rows))
    text = io.StringIO(newline="")
    writer = csv.writer(text)
    own = ("policy", "object", "category", "trials", "success", "contact", "distance", "motion_only", "with_contact")
    ends = [f"{name}_{end}" for name in ("success", "contact", "distance") for end in ("low", "high")]
    writer.writerow([*own, *ends, *STAGES, *(f"published {head}" for head in HEAD)])
    for policy, of_policy in policies(rows).items():
        theirs = printed(policy)[1]
        for line in lines(of_policy):
            those = of_policy if line.name == SUMMARY else [row for row in of_policy if row.object == line.name]
            limits = [
                "" if interval is None else round(interval[k], 4)
                for interval in (line.success_ci95, line.contact_ci95, line.distance_ci95)
                for k in (0, 1)
            ]
            writer.writerow([
                policy, line.name, line.category, line.total, line.success, line.contact, round(line.distance, 4),
                *line.motion, *limits, *reached(those), *theirs.get(line.name, ()),
            ])  # fmt: skip
    write_text(out / "robot_tables.csv", text.getvalue())
