"""The main job in small: objects, samples, fit, trials, report; twice with the same seed, and once resumed."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from fb3d_rl.algos.run import run_evaluation
from fb3d_rl.algos.run import run_training as run
from fb3d_rl.algos.weights import best_cosine, load_network
from fb3d_rl.errors import UserError
from fb3d_rl.evaluation import evaluate as evaluation
from fb3d_rl.rollout.rows import read_trials, write_trials
from fb3d_rl.training.run_log import RunLog, read_rows

Config = Callable[[str, list[str]], Any]
CONF = str(Path(__file__).parents[1] / "conf")
SMALL = [
    "experiment=smoke",
    "assets.categories=[Microwave,KitchenPot]",
    "algo.epochs=1.0",
    "algo.batch_size=4",
    "algo.neighbors=16",
    "algo.log_every=2",
    "algo.evaluate_every=3",
    "algo.checkpoint_every=3",
    "data.points=256",
    "data.train_samples=24",
    "data.workers=0",
    "camera.resolution=48",
    "evaluation.trials=2",
    "env.horizon=70",
]


@pytest.fixture(scope="module")
def first(tmp_path_factory: pytest.TempPathFactory, config: Config) -> Path:
    out = tmp_path_factory.mktemp("first")
    run(config("train", SMALL), out)
    return out


def test_a_run_leaves_what_it_promises(first: Path) -> None:
    names = {path.name for path in first.iterdir()}
    assert names >= {"metrics.jsonl", "checkpoint.pt", "rows.csv", "flow_rows.csv", "summary.json",
                     "flow.png", "clouds.npz"}  # fmt: skip
    assert not [name for name in names if name.endswith((".part", ".tmp"))]
    summary = json.loads((first / "summary.json").read_text())
    for key in ("flow/cosine", "flow/rmse", "flow/magnitude_error", "success_rate", "normalized_distance",
                "contact_rate", "expert/success_rate", "by_category", "n", "seed", "git_revision"):  # fmt: skip
        assert key in summary, key
    rows = read_trials(first / "rows.csv")
    assert [row.policy for row in rows] == ["expert"] * 2 + ["artflownet"] * 2
    assert all(row.contact for row in rows if row.policy == "expert")
    assert "nan" not in (first / "metrics.jsonl").read_text().lower()
    best = max(row["val/cosine"] for row in read_rows(first / "metrics.jsonl") if "val/cosine" in row)
    assert best_cosine(first / "best.safetensors") == best and load_network(first / "best.safetensors").arguments


def test_the_same_seed_gives_the_same_bits(first: Path, tmp_path: Path, config: Config) -> None:
    run(config("train", SMALL), tmp_path)
    log = read_rows(tmp_path / "metrics.jsonl", times=False)
    assert log == read_rows(first / "metrics.jsonl", times=False) and any("train/loss" in row for row in log)
    for name in ("rows.csv", "flow_rows.csv"):
        assert (tmp_path / name).read_bytes() == (first / name).read_bytes(), name


def test_a_report_without_clouds(first: Path, tmp_path: Path, config: Config) -> None:
    alone = ["evaluation.clouds=0", "evaluation.trials=0", "policy=artflownet", f"checkpoint={first}/checkpoint.pt"]
    small = [word for word in SMALL if not word.startswith(("algo", "evaluation"))]
    run_evaluation(config("evaluate", [*small, *alone]), tmp_path)
    names = {path.name for path in tmp_path.iterdir()}
    assert names >= {"flow_rows.csv"} and not names & {"clouds.npz", "flow.png"}


def test_nothing_that_is_evaluated_is_looked_at_while_training(first: Path, tmp_path: Path, config: Config) -> None:
    """The training log and what is chosen by it are the same whatever objects are evaluated in the end."""
    others = ["assets.eval_count=2", "assets.unseen_categories=[Box]", "evaluation.trials=0"]
    run(config("train", [*SMALL, *others]), tmp_path)
    log = read_rows(tmp_path / "metrics.jsonl", times=False)
    assert log == read_rows(first / "metrics.jsonl", times=False) and any("val/cosine" in row for row in log)
    assert load_network(tmp_path / "best.safetensors").digest() == load_network(first / "best.safetensors").digest()
    drawn = {name for name, _ in json.loads((first / "samples" / "samples.json").read_text())["recipe"]["objects"]}
    assert len(drawn) == 3  # of two of each category, one is for validation


@pytest.mark.slow
def test_another_seed_gives_other_objects_and_weights(first: Path, tmp_path: Path, config: Config) -> None:
    run(config("train", [*SMALL, "seed=1"]), tmp_path)
    assert read_rows(tmp_path / "metrics.jsonl", times=False) != read_rows(first / "metrics.jsonl", times=False)


@pytest.mark.slow
def test_a_resumed_run_equals_a_straight_one(first: Path, tmp_path: Path, config: Config) -> None:
    # The learning rate's cycle depends on the number of steps, so a shorter run would not do: this one is cut.
    write = RunLog.write

    def stop_at_four(log: RunLog, row: dict[str, object]) -> None:
        if row["step"] == 4:
            raise KeyboardInterrupt
        write(log, row)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(RunLog, "write", stop_at_four)
        with pytest.raises(KeyboardInterrupt):
            run(config("train", SMALL), tmp_path)
    run(config("train", [*SMALL, "resume=true"]), tmp_path)
    assert read_rows(tmp_path / "metrics.jsonl", times=False) == read_rows(first / "metrics.jsonl", times=False)
    assert (tmp_path / "rows.csv").read_bytes() == (first / "rows.csv").read_bytes()


def test_a_run_that_ended_before_its_first_checkpoint_begins_anew(
    first: Path, tmp_path: Path, config: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = [*SMALL, "evaluation.trials=0"]

    def interrupted(log: RunLog, row: dict[str, object]) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(RunLog, "write", interrupted)
        with pytest.raises(KeyboardInterrupt):
            run(config("train", words), tmp_path)
    assert not (tmp_path / "checkpoint.pt").exists() and (tmp_path / "samples" / "samples.json").is_file()
    run(config("train", [*words, "resume=true"]), tmp_path)
    assert read_rows(tmp_path / "metrics.jsonl", times=False) == read_rows(first / "metrics.jsonl", times=False)


def test_a_kept_data_set_gives_the_same_run(first: Path, tmp_path: Path, config: Config) -> None:
    own = [*SMALL, "evaluation.trials=0", "data.train_samples=1"]  # which does not matter then
    run(config("train", [*own, f"data.dataset={first / 'samples'}"]), tmp_path)
    assert read_rows(tmp_path / "metrics.jsonl", times=False) == read_rows(first / "metrics.jsonl", times=False)
    assert not (tmp_path / "samples").exists()
    others = ["assets.train_count=20", "assets.validation_share=0.3"]  # validates on what was trained on
    with pytest.raises(UserError, match="holds clouds of .* validated or evaluated on"):
        run(config("train", [*own, *others, f"data.dataset={first / 'samples'}"]), tmp_path / "seen")
    with pytest.raises(UserError, match="no finished flow samples"):
        run(config("train", [*own, f"data.dataset={first}"]), tmp_path / "other")


@pytest.mark.slow
def test_evaluating_the_checkpoint_reproduces_the_runs_rows(first: Path, tmp_path: Path, config: Config) -> None:
    same = [item for item in SMALL if not item.startswith(("algo.", "data.train_samples"))]
    run_evaluation(config("evaluate", [*same, "policy=artflownet", f"checkpoint={first}"]), tmp_path)
    assert (tmp_path / "rows.csv").read_bytes() == (first / "rows.csv").read_bytes()
    assert (tmp_path / "flow_rows.csv").read_bytes() == (first / "flow_rows.csv").read_bytes()


@pytest.mark.slow
def test_an_interrupted_evaluation_goes_on_from_its_rows(
    first: Path, tmp_path: Path, config: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = [word for word in SMALL if not word.startswith("algo.")]
    words += ["policy=artflownet", f"checkpoint={first / 'checkpoint.pt'}"]
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    expected = run_evaluation(config("evaluate", words), whole)
    cut.mkdir()
    write_trials(cut / "rows.csv", [expected[0], expected[1], expected[3]])
    times = (whole / "decision_times.jsonl").read_text().splitlines(keepends=True)
    slow = [json.dumps({**json.loads(line), "seconds": [5.0] * 70}) + "\n" for line in times]
    (cut / "decision_times.jsonl").write_text("".join(slow))
    ran: list[int] = []
    run_all = evaluation.run_trials

    def counted(name: str, policy: Any, objects: Any, scheduled: list[Any], *rest: Any) -> Any:
        ran.append(len(scheduled))
        return run_all(name, policy, objects, scheduled, *rest)

    monkeypatch.setattr(evaluation, "run_trials", counted)
    assert run_evaluation(config("evaluate", [*words, "resume=true"]), cut) == expected
    assert ran == [0, 1]
    assert (cut / "rows.csv").read_bytes() == (whole / "rows.csv").read_bytes()
    # The median is that of all trials: of artflownet's two, one is kept with its time.
    assert json.loads((cut / "summary.json").read_text())["expert/time/decision_ms"] == 5000.0
    kept = [json.loads(line) for line in (cut / "decision_times.jsonl").read_text().splitlines()]
    assert [(line["policy"], line["trial"], line["seconds"][0] == 5.0) for line in kept] == [
        ("expert", 0, True), ("expert", 1, True), ("artflownet", 1, True), ("artflownet", 0, False)
    ]  # fmt: skip
    for foreign, said in (
        (replace(expected[0], trial=1), "trial 1, expert with .* not the one that is scheduled"),
        (replace(expected[0], key="another view"), "not the one that is scheduled"),
        (replace(expected[2], policy_digest="another network"), "other weights or options"),
        (replace(expected[2], policy="bc"), "other weights or options"),
    ):
        write_trials(cut / "rows.csv", [foreign])
        with pytest.raises(UserError, match=said):
            run_evaluation(config("evaluate", [*words, "resume=true"]), cut)
        assert read_trials(cut / "rows.csv") == [foreign]


@pytest.mark.slow
def test_training_and_flow_metrics_need_no_simulator(tmp_path: Path) -> None:
    launch = Path(CONF).parent / "launch"
    overrides = [item for item in SMALL if not item.startswith("evaluation.")]
    program = f"""
import runpy, sys
sys.modules["mani_skill"] = sys.modules["sapien"] = None  # as if they were not installed
sys.path.insert(0, {str(launch)!r})
sys.argv = ["train.py", *{overrides!r}, "evaluation.trials=0", "hydra.run.dir={tmp_path / "run"}"]
runpy.run_path({str(launch / "train.py")!r}, run_name="__main__")
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=200, check=False)
    assert done.returncode == 0, done.stderr
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert "flow/cosine" in summary and "success_rate" not in summary
    # With trials it says so before any work.
    asked = program.replace("evaluation.trials=0", "evaluation.trials=1").replace(
        str(tmp_path / "run"), str(tmp_path / "unused")
    )
    refused = subprocess.run([sys.executable, "-c", asked], capture_output=True, text=True, check=False)
    assert refused.returncode == 2 and "evaluation.trials=0" in refused.stderr
    assert len(refused.stderr.splitlines()) == 1 and not (tmp_path / "unused").exists()
