"""UMPNet's evaluation scenes, and the objects that stand in them."""

from __future__ import annotations

import gzip
import json
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.camera.options import CameraOptions
from fb3d_rl.camera.umpnet import TURN
from fb3d_rl.errors import UserError
from fb3d_rl.scene.posed import Posed

SCENES = Path(__file__).with_name("scenes.json.gz")
"""The 4,400 scenes of UMPNet's repository; SCENES_LICENSE.txt beside it is their notice."""

Mode = Literal["manipulation", "exploration"]

CAMERA = CameraOptions(resolution=640, fov=69.4, kind="umpnet")
"""The optics of UMPNet's camera."""

LEAST = 1e-6
"""A joint with a smaller range (rad or m) moves nothing."""

OFF = 2e-3
"""By how much (rad or m) a scene's limits may be off those of the object's URDF."""


@dataclass(frozen=True)
class JointState:
    """A joint of a scene, rad or m in UMPNet's world: its limits, where it is in the goal image and at the start."""

    lower: float
    upper: float
    goal: float
    start: float


@dataclass(frozen=True)
class Scene:
    """One of the table's scenes.

    Attributes:
        mode: "manipulation": the selected joint is to come from its start to its goal; "exploration": no goal.
        category: of the object.
        number: 0 to 99 among the scenes of this mode and category.
        object: the object's id.
        scale: metres in UMPNet's world of one metre of the object.
        height: of the object's base above the ground, m in UMPNet's world.
        orientation: of the base there, xyzw.
        selected: PyBullet's index of the joint to move; None in exploration.
        joints: the joints that may be moved, by PyBullet's index.
    """

    mode: Mode
    category: str
    number: int
    object: str
    scale: float
    height: float
    orientation: tuple[float, ...]
    selected: int | None
    joints: Mapping[int, JointState]

    @property
    def name(self) -> str:
        return f"{self.mode} {self.category} {self.number}"

    @property
    def ranges(self) -> float:
        """Range (rad or m) of the selected joint; infinite without one."""
        joint = None if self.selected is None else self.joints[self.selected]
        return math.inf if joint is None else joint.upper - joint.lower


def read_scenes(mode: Mode, path: Path = SCENES) -> list[Scene]:
    """The scenes of one mode, by category and number; without Toy, which is none of the project's categories.

    Raises:
        UserError: the file is missing or broken; names the scene.
    """
    try:
        table = json.loads(gzip.decompress(path.read_bytes()))
    except (OSError, EOFError, ValueError) as error:
        raise UserError(f"{path} is no table of UMPNet's scenes ({error})") from error
    if not isinstance(table, list):
        raise UserError(f"{path} is no table of UMPNet's scenes: it holds no list")
    found = [_scene(path, row) for row in table if not isinstance(row, dict) or row.get("category") != "Toy"]
    return sorted((s for s in found if s.mode == mode), key=lambda s: (s.category, s.number))


def _scene(path: Path, row: Any) -> Scene:
    try:
        scene = Scene(
            row["mode"], row["category"], row["number"], row["object"], float(row["scale"]),
            float(row["base_position"][2]), tuple(map(float, row["base_orientation_xyzw"])), row["selected_joint"],
            {int(k): JointState(*map(float, values)) for k, values in row["joints"].items()},
        )  # fmt: skip
        numbers = [scene.scale, scene.height, *scene.orientation]
        numbers += [x for j in scene.joints.values() for x in (j.lower, j.upper, j.goal, j.start)]
        goal = scene.mode != "manipulation" or scene.selected in scene.joints
        if not (np.isfinite(numbers).all() and scene.scale > 0 and len(scene.orientation) == 4 and goal):
            raise ValueError("a number is out of range")
        if any(not j.lower <= j.upper for j in scene.joints.values()):
            raise ValueError("a joint's lower limit is above its upper one")
    except (KeyError, ValueError, TypeError, IndexError, AttributeError) as error:
        raise UserError(f"{path}: a scene is broken ({error!r}): {str(row)[:100]}") from error
    return scene


def bullet_order(obj: ArticulatedObject) -> list[int]:
    """Links by PyBullet's joint index: each joint's child, depth first, in the order of the URDF's joints."""
    children: dict[int, list[int]] = {i: [] for i in range(-1, len(obj.links))}
    for i, link in enumerate(obj.links):
        children[link.parent].append(i)
    order, stack = [], children[children[-1][0]][::-1]
    while stack:
        order.append(stack.pop())
        stack += children[order[-1]][::-1]
    return order


@dataclass(frozen=True, eq=False)
class Placed:
    """A scene with its object, in the world of :mod:`fb3d_rl.camera.umpnet`: the object's own size, m.

    Attributes:
        scene: the scene.
        posed: the object, its base's pose and its joints' limits those of the scene.
        start: joint state [J] (rad or m) at the start.
        goal: joint state [J] of the goal image.
        joint: index of the selected joint in a joint state, -1 without one.
        movable: links that the scene lets one move.
    """

    scene: Scene
    posed: Posed
    start: NDArray[np.float64]
    goal: NDArray[np.float64]
    joint: int
    movable: tuple[int, ...]

    @property
    def link(self) -> int:
        """The selected joint's link, -1 without one."""
        return -1 if self.joint < 0 else self.posed.obj.movable[self.joint]

    @cached_property
    def towards_open(self) -> bool:
        """Whether the goal is more open than the start, by the project's rule of what is open."""
        j, posed = self.joint, self.posed
        return bool((self.goal[j] - self.start[j]) * (posed.opened[j] - posed.closed[j]) > 0)


def place(scene: Scene, obj: ArticulatedObject) -> Placed:
    """The object in its scene.

    Raises:
        UserError: the object has other joints than the scene.
    """
    order, s = bullet_order(obj), scene.scale
    links = list(obj.links)
    states = {}
    for index, joint in scene.joints.items():
        link = order[index] if 0 <= index < len(order) else -1
        if link not in obj.movable or obj.joint_of(link).type == "continuous":
            raise UserError(f"scene {scene.name}: object {obj.id} has no joint number {index} that moves within limits")
        kind = obj.joint_of(link)
        unit = s if kind.type == "prismatic" else 1.0
        limits = joint.lower / unit, joint.upper / unit
        if abs(np.subtract(limits, kind.limits)).max() > OFF / unit:  # the lids whose travel UMPNet has changed
            links[link] = replace(links[link], joint=replace(kind, limits=limits))
        states[link] = joint.start / unit, joint.goal / unit
    if any(new is not old for new, old in zip(links, obj.links, strict=True)):
        obj = replace(obj, links=tuple(links))
    posed = Posed(obj, CAMERA)
    posed.T_world_base = np.eye(4)
    posed.T_world_base[:3, :3] = TURN @ Rotation.from_quat(scene.orientation).as_matrix()
    posed.T_world_base[2, 3] = scene.height / s
    rest = np.clip(0.0, *obj.limits.T)
    start, goal = rest.copy(), rest.copy()
    for link, (begin, end) in states.items():
        start[obj.movable.index(link)], goal[obj.movable.index(link)] = begin, end
    selected = -1 if scene.selected is None else obj.movable.index(order[scene.selected])
    others = np.arange(len(goal)) != selected
    start[others] = goal[others]  # only the selected joint leaves the state of the goal image
    return Placed(scene, posed, start, goal, selected, tuple(states))


@dataclass(frozen=True)
class Left:
    """The scenes left out: counts by category of those whose object is missing, these objects, unmovable ones."""

    missing: Mapping[str, int]
    objects: tuple[str, ...]
    unmovable: tuple[str, ...]

    def sentences(self) -> list[str]:
        """What is to be said about them."""
        said = []
        if self.missing:
            counts = ", ".join(f"{name} {count}" for name, count in self.missing.items())
            total = sum(self.missing.values())
            said.append(f"{total} scenes are left out: {len(self.objects)} of their objects are missing ({counts})")
        said += [f"scene {name} counts as not movable: the selected joint has no range" for name in self.unmovable]
        return said


def sorted_out(scenes: Sequence[Scene], objects: Iterable[str]) -> tuple[list[Scene], Left]:
    """The scenes that can be run with objects of these ids, and which are left out.

    Raises:
        UserError: none is left.
    """
    known = set(objects)
    missing = [scene for scene in scenes if scene.object not in known]
    still = [scene for scene in scenes if scene.object in known and scene.ranges < LEAST]
    kept = [scene for scene in scenes if scene.object in known and scene.ranges >= LEAST]
    if not kept:
        raise UserError(
            "none of UMPNet's scenes has one of these objects; give a root that holds some of UMPNet's test objects"
        )
    counts = dict(sorted(Counter(scene.category for scene in missing).items()))
    return kept, Left(counts, tuple(sorted({s.object for s in missing})), tuple(scene.name for scene in still))


def stand_in(scene: Scene, obj: ArticulatedObject) -> Scene:
    """The scene with another object, such as a procedural one: as far open, with the same yaw, on the ground.

    The part is one that opens, by the scene's number; all others are closed. Shares of the range from closed to open
    are those of the scene's joint from its lower limit.

    Raises:
        UserError: the object has no part that opens.
    """
    posed, order = Posed(obj, CAMERA), bullet_order(obj)
    if not posed.openable:
        raise UserError(f"object {obj.id} has no part that opens, so it can stand in none of UMPNet's scenes")
    index = scene.selected if scene.selected is not None else min(scene.joints)
    told = scene.joints[index]
    joints = {}
    chosen = posed.openable[scene.number % len(posed.openable)]
    for link in posed.openable:
        j = obj.movable.index(link)
        unit = scene.scale if obj.joint_of(link).type == "prismatic" else 1.0
        closed, opened = unit * posed.closed[j], unit * posed.opened[j]
        shares = [(x - told.lower) / max(told.upper - told.lower, LEAST) for x in (told.goal, told.start)]
        goal, start = (float(closed + share * (opened - closed)) if link == chosen else closed for share in shares)
        joints[order.index(link)] = JointState(min(closed, opened), max(closed, opened), goal, start)
    front = Rotation.from_quat(scene.orientation).apply([-1.0, 0.0, 0.0])
    # At 90 degrees it faces the camera. Bases of their own that are turned by quarters do not count.
    askew = (math.degrees(math.atan2(front[1], front[0])) + 45.0) % 90.0 - 45.0
    turned = tuple(Rotation.from_euler("z", 90.0 + askew, degrees=True).as_quat().tolist())
    selected = None if scene.selected is None else order.index(chosen)
    height = float(posed.T_world_base[2, 3]) * scene.scale
    return replace(scene, object=obj.id, height=height, orientation=turned, selected=selected, joints=joints)
