"""Ctrl-C while workers run ends the command, and everything that it started, with one sentence."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

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
