"""What of an object can be opened, and which way: closed and open joint states, openable parts, standing height."""

from __future__ import annotations

import itertools
from collections.abc import Iterable

import numpy as np
import torch
from numpy.typing import NDArray

from fb3d_rl.assets.articulation import ArticulatedObject, Link
from fb3d_rl.kinematics.tree import KinematicTree

CONTROLS = frozenset(
    "button knob lever lock wheel foot_pad handle pump_lid rotation_tray translation_tray tray shelf caster "
    "switch slider toggle_button toggle regulator cover_switch hinge_knob".split()
)
"""Semantic names of parts that are turned, pressed or lie inside, but are not what one opens an object by."""

LARGEST = 20.0
"""An object with a larger diagonal (m) is not in metres."""

MIN_TRAVEL = 0.015
"""A part whose farthest point moves less (m) over its joint's range opens nothing."""

MIN_ANGLE = 0.1
"""A revolute joint with a smaller range (rad) opens nothing."""

PARTLY_OPEN = frozenset({"Door", "Box", "Table", "Phone", "Bucket"})
"""Categories that start 20 % open in the reference protocol; all others start closed."""


def link_corners(link: Link) -> NDArray[np.float64]:
    """Corners [8, 3] of the link's bounding box in its own frame; [0, 3] for a link without a mesh."""
    vertices = [mesh.vertices for mesh in link.visuals]
    if not vertices:
        return np.zeros((0, 3))
    stacked = np.concatenate(vertices)
    bounds = np.stack([stacked.min(0), stacked.max(0)])
    return np.array([[bounds[c[i], i] for i in range(3)] for c in itertools.product((0, 1), repeat=3)])


def _bounds(
    obj: ArticulatedObject, tree: KinematicTree, qpos: NDArray[np.float64], links: Iterable[int]
) -> NDArray[np.float64]:
    """Bounds [2, 3] of the vertices of ``links`` in the base frame at joint state ``qpos`` [J]."""
    poses = tree.forward(torch.as_tensor(qpos)).numpy()
    points = [mesh.vertices @ poses[i, :3, :3].T + poses[i, :3, 3] for i in links for mesh in obj.links[i].visuals]
    stacked = np.concatenate(points) if points else np.zeros((1, 3))
    return np.stack([stacked.min(0), stacked.max(0)])


def opening_range(obj: ArticulatedObject) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Closed and open joint states, each [J] (rad or m).

    The lower limit is closed and the upper one open, as in the reference's protocol. Some joints point the other
    way: their model rests at 0, the *upper* limit. There the end at which the part and the object's body have the
    smaller bounding box is the closed one (a laptop folds, a door lies in its frame); where both are alike (a sash
    that slides in its frame) it is the pose in which the object was modelled. A joint without finite limits has no
    range: both states are 0.
    """
    lower, upper = obj.limits[:, 0].copy(), obj.limits[:, 1].copy()
    endless = ~(np.isfinite(lower) & np.isfinite(upper))
    lower[endless], upper[endless] = 0.0, 0.0
    rest = np.clip(np.zeros_like(lower), lower, upper)
    tree = KinematicTree.from_object(obj)
    closed, opened = lower.copy(), upper.copy()
    for j in np.flatnonzero((np.abs(upper) < 1e-3) & (lower < -1e-3)):
        moves = tree.descendants.numpy()
        others = moves[~moves[:, obj.movable[j]]]  # joints that do not carry the part
        alone = np.flatnonzero(~others.any(0))
        folded, modelled = rest.copy(), rest.copy()
        folded[j], modelled[j] = lower[j], upper[j]
        volumes = [np.prod(np.diff(_bounds(obj, tree, qpos, alone), axis=0)) for qpos in (folded, modelled)]
        if volumes[1] < 1.02 * volumes[0]:
            closed[j], opened[j] = upper[j], lower[j]
    return closed, opened


def _rigid(obj: ArticulatedObject, link: int) -> set[int]:
    """The link and all that is fixed to it."""
    fixed = {link}
    for i in obj.descendants(link):
        if obj.links[i].parent in fixed and not obj.joint_of(i).movable:
            fixed.add(i)
    return fixed


def travel(obj: ArticulatedObject, joint: int) -> float:
    """Upper bound (m) of how far a point of joint ``joint``'s part moves over the joint's range.

    Of joints that follow it, the one that moves its part farthest counts.
    """
    link = obj.movable[joint]
    moving = [link, *(follower for follower, leader in obj.followers.items() if leader == link)]
    return max(_travel(obj, each) for each in moving)


def _travel(obj: ArticulatedObject, link: int) -> float:
    lower, upper = obj.joint_of(link).limits
    if not np.isfinite([lower, upper]).all():
        return 0.0
    if obj.joint_of(link).type == "prismatic":
        return float(upper - lower)
    poses = KinematicTree.from_object(obj).forward(torch.zeros(len(obj.movable))).numpy()
    to_link = np.linalg.inv(poses[link])
    radius = 0.0
    for carried in _rigid(obj, link):
        pose = to_link @ poses[carried]
        corners = link_corners(obj.links[carried]) @ pose[:3, :3].T + pose[:3, 3]
        radius = max(radius, np.linalg.norm(np.cross(corners, obj.joint_of(link).axis), axis=-1).max(initial=0.0))
    return float(radius * min(upper - lower, np.pi))


def openable_links(obj: ArticulatedObject) -> list[int]:
    """Links (indices) that one opens: doors, drawers, lids, screens, seats, sashes ...

    A part counts if its joint slides or turns between finite limits, and moves far enough to matter. Controls and
    inner parts (buttons, knobs, trays, ...) count only on objects that have nothing else, such as a switch, or a
    bucket with its handle.
    """
    candidates = []
    for j, link in enumerate(obj.movable):
        joint = obj.joint_of(link)
        lower, upper = joint.limits
        turns_enough = joint.type == "prismatic" or upper - lower >= MIN_ANGLE
        if joint.type in ("revolute", "prismatic") and turns_enough and travel(obj, j) >= MIN_TRAVEL:
            candidates.append(link)
    parts = [link for link in candidates if obj.links[link].semantic not in CONTROLS]
    return parts or candidates


def start_fraction(category: str) -> float:
    """How far the part to open is open at the start (fraction of its range), by the reference protocol."""
    return 0.2 if category in PARTLY_OPEN else 0.0


def standing_pose(obj: ArticulatedObject) -> NDArray[np.float64]:
    """T_world_base [4, 4] that stands the closed object on the ground z = 0, its base's x and y kept."""
    pose = np.eye(4)
    pose[2, 3] = -_closed_bounds(obj)[0, 2]
    return pose


def standing_bounds(obj: ArticulatedObject) -> NDArray[np.float64]:
    """World bounds [2, 3] (m) of the closed object on the ground, as :func:`standing_pose` places it."""
    bounds = _closed_bounds(obj)
    bounds[:, 2] -= bounds[0, 2]
    return bounds


def _closed_bounds(obj: ArticulatedObject) -> NDArray[np.float64]:
    closed, _ = opening_range(obj)
    return _bounds(obj, KinematicTree.from_object(obj), closed, range(len(obj.links)))
