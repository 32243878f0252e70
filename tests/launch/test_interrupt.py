"""Ctrl-C while workers run ends the command, and everything that it started, with one sentence."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]


def group(number: int) -> list[str]:
    """Commands of the processes of a process group that have not ended."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, member = stat.read_text().rpartition(")")[2].split()[:3]
            if int(member) == number and state != "Z":
                found.append((stat.parent / "cmdline").read_text().replace("\0", " "))
        except (FileNotFoundError, ProcessLookupError):
            continue  # it ended meanwhile
    return found


def workers(number: int) -> int:
    return sum("spawn_main" in command for command in group(number))


COMMANDS = {
    "train": ["train.py", "experiment=smoke"],
    "evaluate": ["evaluate.py", "collector.workers=2"],
    "view": ["view.py", "port=18090"],
    "serve": ["serve.py", "port=0"],
    "validate": ["objects.py", "validate", "ROOT", "--workers", "2", "--out", "validation.json"],
    "list": ["objects.py", "list", "ROOT"],
    "preview": ["objects.py", "preview", "ROOT", "--out", "sheet.png"],
    "generate": ["objects.py", "generate", "--out", "made"],
    "unpack": ["objects.py", "unpack", "objects.zip", "--out", "unpacked"],
    "record": ["demos.py", "record", "demos", "--trials", "2", "--workers", "2"],
    "report": ["report.py", "."],
    "benchmark": ["benchmark.py", "network", "--rounds", "1"],
    "export": ["export.py", "pretrained", "net.pt2"],
    "predict": ["predict.py", "cloud.npy", "out=made"],
}
SOME = {("validate", 0.05), ("train", 0.4), ("evaluate", 1.5), ("report", 0.1), ("record", 0.8), ("predict", 1.5)}
# Python's own start, before the first line of the script, is not the script's to guard.
START = """
import os, runpy, sys
sys.argv = sys.argv[1:]
sys.path.insert(0, os.path.dirname(sys.argv[0]))
os.write(1, b"up")
runpy.run_path(sys.argv[0], run_name="__main__")
"""


@pytest.mark.skipif(not hasattr(os, "killpg"), reason="needs groups of processes")
@pytest.mark.parametrize(
    ("name", "after"),
    [
        pytest.param(name, after, marks=() if (name, after) in SOME else pytest.mark.slow)
        for name in COMMANDS
        for after in (0.05, 0.1, 0.4, 0.8, 1.5, 3.0, 6.0, 12.0)
    ],
)
def test_a_command_ends_in_one_line_whenever_it_is_interrupted(
    tmp_path: Path, procedural_root: Path, name: str, after: float
) -> None:
    if name == "report":
        (tmp_path / "metrics.jsonl").write_text('{"step": 1, "train/loss": 0.5}\n')
    if name == "predict":
        np.save(tmp_path / "cloud.npy", np.random.default_rng(0).random((3000, 3)))
    if name == "unpack":
        shutil.make_archive(str(tmp_path / "objects"), "zip", procedural_root)
    words = [word.replace("ROOT", str(procedural_root)) for word in COMMANDS[name]]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    with subprocess.Popen(
        [sys.executable, "-c", START, str(ROOT / "launch" / words[0]), *words[1:]],
        cwd=tmp_path,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    ) as process:
        assert process.stdout is not None and process.stdout.read(2) == "up"
        time.sleep(after)
        if process.poll() is not None:
            return  # it was quicker
        os.killpg(process.pid, signal.SIGINT)
        _, said = process.communicate(timeout=60)
    if process.returncode == 0:  # it was just about to end, or served its page until then
        assert not said
    else:
        assert process.returncode == 2 and said.count("\n") == 1, said
        assert said.startswith(("error: interrupted", "error: Stopped by Ctrl-C")), said
    time.sleep(0.2)
    assert group(process.pid) == []


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc").is_dir(), reason="looks for processes in /proc")
@pytest.mark.parametrize("after", [0.0, 2.0, 12.0], ids="{} s after the start of the workers".format)
def test_nothing_is_left_behind(tmp_path: Path, after: float) -> None:
    command = [sys.executable, str(ROOT / "launch" / "evaluate.py"), "collector.workers=2", "assets.eval_count=20",
               "data.points=256", "camera.resolution=48", "hydra.run.dir=run"]  # fmt: skip
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    with (
        (tmp_path / "stderr").open("w") as stderr,
        subprocess.Popen(
            command,
            cwd=tmp_path,
            env=environment,
            stdout=subprocess.DEVNULL,
            stderr=stderr,
            start_new_session=True,
            # A shell that runs the tests in the background has SIGINT ignored, which children inherit.
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        ) as process,
    ):
        until = time.monotonic() + 120
        while workers(process.pid) < 2 and time.monotonic() < until:
            time.sleep(0.05)
        assert workers(process.pid) == 2
        time.sleep(after)
        os.killpg(process.pid, signal.SIGINT)  # as a terminal does
        assert process.wait(timeout=60) == 2
    time.sleep(0.5)
    assert group(process.pid) == []
    lines = (tmp_path / "stderr").read_text().splitlines()
    assert len(lines) == 1 and lines[0].startswith("error: interrupted"), lines


@pytest.mark.slow
def test_the_live_page_ends_without_a_word(tmp_path: Path) -> None:
    pytest.importorskip("viser", reason="viser is not installed; install it to run this test")
    command = [sys.executable, str(ROOT / "launch" / "view.py"), "port=18080"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    with subprocess.Popen(
        command,
        cwd=tmp_path,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    ) as process:
        assert process.stdout is not None and process.stderr is not None
        while "http://127.0.0.1:" not in (line := process.stdout.readline()):
            assert line, process.stderr.read()
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=60) == 0
        assert process.stderr.read() == ""
    assert not list(tmp_path.iterdir())
