"""A robot arm before a depth camera.

python launch/robot.py calibrate --out calibration.json [--samples 30] [--seed 0] [--keep DIR]
python launch/robot.py calibrate FOLDER --out calibration.json [--marker-side .1] [--dictionary 4X4_50] [--marker-id 0]
python launch/robot.py run [--object Microwave] [--policy pretrained] [--video FILE.mp4] [--record DIR]
python launch/robot.py run --driver package.module:make --calibration calibration.json [--allow-motion] [--record DIR]
python launch/robot.py run --driver recorded --session DIR

calibrate finds where a fixed camera stands in the robot's base, from pictures of a marker on the flange: in a simulated
cell, or with the pictures and poses in FOLDER (docs/robot.md describes its files). run makes one attempt to open what
the camera sees: in a simulated cell, on your own robot, or once more from a recording.
"""

from __future__ import annotations

from fb3d_rl import interrupt

if __name__ == "__main__":
    interrupt.expect()

import argparse
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code (1: a poor calibration; 2: an error that the user can fix)."""
    options = _parser().parse_args(arguments)
    # Imported late: --help answers at once.
    from fb3d_rl.errors import exit_code

    return exit_code(lambda: COMMANDS[options.command](options), interrupted="nothing was written")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    says = "where the camera stands in the robot's base; the exit code is 1 if the result is too poor to use"
    hand_eye = commands.add_parser("calibrate", help=says, description=says)
    hand_eye.add_argument(
        "folder", type=Path, nargs="?", metavar="FOLDER", help="your pictures and poses (default: a simulated cell)"
    )
    hand_eye.add_argument("--out", type=Path, required=True, help="file to write, .json")
    hand_eye.add_argument("--samples", type=int, help="pictures that the simulated cell takes (default: 30)")
    hand_eye.add_argument("--seed", type=int, help="of the simulated cell (default: 0)")
    hand_eye.add_argument(
        "--keep", type=Path, metavar="DIR", help="write the simulated pictures and poses, as a FOLDER"
    )
    hand_eye.add_argument("--marker-side", type=float, default=0.1, help="of the black square, m (default: .1)")
    hand_eye.add_argument("--dictionary", default="4X4_50", help="OpenCV's set of ArUco markers (default: 4X4_50)")
    hand_eye.add_argument("--marker-id", type=int, default=0, help="which marker of the set (default: 0)")
    _run_parser(commands)
    return parser


def _run_parser(commands: Any) -> None:
    says = "one attempt to open what the camera sees; the exit code is 1 if it failed"
    run = commands.add_parser("run", help=says, description=says)
    driver = "simulated, recorded, or package.module:make of your own (default: simulated)"
    run.add_argument("--driver", default="simulated", help=driver)
    run.add_argument("--object", default="Microwave", help="on the simulated table: a category, or an object's folder")
    run.add_argument("--part", help="link of the object to open (default: the largest that opens)")
    run.add_argument(
        "--arm", default="sawyer", help="sawyer, panda, URDF:FLANGE or URDF:JOINT,JOINT,...:FLANGE (default: sawyer)"
    )
    calibration = "of calibrate (default: the simulated cell's truth)"
    run.add_argument("--calibration", type=Path, metavar="FILE", help=calibration)
    policy = "weights, a run folder, pretrained, or expert: the simulated truth (default: pretrained)"
    run.add_argument("--policy", default="pretrained", help=policy)
    run.add_argument("--noise", default="azure_kinect", help="of the simulated camera: azure_kinect, stereo, exact")
    run.add_argument("--suction", default="seal", help="of the simulated cup: seal, perfect (default: seal)")
    run.add_argument("--seed", type=int, default=0)
    run.add_argument("--session", type=Path, metavar="DIR", help="a recorded session, for --driver recorded")
    run.add_argument("--record", type=Path, metavar="DIR", help="record the session in this new folder")
    run.add_argument("--video", type=Path, metavar="FILE", help="film of the simulated cell, .mp4 or .gif")
    run.add_argument("--allow-motion", action="store_true", help="let a robot that is not simulated move")


def calibrate(options: argparse.Namespace) -> int:
    """Hand-eye calibration."""
    from fb3d_rl.errors import UserError
    from fb3d_rl.files import write_text
    from fb3d_rl.robot.calibration import calibrated
    from fb3d_rl.robot.calibration_session import read_session, simulate
    from fb3d_rl.robot.marker import Marker

    if not 0.0 < options.marker_side < 10.0:
        raise UserError(f"--marker-side {options.marker_side} is out of range; give the side of the black square in m")
    marker = Marker(options.marker_side, options.dictionary, options.marker_id)
    if options.folder is not None:
        given = [name for name in ("samples", "seed", "keep") if getattr(options, name) is not None]
        if given:
            raise UserError(f"--{given[0]} is for the simulated cell; leave it out with a FOLDER")
        session = read_session(options.folder)
    else:
        samples, seed = (30 if options.samples is None else options.samples), options.seed or 0
        if samples < 1 or seed < 0:
            raise UserError(
                f"--samples {samples} --seed {seed} is out of range; give 1 or more samples, a seed of 0 or more"
            )
        session = simulate(samples, seed, marker)
        if options.keep is not None:
            session.write(options.keep)
    result = calibrated(session, marker)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    write_text(options.out, json.dumps(result.entry(), indent=1) + "\n")
    x, y, z = result.found.camera[:3, 3]
    print(f"The marker is in {len(result.names)} of {len(session.names)} pictures.")
    print(f"The camera is at ({x:.4f}, {y:.4f}, {z:.4f}) m in the robot's base.")
    if result.errors is not None:
        turn, shift = result.errors
        print(f"True error in this simulated cell: {turn:.3f} degrees and {1000 * shift:.2f} mm.")
    print(f"{result.verdict[0].upper()}{result.verdict[1:]}.")
    print(f"Wrote {options.out}.")
    return int(result.grade == "poor")


def run(options: argparse.Namespace) -> int:
    """One attempt."""
    from fb3d_rl.algos.weights import load_network
    from fb3d_rl.robot.run import Settings, make_attempt

    settings = Settings(**{key: value for key, value in vars(options).items() if key != "command"})
    return make_attempt(settings, load_network, print)


COMMANDS: dict[str, Callable[[argparse.Namespace], int | None]] = {"calibrate": calibrate, "run": run}

if __name__ == "__main__":
    interrupt.run(main)
