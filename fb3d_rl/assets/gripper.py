"""The floating suction gripper's shape, read from the one file that describes it."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from defusedxml import ElementTree
from numpy.typing import NDArray

from fb3d_rl.assets.articulation import Mesh

URDF = Path(__file__).with_name("gripper.urdf")
"""The gripper: its joints, masses and boxes."""

FINGERS = ("finger_left", "finger_right")
"""Links whose ends form the suction tip."""

BODIES = ("hand", *FINGERS)
"""Links that have a shape."""

TOOL = "tool"
"""Link at the suction tip, in front of the hand's origin along the tool axis, the hand's +x."""


@cache
def gripper_meshes() -> tuple[tuple[Mesh, ...], ...]:
    """The shapes of ``BODIES``, for cameras: the URDF's boxes, each in its link's frame (m)."""
    links = {link.get("name"): link for link in ElementTree.parse(URDF).iter("link")}
    return tuple(tuple(_box(shape) for shape in links[name].iter("collision")) for name in BODIES)


def _box(collision: Any) -> Mesh:
    box = trimesh.creation.box(extents=_numbers(collision.find("geometry/box").get("size")))
    centre = _numbers(collision.find("origin").get("xyz"))
    return Mesh(np.asarray(box.vertices) + centre, np.asarray(box.faces, dtype=np.int64))


def _numbers(words: str) -> NDArray[np.float64]:
    return np.array([float(word) for word in words.split()])


def _tip() -> float:
    joints: dict[str | None, Any] = {joint.get("name"): joint for joint in ElementTree.parse(URDF).iter("joint")}
    return float(_numbers(joints[TOOL].find("origin").get("xyz"))[0])


TIP = _tip()
"""How far (m) the suction tip is in front of the hand's origin, along the hand's x axis."""

HAND_LENGTH = TIP - min(float(mesh.vertices[:, 0].min()) for mesh in gripper_meshes()[0])
"""From the suction tip to the hand's far end, m."""
