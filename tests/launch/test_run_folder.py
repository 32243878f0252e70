"""Run folders: a new run wants a new one; resuming takes the folder's own configuration and changes nothing else."""

from __future__ import annotations

import importlib
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from filelock import FileLock

LAUNCH = str(Path(__file__).resolve().parents[2] / "launch")
Launch = Callable[..., int]
"""Command line words -> exit code."""


@pytest.fixture
def seen() -> list[Any]:
    """The configurations that came to the task."""
    return []


@pytest.fixture
def launch(seen: list[Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Launch:
    """launch/<name>.py in this process, with a task that only looks at its configuration."""
    monkeypatch.syspath_prepend(LAUNCH)
    monkeypatch.chdir(tmp_path)
    command = importlib.import_module("command")

    def run(*words: str, name: str = "train", task: Callable[[Any, Path], None] | None = None) -> int:
        monkeypatch.setattr(sys, "argv", [f"{name}.py", *words])
        try:
            command.main(name, task or (lambda cfg, out: seen.append(cfg)))
        except SystemExit as end:
            return int(end.code or 0)
        return 0

    return run


def content(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


BEGUN = ["assets.categories=[Microwave]", "algo.lr=0.002", "seed=3", "protocol=closed", "hydra.run.dir=run"]


@pytest.fixture
def run_dir(launch: Launch, seen: list[Any], tmp_path: Path) -> Path:
    """A run that was begun."""
    assert launch(*BEGUN) == 0
    (tmp_path / "run" / "rows.csv").write_text("kept")
    seen.clear()
    return tmp_path / "run"


def test_a_resumed_run_takes_its_folders_configuration(launch: Launch, seen: list[Any], run_dir: Path) -> None:
    before = content(run_dir)
    assert launch("resume=true", "hydra.run.dir=run") == 0
    (cfg,) = seen
    assert (cfg.resume, cfg.assets.categories, cfg.algo.lr, cfg.seed) == (True, ["Microwave"], 0.002, 3)
    assert (cfg.evaluation.start, cfg.evaluation.repeats) == ("closed", 5)
    assert content(run_dir) == before


@pytest.mark.parametrize(
    "words",
    [
        BEGUN[:4],  # the command as it was given
        ["protocol=closed", "algo.lr=2e-3"],
        ["device=cpu", "collector=direct", "collector.restarts=1", "logger=csv", "data.workers=1"],
    ],
    ids=" ".join,
)
def test_what_agrees_or_changes_no_number_may_be_said(
    launch: Launch, seen: list[Any], run_dir: Path, words: list[str]
) -> None:
    assert launch(*words, "resume=true", "hydra.run.dir=run") == 0
    (cfg,) = seen
    assert (cfg.algo.lr, cfg.seed) == (0.002, 3)
    if "device=cpu" in words:
        assert (cfg.device, cfg.collector.backend, cfg.collector.restarts) == ("cpu", "direct", 1)
        assert (cfg.logger.name, cfg.data.workers) == ("csv", 1)


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["seed=0"], "seed=3, not 0"),  # the default, which differs all the same
        (["assets.categories=[Microwave,Safe]"], "assets.categories"),
        (["protocol=reference"], "evaluation.repeats=5, not 1"),
        (["algo=dagger"], "algo."),
        (["assets=partnet_mobility", "assets.root=DIR"], "assets."),
        (["experiment=smoke"], "was begun with"),
        (["env.horizon=149"], "env.horizon=150, not 149"),
    ],
)
def test_another_setting_is_refused_and_nothing_changes(
    launch: Launch, seen: list[Any], run_dir: Path, capsys: pytest.CaptureFixture[str], words: list[str], named: str
) -> None:
    before = content(run_dir)
    assert launch(*words, "resume=true", "hydra.run.dir=run") == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: ") and named in line and "hydra.run.dir" in line
    assert content(run_dir) == before and not seen


@pytest.mark.parametrize("left", ["config.yaml", "rows.csv", "videos", "checkpoint.pt", "clouds.npz"])
def test_a_used_folder_is_refused_without_resume(
    launch: Launch, seen: list[Any], tmp_path: Path, capsys: pytest.CaptureFixture[str], left: str
) -> None:
    (tmp_path / "run" / left).mkdir(parents=True)
    for name in ("train", "evaluate"):
        assert launch("hydra.run.dir=run", name=name) == 2
        assert left in (line := capsys.readouterr().err) and "resume=true" in line
    assert not seen and not content(tmp_path / "run")
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "mine.txt").write_text("a folder may hold other things")
    assert launch("hydra.run.dir=notes") == 0 and len(seen) == 1


def test_there_is_nothing_to_resume_in_an_empty_folder(
    launch: Launch, seen: list[Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert launch("resume=true", "hydra.run.dir=run") == 2
    assert "holds no run" in capsys.readouterr().err and not seen and not (tmp_path / "run").exists()


def test_a_folder_of_another_version_is_refused(
    launch: Launch, seen: list[Any], run_dir: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = yaml.safe_load((run_dir / "config.yaml").read_text())
    del config["env"]["horizon"]
    (run_dir / "config.yaml").write_text(yaml.safe_dump(config))
    assert launch("resume=true", "hydra.run.dir=run") == 2
    assert "env.horizon" in capsys.readouterr().err and not seen


def test_a_folder_that_another_process_writes_to_is_refused_until_that_dies(
    launch: Launch, seen: list[Any], run_dir: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    program = f"""
import sys, time
from filelock import FileLock
lock = FileLock({str(run_dir / ".lock")!r})
lock.acquire()
print("held", flush=True)
time.sleep(60)
"""
    other = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True)
    assert other.stdout is not None and other.stdout.readline() == "held\n"
    assert launch("resume=true", "hydra.run.dir=run") == 2
    assert "another process" in capsys.readouterr().err and not seen
    other.kill()
    other.wait()
    assert launch("resume=true", "hydra.run.dir=run") == 0 and len(seen) == 1


def test_a_folder_that_another_process_has_just_taken_is_left_to_it(
    launch: Launch, seen: list[Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "run").mkdir()
    with FileLock(tmp_path / "run" / ".lock"):
        assert launch("hydra.run.dir=run") == 2
        assert "another process" in capsys.readouterr().err and not seen
        assert (tmp_path / "run" / ".lock").exists()


def test_a_run_holds_its_folder(launch: Launch, run_dir: Path) -> None:
    held = []

    def task(cfg: Any, out: Path) -> None:
        with pytest.raises(TimeoutError):
            FileLock(out / ".lock").acquire(timeout=0)
        held.append(out)

    assert launch("resume=true", "hydra.run.dir=run", task=task) == 0 and len(held) == 1


def test_a_sweep_is_resumed_by_the_same_command(launch: Launch, tmp_path: Path) -> None:
    """Those that were begun go on, in the folders that they have; the others begin."""
    sweep = ["-m", "seed=1,2", "hydra.sweep.dir=sweep"]
    ran: list[tuple[str, bool]] = []

    def stop_at_two(cfg: Any, out: Path) -> None:
        ran.append((out.name, cfg.resume))
        if cfg.seed == 2 and not cfg.resume:
            raise KeyboardInterrupt
        (out / "summary.json").touch()

    assert launch(*sweep, task=stop_at_two) == 2
    assert launch(*sweep, "resume=true", task=stop_at_two) == 0
    assert ran == [("seed=1", False), ("seed=2", False), ("seed=1", True), ("seed=2", True)]
    assert launch("-m", "seed=1,3", "hydra.sweep.dir=sweep", "resume=true", task=stop_at_two) == 0
    assert ran[4:] == [("seed=1", True), ("seed=3", False)]
    config = yaml.safe_load((tmp_path / "sweep" / "seed=3" / "config.yaml").read_text())
    assert config["seed"] == 3 and not config["resume"]
