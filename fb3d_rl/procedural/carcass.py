"""A carcass: a hollow body of cells, closed by a door, doors, a drawer, a fixed panel, or open."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from fb3d_rl.procedural.fronts import FrontStyle, Side, drawer, hinged_door, swing_room
from fb3d_rl.procedural.shapes import Piece, Range, box, rod
from fb3d_rl.procedural.spec import Part

CellKind = Literal["drawer", "left", "right", "bottom", "top", "double", "open", "controls"]
"""A cell's front: drawer, door hinged on one side, pair of doors, nothing, or a fixed panel with knobs."""


@dataclass(frozen=True)
class Cell:
    """One opening of a carcass, with its share of the column's height."""

    kind: CellKind
    weight: float = 1.0
    shelves: int = 0


@dataclass(frozen=True)
class Column:
    """Cells from bottom to top, with their column's share of the carcass's width."""

    cells: Sequence[Cell]
    weight: float = 1.0


@dataclass(frozen=True)
class Carcass:
    """A hollow body; lengths in metres.

    Attributes:
        size: Width, height and depth over everything but handles, legs included.
        wall: Thickness of outer walls and dividers.
        columns: From left to right, seen from the front.
        style: Of the fronts.
        inset: Whether fronts lie inside the walls, flush with them, or in front of them.
        clearance: Gap between fixed and moving surfaces.
        legs: Height of the legs or plinth; 0 for none.
        leg_kind: What stands below the carcass.
        top: Thickness of a top plate above the carcass; 0 for none.
        overhang: How far the top plate stands out at the sides and in front.
        door: PartNet's name of a door.
        free_swing: Range of upper limits (rad) of a door with nothing beside its hinge.
    """

    size: tuple[float, float, float]
    wall: float
    columns: Sequence[Column]
    style: FrontStyle
    inset: bool = False
    clearance: float = 0.005
    legs: float = 0.0
    leg_kind: Literal["legs", "rods", "plinth"] = "legs"
    top: float = 0.0
    overhang: float = 0.0
    door: str = "rotation_door"
    free_swing: Range = (1.4, 2.2)


BESIDE = 0.0025
"""Least distance (m) between a wall and the front of an open door that is set in beside it."""


def scaled_size(width: float, height: float, depth: float, diagonal: float = 1.94) -> tuple[float, float, float]:
    """The proportions as a size (m) with the given diagonal; PartNet's is 2 m, handles included."""
    scale = diagonal / float(np.linalg.norm([width, height, depth]))
    return width * scale, height * scale, depth * scale


def build(rng: np.random.Generator, carcass: Carcass) -> tuple[list[Piece], list[Part]]:
    """Pieces of the body and the movable parts."""
    width, height, depth = carcass.size
    wall, style = carcass.wall, carcass.style
    x: Range = (-width / 2, width / 2)
    y: Range = (carcass.legs, height - carcass.top)
    front = depth / 2
    face: Range = (front - style.thickness, front)  # the slice in which all fronts lie
    z: Range = (-front, front if carcass.inset else face[0] - carcass.clearance)
    inner_y: Range = (y[0] + wall, y[1] - wall)
    inner_z: Range = (z[0] + wall, face[0] - carcass.clearance)
    body = [
        box("vertical_side_panel", (x[0], x[0] + wall), y, z),
        box("vertical_side_panel", (x[1] - wall, x[1]), y, z),
        box("bottom_panel", (x[0] + wall, x[1] - wall), (y[0], inner_y[0]), z),
        box("top_panel", (x[0] + wall, x[1] - wall), (inner_y[1], y[1]), z),
        box("back_panel", (x[0] + wall, x[1] - wall), inner_y, (z[0], inner_z[0])),
        *_stand(carcass, x, z),
    ]
    if carcass.top:
        over = carcass.overhang
        body.append(box("tabletop", (x[0] - over, x[1] + over), (y[1], height), (z[0], front + over)))

    openings: list[tuple[Cell, int, Range, Range]] = []
    edges = _split((x[0] + wall, x[1] - wall), [column.weight for column in carcass.columns], wall)
    for i, (column, cell_x) in enumerate(zip(carcass.columns, edges, strict=True)):
        if i:
            body.append(box("vertical_divider", (cell_x[0] - wall, cell_x[0]), inner_y, (inner_z[0], z[1])))
        for j, (cell, cell_y) in enumerate(
            zip(column.cells, _split(inner_y, [c.weight for c in column.cells], wall), strict=True)
        ):
            if j:
                body.append(box("shelf", cell_x, (cell_y[0] - wall, cell_y[0]), (inner_z[0], z[1])))
            openings.append((cell, i, cell_x, cell_y))

    # One gap for all fronts: the one that the door with the shortest swing needs.
    gap = carcass.clearance + max(
        [swing_room(_swing(cell, cell_x, cell_y), style.thickness) for cell, _, cell_x, cell_y in openings]
    )
    parts: list[Part] = []
    for cell, i, cell_x, cell_y in openings:
        grow = -gap if carcass.inset else (wall - gap) / 2
        px, py = (cell_x[0] - grow, cell_x[1] + grow), (cell_y[0] - grow, cell_y[1] + grow)
        for k in range(cell.shelves):
            at = cell_y[0] + (cell_y[1] - cell_y[0]) * (k + 1) / (cell.shelves + 1)
            body.append(box("shelf", cell_x, (at - wall / 3, at + wall / 3), (inner_z[0], inner_z[1] - 0.06 * depth)))
        free = {"left": i == 0, "right": i == len(carcass.columns) - 1}
        for part_x, side in _leaves(cell, px, gap):
            swing = carcass.free_swing if free.get(side) else (1.25, np.pi / 2)
            door = hinged_door(carcass.door, style, side, part_x, py, face, rng.uniform(*swing))
            if carcass.inset and free.get(side):  # opened all the way, its front must not lie on the wall beside it
                beside = abs(cell_x[side == "right"] - door.origin[0])
                door = replace(door, upper=min(door.upper, np.pi - float(np.arcsin(BESIDE / beside))))
            parts.append(door)
        if cell.kind == "drawer":
            parts.append(_drawer(rng, carcass, px, py, face, cell_x, cell_y, inner_z))
        elif cell.kind == "controls":
            body.extend(_controls(rng, px, py, (face[0] - 2 * carcass.clearance, face[1])))
    return body, parts


def _split(whole: Range, weights: Sequence[float], divider: float) -> list[Range]:
    """The range cut into shares proportional to the weights, with a divider (m) between neighbours."""
    share = np.asarray(weights) / np.sum(weights) * (whole[1] - whole[0] - divider * (len(weights) - 1))
    start = whole[0] + np.concatenate([[0.0], np.cumsum(share + divider)[:-1]])
    return [(float(a), float(a + b)) for a, b in zip(start, share, strict=True)]


def _swing(cell: Cell, x: Range, y: Range) -> float:
    """Distance (m) of a door's free edge from its hinge; infinite where nothing swings."""
    if cell.kind in ("bottom", "top"):
        return y[1] - y[0]
    return {"left": 1.0, "right": 1.0, "double": 0.48}.get(cell.kind, 1e3) * (x[1] - x[0])


def _leaves(cell: Cell, x: Range, gap: float) -> list[tuple[Range, Side]]:
    """Ranges in x and hinge sides of the cell's doors."""
    if cell.kind == "double":
        middle = (x[0] + x[1]) / 2
        return [((x[0], middle - gap / 2), "left"), ((middle + gap / 2, x[1]), "right")]
    side: dict[CellKind, Side] = {"left": "left", "right": "right", "bottom": "bottom", "top": "top"}
    return [(x, side[cell.kind])] if cell.kind in side else []


def _drawer(
    rng: np.random.Generator,
    carcass: Carcass,
    px: Range,
    py: Range,
    face: Range,
    cell_x: Range,
    cell_y: Range,
    inner_z: Range,
) -> Part:
    gap = carcass.clearance
    height = rng.uniform(0.5, 0.85) * (cell_y[1] - cell_y[0])
    sheet = min(0.6 * carcass.wall, 0.02, 0.3 * height)
    length = (face[0] - inner_z[0] - gap) * rng.uniform(0.8, 1.0)
    tray = (
        (cell_x[0] + gap, cell_x[1] - gap),
        (cell_y[0] + gap, cell_y[0] + gap + height),
        (face[0] - length, face[0]),
    )
    return drawer(carcass.style, px, py, face, tray, sheet, length * rng.uniform(0.6, 0.9))


def _controls(rng: np.random.Generator, x: Range, y: Range, z: Range) -> list[Piece]:
    """A fixed panel with a row or column of knobs or buttons."""
    pieces = [box("control_panel", x, y, z)]
    width, height = x[1] - x[0], y[1] - y[0]
    count = int(rng.integers(1, 6))
    size = min(0.3 * min(width, height), 0.35 * max(width, height) / count)
    stand = rng.uniform(0.008, 0.03)
    knob = rng.random() < 0.5
    for k in range(count):
        share = (k + 1) / (count + 1)
        cx, cy = (
            (x[0] + share * width, (y[0] + y[1]) / 2) if width > height else ((x[0] + x[1]) / 2, y[0] + share * height)
        )
        if knob:
            pieces.append(rod("knob", (cx, cy, z[0]), (cx, cy, z[1] + stand), size))
        else:
            pieces.append(
                box("button", (cx - size, cx + size), (cy - 0.6 * size, cy + 0.6 * size), (z[0], z[1] + 0.4 * stand))
            )
    return pieces


def _stand(carcass: Carcass, x: Range, z: Range) -> list[Piece]:
    if not carcass.legs:
        return []
    height = (0.0, carcass.legs)
    if carcass.leg_kind == "plinth":
        return [box("base_side_panel", (x[0] + 0.01, x[1] - 0.01), height, (z[0], z[1] - 0.05))]
    thick = max(1.4 * carcass.wall, 0.035)
    pieces = []
    for px in ((x[0], x[0] + thick), (x[1] - thick, x[1])):
        for pz in ((z[0], z[0] + thick), (z[1] - thick, z[1])):
            if carcass.leg_kind == "rods":
                cx, cz = sum(px) / 2, sum(pz) / 2
                pieces.append(rod("leg", (cx, 0.0, cz), (cx, carcass.legs, cz), 0.3 * thick, 0.5 * thick))
            else:
                pieces.append(box("leg", px, height, pz))
    return pieces
