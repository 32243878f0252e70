"""A plan as files: JSON, NPZ and PLY."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fb3d_rl.files import replacing, write_text
from fb3d_rl.predict.plan import Hypothesis, Plan

PIECE = 1 << 16
"""Points that are written at a time: so many stay in the processor's cache."""

ALL_FLOWS = 1_000_000
"""Points of the largest cloud of which all hypotheses' flows are written, not that of the most probable one alone."""

VECTORS = ("contact_point", "pull", "standoff", "precontact_point", "rotation", "quaternion")
"""What a hypothesis has besides its flow and its probability."""

UNITS = {
    "contact_point": "m",
    "precontact_point": "m",
    "pull": "unit vector: which way the part moves, and which way to pull",
    "standoff": "unit vector from the contact point to the hand; the approach is along its opposite",
    "rotation": "R_cloud_tool, 3 x 3, by rows; the tool's +x points from the hand to the suction tip, its spin is free",
    "quaternion": "wxyz, the same rotation",
    "T_world_cloud": "4 x 4, by rows, m: maps the cloud's frame to an upright one, z up, its support at z = 0",
    "camera": "m",
}
"""What the numbers of the JSON file mean."""


def described(plan: Plan, **about: object) -> dict[str, Any]:
    """A plan without its arrays [N, ...], as JSON holds it."""
    return {
        **about,
        "frame": "that of the cloud, in metres, unless a name says otherwise",
        "units": UNITS,
        "points": len(plan.points),
        "foreground_points": int(plan.foreground.sum()),
        "part_points": None if plan.part is None else int(plan.part.sum()),
        "hypotheses": [
            {"probability": one.probability, **{name: getattr(one, name).tolist() for name in VECTORS}}
            for one in plan.hypotheses
        ],
        "T_world_cloud": plan.T_world_cloud.tolist(),
        "camera": plan.camera.tolist(),
        "network_scale": plan.scale,
        "remarks": list(plan.remarks),
    }


def write_json(path: Path, plan: Plan, **about: object) -> None:
    """Write the plan without its arrays, with ``about`` before it."""
    write_text(path, json.dumps(described(plan, **about), indent=1) + "\n")


def write_npz(path: Path, plan: Plan, **further: NDArray[Any]) -> None:
    """Write points [N, 3], flow [N, 3], probabilities [K], foreground [N], part [N] and others, and of at most
    :data:`ALL_FLOWS` points all flows [K, N, 3].
    """
    arrays: dict[str, Any] = {"points": plan.points, "flow": plan.hypotheses[0].flow, "foreground": plan.foreground}
    arrays |= further
    arrays["probabilities"] = np.array([one.probability for one in plan.hypotheses])
    if len(plan.hypotheses) > 1 and len(plan.points) <= ALL_FLOWS:
        arrays["flows"] = np.stack([one.flow for one in plan.hypotheses])
    if plan.part is not None:
        arrays["part"] = plan.part
    with replacing(path) as beside:
        np.savez(beside, **arrays)


def write_ply(path: Path, plan: Plan) -> None:
    """Write the points with the flow of the most probable hypothesis, for MeshLab, CloudCompare and others."""
    best: Hypothesis = plan.hypotheses[0]
    kind = plan.points.dtype.str[1:]
    fields: list[tuple[str, str, NDArray[Any]]] = [(axis, kind, plan.points[:, k]) for k, axis in enumerate("xyz")]
    fields += [(f"flow_{axis}", "f4", best.flow[:, k]) for k, axis in enumerate("xyz")]
    fields.append(("foreground", "u1", plan.foreground))
    if plan.part is not None:
        fields.append(("part_mask", "u1", plan.part))
    names = {"f4": "float", "f8": "double", "u1": "uchar"}
    properties = [f"property {names[code]} {name}" for name, code, _ in fields]
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        "comment metres; flow: which way each point moves, largest about 1",
    ]
    header = "\n".join([*lines, f"element vertex {len(plan.points)}", *properties, "end_header", ""])
    records = np.empty(PIECE, dtype=[(name, f"<{code}") for name, code, _ in fields])
    with replacing(path) as beside, beside.open("wb") as file:
        file.write(header.encode("ascii"))
        for start in range(0, len(plan.points), PIECE):
            for name, _, values in fields:
                piece = values[start : start + PIECE]
                records[name][: len(piece)] = piece
            file.write(records[: len(piece)].data.cast("B"))
