"""Families of furniture: cabinets and desks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fb3d_rl.procedural.carcass import Carcass, Cell, CellKind, Column, build, scaled_size
from fb3d_rl.procedural.fronts import draw_front
from fb3d_rl.procedural.shapes import box
from fb3d_rl.procedural.spec import ObjectSpec, Part


def _suited(rng: np.random.Generator, cell: Cell, width: float, height: float) -> Cell:
    """The cell with a front that suits its proportions: no tall drawers and no very wide doors."""
    if cell.kind == "drawer" and height > min(1.5 * width, 0.55):
        return replace(cell, kind="left" if rng.random() < 0.5 else "right")
    if cell.kind in ("left", "right") and width > 1.5 * height:
        return replace(cell, kind=rng.choice(["drawer", "bottom", "top"], p=[0.6, 0.25, 0.15]), shelves=0)
    return cell


def _storage_column(rng: np.random.Generator, most: int, budget: int, leaf: float, outward: float) -> list[Cell]:
    """At most `most` cells with at most `budget` movable parts.

    `leaf` is the column's width (m), `outward` the chance that a single door is hinged on the left.
    """
    theme = rng.choice(["drawers", "doors", "mixed"])
    cells: list[Cell] = []
    for _ in range(int(rng.integers(1, most + 1))):
        if budget <= 0 or (cells and rng.random() < 0.1):
            cells.append(Cell("open"))
        elif theme == "drawers" or (theme == "mixed" and rng.random() < 0.5):
            cells.append(Cell("drawer", rng.uniform(0.7, 1.2)))
            budget -= 1
        else:
            double = leaf > 0.6 and budget >= 2 and rng.random() < 0.6
            kind: CellKind = "double" if double else ("left" if rng.random() < outward else "right")
            cells.append(Cell(kind, rng.uniform(1.2, 2.2), int(rng.integers(0, 3))))
            budget -= 2 if double else 1
    return cells


MOST_PARTS = 8
"""Movable parts of one piece of furniture."""


def storage_furniture(rng: np.random.Generator) -> ObjectSpec:
    """Cabinets of one to three columns of drawers, doors and open compartments: one to eight movable parts."""
    width, height, depth = scaled_size(rng.uniform(0.5, 1.6), rng.uniform(0.6, 1.7), rng.uniform(0.45, 0.9))
    count = int(rng.choice(3, p=[0.6, 0.3, 0.1] if width < height else [0.25, 0.45, 0.3])) + 1
    stand = rng.choice(["none", "legs", "rods", "plinth"])
    legs = 0.0 if stand == "none" else rng.uniform(0.04, 0.18) * height
    most = min({1: 6, 2: 4, 3: 3}[count], max(int((height - legs) / 0.2), 1))
    shares = rng.uniform(0.8, 1.25, count)
    columns = []
    budget = MOST_PARTS
    for i, share in enumerate(shares):
        outward = 0.5 if count == 1 or 0 < i < count - 1 else (0.8 if i == 0 else 0.2)
        leaf = width * share / shares.sum()
        cells = _storage_column(rng, most, budget - (count - 1 - i), leaf, outward)
        total = sum(cell.weight for cell in cells)
        cells = [_suited(rng, cell, leaf, (height - legs) * cell.weight / total) for cell in cells]
        budget -= sum({"open": 0, "double": 2}.get(cell.kind, 1) for cell in cells)
        columns.append(Column(cells, float(share)))
    body, parts = build(
        rng,
        Carcass(
            size=(width, height, depth),
            wall=rng.uniform(0.018, 0.045),
            columns=columns,
            style=draw_front(rng, (0.018, 0.045)),
            inset=bool(rng.random() < 0.35),
            clearance=rng.uniform(0.0045, 0.006),
            legs=legs,
            leg_kind="plinth" if stand == "none" else stand,
            top=rng.uniform(0.02, 0.05) if rng.random() < 0.4 else 0.0,
            overhang=rng.uniform(0.0, 0.03),
        ),
    )
    return ObjectSpec("StorageFurniture", "heavy", "furniture_body", tuple(body), tuple(parts))


def table(rng: np.random.Generator) -> ObjectSpec:
    """Desks: drawers in a row or two between tall legs, or in pedestals beside the knees; an overhanging top."""
    size = scaled_size(rng.uniform(0.9, 1.7), rng.uniform(0.6, 1.0), rng.uniform(0.6, 0.9))
    if rng.random() < 0.4:
        return _pedestal_desk(rng, size)
    columns = []
    for _ in range(int(rng.integers(1, 4))):
        rows = int(rng.choice([1, 2], p=[0.75, 0.25]))
        columns.append(Column([Cell("drawer", rng.uniform(0.8, 1.2)) for _ in range(rows)], rng.uniform(0.8, 1.25)))
    body, parts = build(
        rng,
        Carcass(
            size=size,
            wall=rng.uniform(0.018, 0.035),
            columns=columns,
            style=draw_front(rng, (0.018, 0.035), framed=0.2),
            inset=bool(rng.random() < 0.5),
            clearance=rng.uniform(0.0045, 0.006),
            legs=rng.uniform(0.5, 0.68) * size[1],
            leg_kind="legs" if rng.random() < 0.5 else "rods",
            top=rng.uniform(0.02, 0.05),
            overhang=rng.uniform(0.0, 0.08),
        ),
    )
    return ObjectSpec("Table", "heavy", "furniture_body", tuple(body), tuple(parts))


def _pedestal_desk(rng: np.random.Generator, size: tuple[float, float, float]) -> ObjectSpec:
    """A desk on one pedestal and legs, or on two, each with one to four drawers, or a door below up to two."""
    width, height, depth = size
    top, wall, over = rng.uniform(0.02, 0.05), rng.uniform(0.018, 0.035), rng.uniform(0.0, 0.05)
    style = draw_front(rng, (0.018, 0.035), framed=0.2)
    inset, share = bool(rng.random() < 0.5), rng.uniform(0.24, 0.36)
    sides = [-1.0, 1.0] if rng.random() < 0.5 else [rng.choice([-1.0, 1.0])]
    body = [box("tabletop", (-width / 2, width / 2), (height - top, height), (-depth / 2, depth / 2 + over))]
    parts: list[Part] = []
    for side in sides:
        cells = [Cell("drawer", rng.uniform(0.7, 1.2)) for _ in range(int(rng.integers(1, 5)))]
        if rng.random() < 0.3:
            cells = [Cell("left" if side > 0 else "right", rng.uniform(1.5, 2.5)), *cells[:2]]
        carcass = Carcass(
            size=(share * width, height - top, depth),
            wall=wall,
            columns=[Column(cells)],
            style=style,
            inset=inset,
            clearance=rng.uniform(0.0045, 0.006),
            legs=rng.uniform(0.02, 0.1) if rng.random() < 0.5 else 0.0,
            leg_kind="rods" if rng.random() < 0.5 else "plinth",
        )
        pieces, movable = build(rng, carcass)
        # Flush with the top's side; its fronts do not swing under the top, which stands out no more than they do.
        shift = np.array([side * (1 - share) * width / 2, 0.0, 0.0])
        body += [piece.transformed(1.0, shift) for piece in pieces]
        parts += [part.moved(1.0, shift) for part in movable]
    if len(sides) == 1:
        thick, x = rng.uniform(0.03, 0.06), -sides[0] * width / 2
        leg_x = (min(x, x + sides[0] * thick), max(x, x + sides[0] * thick))
        if rng.random() < 0.5:
            body.append(box("leg", leg_x, (0.0, height - top), (-depth / 2, depth / 2)))
        else:
            for z in ((-depth / 2, -depth / 2 + thick), (depth / 2 - thick, depth / 2)):
                body.append(box("leg", leg_x, (0.0, height - top), z))
    if rng.random() < 0.5:  # a board that closes the back between the knees and the wall
        low, high = (-width / 2 + share * width, width / 2 - share * width)
        if len(sides) == 1:
            low, high = sorted((sides[0] * (0.5 - share) * width, -sides[0] * (width / 2 - 0.07)))
        body.append(box("back_panel", (low, high), (0.35 * height, height - top), (-depth / 2, -depth / 2 + wall)))
    return ObjectSpec("Table", "heavy", "furniture_body", tuple(body), tuple(parts))
