"""What results/ shows follows from the rows beside it, and the published weights are there."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from fb3d_rl.evaluation.published import paper
from fb3d_rl.evaluation.runs import read_run
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


@pytest.mark.parametrize("folder", RUNS, ids=lambda path: str(path.relative_to(RESULTS)))
def test_numbers_are_those_of_the_rows(folder: Path) -> None:
    run = read_run(folder)
    assert run.rows or run.flow
    computed = json.loads(json.dumps(summary(run.rows, run.flow)))
    assert not differing(computed, run.summary)
    if run.flow_all_parts:
        everything = json.loads(json.dumps(summary([], run.flow_all_parts)))
        assert {key: everything[key] for key in run.summary["flow_all_parts"]} == run.summary["flow_all_parts"]
    assert run.summary["command"].startswith("python launch/") and len(run.summary["git_revision"]) >= 7
    assert isinstance(run.seed, int)


@pytest.mark.parametrize("page", sorted(RESULTS.glob("*/paper.md")), ids=lambda path: path.parent.name)
def test_pages_are_those_of_the_rows(page: Path) -> None:
    assert page.read_text() == paper(read_run(page.parent), "mask")


def test_the_published_weights_load_and_are_small() -> None:
    assert ArtFlowNet.from_pretrained().arguments["part_mask_input"]
    assert PRETRAINED.stat().st_size < 8_000_000
