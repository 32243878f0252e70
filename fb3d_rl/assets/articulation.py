"""What an articulated object is: links with meshes, joined in a tree.

The frames of PartNet-Mobility's URDF files are kept. Every link has one joint to its parent, the root's being
``None``; links are stored parents first, so one pass over the arrays walks the tree.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

JointType = Literal["revolute", "continuous", "prismatic", "fixed"]


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh in its link's frame. Shapes: vertices [V, 3] m, faces [F, 3] int."""

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]


class Mimic(NamedTuple):
    """How a joint follows another one: its position is ``multiplier`` times the other's plus ``offset`` (rad or m)."""

    joint: str
    multiplier: float
    offset: float


@dataclass(frozen=True, eq=False)
class Joint:
    """The joint that carries a link.

    Attributes:
        name: the URDF's name.
        type: "revolute", "continuous", "prismatic" or "fixed".
        origin: T_parent_joint [4, 4] at joint position 0.
        axis: unit axis [3] in the joint's frame (zero for a fixed joint).
        limits: (lower, upper) rad or m; infinite for a continuous joint, (0, 0) for a fixed one.
        mimic: the joint that this one follows, which itself follows none; None for a joint that moves by itself.
    """

    name: str
    type: JointType
    origin: NDArray[np.float64]
    axis: NDArray[np.float64]
    limits: tuple[float, float]
    mimic: Mimic | None = None

    @property
    def movable(self) -> bool:
        return self.type != "fixed"

    def motion(self, position: float) -> NDArray[np.float64]:
        """T_joint_link [4, 4]: where the joint's link stands in the joint's frame at a position (rad or m)."""
        moved = np.eye(4)
        if self.type == "prismatic":
            moved[:3, 3] = position * self.axis
        elif self.movable:
            moved[:3, :3] = Rotation.from_rotvec(position * self.axis).as_matrix()
        return moved


@dataclass(frozen=True, eq=False)
class Link:
    """A rigid part: its name, semantic name ("door", "drawer", ...), parent's index (-1: root), joint and meshes."""

    name: str
    semantic: str
    parent: int
    joint: Joint | None
    visuals: tuple[Mesh, ...]
    collisions: tuple[Mesh, ...]


@dataclass(frozen=True, eq=False)
class ArticulatedObject:
    """An object: its id, category, folder's URDF file and links (parents first).

    ``dropped`` are the remarks of its reader (names that are missing, limits that were swapped, ...), of which ``lost``
    are those on geometry that the object's files describe and ``links`` do not hold; ``content`` is a digest of the
    files that it was read from, "" for an object that was made in memory.
    """

    id: str
    category: str
    urdf: Path
    links: tuple[Link, ...]
    dropped: tuple[str, ...] = ()
    lost: tuple[str, ...] = ()
    content: str = ""

    @cached_property
    def movable(self) -> tuple[int, ...]:
        """Indices of the links with a joint that moves by itself; position k of a joint state [J] is ``movable[k]``'s.

        Joints that follow another one have no position of their own in a joint state (:attr:`followers`).
        """
        return tuple(
            i
            for i, link in enumerate(self.links)
            if link.joint is not None and link.joint.movable and not link.joint.mimic
        )

    @cached_property
    def followers(self) -> dict[int, int]:
        """Link whose joint follows another one -> the link of that one, which is among :attr:`movable`."""
        owner = {self.joint_of(i).name: i for i in self.movable}
        return {
            i: owner[link.joint.mimic.joint]
            for i, link in enumerate(self.links)
            if link.joint is not None and link.joint.mimic is not None
        }

    @cached_property
    def limits(self) -> NDArray[np.float64]:
        """Joint limits [J, 2] in the order of :attr:`movable`."""
        return np.array([self.joint_of(i).limits for i in self.movable], dtype=np.float64).reshape(-1, 2)

    def joint_of(self, link: int) -> Joint:
        """The joint of a link that is not the root."""
        joint = self.links[link].joint
        if joint is None:
            raise ValueError(f"link {self.links[link].name} of {self.id} is the root and has no joint")
        return joint

    def index(self, name: str) -> int:
        """Index of the link called ``name``."""
        for i, link in enumerate(self.links):
            if link.name == name:
                return i
        raise KeyError(f"{self.id} has no link {name!r}")

    def descendants(self, link: int) -> tuple[int, ...]:
        """The link itself and all links that move with it: that it carries, or whose joints follow one of these."""
        carried = {link}
        for i, other in enumerate(self.links):
            if other.parent in carried:
                carried.add(i)
        while led := {i for i, leader in self.followers.items() if leader in carried} - carried:
            carried |= {j for i in led for j in self.descendants(i)}
        return tuple(sorted(carried))
