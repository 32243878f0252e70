"""The page beside the published numbers holds every category of both sides, with numbers that follow from the rows."""

from __future__ import annotations

import runpy
from pathlib import Path

import pytest

from fb3d_rl.errors import UserError
from fb3d_rl.evaluation.published import PUBLISHED, SLIPS, paper
from fb3d_rl.evaluation.runs import read_run
from fb3d_rl.rollout.rows import FlowRow, TrialRow, write_flow, write_trials


def flow(category: str, object_: str, cosine: float, rmse: float, split: str = "test") -> FlowRow:
    return FlowRow(object_, category, split, "*", cosine, rmse, 0.1)


def cells(page: str, name: str) -> list[str]:
    (line,) = [line for line in page.splitlines() if line.startswith(f"| {name} |")]
    return [cell.strip() for cell in line.strip("|").split("|")][1:]


@pytest.fixture
def run(tmp_path: Path) -> Path:
    rows = [flow("Box", "1", 0.9, 0.1), flow("Box", "1", 0.7, 0.3), flow("Box", "2", 1.0, 0.0)]
    rows += [flow("Safe", "3", 0.2, 0.5), flow("Laptop", "4", 0.99, 0.02, "train_test")]
    write_flow(tmp_path / "flow_rows_all_parts.csv", rows)
    trials = [
        TrialRow(i, "artflownet", obj, category, split, "link_0", "lid", "hinge", 0, success=won, contact=True)
        for i, (obj, category, split, won) in enumerate(
            [("1", "Box", "test", True), ("2", "Box", "test", False), ("3", "Safe", "test", True),
             ("4", "Laptop", "train_test", True)]
        )
    ]  # fmt: skip
    trials.append(TrialRow(4, "artflownet", "5", "Door", "test", "link_0", "door", "hinge", 0))  # no contact
    write_trials(tmp_path / "rows.csv", trials)
    return tmp_path


def test_every_cell_follows_from_the_rows(run: Path) -> None:
    page = paper(read_run(run), "mask")
    test = page[page.index("## Flow, test") :]
    box = cells(test, "Box")
    assert box[:2] == ["2", "13"]  # objects of ours, of UMPNet's list
    assert box[2].startswith("**0.900**") and box[3] == "0.808"  # each object counts once
    assert box[4].startswith("**0.100**") and box[5] == "0.220"
    safe = cells(test, "Safe")
    assert safe[2].startswith("0.200") and safe[3].startswith("**")
    assert cells(test, "Oven")[0] == "0" and cells(test, "Oven")[2] == "–"
    instance, mean = cells(test, "**instance mean**"), cells(test, "**class mean**")
    assert instance[:2] == ["3", "261"]
    assert instance[2].startswith("0.667") and instance[3] == "**0.816**"
    assert mean[2].startswith("0.550") and mean[3] == "**0.783**"
    of_train = page[page.index("## Flow, train_test") : page.index("## Flow, test")]
    assert cells(of_train, "**instance mean**")[1] == "132"
    for split in ("train_test", "test"):
        for category in PUBLISHED["flow"]["values"][split]["mask"]:
            assert category in page


def test_success_is_beside_what_is_published(run: Path) -> None:
    page = paper(read_run(run), "no_mask")
    # FlowBotHD trained on all categories and leaves out trials without contact: its rates stand in those columns alone.
    assert cells(page, "published: FlowBotHD: all") == ["", "", "", "", "88.2 %", "93.7 %"]
    assert cells(page, "published: FlowBotHD: test's categories") == ["", "", "", "", "80.5 %", "86.3 %"]
    assert "all of which it trained on" in page and "left out, not counted as failures" in page
    own = cells(page, "artflownet: all")
    assert own[0] == "5, 5 trials" and own[3] == "4 trials"
    rates = [cell.split(" (")[0] for cell in (*own[1:3], *own[4:])]
    assert rates == ["62.5 %", "60.0 %", "83.3 %", "75.0 %"], "without contact: a failure, or left out"
    unseen = cells(page, "artflownet: test")
    assert [cell.split(" (")[0] for cell in unseen] == [
        "4, 4 trials",
        "50.0 %",
        "50.0 %",
        "3 trials",
        "75.0 %",
        "66.7 %",
    ]
    assert "One training (one seed)" in page
    assert "11 of" in page  # the supplement's slips


def test_the_slips_are_those_of_the_table() -> None:
    """Supplement, Table IV: contact and motion-only cells of its 14 objects, in order; fridge_1 is the fourth."""
    contact = [4, 5, 5, 3, 5, 3, 2, 5, 5, 5, 5, 5, 5, 5]
    motion_only = [
        (3, 4),
        (5, 5),
        (4, 5),
        (5, 5),
        (0, 5),
        (3, 3),
        (1, 2),
        (3, 5),
        (2, 5),
        *3 * [(5, 5)],
        (4, 5),
        (2, 5),
    ]
    opened, tried = map(sum, zip(*motion_only, strict=True))
    assert (sum(contact), opened, tried) == (62, 47, 64) and "add up to 62, where 64 is printed" in SLIPS
    exchanged = (sum(contact) - contact[3] + motion_only[3][0], opened - motion_only[3][0] + contact[3])
    assert exchanged == (64, 45) and "Exchanged (contact in 5 of 5, success in 3 of these)" in SLIPS


def test_a_run_on_other_objects_is_refused(tmp_path: Path) -> None:
    write_flow(tmp_path / "flow_rows_all_parts.csv", [flow("Box", "1", 0.9, 0.1, "all")])
    with pytest.raises(UserError, match="train_test"):
        paper(read_run(tmp_path), "mask")


def test_the_command_knows_all_published_networks() -> None:
    variants = runpy.run_path(str(Path(__file__).parents[2] / "launch" / "report.py"))["VARIANTS"]
    for split in PUBLISHED["flow"]["values"].values():
        assert {*variants} == {*split}
