from __future__ import annotations

import csv
from pathlib import Path

import pytest

from fb3d_rl.errors import UserError
from fb3d_rl.rollout.rows import FlowRow, TrialRow, read_flow, read_trials, write_flow, write_trials


def trial(**changes: object) -> TrialRow:
    values: dict[str, object] = {
        "trial": 3,
        "policy": "expert",
        "object": "7187",
        "category": "Oven",
        "split": "test",
        "link": "link_0",
        "semantic": "door",
        "joint_type": "revolute",
        "seed": 11,
    }
    return TrialRow(**(values | changes))  # type: ignore[arg-type]


def test_trials_round_trip_exactly(tmp_path: Path) -> None:
    rows = [
        trial(normalized_distance=0.1 + 0.2, contact=True, steps=150, attach_step=12, failure="too short"),
        trial(normalized_distance=1e-17, contact=True, success=True),
        trial(status="error", error='line 1\r\nline 2, "quoted"; <b>\udcff', failure="crashed", object="a,b\n"),
    ]
    write_trials(tmp_path / "rows.csv", rows)
    assert read_trials(tmp_path / "rows.csv") == rows
    assert [path.name for path in tmp_path.iterdir()] == ["rows.csv"]


def test_flow_rows_round_trip_exactly(tmp_path: Path) -> None:
    rows = [FlowRow("7187", "Oven", "test", "link_0", 1 / 3, 0.1 + 0.2, 5e-324)]
    write_flow(tmp_path / "flow_rows.csv", rows)
    assert read_flow(tmp_path / "flow_rows.csv") == rows


def test_an_empty_table_still_has_its_header(tmp_path: Path) -> None:
    write_trials(tmp_path / "rows.csv", [])
    assert read_trials(tmp_path / "rows.csv") == []
    with (tmp_path / "rows.csv").open(newline="") as file:
        assert next(csv.reader(file))[:4] == ["trial", "policy", "object", "category"]


@pytest.mark.parametrize(
    "claim",
    [{"contact": True}, {"success": True}, {"held_opened": True}, {"normalized_distance": 0.0}],
    ids=lambda c: next(iter(c)),
)
def test_a_crashed_trial_cannot_claim_anything(claim: dict[str, object]) -> None:
    with pytest.raises(ValueError, match="crashed"):
        trial(status="error", **claim)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_numbers_must_be_finite(value: float) -> None:
    with pytest.raises(ValueError, match="normalized_distance"):
        trial(normalized_distance=value)
    with pytest.raises(ValueError, match="rmse"):
        FlowRow("7187", "Oven", "test", "link_0", 0.5, value, 0.5)


@pytest.mark.parametrize("broken", ["0.5x", "", "nan"])
def test_a_broken_cell_names_file_and_row(tmp_path: Path, broken: str) -> None:
    path = tmp_path / "flow_rows.csv"
    write_flow(path, [FlowRow("7187", "Oven", "test", "link_0", 0.5, 0.25, 0.125)] * 2)
    path.write_text(path.read_text()[::-1].replace("0.125"[::-1], broken[::-1], 1)[::-1])
    with pytest.raises(UserError, match=r"flow_rows\.csv, row 2"):
        read_flow(path)


def test_other_columns_are_refused(tmp_path: Path) -> None:
    (tmp_path / "rows.csv").write_text("trial,policy\n1,expert\n")
    with pytest.raises(UserError, match="columns"):
        read_trials(tmp_path / "rows.csv")


def test_files_of_earlier_versions_lack_what_came_later(tmp_path: Path) -> None:
    path = tmp_path / "rows.csv"
    write_trials(path, [trial(contact=True, repeat=2, seconds=7.5, path_length=1.25, lost=1, key="ab")])
    assert read_trials(path)[0].path_length == 1.25
    rows = list(csv.reader(path.read_text().splitlines()))
    came_later = rows[0].index("repeat") + 1
    path.write_text("".join(",".join(row[:came_later]) + "\n" for row in rows))
    assert read_trials(path) == [trial(contact=True, repeat=2)]
    path.write_text("".join(",".join(row[1:]) + "\n" for row in rows))
    with pytest.raises(UserError, match="columns"):
        read_trials(path)
