"""The console command ``fb3d``: ``fb3d train ...`` is ``python launch/train.py ...``, from any folder."""

from __future__ import annotations

import runpy
import sys
from typing import NoReturn

from fb3d_rl import interrupt
from fb3d_rl.places import folder

COMMANDS = {
    "train": "train a flow network or a policy, and evaluate it",
    "evaluate": "evaluate a policy",
    "objects": "generate, check, list, preview or unpack objects",
    "demos": "record, replay, list, filter, convert or collect demonstrations",
    "predict": "flow, contact point and gripper pose of a cloud of your own",
    "serve": "a policy server for robots, which openpi-client talks to",
    "robot": "a robot arm before a depth camera: hand-eye calibration",
    "report": "the page of a run, or of a comparison of several",
    "view": "the live page: an object, its flow, and the gripper",
    "benchmark": "throughput beside others, measured in one run",
    "export": "the flow network as a file of weights or a torch.export program",
}
"""The scripts in launch/ and what they do."""


def main() -> NoReturn:
    """Run the script that the first word names, with the words after it."""
    interrupt.expect()
    words = sys.argv[1:]
    if not words or words[0] in ("-h", "--help"):
        print("usage: fb3d COMMAND ...\n")
        for name, help_ in COMMANDS.items():
            print(f"  {name:10}{help_}")
        print("\nfb3d COMMAND --help shows a command's options.")
        sys.exit(0)
    if words[0] == "--version":
        from importlib.metadata import version

        print(f"fb3d_rl {version('fb3d_rl')}")
        sys.exit(0)
    if words[0] not in COMMANDS:
        print(f"error: {words[0]!r} is no command of fb3d; choose one of {', '.join(COMMANDS)}", file=sys.stderr)
        sys.exit(2)
    script = folder("launch") / f"{words[0]}.py"
    sys.argv = [str(script), *words[1:]]
    sys.path.insert(0, str(script.parent))
    runpy.run_path(str(script), run_name="__main__")
    sys.exit(0)
