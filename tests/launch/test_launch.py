"""The commands: an error that the user can fix ends in exit code 2 and one sentence, at once and without a trace.

To start Python and import costs seconds, so most of these commands are forked.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TypeAlias

import pytest
import torch

ROOT = Path(__file__).resolve().parents[2]
Launch: TypeAlias = "Callable[..., subprocess.CompletedProcess[str]]"


def start(script: str, *arguments: str, cwd: Path, python: tuple[str, ...] = ()) -> subprocess.CompletedProcess[str]:
    """In a Python of its own."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, *python, str(ROOT / "launch" / script), *arguments]
    return subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, timeout=250, check=False)


def sentence_of(result: subprocess.CompletedProcess[str]) -> str:
    assert result.returncode == 2, result.stderr
    lines = result.stderr.splitlines()
    assert len(lines) == 1 and lines[0].startswith("error: "), result.stderr
    assert "Traceback" not in result.stdout
    return lines[0]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["algo.epcohs=5"], ["epcohs"]),
        (["algo=ppo"], ["ppo", "artflownet"]),
        (["device=gpu"], ["device=gpu", "cuda"]),
        (["algo.epochs=many"], ["algo.epochs", "many"]),
        (["assets=partnet_mobility"], ["assets.root"]),
        (["assets=partnet_mobility", "assets.root=nowhere"], ["assets.root", "nowhere"]),
    ],
)
def test_what_is_wrong_is_said_in_one_sentence_before_any_work(
    launch: Launch, tmp_path: Path, arguments: list[str], words: list[str]
) -> None:
    sentence = sentence_of(launch("train.py", *arguments, cwd=tmp_path))
    assert all(word in sentence for word in words), sentence
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


def test_a_python_of_its_own_says_the_same_and_no_more(launch: Launch, tmp_path: Path) -> None:
    """After all that it imports, too."""
    arguments = ["assets=partnet_mobility", "assets.root=nowhere"]
    alone, forked = (how("train.py", *arguments, cwd=tmp_path) for how in (start, launch))
    assert sentence_of(alone) == sentence_of(forked)


def test_a_root_without_objects_leaves_no_run_folder(launch: Launch, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    arguments = ["assets=partnet_mobility", f"assets.root={tmp_path / 'empty'}", "hydra.run.dir=out"]
    assert "assets.root" in sentence_of(launch("train.py", *arguments, cwd=tmp_path))
    assert not (tmp_path / "out").exists()


def test_a_folder_that_cannot_be_written_is_named(launch: Launch, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    sentence = sentence_of(launch("train.py", "hydra.run.dir=file/run", cwd=tmp_path))
    assert "file/run" in sentence and "hydra.run.dir" in sentence


def test_a_run_folder_in_use_is_left_alone(launch: Launch, tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "notes.txt").write_text("mine")
    arguments = ["resume=true", "hydra.run.dir=run", "assets.categories=[Spaceship]"]
    sentence_of(launch("train.py", *arguments, cwd=tmp_path))
    assert (tmp_path / "run" / "notes.txt").read_text() == "mine"


def test_evaluation_without_a_checkpoint_is_refused(launch: Launch, tmp_path: Path) -> None:
    assert "checkpoint" in sentence_of(launch("evaluate.py", "policy=artflownet", cwd=tmp_path))
    assert "assets.split" in sentence_of(launch("evaluate.py", "assets.eval_split=[Box]", cwd=tmp_path))
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


@pytest.mark.parametrize(
    "script",
    ["train.py", "report.py", *(pytest.param(name, marks=pytest.mark.slow) for name in ("evaluate.py", "view.py"))],
)
def test_help_comes_without_the_heavy_imports(tmp_path: Path, script: str) -> None:
    result = start(script, "--help", cwd=tmp_path, python=("-X", "importtime"))
    assert result.returncode == 0 and result.stdout
    imported = {line.rsplit("|", 1)[-1].strip().split(".")[0] for line in result.stderr.splitlines() if "|" in line}
    assert "pathlib" in imported
    assert not imported & {"torch", "torchrl", "tensordict", "mani_skill", "sapien", "trimesh", "scipy"}
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("arguments", "words"),
    [(["lap"], ["lap", "steps"]), (["--rounds", "0"], ["--rounds"]), (["--root", "nowhere"], ["nowhere"])],
)
def test_the_benchmark_says_what_is_wrong(
    launch: Launch, tmp_path: Path, arguments: list[str], words: list[str]
) -> None:
    sentence = sentence_of(launch("benchmark.py", *arguments, cwd=tmp_path))
    assert all(word in sentence for word in words), sentence
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["object=Spaceship"], ["Spaceship", "Microwave"]),
        (["port=99999"], ["port=99999", "65535"]),
        (["checkpoint=nowhere.safetensors"], ["nowhere.safetensors"]),
        (["record=met"], ["record=met", "policy=dagger"]),
        (["policy=dagger", "checkpoint=nowhere", "record=met"], ["nowhere"]),
    ],
)
def test_the_live_page_says_what_is_wrong_and_leaves_nothing(
    launch: Launch, tmp_path: Path, arguments: list[str], words: list[str]
) -> None:
    pytest.importorskip("viser", reason="viser is not installed; install it to run this test")
    sentence = sentence_of(launch("view.py", *arguments, cwd=tmp_path))
    assert all(word in sentence for word in words), sentence
    assert not list(tmp_path.iterdir())


def test_a_job_that_fails_stops_no_other_and_is_named(tmp_path: Path) -> None:
    small = ["experiment=smoke", "evaluation.trials=0", "assets.categories=[Box]"]
    swept = (
        ["policy=artflownet,expert", "device=cpu,cuda"]
        if not torch.cuda.is_available()
        else ["policy=artflownet,expert"]
    )
    result = start("evaluate.py", "-m", *small, *swept, "hydra.sweep.dir=sweep", cwd=tmp_path)
    assert result.returncode == 2 and "Traceback" not in result.stderr
    (finished,) = (tmp_path / "sweep").rglob("summary.json")
    assert "policy=expert" in finished.parent.name
    lines = result.stderr.splitlines()
    count = len(lines) // 2
    assert lines[count] == f"error: {count} of {count + 1} jobs failed:"
    assert [line.removeprefix("error: ") for line in lines[:count]] == [line.strip() for line in lines[count + 1 :]]
    assert lines[0].startswith("error: job 0 (policy=artflownet") and "checkpoint=PATH" in lines[0]
    assert not [folder for folder in (tmp_path / "sweep").iterdir() if folder != finished.parent and folder.is_dir()]


@pytest.mark.slow
def test_a_fault_of_the_program_stops_no_other_job(tmp_path: Path) -> None:
    program = f"""
import runpy, sys
sys.path.insert(0, {str(ROOT / "launch")!r})
sys.argv = ["evaluate.py", "-m", "seed=0,1,2", "hydra.sweep.dir=sweep"]
import command
def task(cfg, out):
    if cfg.seed == 0:
        raise ZeroDivisionError("a fault")
    if cfg.seed == 2:
        raise KeyboardInterrupt if {{stop}} else command.Interrupted("Stopped by Ctrl-C")
    (out / "done").touch()
command.main("evaluate", task)
"""
    for stop in (True, False):
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        command = [sys.executable, "-c", program.replace("{stop}", str(stop))]
        folder = tmp_path / str(stop)
        folder.mkdir()
        done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 2, done.stderr
        assert "ZeroDivisionError: a fault" in done.stderr and len(list(folder.rglob("done"))) == 1
        last = "interrupted" if stop else "Stopped"
        assert done.stderr.splitlines()[-1].startswith(f"error: job 2 (seed=2): {last}")


@pytest.mark.slow
def test_a_sweep_trains_each_and_the_report_merges_them(tmp_path: Path) -> None:
    small = ["experiment=smoke", "data.labels=40", "evaluation.expert=false", "evaluation.trials=1"]
    swept = start("train.py", "-m", *small, "algo=artflownet,bc", "hydra.sweep.dir=sweep", cwd=tmp_path)
    assert swept.returncode == 0, swept.stderr
    runs = sorted(path.parent for path in (tmp_path / "sweep").rglob("summary.json"))
    assert {json.loads((run / "summary.json").read_text())["policy"] for run in runs} == {"artflownet", "bc"}
    merged = start("report.py", "sweep", cwd=tmp_path)
    assert merged.returncode == 0, merged.stderr
    table = merged.stdout
    assert "artflownet" in table and "bc" in table
