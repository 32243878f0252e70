"""The data contract: every TensorDict key with its trailing shape, dtype, unit and frame.

World frame: right-handed, z up, metres, radians. ``T_ab`` maps coordinates in b to coordinates in a (column
vectors). Quaternions are wxyz, unit, w >= 0. Leading dims: env ``[E]``, rollout ``[E, T]``, rows ``[R]``.
N is the number of points of a cloud (1200 unless configured otherwise).

What a policy carries from step to step is its own affair: it declares it (:mod:`fb3d_rl.policies.policy`), the flow
policy under "policy" (:class:`fb3d_rl.policies.flow_state.FlowState`), what its pulls have taught under "touch"
(:class:`fb3d_rl.policies.touch.TouchState`).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict import TensorDictBase

from fb3d_rl.errors import UserError as UserError  # its earlier place, which scripts of others import it from

ACTION_DIM = 8
"""x y z, roll pitch yaw, two fingers (supplement, II.C)."""

GOAL_POINTS = 512
"""Points of a goal image's cloud."""


Key = str | tuple[str, ...]


@dataclass(frozen=True)
class Entry:
    """One key of the contract: trailing shape ("N" stands for the number of points), dtype and meaning."""

    shape: tuple[int | str, ...]
    dtype: torch.dtype
    meaning: str


F32, BOOL = torch.float32, torch.bool

GROUPS: dict[str, dict[Key, Entry]] = {
    "observation": {
        ("observation", "points"): Entry(("N", 3), F32, "world points, m"),
        ("observation", "valid"): Entry(("N",), BOOL, "False on padding"),
        ("observation", "part_mask"): Entry(("N",), BOOL, "on the part to open"),
        ("observation", "qpos"): Entry((8,), F32, "x y z (m), roll pitch yaw (rad), two fingers (m)"),
        ("observation", "qvel"): Entry((8,), F32, "the same per second"),
        ("observation", "tool_pose"): Entry((7,), F32, "suction tip in the world: p (m) + q (wxyz)"),
        ("observation", "attached"): Entry((1,), BOOL, "suction holds a movable part"),
        ("observation", "contact_force"): Entry((1,), F32, "norm of the contact force on the gripper, N"),
        ("observation", "camera_position"): Entry((3,), F32, "where the depth camera stands in the world, m"),
        ("observation", "goal_sense"): Entry((1,), F32, "1: the goal is to open the part, -1: to close it some way"),
    },
    "action": {
        "action": Entry((8,), F32, "velocities in [-1, 1]: x y z * v_max, r p y * w_max, fingers * f_max"),
    },
    "privileged": {
        ("privileged", "flow"): Entry(
            ("N", 3), F32, "ground-truth 3D articulation flow, largest norm 1, 0 on static and padding"
        ),
    },
    "prediction": {
        ("prediction", "flow"): Entry(("N", 3), F32, "ArtFlowNet's flow, or what a baseline follows in its place"),
    },
    "metrics": {
        "normalized_distance": Entry((1,), F32, "|q_goal - q| / |q_goal - q_start|"),
        "contact": Entry((1,), BOOL, "suction has held the target part in this episode"),
        "held_opened": Entry((1,), BOOL, "a part that suction has held, the target or another, is open"),
    },
    # What UMPNet's world shows besides.
    "umpnet": {
        ("goal", "points"): Entry((GOAL_POINTS, 3), F32, "of the goal image, world, m; in manipulation only"),
        ("goal", "valid"): Entry((GOAL_POINTS,), BOOL, "False on padding; in manipulation only"),
        ("pull", "moved"): Entry((1,), BOOL, "the last pull moved the part, or there was none yet"),
    },
    "sample": {},
}
GROUPS["sample"] = {
    key: GROUPS[key[0]][key]
    for key in (*(("observation", name) for name in ("points", "valid", "part_mask")), ("privileged", "flow"))
}
GROUPS["sample"]["privileged", "link"] = Entry(("N",), torch.int16, "the link that a point lies on, -1 on padding")


def spec(group: str) -> dict[Key, Entry]:
    """Return the keys of one group ("observation", "action", "privileged", "prediction", "metrics", "umpnet",
    "sample").
    """
    return GROUPS[group]


def check(td: TensorDictBase, group: str) -> None:
    """Check that ``td`` holds every key of ``group`` with the contract's trailing shape and dtype.

    Raises:
        ValueError: names the first key that is missing, of another shape or of another dtype.
    """
    lead = td.batch_dims
    points: int | None = None
    for key, entry in spec(group).items():
        if key not in td.keys(include_nested=True):
            raise ValueError(f"{group}: key {key} is missing")
        value = td.get(key)
        trailing = tuple(value.shape[lead:])
        if len(trailing) != len(entry.shape):
            raise ValueError(f"{group}: {key} has trailing shape {trailing}, the contract says {entry.shape}")
        for size, expected in zip(trailing, entry.shape, strict=True):
            if expected == "N":
                points = size if points is None else points
                expected = points
            if size != expected:
                raise ValueError(f"{group}: {key} has trailing shape {trailing}, the contract says {entry.shape}")
        if value.dtype != entry.dtype:
            raise ValueError(f"{group}: {key} is {value.dtype}, the contract says {entry.dtype}")
