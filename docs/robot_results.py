"""The robot's tables of docs/robot.md, from the rows in results/robot/."""

from __future__ import annotations

from pathlib import Path

from fb3d_rl.evaluation.robot_tables import Line, lines, printed
from fb3d_rl.robot.rows import read_robot

ROBOT = Path(__file__).resolve().parents[1] / "results" / "robot"

TRIALS = {
    "expert (true flow), no errors, a perfect seal": "expert_ideal",
    "expert (true flow), all errors": "expert",
    "ArtFlowNet without mask, all errors (.2 degrees, 2 mm)": "artflownet",
    "the same with one grip and each point's most probable flow": "artflownet_one_grip",
    "DAgger Oracle (12,000 labels), all errors, one trial of each object": "dagger_oracle",
    "surface normal (told the part by a mask), all errors": "normal",
}
"""Folders of trials."""

ABLATIONS = {
    "all errors (calibration off by .2 degrees, 2 mm)": "base",
    "calibration exact": "cal0",
    "calibration off by .5 degrees, 5 mm": "cal05",
    "calibration carried out in the cell (`robot.calibration_deg=null`)": "calnull",
    "no error of the camera": "exact",
    "without `lateral`": "no_lateral",
    "without `bias`": "no_bias",
    "without `axial`": "no_axial",
    "without `flying`": "no_flying",
    "without `holes`": "no_holes",
    "without `grazing`": "no_grazing",
    "without `dark`": "no_dark",
    "without `rounding`": "no_rounding",
    "without `limits`": "no_limits",
    "the stereo camera's errors (`robot.noise=stereo`)": "stereo",
    "the same, the median of nine pictures (`robot.pictures=9`)": "stereo9",
    "exact force": "noforce",
    "`robot.rim=false`: the supplement's contact heuristic alone": "rim",
    "`robot.outliers=false`": "outliers",
    "`robot.seal=false`": "seal",
    "`robot.grips=1`": "grip1",
    "`robot.arm=panda`": "panda",
}
"""What is changed, and the name of its file."""


def _summary(path: Path) -> Line:
    return lines(read_robot(path))[-1]


def robot() -> list[str]:
    """Success, contact, distance and motion-only success of the trials that were run, and what is printed."""
    body = ["| | success | contact | distance | motion-only |", "| --- | --- | --- | --- | --- |"]
    for label, folder in TRIALS.items():
        path = ROBOT / folder / "robot.csv"
        if path.is_file():
            line = _summary(path)
            success, contact, distance = line.intervals()
            share, _, held, left, moved = line.cells()
            body.append(f"| {label} | {share} ({success} %) | {held} ({contact} %) | {left} ({distance}) | {moved} |")
    for policy, label in (("artflownet", "FlowBot3D, as printed"), ("dagger", "DAgger Oracle, as printed")):
        share, _, held, left, moved = printed(policy)[1]["SUMMARY"]
        body.append(f"| {label} | {share} | {held} | {left} | {moved} |")
    return body


def robot_ablation() -> list[str]:
    """How many of 14 trials were opened, and held, with one thing changed."""
    body = ["| | expert: opened | held | ArtFlowNet: opened | held |", "| --- | --- | --- | --- | --- |"]
    for label, name in ABLATIONS.items():
        cells = []
        for policy in ("expert", "artflownet"):
            path = ROBOT / "ablations" / policy / f"{name}.csv"
            line = _summary(path) if path.is_file() else None
            cells += [str(line.success), str(line.contact)] if line else ["", ""]
        if any(cells):
            body.append(f"| {label} | {' | '.join(cells)} |")
    return body
