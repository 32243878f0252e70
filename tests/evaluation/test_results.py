"""What results/ shows follows from the rows beside it, and the published weights are there."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path

import pytest

from fb3d_rl.evaluation.comparison import compare
from fb3d_rl.evaluation.comparison_tables import write_csv
from fb3d_rl.evaluation.published import paper
from fb3d_rl.evaluation.runs import find_runs, read_run
from fb3d_rl.evaluation.tables import summary
from fb3d_rl.models.artflownet import PRETRAINED, ArtFlowNet

RESULTS = Path(__file__).resolve().parents[2] / "results"
RUNS = sorted(path.parent for path in RESULTS.glob("*/**/summary.json") if "runs" not in path.parts)


def differing(computed: object, kept: object, where: str = "") -> list[str]:
    """Where a summary keeps something else than was computed, or nothing."""
    if isinstance(computed, dict) and isinstance(kept, dict):
        return [found for key in computed for found in differing(computed[key], kept.get(key), f"{where} {key}")]
    numbers = isinstance(computed, (float, list)) and kept is not None
    same = kept == pytest.approx(computed, rel=1e-9) if numbers else kept == computed  # to rounding
    return [] if same else [f"{where}: {computed} {kept}"]


def test_runs_tables_and_pages_are_kept() -> None:
    """Without them the tests below would have nothing to look at."""
    kept = {path.relative_to(RESULTS).parts[0] for path in RUNS}
    assert {"comparison", "imitation", "partnet_mobility", "procedural", "transfer_mixed"} <= kept and len(RUNS) > 20
    assert len(list(RESULTS.glob("*/comparison.csv"))) > 1 and len(list(RESULTS.glob("*/paper.md"))) > 0


@pytest.mark.parametrize("folder", RUNS, ids=lambda path: str(path.relative_to(RESULTS)))
def test_numbers_are_those_of_the_rows(folder: Path) -> None:
    run = read_run(folder)
    assert run.rows or run.flow
    computed = json.loads(json.dumps(summary(run.rows, run.flow)))
    assert not differing(computed, run.summary)
    if run.flow_all_parts:
        everything = json.loads(json.dumps(summary([], run.flow_all_parts)))
        kept = run.summary["flow_all_parts"]
        assert "flow/cosine" in kept and {key: everything[key] for key in kept} == kept
    assert run.summary["command"].startswith("python launch/") and len(run.summary["git_revision"]) >= 7
    assert isinstance(run.seed, int)


@pytest.mark.slow
@pytest.mark.parametrize("table", sorted(RESULTS.glob("*/comparison.csv")), ids=lambda path: path.parent.name)
def test_comparisons_are_those_of_the_rows(table: Path, tmp_path: Path) -> None:
    write_csv(compare([read_run(run) for run in find_runs([table.parent])[0]]), tmp_path / "comparison.csv")
    kept, computed = (
        [entry_of(row) for row in csv.reader(path.open())] for path in (table, tmp_path / "comparison.csv")
    )
    assert len(computed) == len(kept) > 1
    for one, other in zip(computed, kept, strict=True):
        assert one == other


def entry_of(row: list[str]) -> list[object]:
    """A line of a comparison; its numbers equal others to rounding."""
    return [pytest.approx(float(cell), rel=1e-9) if re.fullmatch(r"-?[\d.]+(e-\d+)?", cell) else cell for cell in row]


@pytest.mark.parametrize("page", sorted(RESULTS.glob("*/paper.md")), ids=lambda path: path.parent.name)
def test_pages_are_those_of_the_rows(page: Path) -> None:
    assert page.read_text() == paper(read_run(page.parent), "mask")


def test_the_published_weights_load_and_are_small() -> None:
    assert ArtFlowNet.from_pretrained().arguments["part_mask_input"]
    assert PRETRAINED.stat().st_size < 8_000_000
