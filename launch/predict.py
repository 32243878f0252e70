"""Predict how the object in a cloud of your own opens, and where a gripper should take hold of it.

python launch/predict.py CLOUD... [checkpoint=pretrained] [out=OUT] [mask=...] [camera=...] [KEY=VALUE ...]

CLOUD: .ply .pcd .npy .npz .xyz .txt .csv, a 16-bit .png of depth with the intrinsics of its camera beside it, or a
recording of ROS: .bag .db3 .mcap or a folder.
For each CLOUD it writes into the folder OUT: NAME.flow.ply and NAME.npz (the flow), NAME.json (the plan: contact point,
pull, pre-contact point, orientation of the gripper, each hypothesis with its probability) and NAME.html (a page with
arrows that opens offline; a click on its points writes the mask= to give).
"""

from __future__ import annotations

from fb3d_rl import interrupt

if __name__ == "__main__":
    interrupt.expect()

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

KEYS = {
    "checkpoint": "the network: a run folder, checkpoint.pt, .safetensors, or pretrained (default: pretrained)",
    "out": "folder to write to (default: predictions)",
    "mask": "the part to open: a field of the file, FIELD:ID, a second file, or box:X,Y,Z,X,Y,Z, two corners in m "
    "(default: a field named part_mask or mask, else none)",
    "camera": "where the camera stood in the cloud's frame, X,Y,Z (m), or a file of its pose T_cloud_camera, 4 x 4, "
    ".npy or text; of a depth image T_world_camera, which moves the points to the world (default: guessed)",
    "up": "which way is up in the cloud's frame: z y x -z -y -x, or X,Y,Z as minus gravity (default: z; depth: -y)",
    "front": "where the object's front is, likewise (default: auto, the side that the camera sees best)",
    "tilt": "degrees that up may be off; a support plane within them is looked for (default: 20; 70 for depth)",
    "ground": "height of the support along up, m, where it is known (default: fitted)",
    "foreground": "false: keep the support and sparse points (default: true)",
    "far": "distance from the camera beyond which points are left out, m (default: none)",
    "scale": "metres in a unit of the file (default: 1, or .001 for a cloud that spans more than 50)",
    "intrinsics": "of a depth image, .json or .yaml (default: NAME.json, NAME.yaml, intrinsics.json ... beside it)",
    "depth_scale": "units of a depth image in a metre (default: what the intrinsics say, else 1000)",
    "topic": "of a recording, the one with the clouds (default: the only one)",
    "message": "of a recording, the place of the cloud among those of its topic, from 0 on (default: 0)",
    "tool_pose": "the suction tip now, X,Y,Z,QW,QX,QY,QZ in the cloud's frame (default: unknown)",
}
"""The settings, given as KEY=VALUE."""

READING = ("scale", "intrinsics", "depth_scale", "topic", "message")
"""Those of them that say how a file is read."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code (2: an error that the user can fix)."""
    lines = "\n".join(f"  {key + '=':13}{text}" for key, text in KEYS.items())
    parser = argparse.ArgumentParser(
        description=__doc__,
        epilog=f"settings:\n{lines}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("words", metavar="CLOUD | KEY=VALUE", nargs="+", help="files, and settings as below")
    words = parser.parse_args(arguments).words
    # Imported late: --help answers at once.
    from fb3d_rl.errors import exit_code

    return exit_code(lambda: run(words), interrupted="clouds that were finished are kept")


def run(words: Sequence[str]) -> int:
    """Read, plan and write, one cloud after the other; a cloud that fails does not stop the others."""
    from fb3d_rl.errors import UserError

    given: dict[str, str] = {}
    clouds: list[Path] = []
    for word in words:
        key, equals, value = word.partition("=")
        if equals and key in KEYS:
            given[key] = value
        elif not equals or Path(word).exists():
            clouds.append(Path(word))
        else:
            raise UserError(f"{key}= is unknown; choose from {', '.join(KEYS)}")
    if not clouds:
        raise UserError("no cloud is named; give the files of one or more")
    settings = _settings(given)
    out = Path(given.get("out", "predictions"))
    if out.exists() and not out.is_dir():
        raise UserError(f"out={out} is a file; name a folder")

    from fb3d_rl.algos.weights import load_network

    checkpoint = given.get("checkpoint", "pretrained")
    net = load_network(checkpoint)
    failed = []
    for cloud, name in zip(clouds, _names(clouds), strict=True):
        try:
            print(f"{cloud}: {_one(cloud, out / name, net, checkpoint, settings)}", flush=True)
        except UserError as error:
            failed.append(f"{cloud}: {error}" if str(cloud) not in str(error) else str(error))
    for sentence in failed:
        print(f"error: {sentence}", file=sys.stderr)
    return 2 if failed else 0


def _one(cloud: Path, beside: Path, net: Any, checkpoint: str, settings: dict[str, Any]) -> str:
    """Plan for one cloud and write its files; returns what the terminal says."""
    from fb3d_rl import plan, read_cloud
    from fb3d_rl.perception.files import in_box
    from fb3d_rl.predict import results
    from fb3d_rl.predict.setting import seen_from
    from fb3d_rl.report.plan_page import sentence, write_page

    reading = {key: settings[key] for key in READING if key in settings}
    planning: dict[str, Any] = {
        key: settings[key]
        for key in ("up", "front", "tilt", "ground", "foreground", "far", "tool_pose")
        if key in settings
    }
    mask, pose = settings.get("mask"), settings.get("camera")
    box = mask if mask is not None and mask.startswith("box:") else None
    file = read_cloud(cloud, None if box else mask, **reading)
    points, camera, assumed = seen_from(file.points, file.camera if pose is None else pose, file.optical)
    planning = assumed | planning
    marked = file.mask if box is None else in_box(points, box)
    found = plan(points, marked, camera, model=net, **planning)
    beside.parent.mkdir(parents=True, exist_ok=True)
    results.write_ply(beside.with_name(f"{beside.name}.flow.ply"), found)
    results.write_npz(beside.with_name(f"{beside.name}.npz"), found, rows=file.rows)
    about = {"cloud": str(cloud), "checkpoint": checkpoint, "reading": list(file.remarks)}
    results.write_json(beside.with_name(f"{beside.name}.json"), found, **about)
    write_page(beside.with_name(f"{beside.name}.html"), found, cloud, file.remarks)
    return f"{sentence(found, file.remarks)}; wrote {beside}.html, .json, .npz and .flow.ply"


def _names(clouds: Sequence[Path]) -> list[str]:
    """Names for the results of each cloud, all different."""
    stems = [cloud.stem for cloud in clouds]
    return [stem if stems.count(stem) == 1 else f"{stem}_{i}" for i, stem in enumerate(stems, 1)]


def _settings(given: dict[str, str]) -> dict[str, Any]:
    """The values of the settings; numbers and lists as such."""
    from fb3d_rl.errors import UserError

    values: dict[str, Any] = dict(given)
    for key in ("tilt", "ground", "far", "scale", "depth_scale"):
        if key in given:
            values[key] = _numbers(key, given[key], 1)[0]
    for key in ("far", "scale", "depth_scale"):
        if key in given and not values[key] > 0:
            raise UserError(f"{key}={given[key]} is out of range; give more than 0")
    if "message" in given:
        if not given["message"].isdecimal():
            raise UserError(f"message={given['message']}: give a whole number, 0 for the first")
        values["message"] = int(given["message"])
    for key in ("up", "front"):
        if "," in given.get(key, ""):
            values[key] = _numbers(key, given[key], 3)
    if "tool_pose" in given:
        values["tool_pose"] = _numbers("tool_pose", given["tool_pose"], 7)
    if "foreground" in given:
        if given["foreground"] not in ("true", "false"):
            raise UserError(f"foreground={given['foreground']} is unknown; choose from true, false")
        values["foreground"] = given["foreground"] == "true"
    if "camera" in given:
        values["camera"] = _pose(given["camera"])
    return values


def _numbers(key: str, text: str, count: int) -> list[float]:
    from fb3d_rl.errors import UserError

    try:
        numbers = [float(word) for word in text.strip("[]()").split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != count or any(x != x or abs(x) == float("inf") for x in numbers):
        raise UserError(
            f"{key}={text}: give {'a number' if count == 1 else f'{count} numbers with commas between them'}"
        )
    return numbers


def _pose(text: str) -> Any:
    """A position [3], or a pose [4, 4] of a file."""
    if not Path(text).is_file():
        return _numbers("camera", text, 3)
    import numpy as np

    from fb3d_rl.errors import UserError

    try:
        numbers = np.load(text, allow_pickle=False) if text.endswith(".npy") else np.loadtxt(text)
        return np.asarray(numbers, dtype=np.float64).reshape(4, 4)
    except (ValueError, EOFError, OSError) as error:
        raise UserError(f"camera={text} is no file of a pose: give 4 x 4 numbers as .npy or text") from error


if __name__ == "__main__":
    interrupt.run(main)
