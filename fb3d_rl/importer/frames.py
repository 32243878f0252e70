"""The units and axes of a foreign object: metres, z up, the front facing -x as in PartNet-Mobility."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray

from fb3d_rl.assets.articulation import ArticulatedObject, Joint, Link, Mesh, Mimic
from fb3d_rl.assets.options import UNITS
from fb3d_rl.kinematics.opening import LARGEST, link_corners, openable_links, opening_range, standing_bounds
from fb3d_rl.kinematics.tree import KinematicTree

UNIT_NAMES = {"m": "metres", "mm": "millimetres", "cm": "centimetres", "inch": "inches"}

ACROSS = (0.2, 5.0)
"""Furniture and appliances measure from so much to so much across, m."""

BOARD = (0.01, 0.03)
"""Their boards are from so much to so much thick, m."""

FLAT = 0.2
"""A board is thinner than this share of its width."""

FITS = 2.0
"""A part does not slide farther than so many times the object's size."""

ALONG = 0.5
"""The horizontal share of a part's motion from which on it opens towards a side, and not upwards."""

START = 0.1
"""A part opens towards where it moves over the first so much (a share) of its range."""

OUTSIDE = 0.05
"""By how much (a share of the object's size) a sliding part leaves the object when it opens out of it."""

TURNS = {"-x": 0, "+y": 1, "+x": 2, "-y": 3}
"""Quarter turns about z, counter-clockwise, that bring a front to -x."""


@dataclass(frozen=True)
class Frame:
    """In which units and axes files are.

    Attributes:
        scale: metres in one of the file's units; "auto" recognises them (:func:`unit_of`).
        up: the axis that points up.
        front: where the object's front faces once z is up; "auto" is where its parts open to.
    """

    scale: float | Literal["auto"] = "auto"
    up: Literal["z", "y"] = "z"
    front: Literal["auto", "-x", "+x", "-y", "+y"] = "auto"


def in_metres(obj: ArticulatedObject, scale: float | Literal["auto"]) -> ArticulatedObject:
    """The object in metres, with a remark if that changed it."""
    if not any(link.visuals for link in obj.links):
        return obj
    size, remarks, own = _size(obj), [], dict[str, float]()
    if scale == "auto":
        unit, said = unit_of(obj, size)
        scale = UNITS[unit]
        own = _other_units(obj, size, scale)
        if said:
            remarks.append(said)
        remarks += [
            f"limits of joint {name}: taken as {'metres' if factor == 1.0 else 'millimetres'}, as they fit the object"
            for name, factor in own.items()
        ]
    elif scale != 1.0:
        remarks.append(f"lengths: {scale:g} times those of the file")
    if scale == 1.0 and not own:
        return replace(obj, dropped=(*obj.dropped, *remarks)) if remarks else obj
    return replace(scaled(obj, scale, own), dropped=(*obj.dropped, *remarks))


def unit_of(obj: ArticulatedObject, size: float) -> tuple[str, str]:
    """The unit of an object of this ``size`` across, a key of ``UNITS``, and what is to be said about it ("": nothing).

    Up to 20 it is the metre. Above, it is the one in which the object would be as large as furniture and appliances
    are: from 200 on millimetres, as CAD has them; below, centimetres, or inches where these alone make boards of it.
    Another one that would fit is named.
    """
    fits = [name for name, unit in UNITS.items() if name != "m" and ACROSS[0] <= unit * size <= ACROSS[1]]
    if size <= LARGEST:
        unit, fits = "m", fits if size > ACROSS[1] else []
    elif "mm" in fits or not fits:
        unit = "mm"
    else:
        thick = _thickness(obj)
        boards = [name for name in fits if BOARD[0] <= UNITS[name] * thick <= BOARD[1]]
        unit = (boards or fits)[0]
    others = [f"{UNIT_NAMES[name]} ({UNITS[name] * size:.2g} m): scale={name}" for name in fits if name != unit]
    if unit == "m" and not others:
        return unit, ""
    said = f"lengths: the object measures {size:.4g} across, so they are taken as {UNIT_NAMES[unit]}"
    if others:
        said += f" ({UNITS[unit] * size:.2g} m), but may be {' or '.join(others)}"
    return unit, said


def _thickness(obj: ArticulatedObject) -> float:
    """How thick the object's boards are: the middle one of its flat shapes; NaN if it has none."""
    sides = [np.sort(np.ptp(mesh.vertices, axis=0)) for link in obj.links for mesh in link.visuals]
    flat = [float(side[0]) for side in sides if side[0] < FLAT * side[1]]
    return float(np.median(flat)) if flat else math.nan


def _other_units(obj: ArticulatedObject, size: float, scale: float) -> dict[str, float]:
    """Sliding joint -> the factor of its limits, where that is not the object's ``scale``: they fit in other units."""
    travels = {joint.name: joint.limits[1] - joint.limits[0] for joint in map(obj.joint_of, obj.movable)
               if joint.type == "prismatic"}  # fmt: skip
    if scale == 1.0:
        return {name: UNITS["mm"] for name, travel in travels.items() if travel > LARGEST and travel > FITS * size}
    return {name: 1.0 for name, travel in travels.items() if 0.0 < travel <= FITS * scale * size}


def _size(obj: ArticulatedObject) -> float:
    return float(np.linalg.norm(np.diff(standing_bounds(obj), axis=0)))


def scaled(obj: ArticulatedObject, factor: float, own: Mapping[str, float]) -> ArticulatedObject:
    """The object ``factor`` times as large; ``own`` has the factors of the limits of sliding joints that differ."""
    slides = {link.joint.name for link in obj.links if link.joint is not None and link.joint.type == "prismatic"}
    known: dict[int, Mesh] = {}

    def mesh(old: Mesh) -> Mesh:
        return known.setdefault(id(old), Mesh(factor * old.vertices, old.faces))

    def joint(old: Joint | None) -> Joint | None:
        if old is None:
            return None
        origin = old.origin.copy()
        origin[:3, 3] *= factor
        unit = own.get(old.name, factor) if old.type == "prismatic" else 1.0
        mimic = old.mimic
        if mimic is not None:
            per = own.get(mimic.joint, factor) if mimic.joint in slides else 1.0
            mimic = Mimic(mimic.joint, mimic.multiplier * unit / per, mimic.offset * unit)
        return replace(old, origin=origin, limits=(unit * old.limits[0], unit * old.limits[1]), mimic=mimic)

    links = tuple(
        replace(link, joint=joint(link.joint), visuals=tuple(map(mesh, link.visuals)),
                collisions=tuple(map(mesh, link.collisions)))
        for link in obj.links
    )  # fmt: skip
    return replace(obj, links=links)


def upright(obj: ArticulatedObject, up: str, front: str) -> ArticulatedObject:
    """The object with z up and its front facing -x, on a further root link if it has to be turned for that."""
    turn = np.eye(4)
    if up == "y":
        turn[1:3, 1:3] = [[0.0, -1.0], [1.0, 0.0]]
        obj = _on_base(obj, turn, "axes: y pointed up, now z does")
    if front == "auto":
        front = front_of(obj) or "-x"
    quarters = TURNS[front]
    if not quarters:
        return obj
    cos, sin = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))[quarters]
    turn = np.eye(4)
    turn[:2, :2] = [[cos, -sin], [sin, cos]]
    return _on_base(obj, turn, f"axes: the front faced {front}, now it faces -x")


def _on_base(obj: ArticulatedObject, turn: NDArray[np.float64], remark: str) -> ArticulatedObject:
    """The object fixed to a new root link, on which it is turned by T_base_object [4, 4]."""
    root, *others = obj.links
    names = {link.name for link in obj.links} | {link.joint.name for link in others if link.joint is not None}
    if not root.visuals and not root.collisions and others and all(link.parent for link in others[1:]):
        first = others[0].joint  # the root only carries: its joint is turned, as in PartNet-Mobility
        if first is not None and not first.movable:
            carried = replace(others[0], joint=replace(first, origin=turn @ first.origin))
            return replace(obj, links=(root, carried, *others[1:]), dropped=(*obj.dropped, remark))
    number = next(k for k in range(len(names) + 1) if f"base_{k}" not in names)
    fixed = Joint(f"base_{number}", "fixed", turn, np.zeros(3), (0.0, 0.0))
    links = (
        Link(f"base_{number}", "", -1, None, (), ()),
        *(replace(link, parent=link.parent + 1, joint=link.joint or fixed) for link in obj.links),
    )
    return replace(obj, links=links, dropped=(*obj.dropped, remark))


def front_of(obj: ArticulatedObject) -> str | None:
    """Where an object's parts open to, a key of :data:`TURNS`; None if nothing tells.

    Doors and drawers tell by their motion, lids by the side that is opposite their hinge, and what slides within the
    object, such as a sash, by the side of the object that it lies on.
    """
    tree = KinematicTree.from_object(obj)
    closed, opened = opening_range(obj)
    votes: defaultdict[str, float] = defaultdict(float)

    def corners(link: int, share: float) -> NDArray[np.float64]:
        state = closed.copy()
        j = obj.movable.index(link)
        state[j] += share * (opened[j] - closed[j])
        poses = tree.forward(torch.as_tensor(state)).numpy()
        placed = [link_corners(obj.links[i]) @ poses[i, :3, :3].T + poses[i, :3, 3] for i in obj.descendants(link)]
        return np.concatenate(placed)

    bounds = standing_bounds(obj)
    for link in openable_links(obj):
        rest = corners(link, 0.0)
        motion = (corners(link, START) - rest).mean(0)
        towards, weight = motion[:2] / max(float(np.linalg.norm(motion)), 1e-9), 1.0
        if np.linalg.norm(towards) < ALONG:
            if obj.joint_of(link).type == "prismatic":
                continue
            hinge = tree.forward(torch.as_tensor(closed))[link].numpy()
            axis, arm = hinge[:3, :3] @ obj.joint_of(link).axis, rest.mean(0) - hinge[:3, 3]
            towards, weight = (arm - (arm @ axis) * axis)[:2], 0.5
        elif obj.joint_of(link).type == "prismatic" and not _leaves(corners(link, 1.0), bounds):
            thin = np.ptp(rest[:, :2], axis=0).argmin()
            towards, weight = np.zeros(2), 0.5
            towards[thin] = rest[:, thin].mean() - bounds[:, thin].mean()
        axis_number = int(np.abs(towards).argmax())
        if abs(towards[axis_number]) > 1e-6:
            votes[("-" if towards[axis_number] < 0 else "+") + "xy"[axis_number]] += weight
    best = max(votes.values(), default=0.0)
    return next((name for name in TURNS if votes[name] == best), None) if votes else None


def _leaves(points: NDArray[np.float64], bounds: NDArray[np.float64]) -> bool:
    """Whether points [P, 3] lie beside the box [2, 3]."""
    slack = OUTSIDE * math.dist(bounds[0], bounds[1])
    low, high = points[:, :2].min(0), points[:, :2].max(0)
    return bool((low < bounds[0, :2] - slack).any() or (high > bounds[1, :2] + slack).any())
