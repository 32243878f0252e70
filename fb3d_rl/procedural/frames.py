"""Families that close an opening in a frame: doors, windows and washing machines."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fb3d_rl.procedural.fronts import FrontStyle, Side, draw_handle, hinged_door, panel, swing_room
from fb3d_rl.procedural.shapes import Piece, Range, Vector, around, box, housing, rod
from fb3d_rl.procedural.spec import ObjectSpec, Part


def frame(name: str, x: Range, y: Range, z: Range, bar: float, sill: bool, head: float | None = None) -> list[Piece]:
    """Upright bars of width `bar` (m) and an upper one of height `head` (`bar` unless given) inside the outline x, y,
    with a lower bar if `sill`.
    """
    pieces = [
        box(name, (x[0], x[0] + bar), y, z),
        box(name, (x[1] - bar, x[1]), y, z),
        box(name, (x[0] + bar, x[1] - bar), (y[1] - (bar if head is None else head), y[1]), z),
    ]
    if sill:
        pieces.append(box(name, (x[0] + bar, x[1] - bar), (y[0], y[0] + bar), z))
    return pieces


def door(rng: np.random.Generator) -> ObjectSpec:
    """A frame, or a piece of wall, with one leaf or two that meet in the middle; they open to the front or, where there
    is room, inward.
    """
    double = rng.random() < 0.35
    width, height = rng.uniform(0.6, 0.95) * (1.6 if double else 1.0), rng.uniform(1.3, 1.8)
    scale = 1.97 / float(np.hypot(width, height))
    x, y = (-width * scale / 2, width * scale / 2), (0.0, height * scale)
    if rng.random() < 0.35:
        bar, head = rng.uniform(0.08, 0.2) * (x[1] - x[0]), rng.uniform(0.08, 0.3) * (y[1] - y[0])
        deep, sill = rng.uniform(0.08, 0.25), False
    else:
        bar, deep = rng.uniform(0.03, 0.08), rng.uniform(0.05, 0.12)
        head, sill = bar, bool(rng.random() < 0.3)
    body = frame("door_frame", x, y, (-deep, 0.0), bar, sill, head)
    thickness = min(rng.uniform(0.03, 0.05), deep)
    style = FrontStyle(
        draw_handle(rng, bare=0.0),
        thickness,
        rng.uniform(0.05, 0.1) * rng.integers(0, 2),
        rng.uniform(0.2, 0.45),
        rng.random(),
    )
    inner = x[1] - x[0] - 2 * bar
    gap = rng.uniform(0.0045, 0.006) + swing_room(inner / (2 if double else 1), thickness)
    leaf_y = (y[0] + (bar + gap if sill else gap), y[1] - head - gap)
    left, right = x[0] + bar + gap, x[1] - bar - gap
    leaves: list[tuple[Range, Side]]
    if double:
        leaves = [((left, -gap / 2), "left"), ((gap / 2, right), "right")]
    else:
        leaves = [((left, right), "left" if rng.random() < 0.5 else "right")]
    inward = bool(rng.random() < 0.3)
    if inward:  # what stands out in front of the leaf swings beyond its free edge: keep it away from there
        grip = style.handle
        kind = "bar" if grip.kind == "lip" else grip.kind
        style = replace(style, handle=replace(grip, kind=kind, inset=max(grip.inset, 0.06)))
    swing = (1.3, np.pi / 2) if inward else (1.3, 2.0)
    parts = [
        hinged_door("rotation_door", style, side, leaf_x, leaf_y, (-thickness, 0.0), rng.uniform(*swing), inward)
        for leaf_x, side in leaves
    ]
    return ObjectSpec("Door", "static", "door_frame", tuple(body), tuple(parts))


def window(rng: np.random.Generator) -> ObjectSpec:
    """A frame with one hinged pane, or two: one or both slide past the other, or both are hinged at the sides."""
    width, height = rng.uniform(0.9, 1.6), rng.uniform(0.8, 1.4)
    scale = 1.96 / float(np.hypot(width, height))
    x, y = (-width * scale / 2, width * scale / 2), (0.0, height * scale)
    bar, sheet, clearance = rng.uniform(0.04, 0.08), rng.uniform(0.03, 0.05), rng.uniform(0.0045, 0.006)
    deep = 2 * sheet + 2 * clearance
    body = frame("window_frame", x, y, (-deep, 0.0), bar, sill=True)
    style = FrontStyle(draw_handle(rng, bare=0.1), sheet, rng.uniform(0.04, 0.08), rng.uniform(0.2, 0.45), rng.random())
    if rng.random() < 0.2:  # one pane, hinged at the top or at a side
        side: Side = rng.choice(["top", "left", "right"])
        reach = (y[1] - y[0] if side == "top" else x[1] - x[0]) - 2 * bar
        gap = clearance + swing_room(reach, sheet)
        pane_x, pane_y = (x[0] + bar + gap, x[1] - bar - gap), (y[0] + bar + gap, y[1] - bar - gap)
        upper = rng.uniform(1.25, 1.6)
        sash = hinged_door("rotation_window", style, side, pane_x, pane_y, (-sheet, 0.0), upper)
        return ObjectSpec("Window", "static", "window_frame", tuple(body), (sash,))
    if rng.random() < 0.4:
        gap = clearance + swing_room((x[1] - x[0]) / 2 - bar, sheet)
        pane_y = (y[0] + bar + gap, y[1] - bar - gap)
        leaves: list[tuple[Range, Side]] = [
            ((x[0] + bar + gap, -gap / 2), "left"),
            ((gap / 2, x[1] - bar - gap), "right"),
        ]
        parts = [
            hinged_door("rotation_window", style, side, pane_x, pane_y, (-sheet, 0.0), rng.uniform(1.25, 1.9))
            for pane_x, side in leaves
        ]
        return ObjectSpec("Window", "static", "window_frame", tuple(body), tuple(parts))
    pane_y = (y[0] + bar + clearance, y[1] - bar - clearance)
    lap = rng.uniform(0.02, 0.06)  # the panes overlap in the middle, one track behind the other
    left, right = (x[0] + bar + clearance, lap / 2), (-lap / 2, x[1] - bar - clearance)
    tracks = [(-sheet - clearance / 2, -clearance / 2), (-2 * sheet - 1.5 * clearance, -sheet - 1.5 * clearance)]
    front_is_left = rng.random() < 0.5
    panes = (
        [(left, tracks[0], 1.0), (right, tracks[1], -1.0)]
        if front_is_left
        else [(right, tracks[0], -1.0), (left, tracks[1], 1.0)]
    )
    movable = 2 if rng.random() < 0.4 else 1
    styles = (style, replace(style, handle=replace(style.handle, kind="none")))  # no room before the rear pane
    parts = []
    for k, (pane_x, pane_z, way) in enumerate(panes):
        pane = panel("window_pane", styles[k], pane_x, pane_y, pane_z, "left" if way > 0 else "right")
        if k < movable:
            travel = (pane_x[1] - pane_x[0] - lap) * rng.uniform(0.6, 0.9)
            parts.append(Part("translation_window", "slider", (way, 0, 0), travel, tuple(pane)))
        else:
            body.extend(pane)
    return ObjectSpec("Window", "static", "window_frame", tuple(body), tuple(parts))


def washing_machine(rng: np.random.Generator) -> ObjectSpec:
    """A hollow box with a round door hinged at one side, below a control panel, or with a lid on top."""
    width, height, depth = rng.uniform(0.8, 1.0), rng.uniform(0.95, 1.3), rng.uniform(0.75, 1.05)
    scale = 1.95 / float(np.linalg.norm([width, height, depth]))
    width, height, depth = width * scale, height * scale, depth * scale
    if rng.random() < 0.3:
        return _top_loader(rng, width, height, depth)
    x, y, z = (-width / 2, width / 2), (0.0, height), (-depth / 2, depth / 2)
    sheet = rng.uniform(0.02, 0.04)
    controls = rng.uniform(0.12, 0.2) * height
    radius = min(width, height - controls) * rng.uniform(0.3, 0.42)
    cx, cy = 0.0, (height - controls) * rng.uniform(0.5, 0.56)
    hole = 0.68 * radius  # half side of the square opening, which the round door covers
    front = (z[1] - sheet, z[1])
    body = [
        *housing(x, y, (z[0], front[0]), sheet),
        *around("front_panel", x, y, front, ((cx - hole, cx + hole), (cy - hole, cy + hole))),
    ]
    knob = (x[0] + rng.uniform(0.2, 0.8) * width, height - controls / 2)
    body.append(rod("knob", (*knob, front[0]), (*knob, z[1] + rng.uniform(0.01, 0.03)), 0.25 * controls, sides=16))
    near = z[1] + rng.uniform(0.0045, 0.006)
    thickness = rng.uniform(0.03, 0.07)
    far = near + thickness
    sign = 1.0 if rng.random() < 0.5 else -1.0  # of the free edge; the hinge is on the other side
    ring: Vector = (cx, cy, near)
    pieces = [
        rod("door_frame", ring, (cx, cy, far), radius, sides=24),
        rod("glass", (cx, cy, far), (cx, cy, far + rng.uniform(0.01, 0.04)), 0.75 * radius, 0.6 * radius, sides=24),
    ]
    grip = rng.uniform(0.04, 0.1)
    inward, outward = sorted((cx + sign * 0.85 * radius, cx + sign * 0.95 * radius))
    pieces.append(
        box("handle", (inward, outward), (cy - grip, cy + grip), (near + thickness / 2, far + rng.uniform(0.02, 0.05)))
    )
    axis: Vector = (0, -sign, 0)
    door_part = Part("door", "hinge", axis, rng.uniform(1.4, 2.2), tuple(pieces), (cx - sign * radius, cy, far))
    return ObjectSpec("WashingMachine", "static", "washing_machine_body", tuple(body), (door_part,))


def _top_loader(rng: np.random.Generator, width: float, height: float, depth: float) -> ObjectSpec:
    """A hollow box whose top has an opening under a lid, hinged at the back or a side, before a panel with knobs."""
    sheet, gap = rng.uniform(0.02, 0.04), rng.uniform(0.0045, 0.006)
    tall = rng.uniform(0.08, 0.2)
    x, y, z = (-width / 2, width / 2), (0.0, height - tall), (-depth / 2, depth / 2)
    deck = (y[1] - sheet, y[1])
    panel_z = (z[0], z[0] + rng.uniform(0.1, 0.2) * depth)
    hole_x = (x[0] + rng.uniform(0.08, 0.2) * width, x[1] - rng.uniform(0.08, 0.2) * width)
    over, thick, stand = rng.uniform(0.01, 0.02), rng.uniform(0.015, 0.035), rng.uniform(0.01, 0.03)
    # Upright, the lid stands between its hinge and the knobs.
    hole_z = (panel_z[1] + stand + thick + over + rng.uniform(0.03, 0.1), z[1] - rng.uniform(0.04, 0.15) * depth)
    inner = (x[0] + sheet, x[1] - sheet)
    body = [
        box("side_panel", (x[0], inner[0]), (0.0, deck[0]), z),
        box("side_panel", (inner[1], x[1]), (0.0, deck[0]), z),
        box("front_panel", inner, (0.0, deck[0]), (z[1] - sheet, z[1])),
        box("back_panel", inner, (0.0, deck[0]), (z[0], z[0] + sheet)),
        box("bottom_panel", inner, (0.0, sheet), (z[0] + sheet, z[1] - sheet)),
        *around("top_panel", x, deck, z, (hole_x, hole_z), lying=True),
        box("control_panel", x, (y[1], height), panel_z),
    ]
    for share in np.linspace(0.2, 0.8, int(rng.integers(1, 5))):
        at = (x[0] + share * width, (y[1] + height) / 2)
        body.append(rod("knob", (*at, panel_z[0]), (*at, panel_z[1] + stand), 0.3 * tall))
    # The lid lies on the deck, over the opening's edges, and turns about its lower edge.
    lid_x, lid_z = (hole_x[0] - over, hole_x[1] + over), (hole_z[0] - over, hole_z[1] + over)
    low = y[1] + gap
    lid_y = (low, low + thick)
    hinge: list[tuple[Vector, Vector]] = [
        ((-1, 0, 0), (0.0, low, lid_z[0])),
        ((0, 0, 1), (lid_x[0], low, 0.0)),
        ((0, 0, -1), (lid_x[1], low, 0.0)),
    ]
    axis, origin = hinge[int(rng.choice(3, p=[0.6, 0.2, 0.2]))]
    pieces = [box("lid_surface", lid_x, lid_y, lid_z)]
    if rng.random() < 0.6:  # a grip at the front edge
        half = rng.uniform(0.06, 0.2) * width
        middle = (lid_x[0] + lid_x[1]) / 2
        pieces.append(
            box("handle", (middle - half, middle + half), (lid_y[1], lid_y[1] + 0.02), (lid_z[1] - 0.04, lid_z[1]))
        )
    lid = Part("door", "hinge", axis, rng.uniform(1.25, np.pi / 2), tuple(pieces), origin)
    return ObjectSpec("WashingMachine", "static", "washing_machine_body", tuple(body), (lid,))
