"""A robot arm that carries a suction cup: what its URDF tells, forward kinematics and Jacobian.

Frames: the base is the URDF's root; the tip is the centre of the cup's opening, its z axis pointing out of the cup. A
joint state is in the order of :attr:`Arm.joints`, rad.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import torch
from defusedxml import ElementTree
from numpy.typing import NDArray
from torch import Tensor

from fb3d_rl.assets.articulation import ArticulatedObject, Joint, Link
from fb3d_rl.assets.partnet_mobility import named_errors
from fb3d_rl.errors import UserError
from fb3d_rl.geometry.transforms import axis_angle_to_matrix
from fb3d_rl.importer.files import Source
from fb3d_rl.importer.reading import FileReader
from fb3d_rl.kinematics.tree import KinematicTree
from fb3d_rl.robot.capsules import Capsule, enclosing_capsules

SAWYER = Path(__file__).with_name("sawyer.urdf")

CUP_RADIUS = 0.015
"""Of the suction cup, m: it measures 3 cm across (supplement I.A)."""

CUP_LENGTH = 0.14
"""From the arm's flange to the cup's opening, m."""

CUP: tuple[Capsule, ...] = (
    Capsule(np.array([[0.0, 0.0, -CUP_RADIUS], [0.0, 0.0, -0.06]]), CUP_RADIUS),
    Capsule(np.array([[0.0, 0.0, -0.09], [0.0, 0.0, -0.11]]), 0.035),
)
"""The cup on its tube, and the gripper's body behind it, in the tip's frame (our measures)."""

SPEED = 1.0
"""The most that is asked of any joint, rad/s, or its own limit where that is smaller. Rethink plans with this for the
wrist (sawyer_moveit_config's joint_limits.yaml, github.com/RethinkRobotics/sawyer_moveit at 0d9b20d)."""

ACCELERATION = 2.0
"""The same of accelerations, rad/s^2, from there; a URDF has none."""


@dataclass(frozen=True, eq=False)
class Arm:
    """An arm of J joints in a row.

    Attributes:
        name: what messages call it.
        urdf: the file that describes it.
        joints: the names of its joints, from the base on.
        tree: base, one link behind each joint, tip: J + 2 links, float64.
        lower: joint limits [J], rad.
        upper: likewise.
        velocity: the most that each joint can do [J], rad/s.
        home: a joint state [J] from which the workspace before the arm is in easy reach.
        links: the link of ``tree`` [K] that each body belongs to.
        ends: the ends of the bodies, which are capsules, in their links' frames [K, 2, 3], m.
        radii: their radii [K], m.
        tolerated: pairs of links of ``tree`` that are never held to be in collision.
    """

    name: str
    urdf: Path
    joints: tuple[str, ...]
    tree: KinematicTree
    lower: Tensor
    upper: Tensor
    velocity: Tensor
    home: Tensor
    links: NDArray[np.int64]
    ends: NDArray[np.float64]
    radii: NDArray[np.float64]
    tolerated: frozenset[tuple[int, int]] = frozenset()

    def forward(self, q: Tensor) -> Tensor:
        """T_base_link [..., J + 2, 4, 4] of base, links and tip at joint states [..., J]."""
        # What the tree does joint by joint, for the joints of a row at once: it is asked in every control step.
        axes, origins = self.tree.axes[1:-1], self.tree.origins
        q = q.to(axes)
        moved = origins[1:-1].expand(*q.shape, 4, 4).clone()
        moved[..., :3, :3] @= axis_angle_to_matrix(axes.expand(*q.shape, 3), q)
        poses = [origins[0].expand(*q.shape[:-1], 4, 4)]
        for own in moved.unbind(-3):
            poses.append(poses[-1] @ own)
        return torch.stack([*poses, poses[-1] @ origins[-1]], dim=-3)

    def tip(self, q: Tensor) -> Tensor:
        """T_base_tip [..., 4, 4] at joint states [..., J]."""
        return self.forward(q)[..., -1, :, :]

    def jacobian(self, q: Tensor) -> Tensor:
        """The Jacobian [..., 6, J] of the tip: velocity (m/s), then angular velocity (rad/s) in the base's axes."""
        return self.pose_and_jacobian(q)[1]

    def pose_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """T_base_tip [..., 4, 4] and the Jacobian [..., 6, J] at joint states [..., J]."""
        poses = self.forward(q)
        frames, tip = poses[..., 1:-1, :, :], poses[..., -1, :, :]
        axes = (frames[..., :3, :3] @ self.tree.axes[1:-1, :, None]).squeeze(-1)
        arms = tip[..., None, :3, 3] - frames[..., :3, 3]
        return tip, torch.cat([torch.linalg.cross(axes, arms), axes], dim=-1).mT

    def within(self, q: Tensor, slack: float = 1e-6) -> Tensor:
        """Whether joint states [..., J] keep the limits, [...] bool."""
        return ((q >= self.lower - slack) & (q <= self.upper + slack)).all(-1)


@cache
def sawyer() -> Arm:
    """Rethink's Sawyer with the suction cup on its hand."""
    home = (0.0, -1.9, 0.0, 2.0, 0.0, 1.47, 0.0)
    return load_arm(SAWYER, [f"right_j{i}" for i in range(7)], "right_hand", home=home)


@cache
def panda() -> Arm:
    """Franka's Panda, from mani-skill's files, with the suction cup in place of its hand."""
    spec = find_spec("mani_skill")
    if spec is None or spec.origin is None:
        raise UserError("the Panda is described by a file of mani-skill, which is not installed; use the Sawyer")
    urdf = Path(spec.origin).parent / "assets/robots/panda/panda_v2.urdf"
    home = (0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785)
    return load_arm(urdf, [f"panda_joint{i}" for i in range(1, 8)], "panda_link8", home=home)


@cache
def named_arm(name: str) -> Arm:
    """The arm of an option: sawyer, panda, URDF:FLANGE with all joints that turn the flange, or URDF:JOINT,...:FLANGE.

    Raises:
        UserError: the name is none of these, or the file holds no such arm.
    """
    if name in ("sawyer", "panda"):
        return sawyer() if name == "sawyer" else panda()
    urdf, *joints, flange = name.split(":") if name.count(":") in (1, 2) else ("", "")
    if not urdf:
        raise UserError(f"the arm {name} is unknown; choose sawyer or panda, or give URDF:FLANGE, the link of the cup")
    return load_arm(urdf, joints[0].split(",") if joints else None, flange)


def load_arm(
    urdf: str | Path,
    joints: Sequence[str] | None,
    tip: str,
    cup: Sequence[Capsule] = CUP,
    cup_length: float = CUP_LENGTH,
    home: Sequence[float] | None = None,
) -> Arm:
    """An arm that a URDF describes.

    Its bodies are capsules that enclose its collision shapes (a link without any: its visual ones). What the flange
    carries gives way to the cup; other joints stay at 0 or the limit nearest to it. A file of the same name beside it
    that ends in .srdf tells which links may touch each other.

    Args:
        urdf: the file.
        joints: the names of the joints that move the flange, from the base on; they turn. None for all that turn it.
        tip: the link that the cup is mounted on, the flange; the cup points along its z axis.
        cup: the bodies of cup and gripper, in the frame of the cup's opening.
        cup_length: from the flange to the cup's opening, m.
        home: the joint state to start from (rad); the middle of the limits unless given.

    Raises:
        UserError: the file cannot be read, or does not hold such an arm.
    """
    path = Path(urdf).expanduser()
    links, speeds = _read(path)
    moved, flange = _arm_links(links, joints, tip)
    names = [links.joint_of(i).name for i in moved]
    chain = _chain(links, moved, flange, cup_length)
    lower, upper = torch.as_tensor(chain.limits).unbind(-1)
    bodies = [(len(chain.links) - 1, capsule) for capsule in cup] + _bodies(links, moved, flange)
    return Arm(
        name=path.stem,
        urdf=path,
        joints=tuple(names),
        tree=KinematicTree.from_object(chain),
        lower=lower,
        upper=upper,
        velocity=torch.tensor([speeds.get(name) or np.inf for name in names], dtype=torch.float64),
        home=(lower + upper) / 2 if home is None else torch.tensor(home, dtype=torch.float64),
        links=np.array([link for link, _ in bodies]),
        ends=np.stack([capsule.ends for _, capsule in bodies]),
        radii=np.array([capsule.radius for _, capsule in bodies]),
        tolerated=_tolerated(links, moved),
    )


def _read(path: Path) -> tuple[ArticulatedObject, dict[str | None, float]]:
    """What a URDF describes, and the velocity limits (rad/s) of its joints that have one."""
    reader = FileReader(Source(path, path.stem, "unknown"))
    with named_errors(path.stem, path):
        links = ArticulatedObject(path.stem, "robot", path, reader.read()[0])
        limits = [(joint.get("name"), joint.find("limit")) for joint in reader.parse().iter("joint")]
    return links, {name: float(limit.get("velocity") or "inf") for name, limit in limits if limit is not None}


def _arm_links(obj: ArticulatedObject, joints: Sequence[str] | None, tip: str) -> tuple[list[int], int]:
    """The links behind an arm's joints and its flange, as indices."""
    names = [link.name for link in obj.links]
    if tip not in names:
        raise UserError(f"{obj.urdf} has no link {tip!r} to mount the cup on; it has {', '.join(names)}")
    flange = names.index(tip)
    way = [flange]
    while obj.links[way[0]].parent >= 0:
        way.insert(0, obj.links[way[0]].parent)
    movable = [i for i in way[1:] if obj.joint_of(i).movable]
    if joints is None:
        joints = [obj.joint_of(i).name for i in movable if obj.joint_of(i).type != "prismatic"]
    if not joints:
        raise UserError(f"{obj.urdf}: no joint turns {tip}")
    moved = [i for i in movable if obj.joint_of(i).name in joints]
    if [obj.joint_of(i).name for i in moved] != list(joints):
        here = ", ".join(obj.joint_of(i).name for i in movable) or "none"
        raise UserError(
            f"{obj.urdf}: the joints {', '.join(joints)} do not move {tip} in this order; those that do are {here}"
        )
    if any(obj.joint_of(i).type == "prismatic" for i in moved):
        raise UserError(f"{obj.urdf}: an arm's joints turn, but one of {', '.join(joints)} slides")
    return moved, flange


def _tolerated(obj: ArticulatedObject, moved: Sequence[int]) -> frozenset[tuple[int, int]]:
    """Pairs of links in the chain, the lower one first, between which the SRDF beside the URDF disables collisions."""
    srdf = obj.urdf.with_suffix(".srdf")
    if not srdf.is_file():
        return frozenset()
    place = {link.name: _place(obj, i, moved)[0] + 1 for i, link in enumerate(obj.links)}
    with named_errors(srdf.stem, srdf):
        named = [(pair.get("link1"), pair.get("link2")) for pair in ElementTree.parse(srdf).iter("disable_collisions")]
    pairs = [sorted((place[one], place[other])) for one, other in named if one in place and other in place]
    return frozenset((first, second) for first, second in pairs)


def _resting(joint: Joint) -> NDArray[np.float64]:
    """T_parent_link [4, 4] of a joint that stands at 0, or at its limit."""
    return joint.origin @ joint.motion(float(np.clip(0.0, *joint.limits)))


def _place(obj: ArticulatedObject, link: int, moved: Sequence[int]) -> tuple[int, NDArray[np.float64]]:
    """The link among ``moved`` (position; -1 for the root) that carries ``link``, and where it stands in its frame."""
    pose = np.eye(4)
    while link not in moved and (joint := obj.links[link].joint) is not None:
        pose = _resting(joint) @ pose
        link = obj.links[link].parent
    return (list(moved).index(link) if link in moved else -1), pose


def _chain(obj: ArticulatedObject, moved: Sequence[int], flange: int, cup_length: float) -> ArticulatedObject:
    """Base, the moved links and the tip as an object of their own: all between is fixed."""
    chain = [Link("base", "", -1, None, (), ())]
    for position, i in enumerate(moved):
        joint = obj.joint_of(i)
        limits = joint.limits if np.isfinite(joint.limits).all() else (-np.pi, np.pi)
        origin = _place(obj, obj.links[i].parent, moved)[1] @ joint.origin
        chain.append(
            Link(obj.links[i].name, "", position, Joint(joint.name, "revolute", origin, joint.axis, limits), (), ())
        )
    origin = _place(obj, flange, moved)[1]
    origin = origin @ np.block([[np.eye(3), np.array([[0.0], [0.0], [cup_length]])], [np.zeros((1, 3)), 1.0]])
    chain.append(Link("tip", "", len(moved), Joint("tip", "fixed", origin, np.zeros(3), (0.0, 0.0)), (), ()))
    return ArticulatedObject(obj.id, obj.category, obj.urdf, tuple(chain))


def _bodies(obj: ArticulatedObject, moved: Sequence[int], flange: int) -> list[tuple[int, Capsule]]:
    """Capsules around the shapes of all links but those that the flange carries, with their link in the chain."""
    bodies = []
    for i, link in enumerate(obj.links):
        if i != flange and i in obj.descendants(flange):
            continue
        carrier, pose = _place(obj, i, moved)
        for mesh in link.collisions or link.visuals:
            for capsule in enclosing_capsules(mesh):
                bodies.append((carrier + 1, Capsule(capsule.ends @ pose[:3, :3].T + pose[:3, 3], capsule.radius)))
    return bodies
