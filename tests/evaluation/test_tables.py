from __future__ import annotations

import io
import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console
from scipy.stats import binomtest

from fb3d_rl.evaluation.intervals import UNIT, means, wilson
from fb3d_rl.evaluation.tables import number_rows, show, summary, tables, trainings
from fb3d_rl.rollout.rows import FlowRow, TrialRow


def trial(category: str, object_: str, success: bool, contact: bool = True, **changes: object) -> TrialRow:
    values: dict[str, object] = {
        "trial": 0,
        "policy": "artflownet",
        "split": "test",
        "link": "link_0",
        "semantic": "door",
        "joint_type": "revolute",
        "seed": 0,
        "contact": contact,
        "success": success,
        "normalized_distance": 0.0 if success else 1.0,
    }
    return TrialRow(category=category, object=object_, **(values | changes))  # type: ignore[arg-type]


# Oven: object a opened in 1 of 2 trials, b in 1 of 1, c in 0 of 1: mean (0.5 + 1 + 0) / 3.
# Safe: object d in 0 of 1.
ROWS = [
    trial("Oven", "a", True),
    trial("Oven", "a", False),
    trial("Oven", "b", True),
    trial("Oven", "c", False, contact=False),
    trial("Safe", "d", False, normalized_distance=0.6),
]
FLOW = [
    FlowRow("a", "Oven", "test", "link_0", 1.0, 0.0, 0.0),
    FlowRow("a", "Oven", "test", "link_1", 0.5, 0.2, 0.1),
    FlowRow("d", "Safe", "test", "link_0", 0.0, 1.0, 0.5),
]


def test_hand_computed_numbers() -> None:
    numbers = summary(ROWS, FLOW, {"seed": 7, "git_revision": "abc"})
    assert numbers["success_rate"] == pytest.approx((0.5 + 1 + 0 + 0) / 4)
    assert numbers["success_rate_class_mean"] == pytest.approx((0.5 + 0) / 2)
    assert numbers["contact_rate"] == pytest.approx((1 + 1 + 0 + 1) / 4)
    assert numbers["contact_rate_class_mean"] == pytest.approx((2 / 3 + 1) / 2)
    assert numbers["motion_only_success_rate"] == pytest.approx((0.5 + 1 + 0) / 3)
    assert numbers["motion_only_success_rate_class_mean"] == pytest.approx((0.75 + 0) / 2)
    assert numbers["normalized_distance"] == pytest.approx((0.5 + 0 + 1 + 0.6) / 4)
    assert numbers["normalized_distance_class_mean"] == pytest.approx((0.5 + 0.6) / 2)
    assert numbers["flow/cosine"] == pytest.approx((0.75 + 0) / 2)
    assert numbers["flow/rmse"] == pytest.approx((0.1 + 1) / 2)
    assert numbers["flow/magnitude_error"] == pytest.approx((0.05 + 0.5) / 2)
    assert numbers["by_category"]["Oven"]["success_rate"] == pytest.approx(0.5)
    assert numbers["by_category"]["Oven"]["artflownet/success_rate"] == pytest.approx(0.5)
    assert numbers["by_category"]["Safe"]["flow/cosine"] == 0.0
    assert (numbers["n"], numbers["n_objects"], numbers["n_error"], numbers["flow/n"]) == (5, 4, 0, 3)
    assert (numbers["seed"], numbers["git_revision"], numbers["policy"]) == (7, "abc", "artflownet")
    assert "by_split" not in numbers
    json.dumps(numbers, allow_nan=False)


def test_the_runs_own_policy_is_not_the_expert() -> None:
    rows = [trial("Oven", "a", True, policy="expert"), trial("Oven", "a", False)]
    numbers = summary(rows, [])
    assert numbers["success_rate"] == numbers["artflownet/success_rate"] == 0.0
    assert numbers["expert/success_rate"] == 1.0
    assert summary(rows, [], {"policy": "expert"})["success_rate"] == 1.0
    assert summary(rows[:1], [])["success_rate"] == 1.0


def test_a_crashed_trial_counts_as_a_failure() -> None:
    crashed = trial("Oven", "e", False, contact=False, status="error", error="boom")
    before, after = summary(ROWS, []), summary([*ROWS, crashed], [])
    assert after["n"] == before["n"] + 1 and after["n_error"] == 1
    for key, value in (("success_rate", 0), ("contact_rate", 0), ("normalized_distance", 1)):
        assert after[key] == pytest.approx((4 * before[key] + value) / 5)


def test_what_it_took_counts_the_trials_that_it_is_about() -> None:
    rows = [
        trial("Oven", "a", True, steps=50, seconds=2.5, path_length=1.0, lost=0, pulls=1),
        trial("Oven", "a", True, steps=70, seconds=3.5, path_length=2.0, lost=1, pulls=2),
        trial("Oven", "b", False, steps=150, seconds=7.5, path_length=4.5, lost=4),
    ]
    numbers = summary(rows, [], {"artflownet/time/decision_ms": 12.34})
    assert (numbers["steps_to_success"], numbers["seconds_to_success"]) == (60, 3.0), "only those that succeeded"
    assert (numbers["path_length"], numbers["times_lost"]) == ((1.5 + 4.5) / 2, (0.5 + 4) / 2), "all of them"
    assert numbers["pulls_until_moved"] == 1.5, "only those that moved"
    with Console(width=100, record=True, file=io.StringIO()) as console:
        show(numbers, console)
    printed = console.export_text()
    assert "What it took" in printed and all(len(table.columns) < 8 for table in tables(numbers))
    assert [column.header for column in tables(numbers)[-1].columns][-2:] == ["pulls until it moved", "ms a decision"]
    assert printed[: printed.index("One training")].splitlines()[-1].split() == [
        "artflownet",
        "60",
        "3.0",
        "3.00",
        "2.25",
        "1.50",
        "12.3",
    ]

    early = summary([trial("Oven", "a", False)], [])  # recorded before these numbers were
    assert early["path_length"] is early["times_lost"] is early["pulls_until_moved"] is None
    assert early["seconds_to_success"] is None
    assert "network_calls" not in numbers
    calls = summary([trial("Oven", "a", True, network_calls=2), trial("Oven", "b", True, network_calls=5)], [])
    assert calls["network_calls"] == calls["artflownet/network_calls"] == 3.5
    with Console(width=100, record=True, file=io.StringIO()) as console:
        show(early, console)
    assert "What it took" not in console.export_text()


def test_seeds_are_told_where_something_was_trained() -> None:
    untrained = [trial("Oven", "a", True, policy=policy) for policy in ("expert", "random", "normal")]
    assert trainings(summary(untrained, [])) == ""
    assert "One training (one seed)" in trainings(summary([*untrained, trial("Oven", "a", True)], []))
    assert "One training (one seed)" in trainings(summary(untrained, FLOW))


def test_splits_are_told_apart() -> None:
    rows = [trial("Oven", "a", True), trial("Safe", "b", False, split="other")]
    by_split = summary(rows, [])["by_split"]
    assert (by_split["test"]["success_rate"], by_split["other"]["success_rate"]) == (1.0, 0.0)


def test_without_contact_motion_only_success_is_undefined() -> None:
    numbers = summary([trial("Oven", "a", False, contact=False)], [])
    assert numbers["motion_only_success_rate"] is None
    assert numbers["motion_only_success_rate_ci95"] is None


def test_the_order_of_rows_does_not_matter() -> None:
    assert summary(ROWS[::-1], FLOW[::-1]) == summary(ROWS, FLOW)


def test_nothing_to_summarise() -> None:
    assert summary([], [], {"seed": 1}) == {"seed": 1, "by_category": {}}


def objects(n: int, seed: int) -> dict[tuple[str, str], float]:
    rng = np.random.default_rng(seed)
    return {(f"category {i % 5}", str(i)): float(rng.random() < 0.6) for i in range(n)}


@pytest.mark.parametrize("seed", range(5))
def test_intervals_hold_their_mean_and_shrink_with_n(seed: int) -> None:
    widths = []
    for n in (20, 80, 320):
        result = means(objects(n, seed), UNIT, share=True)
        for mean, interval in (
            (result.instance, result.instance_ci95),
            (result.class_, result.class_ci95),
        ):
            assert mean is not None and interval is not None
            assert interval[0] < mean < interval[1]
            widths.append(interval[1] - interval[0])
    # Four times the objects halve the interval, give or take the draw.
    for large, small in zip(widths, widths[2:], strict=False):
        assert 0.3 < small / large < 0.75


def test_trials_of_one_object_are_no_independent_evidence() -> None:
    few = summary([trial("Oven", str(i), i < 3) for i in range(6)], [])
    many = summary([trial("Oven", str(i), i < 3) for i in range(6) for _ in range(10)], [])
    assert few["success_rate_ci95"] == many["success_rate_ci95"]


@pytest.mark.parametrize("count", [0, 1, 5, 7])
def test_the_interval_is_clopper_and_pearsons_or_wilsons_where_each_object_has_one_trial(count: int) -> None:
    result = means({("Oven", str(i)): float(i < count) for i in range(7)}, UNIT, share=True)
    both = [binomtest(count, 7).proportion_ci(method=method) for method in ("exact", "wilson")]
    assert result.instance_ci95 == pytest.approx((min(ci.low for ci in both), max(ci.high for ci in both)))
    assert result.class_ci95 == pytest.approx(result.instance_ci95)


def test_equal_values_tell_nothing_about_an_unbounded_mean_but_something_about_a_bounded_one() -> None:
    same = {("Oven", str(i)): 0.5 for i in range(7)}
    assert means(same).instance_ci95 is means(same).class_ci95 is None
    bounded = means(same, UNIT).instance_ci95
    assert bounded is not None and 0.1 < bounded[0] < 0.45 and 0.55 < bounded[1] < 0.9


def test_values_beyond_their_bounds_lie_in_the_interval() -> None:
    """A part that ended further closed than it started has a distance above 1."""
    result = means({("Oven", "a"): 1.25, ("Oven", "b"): 1.25}, UNIT)
    assert result.instance == 1.25 and result.instance_ci95 is not None
    assert result.instance_ci95[0] < 0.5 and result.instance_ci95[1] == 1.25


def test_a_class_mean_of_few_objects_that_weigh_much_is_less_certain() -> None:
    objects_ = {("Oven", str(i)): float(i % 4 > 0) for i in range(20)} | {("Safe", "x"): 1.0}
    result = means(objects_, UNIT, share=True)
    assert result.instance_ci95 is not None and result.class_ci95 is not None
    assert np.ptp(result.class_ci95) > 1.5 * np.ptp(result.instance_ci95)


def test_wilson_agrees_with_scipy_on_whole_counts() -> None:
    for k in range(6):
        expected = binomtest(k, 5).proportion_ci(method="wilson")
        assert wilson(k / 5, 5) == pytest.approx((expected.low, expected.high))


def test_the_terminals_table_has_every_category_and_fits() -> None:
    rows = [
        *ROWS,
        *(trial(r.category, r.object, True, policy=p) for r in ROWS for p in ("expert", "bc", "dagger")),
    ]
    out = io.StringIO()
    show(summary(rows, FLOW), Console(file=out, width=100))
    lines = out.getvalue().splitlines()
    assert max(map(len, lines)) <= 100
    for word in (
        "Oven",
        "Safe",
        "class mean",
        "instance mean",
        "expert",
        "artflownet",
        "bc",
        "dagger",
        "cosine",
    ):
        assert any(word in line for line in lines), word
    assert not any("…" in line for line in lines)


def test_what_was_opened_without_a_mask_is_counted_beside_success() -> None:
    seen = [trial("Oven", name, name == "a", policy="masked", mask="target", held_opened=name == "a") for name in "ab"]
    blind = [trial("Oven", name, name == "a", mask="none", held_opened=name != "d") for name in "abcd"]
    numbers = summary([*seen, *blind], [])
    assert numbers["artflownet/success_rate"] == 0.25 and numbers["artflownet/held_opened_rate"] == 0.75
    assert numbers["by_category"]["Oven"]["artflownet/held_opened_rate"] == 0.75
    assert not any(key.startswith("masked/held") for key in numbers)
    out = io.StringIO()
    show(numbers, Console(file=out, width=100))
    line = next(line for line in out.getvalue().split("Without a part mask")[1].splitlines() if "artflownet" in line)
    assert "25 %" in line and "75 %" in line
    out = io.StringIO()
    show(summary(seen, []), Console(file=out, width=100))
    assert "mask" not in out.getvalue().replace("masked", "")


def test_a_table_of_benchmarks_has_every_number() -> None:
    rows = list(number_rows({"steps": {"a": 1234.5, "b": 0.5123, "objects": ["x"], "c": "not measured"}}))
    assert rows == [("steps", "a", "1234"), ("steps", "b", "0.512"), ("steps", "c", "not measured")]


@pytest.mark.parametrize("module", ["fb3d_rl.evaluation.intervals", "fb3d_rl.rollout.rows"])
def test_rows_and_intervals_load_no_torch(module: str) -> None:
    code = f"import sys, {module}; sys.exit('torch' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_proposals_are_shown_where_a_network_has_several_and_older_rows_lack_them() -> None:
    old = FlowRow("1", "Box", "test", "link_0", 0.5, 0.2, 0.1)
    single = replace(old, axis_cosine=0.9, best_cosine=0.5, probability=1.0, hit=1.0)
    several = replace(single, best_cosine=0.8, probability=0.6, hit=0.0)
    assert "flow/axis_cosine" not in summary([], [old])
    numbers = summary([], [several])
    assert (numbers["flow/axis_cosine"], numbers["flow/best_cosine"], numbers["flow/hit"]) == (0.9, 0.8, 0.0)
    titles = [[str(table.title) for table in tables(summary([], [row]))] for row in (old, single, several)]
    assert titles[0] == titles[1] == titles[2][:-1] and titles[2][-1] == "Several proposed flows"
