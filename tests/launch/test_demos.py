"""launch/demos.py: from recording to another format and back; an error that the user can fix is one sentence."""

from __future__ import annotations

import importlib.util
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import ModuleType

import pytest
import torch

from fb3d_rl.data.demonstrations import DemonstrationBuffer

SCRIPT = Path(__file__).resolve().parents[2] / "launch" / "demos.py"
SMALL = ["--categories", "Microwave", "--objects", "1", "--points", "64"]


@pytest.fixture(scope="module")
def demos() -> ModuleType:
    found = importlib.util.spec_from_file_location("launch_demos", SCRIPT)
    assert found is not None and found.loader is not None
    module = importlib.util.module_from_spec(found)
    found.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def recorded(demos: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path: Path = tmp_path_factory.mktemp("recorded") / "demos"
    assert demos.main(["record", str(path), *SMALL, "--trials", "2", "--successful", "--workers", "1"]) == 0
    return path


def say(demos: ModuleType, capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """The sentence that the command ends with."""
    capsys.readouterr()
    assert demos.main([str(argument) for argument in arguments]) == 2
    captured = capsys.readouterr()
    (line,) = captured.err.splitlines()
    assert line.startswith("error: ")
    return line


def test_record_then_list_filter_export_import_and_show(
    demos: ModuleType, recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def run(*arguments: object) -> str:
        assert demos.main([str(argument) for argument in arguments]) == 0
        return capsys.readouterr().out

    made = DemonstrationBuffer.open(recorded)
    assert [info.success for info in made.episodes] == [True, True] and made.about["seed"] == 0
    listed = run("list", recorded)
    assert "Microwave" in listed and str(len(made)) in listed and "100 %" in listed
    assert made.episodes[1].object in run("list", recorded, "--episode", 1)
    few = max(info.steps for info in made.episodes)
    run("filter", recorded, tmp_path / "some", "--category", "Microwave,Oven", "--max-steps", few, "--successful")
    run("export", tmp_path / "some", tmp_path / "x.h5")
    run("import", tmp_path / "x.h5", tmp_path / "again")
    again = DemonstrationBuffer.open(tmp_path / "again")
    assert again.episodes == made.episodes
    for key in made.keys:
        assert torch.equal(again[range(len(made))].get(key), made[range(len(made))].get(key))
    shown = run("show", tmp_path / "again", "--episode", 1, "--out", tmp_path / "pictures" / "x.png")
    assert (tmp_path / "pictures" / "x.png").stat().st_size > 1000 and "did not repeat" not in shown


def test_what_is_wrong_is_one_sentence(
    demos: ModuleType, recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    for arguments, words in (
        (["list", tmp_path / "nowhere"], "nowhere"),
        (["list", recorded, "--episode", 2], "2 episodes"),
        (["show", recorded, "--episode", 0, "--out", "x.txt"], "x.txt"),
        (["filter", recorded, out, "--failed"], "none of the 2"),
        (["filter", recorded, out, "--category", "Oven"], "none of the 2"),
        (["filter", recorded, out, "--min-steps", 1000], "none of the 2"),
        (["filter", recorded, recorded], "exists already"),
        (["export", recorded, tmp_path], "exists already|pyarrow"),
        (["import", tmp_path / "x.h5", out], "x.h5"),
        (["import", tmp_path / "x.h5", recorded], "x.h5"),
        (["record", out, "--trials", 0], "--trials 0"),
        (["record", out, "--root", tmp_path], "holds no object"),
        (["record", out, "--categories", "Car"], "Car"),
        (["record", recorded, *SMALL, "--trials", 1], "exists already"),
        (
            ["record", tmp_path / "few", *SMALL, "--trials", 1, "--successful", "--horizon", 1, "--workers", 1],
            "was kept",
        ),
    ):
        sentence = say(demos, capsys, *arguments)
        assert any(word in sentence for word in words.split("|")), sentence
    assert not out.exists()


def test_help_answers_without_torch() -> None:
    code = f"import runpy, sys; sys.argv = ['demos.py']; runpy.run_path({str(SCRIPT)!r}); print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


@pytest.mark.slow
def test_ctrl_c_keeps_what_was_recorded(tmp_path: Path) -> None:
    command = [
        sys.executable,
        str(SCRIPT),
        "record",
        str(tmp_path / "demos"),
        *SMALL,
        "--trials",
        "500",
        "--workers",
        "2",
    ]
    environment = {**os.environ, "PYTHONPATH": str(SCRIPT.parents[1]), "OMP_NUM_THREADS": "1"}
    # A shell that runs the tests in the background has SIGINT ignored, which children inherit.
    with subprocess.Popen(
        command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    ) as process:  # fmt: skip
        until = time.monotonic() + 200
        while time.monotonic() < until and not (
            (tmp_path / "demos").is_dir() and len(DemonstrationBuffer.open(tmp_path / "demos").episodes) >= 10
        ):
            time.sleep(0.5)
        os.killpg(process.pid, signal.SIGINT)
        assert process.wait(timeout=60) == 2
        assert process.stderr is not None
        assert process.stderr.read().splitlines()[-1].startswith("error: interrupted")
    kept = DemonstrationBuffer.open(tmp_path / "demos")
    assert 10 <= len(kept.episodes) < 500
    assert sum(info.rows for info in kept.episodes) == len(kept)
    assert bool(kept[range(len(kept))]["observation", "valid"].any(-1).all())
