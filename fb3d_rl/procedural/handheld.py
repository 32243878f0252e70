"""Families of small things, kettles, staplers, phones and switches, and of what one sits on: chairs, toilets."""

from __future__ import annotations

import numpy as np

from fb3d_rl.procedural.shapes import Piece, around, box, circle, housing, loft, rod, slab, wall
from fb3d_rl.procedural.spec import ObjectSpec, Part


def kettle(rng: np.random.Generator) -> ObjectSpec:
    """A hollow kettle with a spout in front and a handle behind or above; its lid is lifted or swings up."""
    clearance = rng.uniform(0.004, 0.0055)
    radius, height = 0.5, rng.uniform(0.6, 1.1)
    neck = radius * rng.uniform(0.5, 0.75)
    thickness, floor = rng.uniform(0.018, 0.03), rng.uniform(0.02, 0.04)
    rim = circle(int(rng.choice([16, 20, 24])))
    waist = height * rng.uniform(0.35, 0.55)
    foot = radius * rng.uniform(0.8, 0.98)
    at_floor = foot + (radius - foot) * floor / waist
    body = [
        slab("kettle_bottom", rim, (0.0, floor), (foot, foot), (at_floor, at_floor)),
        *wall("kettle_wall", rim, (floor, waist), (at_floor, at_floor), (radius, radius), thickness),
        *wall("kettle_wall", rim, (waist, height), (radius, radius), (neck, neck), thickness),
    ]
    spout = waist * rng.uniform(0.7, 0.95)
    inside = at_floor + (radius - at_floor) * spout / waist - thickness
    tip = radius + rng.uniform(0.2, 0.4)
    wide = rng.uniform(0.06, 0.1)
    body.append(rod("spout", (0.0, spout, inside), (0.0, height * rng.uniform(0.85, 1.05), tip), wide, 0.5 * wide))

    swings = rng.random() < 0.4
    edge, dome, knob = rng.uniform(0.015, 0.03), rng.uniform(0.02, 0.1), rng.uniform(0.06, 0.12)
    base, brim = height + clearance, neck * rng.uniform(0.98, 1.08)
    crown = brim * rng.uniform(0.3, 0.55)
    stem = min(rng.uniform(0.03, 0.06), crown)
    top = base + edge + dome
    lid = [
        slab("lid_surface", rim, (base, base + edge), (brim, brim), (brim, brim)),
        slab("lid_surface", rim, (base + edge, top), (0.97 * brim, 0.97 * brim), (crown, crown)),
        rod("handle", (0.0, top - 0.005, 0.0), (0.0, top + knob, 0.0), 0.6 * stem, stem),
    ]
    upper = rng.uniform(1.3, 1.7) if swings else rng.uniform(0.25, 0.4)
    grip = rng.uniform(0.02, 0.035)
    if not swings and rng.random() < 0.5:  # an arch over the lid, high enough to lift it out below
        arch = top + knob + 1.6 * upper + grip
        beside = 0.96 * radius
        corners = [(-beside, waist, 0.0), (-beside, arch, 0.0), (beside, arch, 0.0), (beside, waist, 0.0)]
    else:
        low, high = waist * rng.uniform(0.35, 0.7), height * rng.uniform(0.7, 0.85)
        behind = -radius - rng.uniform(0.15, 0.3)
        at_low = at_floor + (radius - at_floor) * low / waist - 0.5 * thickness
        at_high = radius + (neck - radius) * max(high - waist, 0.0) / (height - waist) - 0.5 * thickness
        corners = [(0.0, low, -at_low), (0.0, low, behind), (0.0, high, behind), (0.0, high, -at_high)]
    body += [rod("handle", a, b, grip) for a, b in zip(corners, corners[1:], strict=False)]
    part = (
        Part("lid", "hinge", (-1, 0, 0), upper, tuple(lid), (0.0, base, brim * float(rim[:, 1].min())))
        if swings
        else Part("lid", "slider", (0, 1, 0), upper, tuple(lid))
    )
    return ObjectSpec("Kettle", "free", "kettle_body", tuple(body), (part,))


def stapler(rng: np.random.Generator) -> ObjectSpec:
    """A flat base with two cheeks at its back end, between which the arm with the staples is hinged."""
    clearance = rng.uniform(0.005, 0.007)
    length, half, base = 1.8, rng.uniform(0.12, 0.24), rng.uniform(0.04, 0.09)
    back, front = -length / 2, length / 2
    cheek, sheet = rng.uniform(0.02, 0.035), rng.uniform(0.018, 0.03)
    deep, tall = rng.uniform(0.12, 0.3), rng.uniform(0.22, 0.4)  # of the cheeks
    body = [
        box("base_plate", (-half, half), (0.0, base), (back, front)),
        box("cheek", (-half, -half + cheek), (base, base + tall), (back, back + deep)),
        box("cheek", (half - cheek, half), (base, base + tall), (back, back + deep)),
        box("anvil", (-0.5 * half, 0.5 * half), (base, base + 0.5 * sheet), (front - 0.25, front - 0.1)),
    ]
    rest = base + sheet + clearance + rng.uniform(0.0, 0.06)  # the arm's lower side
    height = rng.uniform(0.12, 0.25)
    wide = half - cheek - clearance
    end = front + rng.uniform(-0.08, 0.05)
    start = back + rng.uniform(0.02, 0.06)
    nose = rng.uniform(0.5, 1.0) * height
    arm: list[Piece] = []
    for low, high in ((-wide, -wide + sheet), (wide - sheet, wide)):
        side = [(start, rest), (end, rest), (end, rest + nose), (start, rest + height)]
        arm.append(loft("arm_side", [(low, y, z) for z, y in side], [(high, y, z) for z, y in side]))
    roof = [(start, rest + height), (end, rest + nose), (end, rest + nose + sheet), (start, rest + height + sheet)]
    arm.append(loft("lid_surface", [(-wide, y, z) for z, y in roof], [(wide, y, z) for z, y in roof]))
    inner = (-wide + sheet, wide - sheet)
    arm.append(box("arm_front", inner, (rest, rest + nose), (end - sheet, end)))
    if rng.random() < 0.6:  # the rail with the staples, open at its upper side
        arm.append(box("magazine", inner, (rest, rest + sheet), (start + deep, end - sheet)))
    part = Part("lid", "hinge", (-1, 0, 0), rng.uniform(1.25, 1.55), tuple(arm), (0.0, rest, start))
    return ObjectSpec("Stapler", "free", "stapler_base", tuple(body), (part,))


def phone(rng: np.random.Generator) -> ObjectSpec:
    """A phone that lies on its back: one half is flipped open, or slid towards the front, off the keys."""
    clearance = rng.uniform(0.005, 0.007)
    width, length = rng.uniform(0.8, 1.05), rng.uniform(1.5, 1.75)
    x, z = (-width / 2, width / 2), (-length / 2, length / 2)
    base, cover, key = rng.uniform(0.06, 0.14), rng.uniform(0.05, 0.12), rng.uniform(0.006, 0.012)
    body = [box("base_frame", x, (0.0, base), z)]
    rows, columns, margin = int(rng.integers(3, 6)), 3, 0.1 * width
    pitch_x, pitch_z = (width - 2 * margin) / columns, (0.55 * length) / rows
    for i in range(rows):
        for j in range(columns):
            left, low = x[0] + margin + j * pitch_x, z[1] - 0.08 * length - (i + 1) * pitch_z
            keys = (left, left + 0.8 * pitch_x), (base, base + key), (low, low + 0.7 * pitch_z)
            body.append(box("button", *keys))
    bottom = base + key + clearance
    y = (bottom, bottom + cover)
    slides = rng.random() < 0.35
    over = 0.0 if slides else rng.uniform(0.0, 0.025)
    bezel = rng.uniform(0.05, 0.1)
    field = (bottom, y[1] - rng.uniform(0.004, 0.012))
    inside = (x[0] + bezel, x[1] - bezel), (z[0] + bezel, z[1] + over - bezel)
    pieces = [
        *around("cover_frame", x, y, (z[0], z[1] + over), inside, lying=True),
        box("screen", inside[0], field, inside[1]),
    ]
    if slides:
        part = Part("slider", "slider", (0, 0, 1), rng.uniform(0.35, 0.5) * length, tuple(pieces))
    else:
        part = Part("lid", "hinge", (-1, 0, 0), rng.uniform(1.4, 2.2), tuple(pieces), (0.0, bottom, z[0]))
    return ObjectSpec("Phone", "free", "phone_base", tuple(body), (part,))


def switch(rng: np.random.Generator) -> ObjectSpec:
    """One to three levers or sliders in the slots of a hollow wall box; all are moved upwards."""
    count = int(rng.integers(1, 4))
    clearance = rng.uniform(0.005, 0.007)
    height, pitch, depth = rng.uniform(1.2, 1.6), rng.uniform(0.35, 0.55), rng.uniform(0.25, 0.45)
    sheet = rng.uniform(0.02, 0.04)
    half = 0.5 * pitch * count + rng.uniform(0.0, 0.15)
    x, y, z = (-half, half), (0.0, height), (-depth, 0.0)
    front = (z[1] - sheet, z[1])
    slot = rng.uniform(0.05, 0.09)  # half width
    slides = rng.random() < 0.5
    low, high = height * rng.uniform(0.2, 0.3), height * rng.uniform(0.7, 0.8)
    body = [
        *housing(x, y, (z[0], front[0]), sheet),
        box("switch_frame", x, (0.0, low), front),
        box("switch_frame", x, (high, height), front),
    ]
    centres = [pitch * (k - 0.5 * (count - 1)) for k in range(count)]
    edges = [x[0], *(c + s * slot for c in centres for s in (-1, 1)), x[1]]
    body += [box("switch_frame", pair, (low, high), front) for pair in zip(edges[::2], edges[1::2], strict=True)]
    out = rng.uniform(0.12, 0.25)
    wide = slot - clearance
    parts = []
    for at in centres:
        if slides:
            tall, cap = rng.uniform(0.12, 0.2), rng.uniform(1.0, 1.6) * slot
            start = low + clearance + rng.uniform(0.0, 0.05)
            cap = min(cap, 0.5 * pitch - 0.02)
            pieces = (
                box("stem", (at - wide, at + wide), (start, start + tall), (front[0], clearance + 0.01)),
                box("knob", (at - cap, at + cap), (start, start + tall), (clearance + 0.01, out)),
            )
            travel = (high - clearance - start - tall) * rng.uniform(0.7, 1.0)
            parts.append(Part("slider", "slider", (0, 1, 0), travel, pieces))
        else:
            # The lever turns about an axis behind the front; at rest it points down, by as much as it will point up.
            middle, reach, upper = (low + high) / 2, out + 2.5 * sheet, rng.uniform(0.8, 1.2)
            tilt = 0.5 * upper
            pivot = (at, middle, front[0] - 0.5 * sheet)
            end = (at, middle - reach * np.sin(tilt), pivot[2] + reach * np.cos(tilt))
            thin = 0.6 * wide
            lever = (rod("lever", pivot, end, thin, 0.95 * wide),)
            parts.append(Part("lever", "hinge", (-1, 0, 0), upper, lever, pivot))
    return ObjectSpec("Switch", "static", "switch_frame", tuple(body), tuple(parts))


def folding_chair(rng: np.random.Generator) -> ObjectSpec:
    """Two crossed pairs of legs with a backrest; the seat is folded up to it."""
    half, seat = rng.uniform(0.36, 0.46), rng.uniform(0.75, 0.95)
    height, deep = rng.uniform(1.5, 1.9), rng.uniform(0.7, 0.9)
    lean = rng.uniform(0.2, 0.32)  # of the backrest from the vertical, rad
    tube, thick = rng.uniform(0.018, 0.03), rng.uniform(0.03, 0.06)
    slope = float(np.tan(lean))

    def at(y: float) -> float:  # z of the long legs, which end in the backrest
        return slope * (0.5 * height - y)

    body: list[Piece] = []
    for side in (-half, half):
        body.append(rod("leg", (side, 0.0, at(0.0)), (side, height, at(height)), tube))
        body.append(rod("leg", (side, 0.0, at(0.0) - deep), (side, seat - thick, at(seat) + 0.45 * deep), tube))
    for y in (0.12 * height, height - tube):
        body.append(rod("bar", (-half, y, at(y)), (half, y, at(y)), tube))
    body.append(rod("bar", (-half, 0.1, at(0.0) - 0.9 * deep), (half, 0.1, at(0.0) - 0.9 * deep), tube))
    slats, bottom = int(rng.integers(1, 4)), height * rng.uniform(0.68, 0.76)
    pitch = (height - 2 * tube - bottom) / slats
    for k in range(slats):
        low, high = bottom + k * pitch, bottom + (k + (0.75 if slats > 1 else 0.95)) * pitch
        flat = 0.6 * tube
        quad = [(low, at(low) - flat), (high, at(high) - flat), (high, at(high) + flat), (low, at(low) + flat)]
        body.append(loft("back_slat", [(-half, y, z) for y, z in quad], [(half, y, z) for y, z in quad]))
    wide = half - tube - rng.uniform(0.02, 0.04)
    back = at(seat) + tube + thick + 0.02  # room for the seat's upper side, which turns to the back
    pieces: list[Piece] = []
    boards = int(rng.integers(1, 5))
    board = deep / boards
    for k in range(boards):
        near = back + k * board
        far = near + board * (1.0 if k == boards - 1 else 0.85)
        pieces.append(box("seat_surface", (-wide, wide), (seat, seat + thick), (near, far)))
    if boards > 1:
        for x in (-0.8 * wide, 0.8 * wide - 0.04):
            pieces.append(box("seat_rail", (x, x + 0.04), (seat - 0.03, seat), (back, back + deep)))
    part = Part("seat", "hinge", (-1, 0, 0), rng.uniform(1.2, 1.4), tuple(pieces), (0.0, seat, back))
    return ObjectSpec("FoldingChair", "free", "leg", tuple(body), (part,))


def toilet(rng: np.random.Generator) -> ObjectSpec:
    """A hollow bowl on a foot with a cistern behind it; the lid swings up, that of some cisterns is lifted off."""
    clearance = rng.uniform(0.005, 0.007)
    half, long, bowl = rng.uniform(0.36, 0.45), rng.uniform(0.46, 0.58), rng.uniform(0.7, 0.9)
    thickness, floor = rng.uniform(0.04, 0.06), bowl * rng.uniform(0.35, 0.5)
    outline = circle(int(rng.choice([16, 20, 24])))
    foot = rng.uniform(0.5, 0.75)
    ring = rng.uniform(0.02, 0.04)
    top = bowl + ring
    body = [
        slab("foot", outline, (0.0, floor), (foot * half, foot * long), (half, long)),
        *wall("bowl", outline, (floor, bowl), (half, long), (half, long), thickness),
        *wall("seat", outline, (bowl, top), (half, long), (half, long), 2 * thickness),
    ]
    lid_thick, base = rng.uniform(0.02, 0.04), top + clearance
    hinge = float(outline[:, 1].min()) * long
    front = hinge - lid_thick - rng.uniform(0.03, 0.08)  # of the cistern: the open lid stands before it
    deep, wide, tall = rng.uniform(0.28, 0.4), rng.uniform(0.4, 0.52), rng.uniform(0.45, 0.7)
    low = bowl - rng.uniform(0.0, 0.15)
    sheet = rng.uniform(0.025, 0.04)
    x, y, z = (-wide, wide), (low, low + tall), (front - deep, front)
    inside = (x[0] + sheet, x[1] - sheet), (z[0] + sheet, z[1] - sheet)
    body += [
        box("water_tank", x, (y[0], y[0] + sheet), z),
        *around("water_tank", x, (y[0] + sheet, y[1]), z, inside, lying=True),
        box("pipe", (-0.4 * half, 0.4 * half), (0.0, y[0]), (front - 0.8 * deep, -0.3 * long)),
    ]
    over = rng.uniform(0.0, 0.02)
    cover = box(
        "tank_cover",
        (x[0] - over, x[1] + over),
        (y[1] + clearance, y[1] + clearance + rng.uniform(0.03, 0.06)),
        (z[0], min(z[1] + over, hinge - lid_thick - 0.02)),
    )
    lid = slab("lid_surface", outline, (base, base + lid_thick), (half, long), (0.95 * half, 0.95 * long))
    parts = [Part("lid", "hinge", (-1, 0, 0), rng.uniform(1.3, 1.5), (lid,), (0.0, base, hinge))]
    if rng.random() < 0.4:
        parts.append(Part("pump_lid", "slider", (0, 1, 0), rng.uniform(0.2, 0.4), (cover,)))
    else:
        body.append(cover)
    return ObjectSpec("Toilet", "static", "toilet_body", tuple(body), tuple(parts))
