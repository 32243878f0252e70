"""The robot's trials in the layout of Tables IV and V: the published cells, and rows that are counted by hand."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

from fb3d_rl.evaluation.intervals import wilson
from fb3d_rl.evaluation.published import PUBLISHED, SLIPS
from fb3d_rl.evaluation.robot_tables import HEAD, SUMMARY, lines, markdown, printed, reached, reasons, write_tables
from fb3d_rl.robot.attempt import STAGES
from fb3d_rl.robot.objects import TABLE_I
from fb3d_rl.robot.rows import RobotRow, read_robot, write_robot


def row(name: str, repeat: int, stages: int, reason: str = "", distance: float = 1.0, policy: str = "one") -> RobotRow:
    """A trial that passed so many stages."""
    category = {listed.label: listed.category for listed in TABLE_I}[name]
    passed = {stage: i < stages for i, stage in enumerate(STAGES)}
    return RobotRow(
        repeat, policy, name, category, "revolute", repeat, 0, 0.6, 0.0, -45.0, 0.2, 2.0,
        reason=reason, distance=distance, **passed,
    )  # fmt: skip


ROWS = [
    row("chest_1", 0, 7, distance=0.02),
    row("chest_1", 1, 6, "lost hold", 0.6),
    row("chest_1", 2, 4, "no vacuum"),
    row("jar_1", 0, 7, distance=0.0),
    row("jar_1", 1, 2, "unreachable"),
]


def test_published_cells_are_the_tables_own_but_for_their_slips() -> None:
    """Each row's parts against each other and their sums against the printed ones, but for the slips that are named."""
    for table, slips in (("IV", {"contact": 62, "motion": [47, 64]}), ("V", {"success": 11, "motion": [11, 68]})):
        values = dict(PUBLISHED["robot"]["values"][table])
        summary = values.pop(SUMMARY)
        assert [*values] == [listed.label for listed in TABLE_I]
        sums = [sum(cells[k] for cells in values.values()) for k in (0, 1)]
        motion = [sum(cells[3][k] for cells in values.values()) for k in (0, 1)]
        assert sums == [slips.get("success", summary[0]), slips.get("contact", summary[1])]
        assert motion == slips.get("motion", summary[3])
        odd = [name for name, (success, contact, _, pair) in values.items() if pair != [success, contact]]
        assert odd == (["fridge_1"] if table == "IV" else [])
    mean = sum(cells[2] for name, cells in PUBLISHED["robot"]["values"]["V"].items() if name != SUMMARY) / 14
    assert mean == pytest.approx(0.815, abs=1e-3) and ".815" in SLIPS
    assert printed("artflownet")[1]["minifridge_1"] == ("2/5", "40%", "5/5", "0.155", "2/5")
    assert printed("dagger_oracle")[0] == "V" and printed("dagger_oracle")[1][SUMMARY] == (
        "10/70", "14.3%", "68/70", "0.73", "10/68",
    )  # fmt: skip


def test_rows_are_counted_as_the_supplement_counts() -> None:
    chest, jar, whole = lines(ROWS)
    assert chest.cells() == ("1/3", "33.3%", "2/3", "0.54", "1/2")
    assert jar.cells() == ("1/2", "50%", "1/2", "0.50", "1/1")
    assert whole.cells() == ("2/5", "40%", "3/5", "0.524", "2/3") and whole.name == SUMMARY
    low, high = wilson(1 / 3, 3)
    assert chest.success_ci95 == (pytest.approx(float(low)), pytest.approx(float(high)))
    assert whole.success_ci95 is not None and whole.success_ci95[0] < 0.4 < whole.success_ci95[1]
    assert whole.distance_ci95 is not None and whole.distance_ci95[0] < 0.524 < whole.distance_ci95[1]


def test_stages_say_where_trials_fail() -> None:
    assert reached(ROWS) == [5, 5, 4, 4, 3, 3, 2]
    assert reasons(ROWS) == "1 lost hold, 1 no vacuum, 1 unreachable"
    assert [r.failed for r in ROWS] == ["", "opened", "sealed", "", "planned"]


def test_the_files_have_each_object_and_what_is_published(tmp_path: Path) -> None:
    both = [*ROWS, *(row("jar_1", i, 7, distance=0.0, policy="dagger_oracle") for i in range(5))]
    write_tables(tmp_path, both)
    with (tmp_path / "robot_tables.csv").open(encoding="utf-8") as file:
        cells = list(csv.DictReader(file))
    assert [(c["policy"], c["object"]) for c in cells] == [
        ("one", "chest_1"), ("one", "jar_1"), ("one", SUMMARY), ("dagger_oracle", "jar_1"), ("dagger_oracle", SUMMARY),
    ]  # fmt: skip
    assert cells[0]["success"] == "1" and cells[0]["sealed"] == "2" and cells[0][f"published {HEAD[0]}"] == "3/5"
    assert cells[3][f"published {HEAD[0]}"] == "3/5" and cells[1][f"published {HEAD[0]}"] == "5/5"
    page = (tmp_path / "robot_tables.md").read_text()
    assert page == markdown(both) and "beside Table IV" in page and "beside Table V" in page and SLIPS in page
    assert "| one | chest_1 | 3 | 3 | 3 | 3 | 3 | 2 | 2 | 1 | 1 lost hold, 1 no vacuum |" in page


def test_rows_come_back_as_they_were_and_as_trials(tmp_path: Path) -> None:
    write_robot(tmp_path / "robot.csv", ROWS)
    assert read_robot(tmp_path / "robot.csv") == ROWS
    trials = [r.as_trial() for r in ROWS]
    assert [(t.contact, t.success, t.normalized_distance) for t in trials] == [
        (True, True, 0.02), (True, False, 0.6), (False, False, 1.0), (True, True, 0.0), (False, False, 1.0),
    ]  # fmt: skip
    assert [t.failure for t in trials] == [
        "", "lost hold", "touched, but never held the part", "", "never touched the part",
    ]  # fmt: skip
