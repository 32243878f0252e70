"""Two processes that torchrun starts fit as one does, in one run folder."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from fb3d_rl.data.demonstrations import DemonstrationBuffer
from fb3d_rl.training.run_log import read_rows

ROOT = Path(__file__).resolve().parents[2]
SMALL = [
    "experiment=smoke",
    "assets.categories=[Microwave,KitchenPot]",
    "algo.epochs=2.0",
    "algo.batch_size=32",
    "algo.neighbors=16",
    "algo.log_every=1",
    "algo.evaluate_every=4",
    "algo.checkpoint_every=4",
    "data.points=256",
    "data.train_samples=192",
    "data.workers=0",
    "camera.resolution=48",
    "evaluation.trials=0",
]


def train(folder: Path, processes: int, *words: str) -> subprocess.CompletedProcess[str]:
    start = [] if processes == 1 else ["-m", "torch.distributed.run", f"--nproc-per-node={processes}", "--standalone"]
    folder.mkdir(exist_ok=True)
    return subprocess.run(
        [sys.executable, *start, str(ROOT / "launch" / "train.py"), *words],
        cwd=folder,
        env={**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=250,
        check=False,
    )


@pytest.mark.slow
def test_two_processes_fit_as_one_does(tmp_path: Path) -> None:
    for processes in (1, 2):
        done = train(tmp_path / str(processes), processes, *SMALL)
        assert done.returncode == 0, done.stderr
    alone, together = (sorted((tmp_path / str(n)).rglob("metrics.jsonl")) for n in (1, 2))
    assert len(alone) == len(together) == 1
    # The second process was given a folder of its own, perhaps, and left none.
    (day,) = (tmp_path / "2" / "results" / "runs" / "train").iterdir()
    assert len(list(day.iterdir())) == 1
    losses = [[row["train/loss"] for row in read_rows(path[0]) if "train/loss" in row] for path in (alone, together)]
    assert len(losses[0]) == len(losses[1]) == 12
    # Each process normalizes by the statistics of its own half, so the curves are alike, not equal.
    apart = [abs(two - one) / one for one, two in zip(*losses, strict=True)]
    assert max(apart) < 0.35 and sum(apart) / len(apart) < 0.15, losses
    assert losses[0] != losses[1] and losses[1][-1] < 0.7 * losses[1][0]
    summaries = [json.loads((path[0].parent / "summary.json").read_text()) for path in (alone, together)]
    assert abs(summaries[0]["flow/cosine"] - summaries[1]["flow/cosine"]) < 0.1


@pytest.mark.slow
def test_two_processes_imitate_as_one_does(tmp_path: Path) -> None:
    words = ["algo=dagger", "experiment=smoke", "algo.batch_size=32", "algo.log_every=1", "algo.checkpoint_every=4",
             "data.labels=320", "algo.rounds=2", "evaluation.trials=1", "evaluation.expert=false",
             "algo.learner.contact=true", "algo.learner.phase=true", "collector=direct"]  # fmt: skip
    rows, episodes = [], []
    for processes in (1, 2):
        done = train(tmp_path / str(processes), processes, *words)
        assert done.returncode == 0, done.stderr
        [log] = sorted((tmp_path / str(processes)).rglob("metrics.jsonl"))
        rows.append([row for row in read_rows(log) if "train/loss" in row])
        episodes.append(DemonstrationBuffer.open(log.parent / "buffer").episodes)
        assert (log.parent / "summary.json").exists()
    first = [[row["train/loss"] for row in run if row["round"] == 0] for run in rows]
    # The mean of two halves' gradients is the whole batch's: they part by rounding alone.
    assert len(first[0]) == len(first[1]) >= 10
    assert all(abs(two - one) < 0.01 * one for one, two in zip(*first, strict=True)), first
    assert episodes[0][0] == episodes[1][0], "the first round is the expert's"
    assert {row["round"] for row in rows[1]} == {0, 1}


@pytest.mark.slow
def test_what_one_process_trains_refuses_several(tmp_path: Path) -> None:
    done = train(tmp_path, 2, "algo=screwnet", "experiment=smoke")
    assert done.returncode != 0 and "start it without torchrun" in done.stderr
    for words in ([*SMALL, "algo.batch_size=3"], ["algo=bc", "experiment=smoke", "algo.batch_size=3"]):
        done = train(tmp_path, 2, *words)
        assert done.returncode != 0 and "cannot be split equally" in done.stderr, words
