"""Several runs as one comparison: grouping, merging and pairing of small sweeps whose numbers are known."""

from __future__ import annotations

import csv
import json
import math
import re
import runpy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import binomtest

from fb3d_rl.errors import UserError
from fb3d_rl.evaluation import learning, tables
from fb3d_rl.evaluation.comparison import Comparison, Entry, compare
from fb3d_rl.evaluation.comparison_tables import COLUMNS
from fb3d_rl.evaluation.runs import find_runs, read_run
from fb3d_rl.evaluation.tables import SUCCESS, difference, summary
from fb3d_rl.report.comparison_page import write_comparison
from fb3d_rl.report.run_page import write_report
from fb3d_rl.rollout.rows import TrialRow, write_trials
from fb3d_rl.training.run_log import RunLog

ROOT = Path(__file__).parents[2]
OBJECTS = [(f"Category{i % 3}", f"object-{i}", "test" if i % 2 else "train_test") for i in range(12)]

Outcome = Callable[[str, int, int], bool]
"""Policy, run seed, place of the object -> success."""


def trials(policy: str, seed: int, success: Outcome, parts: int = 1) -> list[TrialRow]:
    rows = []
    for i, (category, object_, split) in enumerate(OBJECTS):
        for part in range(parts):
            opened = success(policy, seed, i)
            rows.append(
                TrialRow(
                    trial=len(rows), policy=policy, object=object_, category=category, split=split,
                    link=f"link_{part}", semantic="door", joint_type="revolute", seed=1000 * seed + i, steps=40 + i,
                    contact=True, success=opened, normalized_distance=0.0 if opened else 1.0,
                    seconds=(40 + i) / 20, path_length=1.5, lost=2, key=f"{object_}-{part}-{seed}",
                )
            )  # fmt: skip
    return rows


def write_run(
    folder: Path,
    policy: str,
    seed: int,
    rows: Sequence[TrialRow],
    log: Sequence[Mapping[str, Any]] = (),
    settings: Mapping[str, Any] | None = None,
) -> Path:
    folder.mkdir(parents=True)
    config = {"algo": {"name": policy.split("_")[0], "lr": 0.001, **(settings or {})}, "seed": seed}
    (folder / "config.yaml").write_text(json.dumps(config))
    write_trials(folder / "rows.csv", rows)
    facts = {"seed": seed, "policy": policy, "command": f"train {folder.name}", "git_revision": "cafe01"}
    facts[f"{policy}/time/decision_ms"] = 10.5 + seed
    if log and "labels" in log[-1]:
        facts |= {"labels": log[-1]["labels"], "expert_share": 1 / len(log) + 0.01 * seed}
    (folder / "summary.json").write_text(json.dumps(summary(rows, [], facts)))
    with RunLog(folder) as run_log:
        for row in log:
            run_log.write(dict(row))
    return folder


def rounds_of(seed: int, count: int) -> list[dict[str, float]]:
    return [
        {
            "step": 100.0 * (r + 1),
            "round": r,
            "labels": 1000.0 * (r + 1) + 30 * seed,
            "beta": float(0.5**r),
            "collect/expert_share": float(0.5**r),
            "collect/success_rate": 0.3 + 0.05 * r,
            "collect/contact_rate": 0.8,
            "val/success_rate": 0.2 + 0.1 * r + 0.04 * seed,
            "val/contact_rate": 0.7,
            "train/loss": 1 / (r + 1 + 0.3 * seed),
            "time/round": 3.0,
        }
        for r in range(count)
    ]


def skill(policy: str, seed: int, i: int) -> bool:
    """The expert opens all; dagger 9 to 11 of 12, bc 6 to 8, artflownet 10, artflownet's part in bc runs equal."""
    return i < {"expert": 12, "artflownet": 10, "dagger": 9 + seed, "bc": 6 + seed}[policy]


def make_sweep(root: Path, seeds: Sequence[int] = (0, 1, 2)) -> Path:
    for algo in ("artflownet", "bc", "dagger"):
        for seed in seeds:
            # Every run repeats the expert, all but the first kind also the network of the first.
            shown = ["expert", "artflownet", *([] if algo == "artflownet" else [algo])]
            rows = [row for policy in shown for row in trials(policy, seed, skill)]
            log: list[dict[str, float]] = [{"step": 10.0 * s, "train/loss": 1 / (1 + s)} for s in range(20)]
            if algo != "artflownet":
                log = rounds_of(seed, 5 if algo == "dagger" else 1)
            write_run(root / f"algo={algo},seed={seed}", algo, seed, rows, log)
    return root


def compared(*roots: Path) -> Comparison:
    return compare([read_run(path) for path in find_runs(roots)[0]])


def entry(found: Comparison, label: str) -> Entry:
    return next(entry for entry in found.entries if entry.label == label)


@pytest.fixture(scope="module")
def sweep(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = make_sweep(tmp_path_factory.mktemp("sweep") / "runs" / "train")
    (root / "algo=dagger,seed=3").mkdir()
    (root / "algo=dagger,seed=3" / "config.yaml").write_text("seed: 3\n")
    return root


@pytest.fixture(scope="module")
def found(sweep: Path) -> Comparison:
    return compared(sweep)


# ------------------------------------------------------------------------------------------- finding and grouping


def test_runs_are_found_at_any_depth_and_unfinished_ones_told_apart(sweep: Path, tmp_path: Path) -> None:
    finished, unfinished = find_runs([sweep.parents[1]])
    assert [path.name for path in finished] == [
        f"algo={algo},seed={seed}" for algo in ("artflownet", "bc", "dagger") for seed in (0, 1, 2)
    ]
    assert [path.name for path in unfinished] == ["algo=dagger,seed=3"]
    assert find_runs([sweep, finished[0]]) == (finished, unfinished), "a run that is found twice counts once"
    for seed in (10, 9):
        write_run(tmp_path / f"seed={seed}", "bc", seed, [])
    (tmp_path / "seed=9" / "objects").mkdir()
    (tmp_path / "seed=9" / "objects" / "summary.json").write_text("not a run's")
    assert [path.name for path in find_runs([tmp_path])[0]] == ["seed=9", "seed=10"]


def test_a_folder_without_finished_runs_is_refused(sweep: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="not a run folder"):
        find_runs([sweep, tmp_path])
    with pytest.raises(UserError, match="not a folder"):
        find_runs([tmp_path / "missing"])
    with pytest.raises(UserError, match="seed=3"):
        find_runs([sweep / "algo=dagger,seed=3"])


def test_seeds_make_a_group_and_settings_tell_groups_apart(tmp_path: Path) -> None:
    for lr in (0.001, 0.01):
        for seed in (0, 1):
            rows = trials("bc", seed, lambda *_: False)
            write_run(tmp_path / f"lr={lr},seed={seed}", "bc", seed, rows, settings={"lr": lr})
    found = compared(tmp_path)
    assert [group.label for group in found.groups] == ["bc · lr=0.001", "bc · lr=0.01"]
    assert [[run.seed for run in group.runs] for group in found.groups] == [[0, 1], [0, 1]]
    # Two trained policies that fail alike are still two.
    assert [entry.label for entry in found.entries] == [group.label for group in found.groups]


def test_a_repeated_run_counts_once_and_one_that_ended_otherwise_stands_apart(tmp_path: Path) -> None:
    write_run(tmp_path / "a", "bc", 0, trials("bc", 0, skill))
    write_run(tmp_path / "b", "bc", 0, trials("bc", 0, skill))
    found = compared(tmp_path)
    assert len(found.groups) == len(found.entries) == 1
    assert found.groups[0].names == ["a", "b"] and found.numbers["bc/n"] == len(OBJECTS)
    write_run(tmp_path / "c", "bc", 0, trials("bc", 0, lambda *_: False))
    assert [entry.label for entry in compared(tmp_path).entries] == ["bc · a", "bc · c"]


def test_runs_without_a_configuration_are_not_taken_for_seeds(tmp_path: Path) -> None:
    for seed in (0, 1):
        (write_run(tmp_path / str(seed), "bc", seed, trials("bc", seed, skill)) / "config.yaml").unlink()
    assert len(compared(tmp_path).groups) == 2


def test_labels_stay_short_and_unique(tmp_path: Path) -> None:
    for k, settings in enumerate(({}, {"net": {"lr": 1}}, {"net": {"lr": 2}, "lr": 0.01}, {"a": 1, "b": 2, "c": 3})):
        write_run(tmp_path / str(k), "bc", 0, trials("bc", 0, skill), settings=settings)
    assert [group.label for group in compared(*(tmp_path / str(k) for k in range(3))).groups] == [
        "bc · algo.lr=0.001, algo.net.lr=unset",
        "bc · algo.lr=0.001, algo.net.lr=1",
        "bc · algo.lr=0.01, algo.net.lr=2",
    ]
    # With many differences the folders tell more.
    assert [group.label for group in compared(tmp_path).groups] == [f"bc · {k}" for k in range(4)]


# ------------------------------------------------------------------------------------------------------- merging


def test_baselines_that_every_run_repeats_are_one_row(found: Comparison) -> None:
    assert [e.label for e in found.entries] == ["expert", "artflownet", "bc", "dagger"]
    for e in found.entries:
        assert e.seeds == [0, 1, 2]
        assert found.numbers[f"{e.label}/n"] == 3 * len(OBJECTS)
        assert found.numbers[f"{e.label}/n_objects"] == len(OBJECTS)
    assert found.numbers["bc/success_rate"] == pytest.approx((6 + 7 + 8) / 36)
    assert found.numbers["dagger/success_rate"] == pytest.approx((9 + 10 + 11) / 36)
    assert entry(found, "dagger").seed_range(SUCCESS) == pytest.approx((9 / 12, 11 / 12))


def test_a_baseline_that_ended_otherwise_is_not_merged(tmp_path: Path) -> None:
    make_sweep(tmp_path, seeds=(0, 1))
    rows = [
        # In BC's run of seed 1, the given network ends one trial otherwise.
        row
        for policy in ("expert", "artflownet", "bc")
        for row in trials(policy, 1, lambda p, s, i: skill(p, s, i) or (p == "artflownet" and i == 11))
    ]
    write_trials(tmp_path / "algo=bc,seed=1" / "rows.csv", rows)
    found = compared(tmp_path)
    assert [e.label for e in found.entries] == ["expert", "artflownet", "artflownet (in bc)", "bc", "dagger"]
    assert found.numbers["artflownet (in bc)/success_rate"] == pytest.approx((10 + 11) / 24)
    assert found.numbers["artflownet/success_rate"] == pytest.approx(10 / 12)


def test_merging_adds_the_trials_of_other_seeds(tmp_path: Path) -> None:
    make_sweep(tmp_path, seeds=(0, 1))
    rows = [row for policy in ("expert", "bc") for row in trials(policy, 2, skill)]
    write_run(tmp_path / "algo=bc,seed=2", "bc", 2, rows)
    found = compared(tmp_path)
    assert entry(found, "expert").seeds == entry(found, "bc").seeds == [0, 1, 2]
    assert entry(found, "dagger").seeds == [0, 1]


def test_the_order_of_runs_changes_no_number(sweep: Path, found: Comparison) -> None:
    other = compare([read_run(path) for path in find_runs([sweep])[0][::-1]])
    assert other.numbers == found.numbers
    assert {(d.entry.label, d.baseline.label, d.metric): d.means for d in other.differences} == {
        (d.entry.label, d.baseline.label, d.metric): d.means for d in found.differences
    }


# ----------------------------------------------------------------------------------------------------- intervals


def test_more_seeds_on_the_same_objects_are_no_more_evidence(tmp_path: Path) -> None:
    def by_object(policy: str, seed: int, i: int) -> bool:
        return i % 3 > 0

    for count in (1, 6):
        for seed in range(count):
            write_run(tmp_path / str(count) / f"seed={seed}", "bc", seed, trials("bc", seed, by_object))
    one, six = compared(tmp_path / "1").numbers, compared(tmp_path / "6").numbers
    assert six["bc/n"] == 6 * one["bc/n"]
    assert six["bc/success_rate_ci95"] == one["bc/success_rate_ci95"]


def test_the_interval_is_the_binomials_where_each_object_has_one_trial(tmp_path: Path) -> None:
    write_run(tmp_path / "run", "bc", 0, trials("bc", 0, skill))
    expected = binomtest(len(OBJECTS) // 2, len(OBJECTS)).proportion_ci(method="exact")
    assert compared(tmp_path).numbers["bc/success_rate_ci95"] == pytest.approx((expected.low, expected.high))


def test_an_even_outcome_has_the_interval_of_the_objects_not_of_the_trials(found: Comparison) -> None:
    expected = binomtest(len(OBJECTS), len(OBJECTS)).proportion_ci(method="exact")
    assert found.numbers["expert/success_rate_ci95"] == pytest.approx((expected.low, expected.high))


# ------------------------------------------------------------------------------------------------------- pairing


def pairs_of(one: Sequence[bool], two: Sequence[bool]) -> list[tuple[TrialRow, TrialRow]]:
    a = trials("a", 0, lambda _, __, i: one[i])
    b = trials("b", 0, lambda _, __, i: two[i])
    return list(zip(a, b, strict=True))


def test_rows_are_paired_by_what_their_trials_are(tmp_path: Path) -> None:
    """The same object, part and seed seen from elsewhere, or started otherwise, is another trial."""
    write_run(tmp_path / "expert", "expert", 0, trials("expert", 0, skill))
    elsewhere = [replace(row, key=f"other {row.key}") for row in trials("bc", 0, skill)]
    write_run(tmp_path / "bc", "bc", 0, [*trials("bc", 0, skill)[:5], *elsewhere[5:]])
    (success, *_) = [d for d in compared(tmp_path).differences if d.metric is SUCCESS]
    assert success.n == 5


@pytest.mark.parametrize(
    ("mine", "other", "pairs"),
    [
        ({"camera": {"fov": 40.0}}, {"camera": {"fov": 40.0}}, len(OBJECTS)),
        ({"camera": {"azimuth": [-45, 45]}}, {"camera": {"azimuth": [-30, -30]}}, 0),
        ({"evaluation": {"start": "reference"}}, {"evaluation": {"start": "closed"}}, 0),
        ({"env": {"suction": {"hold": "any"}}}, {"env": {"suction": {"hold": "target"}}}, 0),
        ({"assets": {"split": "all"}, "data": {"points": 9}}, {"assets": {"split": "x"}, "data": {"points": 9}},
         len(OBJECTS)),
        ({}, {}, 0),  # nobody knows
    ],
)  # fmt: skip
def test_rows_without_keys_are_paired_where_the_settings_of_trials_agree(
    tmp_path: Path, mine: dict[str, Any], other: dict[str, Any], pairs: int
) -> None:
    for name, settings in (("expert", mine), ("bc", other)):
        rows = [replace(row, key="") for row in trials(name, 0, skill)]
        folder = write_run(tmp_path / name, name, 0, rows)
        (folder / "config.yaml").write_text(json.dumps({"seed": 0, "policy": {"name": name}, **settings}))
    assert [d.n for d in compared(tmp_path).differences if d.metric is SUCCESS] == [pairs] * (pairs > 0)


def test_differences_by_hand(found: Comparison) -> None:
    by_name = {(d.entry.label, d.baseline.label): d for d in found.differences if d.metric is SUCCESS}
    assert set(by_name) == {
        *((name, "expert") for name in ("artflownet", "bc", "dagger")),
        *((name, "bc") for name in ("artflownet", "dagger")),
    }
    assert all(d.n == 36 for d in by_name.values())
    assert by_name["dagger", "bc"].means.instance == pytest.approx(3 / 12)
    assert by_name["bc", "expert"].means.instance == pytest.approx(-(6 + 5 + 4) / 36)


def test_pairing_removes_what_both_share() -> None:
    """Objects that are easy or hard for both widen each mean's interval, not that of the difference."""
    easy = [i % 2 == 0 for i in range(12)]
    better = [*easy]
    better[1] = True
    rows = pairs_of(better, easy) + 5 * pairs_of(easy, easy)
    pairs = [(replace(a, object=str(i)), replace(b, object=str(i))) for i, (a, b) in enumerate(rows)]
    paired = difference(pairs, SUCCESS)
    assert paired.instance == pytest.approx(1 / len(pairs)) and paired.instance_ci95 is not None
    low, high = paired.instance_ci95
    alone = tables.measure([b for _, b in pairs], SUCCESS).instance_ci95
    assert alone is not None and high - low < 0.6 * (alone[1] - alone[0])
    same = difference(pairs_of(easy, easy), SUCCESS)
    assert same.instance == 0 and same.instance_ci95 is not None, "ties are no certainty"
    assert same.instance_ci95[0] == pytest.approx(-same.instance_ci95[1]) and 0.1 < same.instance_ci95[1] < 0.35


def test_a_difference_turns_its_sign_with_its_sides() -> None:
    one, two = [i < 9 for i in range(12)], [i % 2 == 0 for i in range(12)]
    there, back = difference(pairs_of(one, two), SUCCESS), difference(pairs_of(two, one), SUCCESS)
    assert there.instance == pytest.approx(-(back.instance or 0)) and there.instance_ci95 and back.instance_ci95
    assert there.instance_ci95 == pytest.approx((-back.instance_ci95[1], -back.instance_ci95[0]))


def test_intervals_of_differences_hold_their_truth() -> None:
    """In simulated sweeps of 60 objects and three seeds, about 95 % of the intervals hold the true difference."""
    held, runs = 0, 150
    template = trials("a", 0, lambda *_: False)[0]
    for number in range(runs):
        rng = np.random.default_rng(number)
        pairs = []
        for i in range(60):
            ease = rng.random()
            for _ in range(3):
                rows = [
                    TrialRow(**{**vars(template), "object": str(i), "success": bool(rng.random() < p)})
                    for p in (0.3 + 0.6 * ease, 0.1 + 0.6 * ease)
                ]
                pairs.append((rows[0], rows[1]))
        interval = difference(pairs, SUCCESS).instance_ci95
        assert interval is not None
        held += interval[0] <= 0.2 <= interval[1]
    assert 0.89 <= held / runs <= 0.99


def test_only_trials_of_both_are_paired(tmp_path: Path) -> None:
    write_run(tmp_path / "bc0", "bc", 0, trials("bc", 0, skill))
    write_run(tmp_path / "dagger0", "dagger", 0, trials("dagger", 0, skill)[:8])
    write_run(tmp_path / "dagger1", "dagger", 1, trials("dagger", 1, skill))
    (found,) = [d for d in compared(tmp_path).differences if d.metric is SUCCESS]
    assert found.n == 8 and found.means.instance == pytest.approx(2 / 8)
    with pytest.raises(ValueError, match="object-0 and"):
        difference([(trials("a", 0, skill_of_none)[0], trials("b", 0, skill_of_none)[1])], SUCCESS)


def skill_of_none(policy: str, seed: int, i: int) -> bool:
    return False


def test_each_policy_meets_the_baseline_of_its_own_settings(tmp_path: Path) -> None:
    for policy in ("bc", "dagger"):
        for lr in (0.001, 0.01):
            rows = trials(policy, 0, lambda p, s, i, lr=lr: skill(p, s, i) and lr < 0.005)  # type: ignore[misc]
            write_run(tmp_path / f"{policy},{lr}", policy, 0, rows, settings={"lr": lr})
    pairs = {(d.entry.label, d.baseline.label) for d in compared(tmp_path).differences}
    assert pairs == {(f"dagger · lr={lr}", f"bc · lr={lr}") for lr in ("0.001", "0.01")}


# --------------------------------------------------------------------------------------------------------- labels


def test_labels_and_expert_share(found: Comparison) -> None:
    dagger = entry(found, "dagger")
    assert dagger.labels == pytest.approx(5000 + 30)
    assert dagger.expert_share == pytest.approx(0.21), "as the run took it from its buffer, whatever its log says"
    assert entry(found, "expert").labels is None and entry(found, "artflownet").labels is None
    assert entry(found, "bc").expert_share == pytest.approx(1.01)


def test_a_curve_is_the_mean_of_seeds_between_the_lowest_and_the_highest() -> None:
    logs = [rounds_of(seed, 4) for seed in (0, 1, 2)]
    curve = learning.curve(logs, "val/success_rate")
    assert curve is not None and curve.rounds == [0, 1, 2, 3]
    assert curve.labels == pytest.approx([1030, 2030, 3030, 4030])
    assert curve.mean == pytest.approx([0.24, 0.34, 0.44, 0.54])
    assert curve.low == pytest.approx([0.2, 0.3, 0.4, 0.5]) and curve.high == pytest.approx([0.28, 0.38, 0.48, 0.58])
    assert learning.curve([[{"step": 1, "train/loss": 0.1}]], "train/loss") is None


def test_of_a_value_that_is_logged_twice_in_a_round_the_last_counts() -> None:
    log: list[dict[str, Any]] = [
        {"step": 1, "round": 0, "labels": 100, "train/loss": 0.9, "collect/expert_share": 1.0},
        {"step": 2, "round": 0, "labels": 100, "train/loss": 0.5, "val/success_rate": None},
        {"step": 3, "round": 1, "labels": 300, "train/loss": float("nan"), "collect/expert_share": 0.25},
    ]
    first, second = learning.rounds(log)
    assert first["train/loss"] == 0.5 and "val/success_rate" not in first and "train/loss" not in second


# ---------------------------------------------------------------------------------------------------------- files


class Page(HTMLParser):
    """Tags, texts and figures of a page; the tags must close in order."""

    void = frozenset({"meta", "br"})

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.text: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.figures: dict[str, Any] = {}
        self.open: list[str] = []
        self.figure: str | None = None
        self.feed(path.read_text("utf-8"))
        self.close()
        assert not self.open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        self.figure = dict(attrs).get("data-figure")
        if tag not in self.void:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag
        self.figure = None

    def handle_data(self, data: str) -> None:
        if self.figure:
            self.figures[self.figure] = json.loads(data)
        elif self.cdata_elem is None and data.strip():
            self.text.append(data)


@pytest.fixture(scope="module")
def page(found: Comparison, tmp_path_factory: pytest.TempPathFactory) -> Page:
    out = tmp_path_factory.mktemp("out") / "comparison.html"
    return Page(write_comparison(found, out, [Path("algo=dagger,seed=3")]))


def test_the_page_is_whole_and_loads_nothing(page: Page) -> None:
    for tag, attrs in page.tags:
        assert not {"src", "data", "action"} & set(attrs), (tag, attrs)
        assert (attrs.get("href") or "#").startswith("#"), (tag, attrs)
        assert tag not in ("link", "iframe", "img", "base", "object", "embed")
    assert len(page.figures) > 3
    for id_ in page.figures:
        assert sum(attrs.get("id") == id_ for _, attrs in page.tags) == 1, id_


def test_the_page_tells_what_was_left_out_and_how_numbers_come_about(page: Page) -> None:
    shown = " ".join(page.text)
    for words in (
        "algo=dagger,seed=3", "Comparison of 9 runs", "an object as the unit", "Minus bc", "Minus expert", "+25",
        "5,030", "58 %", "Category2", "Split test", "cafe01",
    ):  # fmt: skip
        assert words in shown, words


def test_what_it_took_is_a_row_per_policy(found: Comparison, page: Page) -> None:
    assert found.numbers["dagger/time/decision_ms"] == pytest.approx(11.5), "the mean over seeds"
    assert found.numbers["expert/time/decision_ms"] is None, "no run is about it, and none told"
    words = page.text[page.text.index("What it took", page.text.index("What it took") + 1) :]
    row = words[words.index("dagger") :][:20]
    assert {"1.50", "2.00", "11.5"} <= set(row), row


def test_the_learning_curves_have_a_line_per_group(page: Page) -> None:
    figures = {id_: figure for id_, figure in page.figures.items() if id_.startswith("success-")}
    assert {figure["layout"]["xaxis"]["title"]["text"] for figure in figures.values()} == {"labels", "round"}
    for figure in figures.values():
        lines = {trace["name"]: trace for trace in figure["data"] if trace.get("name")}
        assert set(lines) == {"bc", "dagger"}
        assert (len(lines["bc"]["x"]), len(lines["dagger"]["x"])) == (1, 5)
    held_out = next(iter(figures.values()))
    assert held_out["data"][-1]["y"] == pytest.approx([0.24, 0.34, 0.44, 0.54, 0.64])


def test_names_from_outside_are_shown_not_run(tmp_path: Path) -> None:
    evil = "<script>alert(1)</script>"
    for value in (evil, "tame"):
        write_run(tmp_path / value[:3], "bc", 0, trials("bc", 0, skill), settings={"note": value})
    page = Page(write_comparison(compared(tmp_path), tmp_path / "out.html", [Path(evil)]))
    assert sum(evil in piece for piece in page.text) >= 5
    assert sum(tag == "script" for tag, _ in page.tags) == len(page.figures) + 3  # plotly and two of the page's own


def test_the_csv_holds_every_number(found: Comparison, tmp_path: Path) -> None:
    write_comparison(found, tmp_path / "c.html")
    with (tmp_path / "c.csv").open(newline="") as file:
        reader = csv.DictReader(file)
        assert tuple(reader.fieldnames or ()) == COLUMNS
        rows = {tuple(row[key] for key in COLUMNS[:5]): row for row in reader}

    def value(*key: str) -> float:
        return float(rows[key]["value"])

    for label in ("expert", "artflownet", "bc", "dagger"):
        whole = rows[label, "all", "all", "all", "success_rate"]
        assert float(whole["value"]) == found.numbers[f"{label}/success_rate"]
        assert [float(whole["low"]), float(whole["high"])] == found.numbers[f"{label}/success_rate_ci95"]
        assert whole["n"] == "36"
        seeds = [value(label, str(seed), "all", "all", "success_rate") for seed in (0, 1, 2)]
        assert math.fsum(seeds) / 3 == pytest.approx(float(whole["value"]))
        splits = [value(label, "all", split, "all", "contact_rate") for split in ("test", "train_test")]
        assert splits == [1.0, 1.0]
        categories = [value(label, "all", "all", f"Category{c}", "success_rate") for c in range(3)]
        assert math.fsum(categories) / 3 == pytest.approx(value(label, "all", "all", "all", "success_rate_class_mean"))
    assert value("dagger", "all", "all", "all", "success_rate_minus_bc") == pytest.approx(0.25)
    assert value("dagger", "all", "all", "all", "times_lost") == 2
    opened = [row for key, row in entry(found, "bc").rows.items() if row.success]
    assert rows["bc", "all", "all", "all", "steps_to_success"]["n"] == str(len(opened)) != "36"
    assert value("dagger", "2", "all", "all", "time/decision_ms") == 12.5
    assert value("dagger", "2", "all", "all", "labels") == 5060
    assert value("dagger", "all", "all", "all", "labels") == 5030


def test_the_report_of_a_run_shows_its_learning_curve(sweep: Path, tmp_path: Path) -> None:
    page = Page(write_report(sweep / "algo=dagger,seed=0", tmp_path / "dagger.html"))
    figures = {id_: figure for id_, figure in page.figures.items() if id_.startswith("learning-")}
    assert set(figures) == {"learning-success", "learning-contact", "learning-expert", "learning-loss"}
    for figure in figures.values():
        for trace in figure["data"]:
            assert trace["x"] == [1000.0, 2000.0, 3000.0, 4000.0, 5000.0]
    assert [trace["name"] for trace in figures["learning-expert"]["data"]] == ["share of labels", "beta"]
    assert figures["learning-expert"]["data"][1]["y"] == [1.0, 0.5, 0.25, 0.125, 0.0625]
    assert not any(id_.startswith("training-") for id_ in page.figures), "logged once a round: seen over labels"
    # A single round makes no curve over labels.
    page = Page(write_report(sweep / "algo=bc,seed=0", tmp_path / "bc.html"))
    assert not any(id_.startswith("learning-") for id_ in page.figures)


def test_command_line(sweep: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main = runpy.run_path(str(ROOT / "launch" / "report.py"))["main"]
    assert main([str(sweep), "--out", str(tmp_path / "c.html")]) == 0
    printed = capsys.readouterr().out
    for label in ("expert", "artflownet", "bc", "dagger"):
        # A row of the comparison, one of each of two splits.
        assert len(re.findall(rf"^{label} +0, 1, 2 +\d+ ", printed, re.MULTILINE)) == 3
    assert max(map(len, printed.splitlines()[:-2])) <= 100
    (left_out,) = [line for line in printed.splitlines() if "not finished" in line]
    assert "algo=dagger,seed=3" in left_out
    assert (tmp_path / "c.html").is_file() and (tmp_path / "c.csv").is_file()
    runs = sorted(path for path in sweep.iterdir() if path.name.startswith("algo=bc"))
    assert main([str(path) for path in runs]) == 0
    assert (sweep / "comparison.html").is_file(), "next to the runs"


def test_bad_input_ends_with_one_sentence_and_exit_code_2(
    sweep: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    main = runpy.run_path(str(ROOT / "launch" / "report.py"))["main"]
    assert main([str(tmp_path), str(sweep)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: ") and str(tmp_path) in line


@pytest.mark.parametrize("content", ["[1, 2]", "a: [", "text"])
def test_a_configuration_that_is_none_is_named(tmp_path: Path, content: str) -> None:
    write_run(tmp_path / "run", "bc", 0, trials("bc", 0, skill))
    (tmp_path / "run" / "config.yaml").write_text(content)
    with pytest.raises(UserError, match=r"(?i)cannot read .*config\.yaml"):
        compared(tmp_path)
