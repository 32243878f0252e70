"""Families of kitchen appliances, and safes: a carcass with one or a few doors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fb3d_rl.procedural.carcass import Carcass, Cell, CellKind, Column, build, scaled_size
from fb3d_rl.procedural.fronts import FrontStyle, Side, draw_front, draw_handle
from fb3d_rl.procedural.shapes import Piece, box, rod
from fb3d_rl.procedural.spec import ObjectSpec, Part

LEFT_HINGED = 0.3
"""Share of single doors of refrigerators and safes that are hinged on the left; most are made for right hands."""


def refrigerator(rng: np.random.Generator) -> ObjectSpec:
    """One door, freezer above or below, two doors side by side, or those above a drawer."""
    size = scaled_size(rng.uniform(0.6, 1.0), rng.uniform(1.0, 1.9), rng.uniform(0.55, 0.8))
    side: CellKind = "left" if rng.random() < LEFT_HINGED else "right"
    small, large = Cell(side, rng.uniform(0.35, 0.7), 1), Cell(side, 1.0, int(rng.integers(1, 4)))
    double = Cell("double", 1.0, int(rng.integers(1, 4)))
    layouts = [[large], [large, small], [small, large], [double], [Cell("drawer", rng.uniform(0.3, 0.5)), double]]
    cells = layouts[int(rng.choice(len(layouts), p=[0.15, 0.25, 0.25, 0.2, 0.15]))]
    body, parts = build(
        rng,
        Carcass(
            size=size,
            wall=rng.uniform(0.03, 0.06),
            columns=[Column(cells)],
            style=draw_front(rng, (0.045, 0.085), bare=0.05, framed=0.0),
            clearance=rng.uniform(0.0045, 0.006),
            legs=rng.uniform(0.02, 0.06) if rng.random() < 0.6 else 0.0,
            leg_kind="plinth" if rng.random() < 0.5 else "rods",
            door="door",
            free_swing=(1.5, 3.1),
        ),
    )
    return ObjectSpec("Refrigerator", "heavy", "refrigerator_body", tuple(body), tuple(parts))


def microwave(rng: np.random.Generator) -> ObjectSpec:
    """A door with a window beside a control panel."""
    size = scaled_size(rng.uniform(1.3, 1.9), rng.uniform(0.75, 1.1), rng.uniform(0.8, 1.2))
    mirrored = rng.random() < 0.2
    columns = [Column([Cell("right" if mirrored else "left")], rng.uniform(2.2, 4.0)), Column([Cell("controls")], 1.0)]
    handle = draw_handle(rng, bare=0.15)
    if handle.kind == "bar":
        handle = replace(handle, length=rng.uniform(0.5, 0.85), shift=0.0)
    body, parts = build(
        rng,
        Carcass(
            size=size,
            wall=rng.uniform(0.03, 0.06),
            columns=columns[::-1] if mirrored else columns,
            style=FrontStyle(
                handle, rng.uniform(0.035, 0.075), rng.uniform(0.08, 0.13), rng.uniform(0.2, 0.45), rng.random()
            ),
            clearance=rng.uniform(0.0045, 0.006),
            legs=rng.uniform(0.015, 0.04),
            leg_kind="rods",
            door="door",
            free_swing=(1.4, 2.0),
        ),
    )
    return ObjectSpec("Microwave", "heavy", "microwave_body", tuple(body), tuple(parts))


def safe(rng: np.random.Generator) -> ObjectSpec:
    """A thick-walled box with one door, set in or in front, with a dial and a lever."""
    size = scaled_size(rng.uniform(0.8, 1.3), rng.uniform(0.8, 1.5), rng.uniform(0.8, 1.2))
    side: Side = "left" if rng.random() < LEFT_HINGED else "right"
    style = draw_front(rng, (0.05, 0.09), bare=0.0, framed=0.3)
    body, (door,) = build(
        rng,
        Carcass(
            size=size,
            wall=rng.uniform(0.05, 0.1),
            columns=[Column([Cell(side, 1.0, int(rng.integers(0, 3)))])],
            style=style,
            inset=bool(rng.random() < 0.5),
            clearance=rng.uniform(0.0045, 0.006),
            legs=rng.uniform(0.02, 0.06) if rng.random() < 0.5 else 0.0,
            leg_kind="rods",
            door="door",
            free_swing=(1.4, 3.1),
        ),
    )
    return ObjectSpec("Safe", "heavy", "safe_body", tuple(body), (_with_dial(rng, door),))


def _with_dial(rng: np.random.Generator, door: Part) -> Part:
    """The door with a dial, or a wheel of spokes, fixed on its middle."""
    points = np.concatenate([piece.vertices for piece in door.pieces if piece.name.startswith("door_surface")])
    (x0, y0, z0), (x1, y1, z1) = points.min(0), points.max(0)
    cx, cy = (x0 + x1) / 2, y0 + rng.uniform(0.4, 0.75) * (y1 - y0)
    dial = rod(
        "dial", (cx, cy, (z0 + z1) / 2), (cx, cy, z1 + rng.uniform(0.02, 0.05)), rng.uniform(0.04, 0.1), sides=16
    )
    if rng.random() < 0.4:
        length, at = rng.uniform(0.08, 0.16), z1 + rng.uniform(0.03, 0.06)
        hub = rod("handle", (cx, cy, (z0 + z1) / 2), (cx, cy, at + 0.012), 0.03, sides=8)
        angles = rng.uniform(0, np.pi) + np.pi * np.arange(3) / 3
        spokes = [
            rod(
                "handle",
                (cx - length * np.cos(a), cy - length * np.sin(a), at),
                (cx + length * np.cos(a), cy + length * np.sin(a), at),
                0.012,
                sides=8,
            )
            for a in angles
        ]
        return replace(door, pieces=(*door.pieces, hub, *spokes))
    return replace(door, pieces=(*door.pieces, dial))


def oven(rng: np.random.Generator) -> ObjectSpec:
    """A door below a control panel, sometimes above a drawer or another door; it drops down, or is hinged at a side.

    Cooking ranges have burners on top, and most of them a panel behind these.
    """
    size = scaled_size(rng.uniform(0.8, 1.2), rng.uniform(0.9, 1.4), rng.uniform(0.8, 1.1))
    kind: CellKind = rng.choice(["bottom", "left", "right"], p=[0.86, 0.07, 0.07])
    cells = [Cell(kind, 1.0, int(rng.integers(0, 3))), Cell("controls", rng.uniform(0.15, 0.3))]
    below = rng.choice(["nothing", "drawer", "oven"], p=[0.5, 0.3, 0.2])
    if below == "drawer":
        cells.insert(0, Cell("drawer", rng.uniform(0.25, 0.4)))
    elif below == "oven":
        cells.insert(0, Cell("bottom", rng.uniform(0.6, 1.1), int(rng.integers(0, 3))))
    handle = replace(draw_handle(rng, bare=0.0), kind="bar", length=rng.uniform(0.5, 0.85))
    body, parts = build(
        rng,
        Carcass(
            size=size,
            wall=rng.uniform(0.03, 0.05),
            columns=[Column(cells)],
            style=FrontStyle(
                handle, rng.uniform(0.035, 0.06), rng.uniform(0.07, 0.12), rng.uniform(0.2, 0.45), rng.random()
            ),
            clearance=rng.uniform(0.0045, 0.006),
            legs=rng.uniform(0.02, 0.08) if rng.random() < 0.6 else 0.0,
            leg_kind="plinth" if rng.random() < 0.5 else "rods",
            door="door",
        ),
    )
    if rng.random() < 0.6:
        body += _burners(rng, size)
    return ObjectSpec("Oven", "heavy", "oven_body", tuple(body), tuple(parts))


def _burners(rng: np.random.Generator, size: tuple[float, float, float]) -> list[Piece]:
    """Four burners on top of a range of this size, with a grate or without, and often a panel behind them."""
    width, y, depth = size
    pieces = []
    if rng.random() < 0.7:
        rise = rng.uniform(0.05, 0.35)
        pieces.append(box("back_panel", (-width / 2, width / 2), (y, y + rise), (-depth / 2, -depth / 2 + 0.06)))
    radius, tall, grate = rng.uniform(0.12, 0.2) * min(width, depth), rng.uniform(0.005, 0.03), rng.random() < 0.5
    for cx in (-0.25 * width, 0.25 * width):
        for cz in (-0.2 * depth, 0.25 * depth):
            pieces.append(rod("burner", (cx, y, cz), (cx, y + tall, cz), radius))
            if grate:
                bar = (y + tall, y + tall + 0.02)
                pieces.append(box("grate", (cx - 1.2 * radius, cx + 1.2 * radius), bar, (cz - 0.01, cz + 0.01)))
                pieces.append(box("grate", (cx - 0.01, cx + 0.01), bar, (cz - 1.2 * radius, cz + 1.2 * radius)))
    return pieces


def dishwasher(rng: np.random.Generator) -> ObjectSpec:
    """One door over nearly the whole front that drops down, below a narrow control panel or alone."""
    size = scaled_size(rng.uniform(0.8, 1.1), rng.uniform(1.0, 1.4), rng.uniform(0.8, 1.1))
    cells = [Cell("bottom", 1.0, int(rng.integers(0, 3)))]
    if rng.random() < 0.6:
        cells.append(Cell("controls", rng.uniform(0.1, 0.18)))
    body, parts = build(
        rng,
        Carcass(
            size=size,
            wall=rng.uniform(0.025, 0.045),
            columns=[Column(cells)],
            style=draw_front(rng, (0.035, 0.07), framed=0.2),
            clearance=rng.uniform(0.0045, 0.006),
            legs=rng.uniform(0.04, 0.1),
            leg_kind="plinth" if rng.random() < 0.7 else "rods",
        ),
    )
    return ObjectSpec("Dishwasher", "heavy", "dishwasher_body", tuple(body), tuple(parts))
