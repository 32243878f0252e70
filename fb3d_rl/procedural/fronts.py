"""Panels, handles, hinged doors and drawers: what the front of a cabinet is made of."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from fb3d_rl.procedural.shapes import Piece, Range, Vector, around, box, rod
from fb3d_rl.procedural.spec import Part

Side = Literal["left", "right", "bottom", "top"]
OPPOSITE: dict[Side, Side] = {"left": "right", "right": "left", "bottom": "top", "top": "bottom"}
# Hinge axes about which a panel in front of the body turns outwards (towards +z) for positive angles.
HINGE_AXIS: dict[Side, Vector] = {"left": (0, -1, 0), "right": (0, 1, 0), "bottom": (1, 0, 0), "top": (-1, 0, 0)}


BEHIND = 0.0015
"""How far (m) a door may swing behind its closed back face."""


@dataclass(frozen=True)
class HandleStyle:
    """How an object's handles look; lengths in metres.

    Attributes:
        kind: "bar" on two posts, "knob", "lip" along the panel's free edge, "recessed" (a grip hollowed out of the
            panel), or "none".
        reach: How far the handle stands out of the panel.
        thickness: Of the bar or lip; a knob is twice as wide, a recessed grip four times.
        length: Of the bar, lip or grip, as a fraction of the panel's side that it runs along.
        inset: Distance of the handle's middle from the panel's free edge.
        shift: Where along the free edge the handle sits, from -1 to 1.
        round: Whether bars are rods rather than square.
    """

    kind: Literal["bar", "knob", "lip", "recessed", "none"]
    reach: float
    thickness: float
    length: float
    inset: float
    shift: float
    round: bool


@dataclass(frozen=True)
class FrontStyle:
    """How the panels of one object look.

    Attributes:
        handle: Handles.
        thickness: Panel thickness, m.
        rail: Width of the frame around a recessed field, m; 0 for a flat panel.
        recess: How deep the field lies, as a fraction of the thickness, below 0.5 where handles are rooted.
        setback: How far a hinge's axis lies inside the door's edge, as a fraction of what is possible.
    """

    handle: HandleStyle
    thickness: float
    rail: float
    recess: float
    setback: float = 0.0


def draw_handle(rng: np.random.Generator, bare: float = 0.12) -> HandleStyle:
    """A random handle style; with probability `bare` there is no handle."""
    rest = 1 - bare
    kinds, shares = ["bar", "knob", "lip", "recessed"], np.array([0.5, 0.25, 0.13, 0.12])
    kind = rng.choice([*kinds, "none"], p=[*rest * shares, bare])
    return HandleStyle(
        kind=kind,
        reach=rng.uniform(0.035, 0.085),
        thickness=rng.uniform(0.014, 0.032),
        length=rng.uniform(0.2, 0.75),
        inset=rng.uniform(0.035, 0.08),
        shift=rng.uniform(-0.6, 0.6),
        round=bool(rng.random() < 0.5),
    )


def draw_front(rng: np.random.Generator, thickness: Range, bare: float = 0.12, framed: float = 0.4) -> FrontStyle:
    """A random front style; panels have a frame with probability `framed`."""
    rail = rng.uniform(0.03, 0.07) if rng.random() < framed else 0.0
    return FrontStyle(draw_handle(rng, bare), rng.uniform(*thickness), rail, rng.uniform(0.2, 0.45), rng.random())


def handle(style: HandleStyle, x: Range, y: Range, z: Range, edge: Side | None) -> list[Piece]:
    """Pieces of a handle on the panel x, y, z, near its free edge, or in its middle if edge is None.

    The handle stays within the panel's outline, so that it never meets a neighbour, and is rooted half-way
    into the panel, so that it also holds on a recessed field.
    """
    if style.kind in ("none", "recessed"):
        return []
    upright = edge in ("left", "right")
    along, across = (y, x) if upright else (x, y)
    run, width = along[1] - along[0], across[1] - across[0]
    thickness = min(style.thickness, 0.25 * width, 0.25 * run)
    inset = min(max(style.inset, thickness), 0.3 * width)
    length = max(style.length * run, 2.5 * thickness)
    if edge is None:
        beside, lip, shift = (across[0] + across[1]) / 2, across[1] - thickness, 0.0
    else:
        low = edge in ("left", "bottom")
        beside = across[0] + inset if low else across[1] - inset
        lip = across[0] if low else across[1] - thickness
        shift = style.shift if upright else 0.0
    depth = ((z[0] + z[1]) / 2, z[1] + style.reach)
    if style.kind == "knob":
        middle = (along[0] + along[1]) / 2 + shift * max(run - 4 * thickness, 0.0) / 2
        beside = min(max(beside, across[0] + thickness), across[1] - thickness)
        return _knob(upright, middle, beside, depth, z[1] + 0.5 * style.reach, thickness)
    middle = (along[0] + along[1]) / 2 + shift * max(run - length, 0.0) / 2
    ends = (middle - length / 2, middle + length / 2)
    if style.kind == "lip":
        return [_strip(upright, ends, (lip, lip + thickness), (depth[0], z[1] + 0.6 * style.reach))]
    return _bar(upright, style.round, ends, beside, depth, thickness)


def _strip(upright: bool, along: Range, across: Range, depth: Range) -> Piece:
    """A box with a range along the panel's free edge, one across it and one in depth."""
    return box("handle", across, along, depth) if upright else box("handle", along, across, depth)


def _point(upright: bool, along: float, across: float, depth: float) -> Vector:
    """The point at a place along the panel's free edge, across it and in depth."""
    return (across, along, depth) if upright else (along, across, depth)


def _knob(upright: bool, along: float, across: float, depth: Range, neck: float, thickness: float) -> list[Piece]:
    """A knob from the lower to the upper end of ``depth`` (m), thin up to ``neck``."""
    root, middle, tip = (_point(upright, along, across, z) for z in (depth[0], neck, depth[1]))
    return [rod("handle", root, middle, 0.5 * thickness), rod("handle", middle, tip, thickness, 0.85 * thickness)]


def _bar(upright: bool, is_round: bool, ends: Range, beside: float, depth: Range, thickness: float) -> list[Piece]:
    """A bar on two posts, round or square, between its ends along the edge."""
    (root, tip), half = depth, thickness / 2
    feet = (ends[0] + thickness, ends[1] - thickness)
    if not is_round:
        across = (beside - half, beside + half)
        posts = [_strip(upright, (a - half, a + half), across, (root, tip - thickness)) for a in feet]
        return [*posts, _strip(upright, ends, across, (tip - thickness, tip))]

    def straight(a: float, b: float, lower: float, radius: float) -> Piece:
        return rod("handle", _point(upright, a, beside, lower), _point(upright, b, beside, tip - half), radius)

    return [*(straight(a, a, root, 0.8 * half) for a in feet), straight(*ends, tip - half, half)]


def panel(name: str, style: FrontStyle, x: Range, y: Range, z: Range, edge: Side | None) -> list[Piece]:
    """A panel with its handle near its free edge, or in its middle if edge is None.

    It is flat, or has four rails around a recessed field where it is large enough for them, or a recessed grip.
    """
    rail, size = style.rail, (x[1] - x[0], y[1] - y[0])
    if style.handle.kind == "recessed":
        return _hollowed(name, "handle", x, y, z, *_grip(style.handle, x, y, edge), 0.7)
    fixed = handle(style.handle, x, y, z, edge)
    if rail <= 0 or min(size) < 4 * rail:
        return [box(name, x, y, z), *fixed]
    inner_x, inner_y = (x[0] + rail, x[1] - rail), (y[0] + rail, y[1] - rail)
    return _hollowed(name, f"{name}_field", x, y, z, inner_x, inner_y, style.recess) + fixed


def _grip(style: HandleStyle, x: Range, y: Range, edge: Side | None) -> tuple[Range, Range]:
    """Ranges in x and y of a recessed grip: along the free edge, or below the upper one of a panel that slides."""
    upright = edge in ("left", "right")
    along, across = (y, x) if upright else (x, y)
    run, width = along[1] - along[0], across[1] - across[0]
    half_length = max(0.3 * style.length, 0.06) * run
    half_width = min(2 * style.thickness, 0.15 * width)
    middle = (along[0] + along[1]) / 2 + (0.8 * style.shift * (run / 2 - half_length) if upright else 0.0)
    inset = min(max(style.inset, 1.5 * half_width), 0.3 * width)
    beside = across[0] + inset if edge in ("left", "bottom") else across[1] - inset
    long, wide = (middle - half_length, middle + half_length), (beside - half_width, beside + half_width)
    return (wide, long) if upright else (long, wide)


def _hollowed(
    name: str, floor: str, x: Range, y: Range, z: Range, hole_x: Range, hole_y: Range, depth: float
) -> list[Piece]:
    """A panel that is thinner within a rectangle, by `depth` of its thickness."""
    return [
        *around(name, x, y, z, (hole_x, hole_y)),
        box(floor, hole_x, hole_y, (z[0], z[1] - depth * (z[1] - z[0]))),
    ]


def hinged_door(
    name: str, style: FrontStyle, side: Side, x: Range, y: Range, z: Range, upper: float, inward: bool = False
) -> Part:
    """A door that turns about an axis in its front face, at its edge on the given side or a little inside.

    So the panel sweeps no space beside itself, except that its free edge swings out by `swing_room` first, and behind
    itself no more than `BEHIND`: nothing of a body or neighbour that keeps this far is ever touched. One that opens
    inward, to the back, is the mirror image: its axis lies in its back face.
    """
    # The back corner beside the axis sweeps a circle of radius hypot(inside, thickness).
    thickness = z[1] - z[0]
    inside = style.setback * ((thickness + BEHIND) ** 2 - thickness**2) ** 0.5
    origin = {
        "left": (x[0] + inside, 0.0),
        "right": (x[1] - inside, 0.0),
        "bottom": (0.0, y[0] + inside),
        "top": (0.0, y[1] - inside),
    }[side]
    pieces = panel("door_surface", style, x, y, z, OPPOSITE[side])
    a, b, c = HINGE_AXIS[side]
    axis: Vector = (-a, -b, -c) if inward else (a, b, c)
    return Part(name, "hinge", axis, upper, tuple(pieces), (*origin, z[0] if inward else z[1]))


def swing_room(width: float, thickness: float) -> float:
    """How far (m) the free back edge of a door swings beyond its closed outline."""
    return float(np.hypot(width, thickness)) - width


def drawer(
    style: FrontStyle, x: Range, y: Range, z: Range, tray: tuple[Range, Range, Range], sheet: float, upper: float
) -> Part:
    """An open-topped tray of sheets `sheet` m thick, with the front panel x, y, z; it slides to the front."""
    tx, ty, tz = tray
    pieces = [
        *panel("drawer_front", style, x, y, z, None),
        box("drawer_bottom", tx, (ty[0], ty[0] + sheet), tz),
        box("drawer_side", (tx[0], tx[0] + sheet), (ty[0] + sheet, ty[1]), tz),
        box("drawer_side", (tx[1] - sheet, tx[1]), (ty[0] + sheet, ty[1]), tz),
        box("drawer_back", (tx[0] + sheet, tx[1] - sheet), (ty[0] + sheet, ty[1]), (tz[0], tz[0] + sheet)),
    ]
    return Part("drawer", "slider", (0, 0, 1), upper, tuple(pieces))
