"""Panels, handles, hinged doors and drawers: what the front of a cabinet is made of."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from fb3d_rl.assets.procedural.shapes import Piece, Range, Vector, box, rod
from fb3d_rl.assets.procedural.spec import Part

Side = Literal["left", "right", "bottom", "top"]
OPPOSITE: dict[Side, Side] = {"left": "right", "right": "left", "bottom": "top", "top": "bottom"}
# Hinge axes about which a panel in front of the body turns outwards (towards +z) for positive angles.
HINGE_AXIS: dict[Side, Vector] = {
    "left": (0, -1, 0),
    "right": (0, 1, 0),
    "bottom": (1, 0, 0),
    "top": (-1, 0, 0),
}


@dataclass(frozen=True)
class HandleStyle:
    """How an object's handles look; lengths in metres.

    Attributes:
        kind: "bar" on two posts, "knob", "lip" along the panel's free edge, or "none".
        reach: How far the handle stands out of the panel.
        thickness: Of the bar or lip; a knob is twice as wide.
        length: Of the bar or lip, as a fraction of the panel's side that it runs along.
        inset: Distance of the handle's middle from the panel's free edge.
        shift: Where along the free edge the handle sits, from -1 to 1.
        round: Whether bars are rods rather than square.
    """

    kind: Literal["bar", "knob", "lip", "none"]
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
    """

    handle: HandleStyle
    thickness: float
    rail: float
    recess: float


def draw_handle(rng: np.random.Generator, bare: float = 0.12) -> HandleStyle:
    """A random handle style; with probability `bare` there is no handle."""
    rest = 1 - bare
    kind = rng.choice(["bar", "knob", "lip", "none"], p=[0.55 * rest, 0.3 * rest, 0.15 * rest, bare])
    return HandleStyle(
        kind=kind,
        reach=rng.uniform(0.035, 0.085),
        thickness=rng.uniform(0.014, 0.032),
        length=rng.uniform(0.2, 0.75),
        inset=rng.uniform(0.035, 0.08),
        shift=rng.uniform(-0.6, 0.6),
        round=bool(rng.random() < 0.5),
    )


def handle(style: HandleStyle, x: Range, y: Range, z: Range, edge: Side | None) -> list[Piece]:
    """Pieces of a handle on the panel x, y, z, near its free edge, or in its middle if edge is None.

    The handle stays within the panel's outline, so that it never meets a neighbour, and is rooted half-way
    into the panel, so that it also holds on a recessed field.
    """
    if style.kind == "none":
        return []
    upright = edge in ("left", "right")
    along, across = (y, x) if upright else (x, y)
    run, width = along[1] - along[0], across[1] - across[0]
    thickness = min(style.thickness, 0.25 * width, 0.25 * run)
    inset = min(max(style.inset, thickness), 0.3 * width)
    length = max(style.length * run, 2.5 * thickness)
    if edge is None:
        middle_across, shift = (across[0] + across[1]) / 2, 0.0
        lip_across = across[1] - thickness
    else:
        low = edge in ("left", "bottom")
        middle_across = across[0] + inset if low else across[1] - inset
        lip_across = across[0] if low else across[1] - thickness
        shift = style.shift if upright else 0.0
    root, front = (z[0] + z[1]) / 2, z[1]
    tip = front + style.reach

    def place(name: str, a: Range, c: Range, depth: Range) -> Piece:
        return box(name, c, a, depth) if upright else box(name, a, c, depth)

    def at(a: float, c: float, depth: float) -> Vector:
        return (c, a, depth) if upright else (a, c, depth)

    middle_along = (along[0] + along[1]) / 2 + shift * max(run - length, 0.0) / 2
    low_end, high_end = middle_along - length / 2, middle_along + length / 2
    half = thickness / 2
    if style.kind == "lip":
        return [
            place(
                "handle",
                (low_end, high_end),
                (lip_across, lip_across + thickness),
                (root, front + 0.6 * style.reach),
            )
        ]
    if style.kind == "knob":
        middle_along = (along[0] + along[1]) / 2 + shift * max(run - 4 * thickness, 0.0) / 2
        middle_across = min(max(middle_across, across[0] + thickness), across[1] - thickness)
        neck = front + 0.5 * style.reach
        return [
            rod(
                "handle",
                at(middle_along, middle_across, root),
                at(middle_along, middle_across, neck),
                0.5 * thickness,
            ),
            rod(
                "handle",
                at(middle_along, middle_across, neck),
                at(middle_along, middle_across, tip),
                thickness,
                0.85 * thickness,
            ),
        ]
    feet = (low_end + thickness, high_end - thickness)
    if style.round:
        posts = [rod("handle", at(a, middle_across, root), at(a, middle_across, tip - half), 0.8 * half) for a in feet]
        bar = rod("handle", at(low_end, middle_across, tip - half), at(high_end, middle_across, tip - half), half)
    else:
        strip = (middle_across - half, middle_across + half)
        posts = [place("handle", (a - half, a + half), strip, (root, tip - thickness)) for a in feet]
        bar = place("handle", (low_end, high_end), strip, (tip - thickness, tip))
    return [*posts, bar]


def panel(name: str, style: FrontStyle, x: Range, y: Range, z: Range) -> list[Piece]:
    """A flat panel, or four rails around a recessed field where the panel is large enough for them."""
    rail = style.rail
    if rail <= 0 or min(x[1] - x[0], y[1] - y[0]) < 4 * rail:
        return [box(name, x, y, z)]
    inner_x, inner_y = (x[0] + rail, x[1] - rail), (y[0] + rail, y[1] - rail)
    return [
        box(name, (x[0], inner_x[0]), y, z),
        box(name, (inner_x[1], x[1]), y, z),
        box(name, inner_x, (y[0], inner_y[0]), z),
        box(name, inner_x, (inner_y[1], y[1]), z),
        box(f"{name}_field", inner_x, inner_y, (z[0], z[1] - style.recess * (z[1] - z[0]))),
    ]


def hinged_door(name: str, style: FrontStyle, side: Side, x: Range, y: Range, z: Range, upper: float) -> Part:
    """A door that turns about its front edge on the given side.

    With the axis in the front edge the panel sweeps no space behind or beside itself, except that its free
    edge swings out by `swing_room` first: nothing of a body or neighbour that keeps this far is ever touched.
    """
    origin = {"left": (x[0], 0.0), "right": (x[1], 0.0), "bottom": (0.0, y[0]), "top": (0.0, y[1])}[side]
    pieces = [
        *panel("door_surface", style, x, y, z),
        *handle(style.handle, x, y, z, OPPOSITE[side]),
    ]
    return Part(name, "hinge", HINGE_AXIS[side], upper, tuple(pieces), (*origin, z[1]))


def swing_room(width: float, thickness: float) -> float:
    """How far (m) the free back edge of a door swings beyond its closed outline."""
    return float(np.hypot(width, thickness)) - width


def drawer(
    style: FrontStyle,
    x: Range,
    y: Range,
    z: Range,
    tray: tuple[Range, Range, Range],
    sheet: float,
    upper: float,
) -> Part:
    """An open-topped tray of sheets `sheet` m thick, with the front panel x, y, z; it slides to the front."""
    tx, ty, tz = tray
    pieces = [
        *panel("drawer_front", style, x, y, z),
        *handle(style.handle, x, y, z, None),
        box("drawer_bottom", tx, (ty[0], ty[0] + sheet), tz),
        box("drawer_side", (tx[0], tx[0] + sheet), (ty[0] + sheet, ty[1]), tz),
        box("drawer_side", (tx[1] - sheet, tx[1]), (ty[0] + sheet, ty[1]), tz),
        box("drawer_back", (tx[0] + sheet, tx[1] - sheet), (ty[0] + sheet, ty[1]), (tz[0], tz[0] + sheet)),
    ]
    return Part("drawer", "slider", (0, 0, 1), upper, tuple(pieces))
