"""Stages and ends of trials, as the flow chart and the stacked bars count them."""

from __future__ import annotations

from collections import Counter

import pytest

from fb3d_rl.evaluation.failures import ENDS, stages
from fb3d_rl.report.failure_charts import bars, flow_chart
from fb3d_rl.report.page import Figure
from fb3d_rl.rollout.rows import TrialRow


def trial(failure: str = "", contact: bool = True, status: str = "ok") -> TrialRow:
    success = not failure and status == "ok"
    return TrialRow(
        0, "bc", "1", "Box", "test", "link_0", "lid", "revolute", 0,
        status=status, contact=contact, success=success, failure=failure,  # type: ignore[arg-type]
    )  # fmt: skip


@pytest.mark.parametrize(
    ("row", "expected"),
    [
        (trial(), ("touched", "held", "success")),
        (trial(contact=False), ("touched", "success")),
        (trial("lost hold"), ("touched", "held", "lost hold")),
        (trial("lost hold, -12 % open"), ("touched", "held", "lost hold")),
        (trial("held at the end, 79 % open"), ("touched", "held", "held, but not opened far enough")),
        (trial("stuck"), ("touched", "held", "stuck")),
        (trial("touched, but never held the part", False), ("touched", "touched, but never held the part")),
        (trial("never touched the part", False), ("never touched the part",)),
        (trial("took too long"), ("took too long",)),
        (trial("crashed", False, "error"), ("crashed",)),
        (trial("", False, "error"), ("crashed",)),
        (trial("something new", False), ("something new",)),
    ],
)
def test_stages_follow_from_the_row(row: TrialRow, expected: tuple[str, ...]) -> None:
    assert stages(row) == ("scheduled", *expected)


def every_end() -> list[TrialRow]:
    """As many trials of each end as its place says, from 1."""
    early = {"touched, but never held the part", "never touched the part"}
    rows = []
    for count, name in enumerate(ENDS, start=1):
        status = "error" if name == "crashed" else "ok"
        held = name not in early and status == "ok"
        rows += [trial("" if name == "success" else name, held, status)] * count
    return rows


def test_the_chart_loses_no_trial_and_names_each_end_once() -> None:
    rows = every_end()
    chart = flow_chart("chart", rows).content["data"][0]
    labels, link = chart["node"]["label"], chart["link"]
    entered: Counter[int] = Counter()
    left: Counter[int] = Counter()
    for source, target, value in zip(link["source"], link["target"], link["value"], strict=True):
        left[source] += value
        entered[target] += value
    for node, label in enumerate(labels):
        count = int(label.rpartition(" ")[2])
        assert count == (entered[node] or left[node]) and (not left[node] or left[node] == count)
    ends = [label for node, label in enumerate(labels) if not left[node]]
    assert sum(int(label.rpartition(" ")[2]) for label in ends) == len(rows)
    assert len(ends) == len(ENDS) and labels[0] == f"scheduled {len(rows)}"
    assert len(set(chart["node"]["color"][3:])) == len(ENDS), "each end has its colour"


def test_nodes_of_the_chart_lie_apart_and_inside() -> None:
    rows = every_end()
    found = flow_chart("chart", rows).content
    layout, node = found["layout"], found["data"][0]["node"]
    height = layout["height"] - layout["margin"]["t"] - layout["margin"]["b"]
    counts = [int(label.rpartition(" ")[2]) for label in node["label"]]
    scale = 2 * node["y"][0] * height / len(rows)  # the first node holds all trials and starts at the top
    for column in set(node["x"]):
        edges = [
            (y * height - 0.5 * scale * count, y * height + 0.5 * scale * count)
            for x, y, count in zip(node["x"], node["y"], counts, strict=True)
            if x == column
        ]
        assert edges[0][0] == pytest.approx(0, abs=1e-9) and edges[-1][1] <= height + 1e-9
        for (_, above), (below, _) in zip(edges, edges[1:], strict=False):
            assert below - above == pytest.approx(node["pad"])


def test_bars_are_shares_of_each_groups_trials() -> None:
    groups = {"one": [trial()] * 3 + [trial("lost hold")], "<two>": [trial("stuck")] * 5}
    (plot,) = (block.content for block in bars("bars", groups) if isinstance(block, Figure))
    shares = {trace["name"]: trace["x"] for trace in plot["data"]}
    assert list(shares) == ["success", "stuck", "lost hold"], "from the best to the worst"
    assert shares == {"success": [0.75, 0.0], "stuck": [0.0, 1.0], "lost hold": [0.25, 0.0]}
    assert plot["data"][0]["y"] == ["one", "&lt;two&gt;"]
