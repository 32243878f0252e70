"""Ctrl-C is never lost, neither in an import nor where Python cannot raise, and is quiet in the end."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
BEGIN = """
from fb3d_rl import interrupt
interrupt.expect()
import atexit, os, signal, sys, time
def press():
    os.kill(os.getpid(), signal.SIGINT)
"""
SWALLOWS = """
import os, signal, time
try:
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(0.3)
except BaseException:
    pass
imported = True
"""
EARLY = "error: interrupted before the work began\n"
LATE_IMPORT = """
def main():
    import swallows
    time.sleep(9)
interrupt.run(main)
"""
WORK = """
import work
def main():
    try:
        work.go()
    finally:
        print("tidied up", sys.modules["swallows"].imported, file=sys.stderr)
interrupt.run(main)
"""
FINALIZER = """
class Thing:
    def __del__(self):
        press()
        time.sleep(0.01)
def main():
    Thing()
    time.sleep(9)
interrupt.run(main)
"""
AT_EXIT = """
atexit.register(lambda: (press(), time.sleep(9)))
interrupt.run(lambda: 1)
"""
MISTAKE = """
atexit.register(press)
interrupt.run(lambda: sys.exit("no"))
"""
CLEAN_UP_FAILS = """
def main():
    try:
        press()
        time.sleep(9)
    finally:
        None.missing
"""
READS_A_FILE = """
def main():
    try:
        press()
        time.sleep(9)
    except BaseException:
        pass
    from fb3d_rl.errors import UserError
    raise UserError("no file can be read")
"""
READS_A_MESH = """
from pathlib import Path
import trimesh
from fb3d_rl.assets.mesh_files import MeshFiles
def swallows(*_, **__):
    try:
        press()
        time.sleep(0.3)
    except BaseException:
        raise ValueError("there is no such file")
    return trimesh.creation.box()
trimesh.load_mesh = swallows
def main():
    Path("mesh.obj").touch()
    MeshFiles(Path("."), [], sys.exit, print).surface("mesh.obj")
"""
EXIT_CODE = """
from fb3d_rl.errors import exit_code
interrupt.run(lambda: exit_code(main, "all is kept"))
"""
LAUNCHED = f"""
sys.path.insert(0, {str(ROOT / "launch")!r})
import command
def launched():
    with command._one_sentence():
        main()
interrupt.run(launched)
"""
IGNORED = """
import signal
signal.signal(signal.SIGINT, signal.SIG_IGN)
"""
PROGRAMS = {
    "at the top": (BEGIN + "press(); time.sleep(9)", 2, EARLY),
    "in the script's import": (BEGIN + "import swallows; time.sleep(9)", 2, EARLY),
    "in a late import of the script": (BEGIN + LATE_IMPORT, 2, EARLY),
    "in an import of the work": (BEGIN + WORK, 2, "tidied up True\nerror: interrupted\n"),
    "in a finalizer": (BEGIN + FINALIZER, 2, "error: interrupted\n"),
    "while Python tidies up": (BEGIN + AT_EXIT, 1, ""),
    "after everything": ("import atexit, os, signal\natexit.register(lambda: os.kill(os.getpid(), signal.SIGINT))\n"
                         + BEGIN + "interrupt.run(lambda: 3)", 3, ""),
    "after a mistake": (BEGIN + MISTAKE, 1, None),
    "where clean-up fails": (BEGIN + CLEAN_UP_FAILS + "interrupt.run(main)", 2, "error: interrupted\n"),
    "where a command's clean-up fails": (BEGIN + CLEAN_UP_FAILS + EXIT_CODE, 2, "error: interrupted; all is kept\n"),
    "where clean-up fails under Hydra": (BEGIN + CLEAN_UP_FAILS + LAUNCHED, 2, "error: interrupted; a folder with a "
                                         "checkpoint.pt or rows.csv goes on with: resume=true hydra.run.dir=FOLDER\n"),
    "where a library swallows it": (BEGIN + READS_A_FILE + EXIT_CODE, 2, "error: interrupted; all is kept\n"),
    "where a library swallows it under Hydra": (
        BEGIN + READS_A_FILE + LAUNCHED, 2, "error: interrupted; a folder with a "
        "checkpoint.pt or rows.csv goes on with: resume=true hydra.run.dir=FOLDER\n"),
    "while a mesh is read": (BEGIN + READS_A_MESH + "interrupt.run(main)", 2, "error: interrupted\n"),
    "where it is ignored": (IGNORED + BEGIN + "interrupt.run(press)", 0, ""),
}  # fmt: skip


@pytest.mark.skipif(sys.platform == "win32", reason="sends signals")
@pytest.mark.parametrize("when", PROGRAMS)
def test_ctrl_c(tmp_path: Path, when: str) -> None:
    program, code, says = PROGRAMS[when]
    (tmp_path / "swallows.py").write_text(SWALLOWS)
    (tmp_path / "work.py").write_text("import time\ndef go():\n    import swallows\n    time.sleep(9)\n")
    (tmp_path / "script.py").write_text(program)
    done = subprocess.run(
        [sys.executable, "script.py"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=8,
        check=False,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    assert done.returncode == code, done.stderr
    assert "Traceback" not in done.stderr and (says is None or done.stderr == says)
