"""Families that open at the top: pots, trash cans, boxes, buckets and laptops."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from fb3d_rl.procedural.shapes import Piece, Range, Vector, around, box, circle, loft, rectangle, rod, slab, wall
from fb3d_rl.procedural.spec import ObjectSpec, Part


def kitchen_pot(rng: np.random.Generator) -> ObjectSpec:
    """A hollow round pot with ears, one long handle or none, and a lid that is lifted straight up."""
    clearance = rng.uniform(0.004, 0.0055)
    kind = rng.choice(["ears", "long", "none"], p=[0.55, 0.3, 0.15])
    reach = {"ears": rng.uniform(0.12, 0.25), "long": rng.uniform(0.6, 1.2), "none": 0.0}[kind]
    # Proportions with the rim's radius as the unit, then the size that gives a bounding box about 2 m across.
    tall, dome, knob = rng.uniform(0.5, 1.7), rng.uniform(0.03, 0.3), rng.uniform(0.1, 0.22)
    span = 2 + (2 * reach if kind == "ears" else reach)
    radius = 2.0 / float(np.linalg.norm([span, 2.0, tall + dome + knob]))
    height, reach, dome, knob = tall * radius, reach * radius, dome * radius, knob * radius
    thickness = rng.uniform(0.025, 0.05)
    foot = radius * rng.uniform(0.75, 1.0)
    rim = circle(int(rng.choice([16, 20, 24])))
    floor = thickness * rng.uniform(1.0, 1.6)
    at_floor = foot + (radius - foot) * floor / height
    body = [
        slab("pot_bottom", rim, (0.0, floor), (foot, foot), (at_floor, at_floor)),
        *wall("pot_wall", rim, (floor, height), (at_floor, at_floor), (radius, radius), thickness),
    ]
    body += _pot_handles(rng, kind, (foot, radius), height, reach, thickness)
    lid = _pot_lid(rng, rim, (foot, radius), height, thickness, clearance, dome, knob)
    parts = (Part("lid", "slider", (0, 1, 0), rng.uniform(0.04, 0.6), tuple(lid)),)
    return ObjectSpec("KitchenPot", "free", "pot_body", tuple(body), parts)


def _pot_handles(
    rng: np.random.Generator, kind: str, radii: Range, height: float, reach: float, thickness: float
) -> list[Piece]:
    """Two ears, one long handle or none, that reach so far (m) beyond a pot with these radii (m) at foot and rim."""
    foot, radius = radii
    grip = rng.uniform(0.025, 0.05)
    high = min(height * rng.uniform(0.72, 0.88), height - grip)
    beside = foot + (radius - foot) * high / height - 0.5 * thickness  # inside the wall's material
    pieces = []
    if kind == "ears":
        spread = radius * rng.uniform(0.18, 0.35)
        for sign in (-1.0, 1.0):
            tip = sign * (radius + reach)
            for z in (-spread, spread):
                # Starts at the wall's material where the wall curves away from the handle.
                start = sign * float(np.sqrt(beside**2 - z**2))
                pieces.append(rod("handle", (start, high, z), (tip, high, z), grip / 2))
            pieces.append(rod("handle", (tip, high, -spread - grip / 2), (tip, high, spread + grip / 2), grip / 2))
    elif kind == "long":
        sign = 1.0 if rng.random() < 0.5 else -1.0
        end = (sign * (radius + reach), high + rng.uniform(0.0, 0.15) * reach, 0.0)
        pieces.append(rod("handle", (sign * beside, high, 0.0), end, 0.6 * grip, 0.9 * grip))
    return pieces


def _pot_lid(
    rng: np.random.Generator,
    rim: npt.NDArray[np.float64],
    radii: Range,
    height: float,
    thickness: float,
    clearance: float,
    dome: float,
    knob: float,
) -> list[Piece]:
    """A domed lid with a grip on top, `clearance` above the rim of a pot with these radii (m) at foot and rim."""
    foot, radius = radii
    base = height + clearance
    edge = rng.uniform(0.015, 0.03)
    brim = radius * rng.uniform(0.97, 1.06)
    crown = radius * rng.uniform(0.3, 0.5)
    shoulder = (brim + crown) / 2
    lid = []
    for y, lower, upper in (
        ((base, base + edge), brim, brim),
        ((base + edge, base + edge + 0.65 * dome), 0.95 * brim, shoulder),
        ((base + edge + 0.65 * dome, base + edge + dome), shoulder, crown),
    ):
        lid.append(slab("lid_surface", rim, y, (lower, lower), (upper, upper)))
    lid += _lid_grip(rng, base + edge + dome, knob, 0.8 * crown)
    if rng.random() < 0.5:  # a collar that reaches into the pot and keeps the lid in place
        depth = rng.uniform(0.02, 0.05)
        inner = foot + (radius - foot) * (height - depth) / height - thickness - 2 * clearance
        lid.append(slab("lid_collar", rim, (height - depth, base), (inner, inner), (inner, inner)))
    return lid


def _lid_grip(rng: np.random.Generator, y: float, height: float, width: float) -> list[Piece]:
    """A knob or a bridge on top of a lid, of the given height and half width (m)."""
    if rng.random() < 0.6:
        radius = min(rng.uniform(0.04, 0.09), width)
        neck = y + 0.5 * height
        return [
            rod("handle", (0.0, y - 0.01, 0.0), (0.0, neck, 0.0), 0.5 * radius),
            rod("handle", (0.0, neck, 0.0), (0.0, y + height, 0.0), radius, 0.8 * radius),
        ]
    half = rng.uniform(0.015, 0.03)
    top = (y + height - 2 * half, y + height)
    return [
        box("handle", (-width, -width + 2 * half), (y - 0.01, top[0]), (-half, half)),
        box("handle", (width - 2 * half, width), (y - 0.01, top[0]), (-half, half)),
        box("handle", (-width, width), top, (-half, half)),
    ]


def trash_can(rng: np.random.Generator) -> ObjectSpec:
    """A tapered bin, round or square, with a lid hinged at the back and often a pedal."""
    clearance = rng.uniform(0.004, 0.0055)
    width, height, depth = rng.uniform(0.7, 1.1), rng.uniform(0.9, 1.9), rng.uniform(0.6, 1.0)
    is_round = rng.random() < 0.5
    if is_round:
        depth = width
    scale = 1.96 / float(np.linalg.norm([width, height, depth]))
    half, height = (width * scale / 2, depth * scale / 2), height * scale
    outline = circle(int(rng.choice([12, 16, 20]))) if is_round else rectangle()
    # A polygon's flat back, unlike a circle, lies within the radius.
    back = -half[1] * float(-outline[:, 1].min())
    taper = rng.uniform(0.7, 1.0)
    foot = (half[0] * taper, half[1] * taper)
    thickness, floor = rng.uniform(0.02, 0.04), rng.uniform(0.02, 0.05)
    base = height * rng.uniform(0.82, 0.94)  # where the bin ends and the lid begins
    share = floor / base
    at_floor = (foot[0] + (half[0] - foot[0]) * share, foot[1] + (half[1] - foot[1]) * share)
    body = [
        slab("bottom_panel", outline, (0.0, floor), foot, at_floor),
        *wall("bin_wall", outline, (floor, base - clearance), at_floor, half, thickness),
    ]
    if rng.random() < 0.5:
        pedal = rng.uniform(0.06, 0.12)
        body.append(box("pedal", (-pedal, pedal), (0.01, 0.035), (0.5 * foot[1], half[1] + rng.uniform(0.03, 0.1))))
    thick = rng.uniform(0.02, 0.05)
    top = height - base - thick
    lid = [slab("lid_surface", outline, (base, base + thick), half, half)]
    if top > 0.02 and rng.random() < 0.6:
        crown = rng.uniform(0.4, 0.85)
        y = (base + thick, base + thick + top)
        lid.append(slab("lid_surface", outline, y, half, (half[0] * crown, half[1] * crown)))
    if rng.random() < 0.7:
        tongue = rng.uniform(0.06, 0.6 * half[0])
        front = (0.6 * half[1], half[1] + rng.uniform(0.02, 0.07))
        lid.append(box("handle", (-tongue, tongue), (base, base + 0.8 * thick), front))
    parts = (Part("lid", "hinge", (-1, 0, 0), rng.uniform(1.3, 2.0), tuple(lid), (0.0, base, back)),)
    return ObjectSpec("TrashCan", "free", "trashcan_body", tuple(body), parts)


def storage_box(rng: np.random.Generator) -> ObjectSpec:
    """A hollow box with one lid hinged at the back, or two flaps hinged at the sides or at front and back."""
    clearance = rng.uniform(0.004, 0.0055)
    width, height, depth = rng.uniform(0.9, 1.7), rng.uniform(0.5, 1.2), rng.uniform(0.7, 1.2)
    scale = 1.96 / float(np.linalg.norm([width, height, depth]))
    half, height = (width * scale / 2, depth * scale / 2), height * scale
    thickness, lid = rng.uniform(0.015, 0.04), rng.uniform(0.015, 0.05)
    base = height - lid
    body = [
        slab("bottom_panel", rectangle(), (0.0, thickness), half, half),
        *wall("box_wall", rectangle(), (thickness, base - clearance), half, half, thickness),
    ]
    y = (base, height)
    kind = rng.choice(["lid", "sides", "front_back"], p=[0.6, 0.2, 0.2])
    x, z = (-half[0], half[0]), (-half[1], half[1])
    if kind == "lid":
        parts = [_box_lid(rng, x, y, z, lid)]
    else:
        parts = _box_flaps(rng, kind == "sides", x, y, z, 2 * clearance)
    return ObjectSpec("Box", "free", "box_body", tuple(body), tuple(parts))


def _box_lid(rng: np.random.Generator, x: Range, y: Range, z: Range, thickness: float) -> Part:
    """One lid, hinged at the back: flat, vaulted or with a raised field, with a lip, a knob or nothing to hold."""
    base, height = y
    over = rng.uniform(0.0, 0.03)
    pieces = [box("lid_surface", (x[0] - over, x[1] + over), y, (z[0], z[1] + over))]
    if rng.random() < 0.3:  # a vault from side to side
        pieces += _vault(x, height, z, rng.uniform(0.1, 0.5) * (z[1] - z[0]))
    elif rng.random() < 0.4:  # a raised, smaller field on top
        rim = rng.uniform(0.06, 0.15)
        raised = (height, height + rng.uniform(0.01, 0.04))
        pieces.append(box("lid_field", (x[0] + rim, x[1] - rim), raised, (z[0] + rim, z[1] - rim)))
    grip = rng.choice(["lip", "knob", "none"], p=[0.5, 0.25, 0.25])
    if grip == "lip":
        tongue = rng.uniform(0.06, 0.3) * x[1] * 2
        front = (z[1] - 0.05, z[1] + over + rng.uniform(0.02, 0.06))
        pieces.append(box("handle", (-tongue / 2, tongue / 2), (base, base + 0.7 * thickness), front))
    elif grip == "knob":
        at = z[1] - rng.uniform(0.06, 0.2) * z[1]
        top = (0.0, height + rng.uniform(0.04, 0.09), at)
        pieces.append(rod("handle", (0.0, base + thickness / 2, at), top, rng.uniform(0.02, 0.04)))
    return Part("rotation_lid", "hinge", (-1, 0, 0), rng.uniform(1.3, 2.1), tuple(pieces), (0.0, base, z[0]))


def _box_flaps(rng: np.random.Generator, sides: bool, x: Range, y: Range, z: Range, gap: float) -> list[Part]:
    """Two flaps, hinged at the sides, or else at front and back."""
    # Each flap's inner upper edge stays within its closed length, since the hinge lies at its lower edge.
    base, share = y[0], rng.uniform(0.35, 0.65)
    flaps: list[tuple[Range, Range, Vector, Vector]]
    if sides:
        cut = x[0] + share * (x[1] - x[0])
        flaps = [
            ((x[0], cut - gap), z, (0, 0, 1), (x[0], base, 0.0)),
            ((cut + gap, x[1]), z, (0, 0, -1), (x[1], base, 0.0)),
        ]
    else:
        cut = z[0] + share * (z[1] - z[0])
        flaps = [
            (x, (z[0], cut - gap), (-1, 0, 0), (0.0, base, z[0])),
            (x, (cut + gap, z[1]), (1, 0, 0), (0.0, base, z[1])),
        ]
    return [
        Part("rotation_lid", "hinge", axis, rng.uniform(1.4, 2.2), (box("lid_surface", fx, y, fz),), origin)
        for fx, fz, axis, origin in flaps
    ]


def _vault(x: Range, y: float, z: Range, rise: float) -> list[Piece]:
    """The upper half of an elliptic cylinder along x, `rise` m high above the rectangle x, z at height y."""
    angle = np.linspace(0.0, np.pi, 9)
    profile = np.stack([y + rise * np.sin(angle), (z[0] + z[1]) / 2 + (z[1] - z[0]) / 2 * np.cos(angle)], 1)
    ends = [np.insert(profile, 0, end, axis=1) for end in x]
    return [loft("lid_surface", ends[0], ends[1])]


def bucket(rng: np.random.Generator) -> ObjectSpec:
    """A tapered bucket with a bail that lies around the rim, to the back or front, and is swung up, or over."""
    radius, height = rng.uniform(0.5, 0.65), rng.uniform(0.7, 1.2)
    foot = radius * rng.uniform(0.65, 0.9)
    thickness, floor = rng.uniform(0.015, 0.03), rng.uniform(0.02, 0.04)
    rim = circle(int(rng.choice([16, 20, 24])))
    at_floor = foot + (radius - foot) * floor / height
    body = [
        slab("bucket_bottom", rim, (0.0, floor), (foot, foot), (at_floor, at_floor)),
        *wall("bucket_wall", rim, (floor, height), (at_floor, at_floor), (radius, radius), thickness),
    ]
    wire = rng.uniform(0.012, 0.022)
    pivot = height - rng.uniform(0.03, 0.06)
    bail = radius + wire + rng.uniform(0.02, 0.035)
    side = 1.0 if rng.random() < 0.5 else -1.0
    segments = 12
    angle = np.pi * np.arange(segments + 1) / segments
    corners = [(float(bail * np.cos(a)), pivot, float(side * bail * np.sin(a))) for a in angle]
    handle = [rod("handle", a, b, wire, sides=8) for a, b in zip(corners, corners[1:], strict=False)]
    parts = (Part("handle", "hinge", (-side, 0, 0), rng.uniform(1.25, 3.0), tuple(handle), (0.0, pivot, 0.0)),)
    return ObjectSpec("Bucket", "free", "bucket_body", tuple(body), parts)


def laptop(rng: np.random.Generator) -> ObjectSpec:
    """A keyboard half and a screen that is closed on it, hinged at the back."""
    clearance = rng.uniform(0.004, 0.0055)
    width, depth = rng.uniform(1.1, 1.7), rng.uniform(0.8, 1.2)
    scale = 1.96 / float(np.linalg.norm([width, depth]))
    x, z = (-width * scale / 2, width * scale / 2), (-depth * scale / 2, depth * scale / 2)
    base, screen, key = rng.uniform(0.03, 0.09), rng.uniform(0.02, 0.05), rng.uniform(0.004, 0.012)
    body = [box("base_frame", x, (0.0, base), z)]
    rows, margin = int(rng.integers(4, 7)), rng.uniform(0.04, 0.1)
    rows_from, rows_to = z[0] + 0.15 * (z[1] - z[0]), z[0] + 0.6 * (z[1] - z[0])
    pitch = (rows_to - rows_from) / rows
    for i in range(rows):
        start = rows_from + i * pitch
        body.append(box("keyboard", (x[0] + margin, x[1] - margin), (base, base + key), (start, start + 0.8 * pitch)))
    bottom = base + key + clearance
    y = (bottom, bottom + screen)
    bezel = rng.uniform(0.03, 0.07)
    over = rng.uniform(0.0, 0.025)  # the screen stands out a little in front, where fingers lift it
    front = z[1] + over
    field = (bottom + 0.2 * screen, y[1])
    inside = (x[0] + bezel, x[1] - bezel), (z[0] + bezel, front - bezel)
    pieces = [
        *around("screen_frame", x, y, (z[0], front), inside, lying=True),
        box("screen", inside[0], field, inside[1]),
    ]
    parts = (Part("screen", "hinge", (-1, 0, 0), rng.uniform(1.6, 2.9), tuple(pieces), (0.0, bottom, z[0])),)
    return ObjectSpec("Laptop", "free", "laptop_base", tuple(body), parts)
