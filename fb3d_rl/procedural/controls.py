"""Families of controls on a panel: push buttons, levers, sliders, knobs, and panels that mix them.

Each control fills a cell of the panel: a plate on the body's surface with a hole where the control goes through. Its
frame is the mount's with the cell's middle as its origin.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from fb3d_rl.procedural.bodies import Half, Pose, draw_body, holed, prism, quarter
from fb3d_rl.procedural.shapes import Piece, box, rod
from fb3d_rl.procedural.spec import ObjectSpec, Part

CLEAR = 0.007
"""Gap (m) between what moves and what does not, in a body about 2 m across."""
SMALLEST = 0.22
"""Least half side (m) of a cell: a control in a smaller one is hardly seen."""


@dataclass(frozen=True)
class Cell:
    """One control and the piece of the plate around it."""

    plate: list[Piece]
    part: Part


def push_button(rng: np.random.Generator) -> ObjectSpec:
    """One to four buttons that are pressed in: round, square or mushrooms, or rockers whose proud end is pressed."""
    return _panel(rng, "PushButton", [_button_cell], top=0.4)


def lever(rng: np.random.Generator) -> ObjectSpec:
    """One to four levers: sticks in slots that tip over, mostly downwards, and arms that turn on the surface."""
    return _panel(rng, "Lever", [_stick_cell, _arm_cell], top=0.2)


def slider(rng: np.random.Generator) -> ObjectSpec:
    """One to four sliders in slots, at one end of them; a toaster's lever goes down."""
    return _panel(rng, "Slider", [_slider_cell], top=0.3)


def knob(rng: np.random.Generator) -> ObjectSpec:
    """One to four knobs that turn about their own axes."""
    return _panel(rng, "Knob", [_knob_cell], top=0.25)


def control_panel(rng: np.random.Generator) -> ObjectSpec:
    """Two to four controls of different kinds on one panel."""
    cells = [_button_cell, _stick_cell, _arm_cell, _slider_cell, _knob_cell]
    return _panel(rng, "ControlPanel", cells, top=0.25, mixed=True)


def _panel(
    rng: np.random.Generator,
    category: str,
    cells: Sequence[Callable[[np.random.Generator, Half, float], Cell]],
    top: float,
    mixed: bool = False,
) -> ObjectSpec:
    """A body with a plate of one to four cells, as many as have room, in a row, a column or a square.

    Args:
        rng: The generator.
        category: The object's.
        cells: What makes the kinds of control that the panel may have.
        top: Probability that the panel is on top of the body.
        mixed: Whether the controls are of different kinds; there are at least two cells then.
    """
    body = draw_body(rng, top=top)
    count = int(rng.integers(2 if mixed else 1, 5))
    share = rng.uniform(0.6, 1.0, 2) if rng.random() < 0.65 else np.ones(2)
    half = tuple(max(part * whole, min(whole, SMALLEST)) for part, whole in zip(share, body.half, strict=True))
    middle = [rng.uniform(-1, 1) * (whole - part) for whole, part in zip(body.half, half, strict=True)]
    options = [(count, 1), (1, count), (2, 2)] if count == 4 else [(count, 1), (1, count)]
    # The arrangement whose cells are the least elongated.
    columns, rows = min(options, key=lambda grid: abs(np.log(half[0] / grid[0] / (half[1] / grid[1]))))
    columns, rows = (max(1, min(n, int(h / SMALLEST))) for n, h in zip((columns, rows), half, strict=True))
    cell_half = (half[0] / columns, half[1] / rows)
    thick = rng.uniform(0.08, 0.18)
    kinds = [cells[k] for k in rng.permutation(len(cells))]
    if not mixed:
        kinds = kinds[:1]
    fixed: list[Piece] = []
    parts = []
    for index in range(columns * rows):
        column, row = index % columns, index // columns
        at = (
            middle[0] - half[0] + (2 * column + 1) * cell_half[0],
            middle[1] - half[1] + (2 * row + 1) * cell_half[1],
            0.0,
        )
        made = kinds[index % len(kinds)](rng, cell_half, thick)
        pose = Pose(Rotation.identity(), at)
        fixed += pose.pieces(made.plate)
        parts.append(pose.part(made.part))
    return body.object(category, rng, fixed, parts)


def _turned(cell: Cell, turns: int) -> Cell:
    """The cell after quarter turns in its plane."""
    pose = quarter(turns)
    return Cell(list(pose.pieces(cell.plate)), pose.part(cell.part))


def _solid(half: Half, thick: float) -> list[Piece]:
    return [box("panel", (-half[0], half[0]), (-half[1], half[1]), (0.0, thick))]


def _button_cell(rng: np.random.Generator, half: Half, thick: float) -> Cell:
    room = min(half)
    if rng.random() < 0.2:
        return _rocker_cell(rng, half, thick)
    travel = rng.uniform(0.5, 0.85) * (thick - CLEAR)
    proud = thick + rng.uniform(0.3, 1.3) * travel
    size = (rng.uniform(0.45, 0.85) * room, rng.uniform(0.45, 0.85) * room)
    kind = rng.choice(["round", "square", "mushroom"], p=[0.45, 0.35, 0.2])
    bottom = travel + CLEAR
    if kind == "square":
        plate = holed("panel", half, (size[0] + CLEAR, size[1] + CLEAR), (0.0, thick))
        pieces = [box("button", (-size[0], size[0]), (-size[1], size[1]), (bottom, proud))]
    elif kind == "round":
        radius = size[0]
        # The hole's sectors leave a circle of 0.92 of its square, and of its corners' radius cos(pi / 16) inside.
        hole = (radius + CLEAR) / (0.92 * float(np.cos(np.pi / 16)))
        if hole >= 0.97 * room:
            radius, hole = radius * 0.85, hole * 0.88
        plate = holed("panel", half, (hole, hole), (0.0, thick), is_round=True)
        crown = rng.uniform(0.6, 1.0)
        edge = thick + 0.5 * (proud - thick)
        pieces = [
            rod("button", (0, 0, bottom), (0, 0, edge), radius, sides=16),
            rod("button", (0, 0, edge), (0, 0, proud), radius, crown * radius, sides=16),
        ]
    else:  # wider above the plate than in it
        stem = rng.uniform(0.3, 0.5) * size[0]
        hole = (stem + CLEAR) / (0.92 * float(np.cos(np.pi / 16)))
        plate = holed("panel", half, (hole, hole), (0.0, thick), is_round=True)
        under = thick + travel + CLEAR
        height = rng.uniform(0.05, 0.12)
        pieces = [
            rod("button", (0, 0, bottom), (0, 0, under + 0.005), stem),
            rod("button", (0, 0, under), (0, 0, under + height), size[0], rng.uniform(0.6, 1.0) * size[0], sides=16),
        ]
    return Cell(plate, Part("button", "slider", (0, 0, -1), travel, tuple(pieces)))


def _rocker_cell(rng: np.random.Generator, half: Half, thick: float) -> Cell:
    """A slab that stands out at one end and is rocked over to the other."""
    turns = int(rng.integers(4))
    across, along = half if turns % 2 == 0 else half[::-1]
    long, wide, sheet = rng.uniform(0.5, 0.8) * along, rng.uniform(0.4, 0.75) * across, rng.uniform(0.03, 0.06)
    # The deeper end must stay above the surface.
    tilt = min(rng.uniform(0.15, 0.3), float(np.arcsin(min((thick - CLEAR) / long, 0.9))))
    pivot = float(np.sin(tilt)) * long + CLEAR + 0.6 * sheet
    hole = (wide + CLEAR, min(float(np.hypot(long, sheet)) + CLEAR, 0.97 * along))
    long = min(long, hole[1] - CLEAR - sheet)
    plate = holed("panel", (across, along), hole, (0.0, thick))
    pose = Pose(Rotation.from_rotvec([tilt, 0, 0]), (0, 0, pivot))
    pieces = pose.pieces([box("button", (-wide, wide), (-long, long), (-sheet / 2, sheet / 2))])
    part = Part("button", "hinge", (-1, 0, 0), 2 * tilt, pieces, (0, 0, pivot))
    return _turned(Cell(plate, part), turns)


def _mostly_down(rng: np.random.Generator) -> int:
    """Quarter turns of a cell whose control goes down unless turned."""
    return int(rng.choice(4, p=[0.46, 0.18, 0.18, 0.18]))


def _stick_cell(rng: np.random.Generator, half: Half, thick: float) -> Cell:
    """A stick in a slot that tips from one end of it to the other."""
    turns = _mostly_down(rng)
    across, along = half if turns % 2 == 0 else half[::-1]
    radius = min(rng.uniform(0.035, 0.08), 0.37 * thick, 0.5 * across)
    pivot = 0.5 * thick
    upper, share, length = rng.uniform(0.8, 1.3), rng.uniform(0.4, 0.6), thick + rng.uniform(0.25, 0.7)
    tip, is_grip = rng.uniform(1.2, 2.0) * radius, rng.random() < 0.5
    grip = rng.uniform(1.2, 1.6) * tip if is_grip else tip
    # Neither at the slot's ends nor at its tip does it leave its cell: in a small one it tips less far.
    while True:
        lean = max(share, 1 - share) * upper
        sine, cosine = float(np.sin(lean)), float(np.cos(lean))
        reach = (thick - pivot) * sine / cosine + 1.1 * radius / cosine  # where it leaves the slot
        if max(reach, length * sine + grip * cosine) < 0.97 * along - CLEAR:
            break
        upper, length = 0.95 * upper, 0.99 * length
    tilt = share * upper
    plate = holed("panel", (across, along), (1.1 * radius + CLEAR, reach + CLEAR), (0.0, thick))
    axis = np.array([0.0, np.sin(tilt), np.cos(tilt)])
    start, low, end = (tuple((np.array([0, 0, pivot]) + at * axis).tolist()) for at in (0.0, 0.8 * length, length))
    # It gets wider towards its tip, but not in the slot.
    tip = min(tip, (0.8 + 0.3 * cosine * length / (thick - pivot)) * radius)
    pieces = [rod("lever", start, end, 0.8 * radius, tip)]
    room = (0.8 * length * cosine + pivot - thick - 2 * CLEAR) / max(sine, 0.1)  # of a grip above the plate
    if is_grip and tip < min(grip, room):
        pieces.append(rod("handle", low, end, min(grip, room)))
    part = Part("lever", "hinge", (1, 0, 0), upper, tuple(pieces), (0, 0, pivot))
    return _turned(Cell(plate, part), turns)


def _arm_cell(rng: np.random.Generator, half: Half, thick: float) -> Cell:
    """An arm on a hub that turns about the surface's normal."""
    length = rng.uniform(0.75, 0.97) * min(half)
    hub, high = rng.uniform(0.18, 0.35) * length, rng.uniform(0.04, 0.2)
    wide, sheet = rng.uniform(0.5, 0.9) * hub, min(rng.uniform(0.03, 0.06), high)
    base = thick + CLEAR
    z = (base + high - sheet, base + high)
    reach = float(np.sqrt(length**2 - wide**2))
    pieces = [rod("lever", (0, 0, base), (0, 0, base + high + 0.01), hub)]
    arm = [(0.0, -wide), (reach, -rng.uniform(0.5, 1.0) * wide), (reach, rng.uniform(0.5, 1.0) * wide), (0.0, wide)]
    pieces.append(prism("lever", arm, z))
    if rng.random() < 0.4:
        at = 0.85 * reach
        pieces.append(
            rod("handle", (at, 0, base + high - 0.01), (at, 0, base + high + rng.uniform(0.05, 0.15)), 0.8 * wide)
        )
    clockwise = rng.random() < 0.5
    upper = rng.uniform(0.7, 1.9)
    # It goes down or to the side from where it stands: half of its way lies on either side of the horizontal.
    start = rng.choice([0.0, np.pi / 2, rng.uniform(-np.pi, np.pi)], p=[0.5, 0.3, 0.2]) + rng.uniform(-0.2, 0.2)
    if not clockwise:
        start = np.pi - start  # the mirror image
    placed = Pose(Rotation.from_rotvec([0, 0, start])).pieces(pieces)
    part = Part("lever", "hinge", (0, 0, -1 if clockwise else 1), upper, placed, (0, 0, base))
    return Cell(_solid(half, thick), part)


def _slider_cell(rng: np.random.Generator, half: Half, thick: float) -> Cell:
    """A cap on a stem in a slot, which slides from one end to the other."""
    turns = _mostly_down(rng)
    across, along = half if turns % 2 == 0 else half[::-1]
    slot = (min(rng.uniform(0.03, 0.07), 0.5 * across), rng.uniform(0.75, 0.95) * along)
    tall = rng.uniform(0.2, 0.45) * slot[1]  # half the stem's extent along the slot
    cap = (rng.uniform(1.5, 3.5) * slot[0], rng.uniform(0.9, 1.2) * tall)
    if rng.random() < 0.3:  # a toaster's lever
        cap = (rng.uniform(0.5, 0.9) * across, rng.uniform(0.5, 0.9) * tall)
    cap = (min(cap[0], 0.95 * across), min(cap[1], tall + 0.03 * along))
    travel = 2 * (slot[1] - tall - CLEAR) * rng.uniform(0.75, 1.0)
    start = slot[1] - tall - CLEAR
    under = thick + CLEAR
    top = under + rng.uniform(0.05, 0.25)
    stem = slot[0] - CLEAR
    pieces = [
        box("stem", (-stem, stem), (start - tall, start + tall), (CLEAR, under + 0.005)),
        box("slider", (-cap[0], cap[0]), (start - cap[1], start + cap[1]), (under, top)),
    ]
    if rng.random() < 0.3:
        ridge = 0.3 * cap[1]
        pieces.append(box("slider", (-cap[0], cap[0]), (start - ridge, start + ridge), (top, top + 0.03)))
    part = Part("slider", "slider", (0, -1, 0), travel, tuple(pieces))
    return _turned(Cell(holed("panel", (across, along), slot, (0.0, thick)), part), turns)


def _knob_cell(rng: np.random.Generator, half: Half, thick: float) -> Cell:
    """A knob that turns about the surface's normal: round with a pointer, a bar or lobes."""
    radius = rng.uniform(0.5, 0.92) * min(half)
    high = rng.uniform(0.3, 1.1) * radius
    base = thick + CLEAR
    clockwise = rng.random() < 0.7
    upper = rng.uniform(0.8, 1.6) if rng.random() < 0.4 else rng.uniform(1.6, 3.6)
    # Half the range lies on either side of the top, as on a stove or a radio; the pointer looks to y at 0.
    start = (0.5 if clockwise else -0.5) * upper
    if rng.random() < 0.3:
        start = rng.uniform(-np.pi, np.pi)
    kind = rng.choice(["pointer", "bar", "lobes", "rim"], p=[0.35, 0.3, 0.2, 0.15])
    foot, top = 0.35 * high, base + high
    fin = rng.uniform(0.08, 0.2) * radius
    if kind == "pointer":
        crown = rng.uniform(0.7, 1.0) * radius
        pieces = [
            rod("knob", (0, 0, base), (0, 0, top), radius, crown, sides=16),
            box("knob", (-fin, fin), (-0.1 * radius, 0.95 * crown), (top - 0.01, top + rng.uniform(0.02, 0.08))),
        ]
    elif kind == "bar":
        pieces = [
            rod("knob", (0, 0, base), (0, 0, base + foot), radius, sides=16),
            box("knob", (-2 * fin, 2 * fin), (-0.75 * radius, 0.9 * radius), (base + foot, top)),
        ]
    elif kind == "lobes":
        count = int(rng.integers(3, 7))
        angles = 2 * np.pi * np.arange(count) / count
        size = 0.3 * radius
        pieces = [rod("knob", (0, 0, base), (0, 0, top), 0.62 * radius, sides=16)]
        for a in angles:
            x, y = 0.68 * radius * float(np.sin(a)), 0.68 * radius * float(np.cos(a))
            pieces.append(rod("knob", (x, y, base + 0.3 * foot), (x, y, top - 0.01), size, sides=8))
    else:
        x, y = 0.0, 0.7 * radius
        pieces = [
            rod("knob", (0, 0, base), (0, 0, base + foot), radius, sides=16),
            rod("knob", (x, y, base + foot - 0.005), (x, y, top + 0.05), 0.2 * radius),
        ]
    placed = Pose(Rotation.from_rotvec([0, 0, start])).pieces(pieces)
    part = Part("knob", "hinge", (0, 0, -1 if clockwise else 1), upper, placed, (0, 0, base))
    return Cell(_solid(half, thick), part)
