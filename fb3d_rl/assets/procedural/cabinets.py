"""Families with fronts: a carcass of cells, closed by a door, doors, a drawer, a fixed panel, or open."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from fb3d_rl.assets.procedural.fronts import FrontStyle, Side, draw_handle, drawer, hinged_door, swing_room
from fb3d_rl.assets.procedural.shapes import Piece, Range, box, rod
from fb3d_rl.assets.procedural.spec import ObjectSpec, Part

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
            parts.append(hinged_door(carcass.door, style, side, part_x, py, face, rng.uniform(*swing)))
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
                box(
                    "button",
                    (cx - size, cx + size),
                    (cy - 0.6 * size, cy + 0.6 * size),
                    (z[0], z[1] + 0.4 * stand),
                )
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


def draw_front(rng: np.random.Generator, thickness: Range, bare: float = 0.12, framed: float = 0.4) -> FrontStyle:
    """A random front style; panels have a frame with probability `framed`."""
    rail = rng.uniform(0.03, 0.07) if rng.random() < framed else 0.0
    return FrontStyle(draw_handle(rng, bare), rng.uniform(*thickness), rail, rng.uniform(0.2, 0.45), rng.random())


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


LEFT_HINGED = 0.3
"""Share of single doors of refrigerators and safes that are hinged on the left; most are made for right hands."""


def refrigerator(rng: np.random.Generator) -> ObjectSpec:
    """One door, freezer above or below, two doors side by side, or those above a drawer."""
    size = scaled_size(rng.uniform(0.6, 1.0), rng.uniform(1.0, 1.9), rng.uniform(0.55, 0.8))
    side: CellKind = "left" if rng.random() < LEFT_HINGED else "right"
    small, large = Cell(side, rng.uniform(0.35, 0.7), 1), Cell(side, 1.0, int(rng.integers(1, 4)))
    double = Cell("double", 1.0, int(rng.integers(1, 4)))
    layouts = [
        [large],
        [large, small],
        [small, large],
        [double],
        [Cell("drawer", rng.uniform(0.3, 0.5)), double],
    ]
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
            free_swing=(1.5, 2.2),
        ),
    )
    return ObjectSpec("Refrigerator", "heavy", "refrigerator_body", tuple(body), tuple(parts))


def microwave(rng: np.random.Generator) -> ObjectSpec:
    """A door with a window beside a control panel."""
    size = scaled_size(rng.uniform(1.3, 1.9), rng.uniform(0.75, 1.1), rng.uniform(0.8, 1.2))
    mirrored = rng.random() < 0.2
    columns = [
        Column([Cell("right" if mirrored else "left")], rng.uniform(2.2, 4.0)),
        Column([Cell("controls")], 1.0),
    ]
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
            free_swing=(1.4, 2.2),
        ),
    )
    return ObjectSpec("Safe", "heavy", "safe_body", tuple(body), (_with_dial(rng, door),))


def _with_dial(rng: np.random.Generator, door: Part) -> Part:
    """The door with a dial, or a wheel of spokes, fixed on its middle."""
    points = np.concatenate([piece.vertices for piece in door.pieces if piece.name.startswith("door_surface")])
    (x0, y0, z0), (x1, y1, z1) = points.min(0), points.max(0)
    cx, cy = (x0 + x1) / 2, y0 + rng.uniform(0.4, 0.75) * (y1 - y0)
    dial = rod(
        "dial",
        (cx, cy, (z0 + z1) / 2),
        (cx, cy, z1 + rng.uniform(0.02, 0.05)),
        rng.uniform(0.04, 0.1),
        sides=16,
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
