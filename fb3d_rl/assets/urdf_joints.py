"""The joints of a description as people write them: defaults of what is missing, degrees, joints that follow others."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from fb3d_rl.assets.articulation import Joint, Link, Mimic

FARTHEST = 1e4
"""Largest coordinate (m) that is accepted; a limit of a sliding joint (m) beyond it counts as infinite."""

FASTENED = ("planar", "floating")
"""URDF's joint types of several degrees of freedom, which are read as fixed."""

DEGREES = (4 * math.pi, 720.0)
"""Limits of a turning joint above the first (two turns) are degrees, not rad; above the second they are infinite."""

TURN = math.pi / 2
"""The range (rad) of a turning joint whose file names no finite one."""

Limits = tuple[float, float]


def sensible(joint: Joint, say: Callable[[str], None]) -> Joint:
    """The joint with its limits in order and in rad; limits beyond measure become infinite.

    Args:
        joint: a revolute or prismatic joint with the limits of its file.
        say: takes a remark.
    """
    lower, upper = joint.limits
    if lower > upper:
        say(f"limits of joint {joint.name}: lower above upper, swapped")
        lower, upper = upper, lower
    turns = joint.type == "revolute"
    largest = max((abs(end) for end in (lower, upper) if math.isfinite(end)), default=0.0)
    if turns and DEGREES[0] < largest <= DEGREES[1]:
        say(f"limits of joint {joint.name}: {lower:g} to {upper:g}, taken as degrees")
        lower, upper = math.radians(lower), math.radians(upper)
    most = DEGREES[1] if turns else FARTHEST
    return replace(
        joint, limits=(lower if abs(lower) <= most else -math.inf, upper if abs(upper) <= most else math.inf)
    )


def bounded(joint: Joint, length: Callable[[], float], say: Callable[[str], None]) -> Joint:
    """The joint with the default range where an end of it is infinite: from the end that is known, else from 0.

    Args:
        joint: a revolute or prismatic joint.
        length: gives the length (m) of the joint's part along the axis, the range of a sliding joint.
        say: takes a remark.
    """
    lower, upper = joint.limits
    if math.isfinite(lower) and math.isfinite(upper):
        return joint
    span = TURN if joint.type == "revolute" else length()
    if math.isfinite(upper):
        lower = upper - span
    else:
        lower = lower if math.isfinite(lower) else 0.0
        upper = lower + span
    range_ = f"{math.degrees(lower):g} to {math.degrees(upper):g} degrees"
    if joint.type == "prismatic":
        range_ = f"{lower:.3g} to {upper:.3g} m, the part's length"
    say(f"limits of joint {joint.name}: missing or infinite, taken as {range_}")
    return replace(joint, limits=(lower, upper))


def followed(
    joints: Mapping[str, tuple[str, Joint]], fail: Callable[[str], NoReturn], say: Callable[[str], None]
) -> dict[str, tuple[str, Joint]]:
    """The joints, each with the one that moves it in the end: a follower of a follower follows the first of them.

    Args:
        joints: child -> (parent, joint), as the file has them.
        fail: raises a UserError that says what is wrong.
        say: takes a remark.

    Raises:
        UserError: joints follow each other in a circle.
    """
    by_name = {joint.name: joint for _, joint in joints.values()}

    def resolved(joint: Joint) -> Joint:
        multiplier, offset, seen, leader = 1.0, 0.0, {joint.name}, joint
        while leader.mimic is not None:
            offset += multiplier * leader.mimic.offset
            multiplier *= leader.mimic.multiplier
            name = leader.mimic.joint
            if name in seen:
                fail(f"joint {joint.name} follows itself (mimic)")
            if name not in by_name:
                say(f"joint {joint.name}: is to mimic {name}, which is no joint; it moves by itself")
                return replace(joint, mimic=None)
            seen.add(name)
            leader = by_name[name]
        if leader is joint:
            return joint
        if not leader.movable or multiplier == 0.0:
            say(f"joint {joint.name}: mimics {leader.name} without ever moving; fixed at {offset:g}")
            return held(joint, offset)
        say(f"joint {joint.name}: moves along with {leader.name} (mimic, {multiplier:g} times it plus {offset:g})")
        return replace(joint, mimic=Mimic(leader.name, multiplier, offset))

    return {
        child: (parent, resolved(joint) if joint.movable and joint.mimic else replace(joint, mimic=None))
        for child, (parent, joint) in joints.items()
    }


def held(joint: Joint, position: float) -> Joint:
    """The joint as a fixed one at a position (rad or m)."""
    return replace(
        joint, type="fixed", origin=joint.origin @ joint.motion(position), axis=0.0 * joint.axis,
        limits=(0.0, 0.0), mimic=None,
    )  # fmt: skip


def limited(links: Sequence[Link], say: Callable[[str], None]) -> tuple[Link, ...]:
    """The links (parents first) with usable limits of their joints, which are those of the file before.

    Args:
        links: the links.
        say: takes a remark.
    """

    def usable(i: int, link: Link) -> Link:
        if link.joint is None or link.joint.mimic or link.joint.type not in ("revolute", "prismatic"):
            return link
        joint = sensible(link.joint, say)
        return replace(link, joint=bounded(joint, lambda: _length(links, i, joint.axis), say))

    return led(map(usable, range(len(links)), links))


def _length(links: Sequence[Link], link: int, axis: NDArray[np.float64]) -> float:
    """The length (m) along an axis [3] of a link with all that is fixed to it; 0 if none of them has a mesh."""
    placed, along = {link: np.eye(4)}, []
    for i, part in enumerate(links):
        if part.parent in placed and part.joint is not None and not part.joint.movable:
            placed[i] = placed[part.parent] @ part.joint.origin
        if i in placed:
            along += [(mesh.vertices @ placed[i][:3, :3].T + placed[i][:3, 3]) @ axis for mesh in part.visuals]
    return float(np.ptp(np.concatenate(along))) if along else 0.0


def led(links: Iterable[Link]) -> tuple[Link, ...]:
    """The links, with the limits of each joint that follows another one: where the other's limits take it."""
    links = tuple(links)
    limits = {link.joint.name: link.joint.limits for link in links if link.joint is not None and not link.joint.mimic}

    def taken_along(link: Link) -> Link:
        if link.joint is None or link.joint.mimic is None:
            return link
        leader, multiplier, offset = link.joint.mimic
        lower, upper = sorted(multiplier * end + offset for end in limits[leader])
        return replace(link, joint=replace(link.joint, limits=(lower, upper)))

    return tuple(map(taken_along, links))
