"""Families that close an opening in a frame: doors, windows and washing machines."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fb3d_rl.assets.procedural.fronts import (
    FrontStyle,
    Side,
    draw_handle,
    hinged_door,
    panel,
    swing_room,
)
from fb3d_rl.assets.procedural.shapes import Piece, Range, Vector, box, housing, rod
from fb3d_rl.assets.procedural.spec import ObjectSpec, Part


def frame(name: str, x: Range, y: Range, z: Range, bar: float, sill: bool) -> list[Piece]:
    """Upright and upper bars of width `bar` (m) inside the outline x, y, with a lower bar if `sill`."""
    pieces = [
        box(name, (x[0], x[0] + bar), y, z),
        box(name, (x[1] - bar, x[1]), y, z),
        box(name, (x[0] + bar, x[1] - bar), (y[1] - bar, y[1]), z),
    ]
    if sill:
        pieces.append(box(name, (x[0] + bar, x[1] - bar), (y[0], y[0] + bar), z))
    return pieces


def door(rng: np.random.Generator) -> ObjectSpec:
    """A frame with one leaf, or two that meet in the middle."""
    double = rng.random() < 0.35
    width, height = rng.uniform(0.6, 0.95) * (1.6 if double else 1.0), rng.uniform(1.3, 1.8)
    scale = 1.97 / float(np.hypot(width, height))
    x, y = (-width * scale / 2, width * scale / 2), (0.0, height * scale)
    bar, deep = rng.uniform(0.03, 0.08), rng.uniform(0.05, 0.12)
    sill = bool(rng.random() < 0.3)
    body = frame("door_frame", x, y, (-deep, 0.0), bar, sill)
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
    leaf_y = (y[0] + (bar + gap if sill else gap), y[1] - bar - gap)
    left, right = x[0] + bar + gap, x[1] - bar - gap
    leaves: list[tuple[Range, Side]]
    if double:
        leaves = [((left, -gap / 2), "left"), ((gap / 2, right), "right")]
    else:
        leaves = [((left, right), "left" if rng.random() < 0.5 else "right")]
    parts = [
        hinged_door("rotation_door", style, side, leaf_x, leaf_y, (-thickness, 0.0), rng.uniform(1.3, 2.0))
        for leaf_x, side in leaves
    ]
    return ObjectSpec("Door", "static", "door_frame", tuple(body), tuple(parts))


def window(rng: np.random.Generator) -> ObjectSpec:
    """A frame with two panes: one or both slide past the other, or both are hinged at the sides."""
    width, height = rng.uniform(0.9, 1.6), rng.uniform(0.8, 1.4)
    scale = 1.96 / float(np.hypot(width, height))
    x, y = (-width * scale / 2, width * scale / 2), (0.0, height * scale)
    bar, sheet, clearance = rng.uniform(0.04, 0.08), rng.uniform(0.03, 0.05), rng.uniform(0.0045, 0.006)
    deep = 2 * sheet + 2 * clearance
    body = frame("window_frame", x, y, (-deep, 0.0), bar, sill=True)
    style = FrontStyle(draw_handle(rng, bare=0.1), sheet, rng.uniform(0.04, 0.08), rng.uniform(0.2, 0.45), rng.random())
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
    tracks = [
        (-sheet - clearance / 2, -clearance / 2),
        (-2 * sheet - 1.5 * clearance, -sheet - 1.5 * clearance),
    ]
    front_is_left = rng.random() < 0.5
    panes = (
        [(left, tracks[0], 1.0), (right, tracks[1], -1.0)]
        if front_is_left
        else [(right, tracks[0], -1.0), (left, tracks[1], 1.0)]
    )
    movable = 2 if rng.random() < 0.4 else 1
    looks = (style, replace(style, handle=replace(style.handle, kind="none")))  # no room before the rear pane
    parts = []
    for k, (pane_x, pane_z, way) in enumerate(panes):
        pane = panel("window_pane", looks[k], pane_x, pane_y, pane_z, "left" if way > 0 else "right")
        if k < movable:
            travel = (pane_x[1] - pane_x[0] - lap) * rng.uniform(0.6, 0.9)
            parts.append(Part("translation_window", "slider", (way, 0, 0), travel, tuple(pane)))
        else:
            body.extend(pane)
    return ObjectSpec("Window", "static", "window_frame", tuple(body), tuple(parts))


def washing_machine(rng: np.random.Generator) -> ObjectSpec:
    """A hollow box with a round door hinged at one side, below a control panel."""
    width, height, depth = rng.uniform(0.8, 1.0), rng.uniform(0.95, 1.3), rng.uniform(0.75, 1.05)
    scale = 1.95 / float(np.linalg.norm([width, height, depth]))
    width, height, depth = width * scale, height * scale, depth * scale
    x, y, z = (-width / 2, width / 2), (0.0, height), (-depth / 2, depth / 2)
    sheet = rng.uniform(0.02, 0.04)
    controls = rng.uniform(0.12, 0.2) * height
    radius = min(width, height - controls) * rng.uniform(0.3, 0.42)
    cx, cy = 0.0, (height - controls) * rng.uniform(0.5, 0.56)
    hole = 0.68 * radius  # half side of the square opening, which the round door covers
    front = (z[1] - sheet, z[1])
    body = [
        *housing(x, y, (z[0], front[0]), sheet),
        box("front_panel", (x[0], cx - hole), y, front),
        box("front_panel", (cx + hole, x[1]), y, front),
        box("front_panel", (cx - hole, cx + hole), (0.0, cy - hole), front),
        box("front_panel", (cx - hole, cx + hole), (cy + hole, height), front),
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
        rod(
            "glass",
            (cx, cy, far),
            (cx, cy, far + rng.uniform(0.01, 0.04)),
            0.75 * radius,
            0.6 * radius,
            sides=24,
        ),
    ]
    grip = rng.uniform(0.04, 0.1)
    inward, outward = sorted((cx + sign * 0.85 * radius, cx + sign * 0.95 * radius))
    pieces.append(
        box(
            "handle",
            (inward, outward),
            (cy - grip, cy + grip),
            (near + thickness / 2, far + rng.uniform(0.02, 0.05)),
        )
    )
    axis: Vector = (0, -sign, 0)
    door_part = Part("door", "hinge", axis, rng.uniform(1.4, 2.2), tuple(pieces), (cx - sign * radius, cy, far))
    return ObjectSpec("WashingMachine", "static", "washing_machine_body", tuple(body), (door_part,))
