"""Families of what is drawn out of a hollow body: telescopic handles and rods, and trays."""

from __future__ import annotations

import numpy as np

from fb3d_rl.procedural.bodies import any_yaw, holed, pitch, ring, yaw
from fb3d_rl.procedural.controls import CLEAR
from fb3d_rl.procedural.shapes import Piece, box, housing, rod
from fb3d_rl.procedural.spec import ObjectSpec, Part


def telescopic_handle(rng: np.random.Generator) -> ObjectSpec:
    """A suitcase's handle, or a rod in a tube (a pump, an aerial, a pen, an umbrella), that is drawn out."""
    return _suitcase(rng) if rng.random() < 0.5 else _tube(rng)


def _suitcase(rng: np.random.Generator) -> ObjectSpec:
    """A hollow body with a bow that slides out of two holes in its top, or in its side if it lies."""
    half, tall = (rng.uniform(0.25, 0.7), rng.uniform(0.12, 0.45)), rng.uniform(0.5, 1.5)
    sheet = rng.uniform(0.02, 0.04)
    thick = rng.uniform(0.02, 0.045)
    spread = min(rng.uniform(0.35, 0.8) * half[0], half[0] - 2 * thick - CLEAR - 0.02)
    at = rng.uniform(-1, 1) * (half[1] - sheet - thick - 3 * CLEAR - 0.01)  # where along the depth
    # The body in a mount's frame: the holes' plate is at z from -sheet to 0.
    z = (-sheet, 0.0)
    hole = thick + CLEAR
    body = [
        box("body", (-half[0], half[0]), (-half[1], at - hole), z),
        box("body", (-half[0], half[0]), (at + hole, half[1]), z),
    ]
    edges = [-half[0], -spread - hole, -spread + hole, spread - hole, spread + hole, half[0]]
    body += [box("body", pair, (at - hole, at + hole), z) for pair in zip(edges[::2], edges[1::2], strict=True)]
    body += housing((-half[0], half[0]), (-half[1], half[1]), (-tall, -sheet), sheet)
    if rng.random() < 0.5:
        x, y = 0.85 * half[0], 0.8 * half[1]
        body += [
            rod("caster", (sx * x, sy * y, -tall - 0.06), (sx * x, sy * y, -tall + 0.005), 0.04, sides=8)
            for sx in (-1, 1)
            for sy in (-1, 1)
        ]
    inside = (tall - sheet) * rng.uniform(0.75, 0.95)
    proud = rng.uniform(0.05, 0.25)
    square = rng.random() < 0.5
    pieces: list[Piece] = []
    for x in (-spread, spread):
        if square:
            pieces.append(box("handle", (x - thick, x + thick), (at - thick, at + thick), (-inside, proud)))
        else:
            pieces.append(rod("handle", (x, at, -inside), (x, at, proud), thick))
    bar = rng.uniform(0.8, 1.8) * thick
    pieces.append(
        box("handle", (-spread - thick, spread + thick), (at - bar, at + bar), (proud - 0.5 * thick, proud + thick))
    )
    upper = inside * rng.uniform(0.5, 0.9)
    part = Part("translation_handle", "slider", (0, 0, 1), upper, tuple(pieces))
    spec = ObjectSpec("TelescopicHandle", "free", "body", tuple(body), (part,))
    angle = np.pi / 2 if rng.random() < 0.7 else rng.choice([0.0, rng.uniform(0.6, 1.2)])
    return any_yaw(rng, float(angle)).spec(pitch(float(angle)).spec(spec))


def _tube(rng: np.random.Generator) -> ObjectSpec:
    """A rod with a knob, a ring or a crossbar in a tube, upright, lying or leaning."""
    long, inner = rng.uniform(0.8, 1.5), rng.uniform(0.03, 0.12)
    outer = inner + rng.uniform(0.02, 0.08)
    body = ring("tube", outer, inner, (-long, 0.0))
    body.append(
        rod(
            "tube_end",
            (0, 0, -long - rng.uniform(0.02, 0.2)),
            (0, 0, -long),
            outer,
            rng.uniform(0.5, 1.6) * outer,
            sides=16,
        )
    )
    if rng.random() < 0.4:  # a block around the tube
        size, low = outer + rng.uniform(0.05, 0.4), -long * rng.uniform(0.5, 0.9)
        body += holed(
            "body", (size, outer + rng.uniform(0.05, 0.3)), (outer, outer), (low, low + rng.uniform(0.2, 0.4) * long)
        )
    thin = (inner - CLEAR) * float(np.cos(np.pi / 16)) * rng.uniform(0.7, 0.97)
    inside, proud = long * rng.uniform(0.6, 0.95), rng.uniform(0.04, 0.25)
    pieces = [rod("handle", (0, 0, -inside), (0, 0, proud), thin)]
    kind = rng.choice(["knob", "bar", "plain", "cone"], p=[0.35, 0.3, 0.2, 0.15])
    size = outer * rng.uniform(0.7, 1.6)
    if kind == "knob":
        pieces.append(
            rod(
                "handle",
                (0, 0, proud - 0.01),
                (0, 0, proud + rng.uniform(0.04, 0.15)),
                size,
                rng.uniform(0.7, 1.0) * size,
            )
        )
    elif kind == "bar":
        half = outer + rng.uniform(0.05, 0.25)
        pieces.append(rod("handle", (-half, 0, proud), (half, 0, proud), min(0.03, 0.5 * proud)))
    elif kind == "cone":
        pieces.append(rod("handle", (0, 0, proud - 0.01), (0, 0, proud + 0.2), size, 0.3 * thin))
    else:
        proud += 0.1
        pieces = [rod("handle", (0, 0, -inside), (0, 0, proud), thin)]
    part = Part("translation_handle", "slider", (0, 0, 1), inside * rng.uniform(0.4, 0.9), tuple(pieces))
    spec = ObjectSpec("TelescopicHandle", "free", "body", tuple(body), (part,))
    angle = float(rng.choice([np.pi / 2, rng.uniform(0.3, 1.3), 0.0], p=[0.5, 0.25, 0.25]))
    return any_yaw(rng, angle).spec(pitch(angle).spec(spec))


def tray(rng: np.random.Generator) -> ObjectSpec:
    """One to four flat trays that slide out of slots in a body, or a round one that turns on a foot."""
    if rng.random() < 0.2:
        return _turntable(rng)
    half, tall, deep = rng.uniform(0.35, 0.8), rng.uniform(0.3, 1.1), rng.uniform(0.5, 1.2)
    sheet = rng.uniform(0.02, 0.05)
    count = int(rng.integers(1, 5))
    highest = min(0.2, 0.5 * tall / count)
    slot = rng.uniform(0.05 if highest > 0.05 else 0.7 * highest, highest)
    wide = rng.uniform(0.5, 0.95) * (half - sheet)
    x, y = (-half, half), (0.0, tall)
    pitch_y = (tall - 2 * sheet) / count
    middles = [sheet + (k + rng.uniform(0.4, 0.6)) * pitch_y for k in range(count)]
    front = (-sheet, 0.0)
    body = housing(x, y, (-deep, front[0]), sheet)
    hole = wide + CLEAR
    body += [box("front_panel", (-half, -hole), y, front), box("front_panel", (hole, half), y, front)]
    edges = [0.0, *(m + s * slot / 2 for m in middles for s in (-1, 1)), tall]
    body += [box("front_panel", (-hole, hole), pair, front) for pair in zip(edges[::2], edges[1::2], strict=True)]
    length = (deep - sheet - CLEAR) * rng.uniform(0.7, 0.95)
    out = rng.uniform(0.01, 0.15)
    parts = []
    for middle in middles:
        low = middle - slot / 2 + CLEAR
        thick = min(rng.uniform(0.2, 0.5) * slot, slot - 2 * CLEAR)
        rim = slot - 2 * CLEAR
        pieces = [box("tray", (-wide, wide), (low, low + thick), (-length, out))]
        kind = rng.choice(["flat", "rim", "lip"])
        if kind == "rim":
            edge = min(0.03, 0.2 * wide)
            pieces += [
                box("tray", side, (low + thick, low + rim), (-length, out))
                for side in ((-wide, -wide + edge), (wide - edge, wide))
            ]
        if kind != "flat":
            pieces.append(box("tray", (-wide, wide), (low, low + rim), (out, out + 0.03)))
        parts.append(Part("translation_tray", "slider", (0, 0, 1), length * rng.uniform(0.5, 0.85), tuple(pieces)))
    spec = ObjectSpec("Tray", "free", "body", tuple(body), tuple(parts))
    return any_yaw(rng, 0.0).spec(spec)


def _turntable(rng: np.random.Generator) -> ObjectSpec:
    """A tray on a pivot near one of its ends, above a body."""
    half, tall = (rng.uniform(0.4, 0.8), rng.uniform(0.3, 0.6)), rng.uniform(0.1, 1.0)
    body = [box("body", (-half[0], half[0]), (0.0, tall), (-half[1], half[1]))]
    sheet, rim = rng.uniform(0.03, 0.06), rng.uniform(0.03, 0.1)
    pivot = (-0.75 * half[0], 0.0)
    base = tall + CLEAR
    x, z = (-half[0], half[0]), (-half[1], half[1])
    edge = 0.04
    pieces = [
        box("tray", x, (base, base + sheet), z),
        box("tray", (x[0], x[0] + edge), (base + sheet, base + sheet + rim), z),
        box("tray", (x[1] - edge, x[1]), (base + sheet, base + sheet + rim), z),
    ]
    sign = rng.choice([-1.0, 1.0])
    part = Part(
        "rotation_tray", "hinge", (0, float(sign), 0), rng.uniform(0.8, 2.2), tuple(pieces), (pivot[0], base, pivot[1])
    )
    return yaw(rng.uniform(-np.pi, np.pi)).spec(ObjectSpec("Tray", "free", "body", tuple(body), (part,)))
