"""Families of vessels and cases whose cap is pulled off, twisted, pressed or flipped open."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from fb3d_rl.procedural.bodies import Pose, any_yaw, chamfered, draw_body, log_uniform, quarter, yaw
from fb3d_rl.procedural.controls import CLEAR
from fb3d_rl.procedural.shapes import Piece, box, circle, level, loft, rod, wall
from fb3d_rl.procedural.spec import ObjectSpec, Part

SIDES = 16


def pull_cap(rng: np.random.Generator) -> ObjectSpec:
    """A bottle, jar, pen, stick or tube whose cap comes off along its axis; it stands, leans or lies."""
    pieces, neck, mouth, collar = _vessel(rng)
    cap, skirt, _ = _cap(rng, neck, mouth, collar)
    upper = skirt + log_uniform(rng, 0.06, 0.4)
    part = Part("translation_lid", "slider", (0, 1, 0), upper, tuple(cap))
    return _laid(rng, ObjectSpec("PullCap", "free", "body", tuple(pieces), (part,)))


def twist_cap(rng: np.random.Generator) -> ObjectSpec:
    """A bottle, jar or tube whose cap is unscrewed, nearly always counter-clockwise; it stands, leans or lies."""
    pieces, neck, mouth, collar = _vessel(rng)
    cap, _, radius = _cap(rng, neck, mouth, collar)
    cap += _ribs(rng, radius, mouth, collar)
    sign = 1 if rng.random() < 0.9 else -1
    part = Part("rotation_lid", "hinge", (0, sign, 0), rng.uniform(1.0, 3.6), tuple(cap), (0.0, mouth, 0.0))
    return _laid(rng, ObjectSpec("TwistCap", "free", "body", tuple(pieces), (part,)))


def pump_cap(rng: np.random.Generator) -> ObjectSpec:
    """A bottle or dispenser whose head, with or without a spout, stands out of a collar and is pressed down."""
    pieces, neck, mouth, _ = _vessel(rng)
    travel, tall = rng.uniform(0.06, 0.3), rng.uniform(0.05, 0.15)
    stem = max(rng.uniform(0.3, 0.6) * neck, 0.02)
    inner = (stem + CLEAR) / float(np.cos(np.pi / SIDES))
    outer = inner + rng.uniform(0.02, 0.06)
    # The stem's lower end goes down in the collar, as far as the collar's floor leaves it.
    top = mouth + travel + CLEAR + tall
    rim = circle(SIDES)
    pieces += wall("collar", rim, (mouth, top), (outer, outer), (outer, outer), outer - inner)
    pieces.append(rod("collar", (0, mouth - 0.03, 0), (0, mouth, 0), max(outer, neck) + 0.02, sides=SIDES))
    under = top + travel + CLEAR
    head, high = max(rng.uniform(0.8, 1.6) * outer, 0.06), rng.uniform(0.05, 0.15)
    lid = [
        rod("pump", (0, mouth + travel + CLEAR, 0), (0, under + 0.01, 0), stem, sides=SIDES),
        rod("pump", (0, under, 0), (0, under + high, 0), head, rng.uniform(0.7, 1.0) * head, sides=SIDES),
    ]
    if rng.random() < 0.7:
        out, thin = head + rng.uniform(0.1, 0.5), 0.4 * high
        lid.append(
            rod("spout", (0, under + 0.5 * high, 0), (0, under + rng.uniform(0.4, 0.6) * high, out), thin, 0.7 * thin)
        )
    part = Part("pump_lid", "slider", (0, -1, 0), travel, tuple(lid))
    spec = ObjectSpec("PumpCap", "free", "body", tuple(pieces), (part,))
    return yaw(rng.uniform(-np.pi, np.pi)).spec(spec)


def flip_cap(rng: np.random.Generator) -> ObjectSpec:
    """A body whose lid, thin or as tall as a lighter's, is hinged at one edge and flips open, on top or in front."""
    body = draw_body(rng, top=0.6, slanted=0.1, round_share=0.2)
    full = rng.random() < 0.5
    share = (1.0, 1.0) if full else tuple(rng.uniform(0.5, 0.95, 2).tolist())
    middle = (0.0, 0.0) if full else tuple((rng.uniform(-1, 1, 2) * (1 - np.array(share)) * body.half).tolist())
    half = (share[0] * body.half[0], share[1] * body.half[1])
    turns = int(rng.choice(4, p=[0.4, 0.2, 0.2, 0.2]))  # unless turned, its hinge is at the far or upper edge
    across, along = half if turns % 2 == 0 else half[::-1]
    sheet = rng.uniform(0.02, 0.08) if rng.random() < 0.65 else rng.uniform(0.1, 0.45)
    z = (CLEAR, CLEAR + sheet)
    if full and body.radius:
        across = along = body.radius
        pieces = [
            rod("lid_surface", (0, 0, z[0]), (0, 0, z[1]), body.radius, rng.uniform(0.8, 1.0) * body.radius, SIDES)
        ]
    else:
        pieces = [box("lid_surface", (-across, across), (-along, along), z)]
    if rng.random() < 0.25:
        size = (rng.uniform(0.35, 0.55) * across, rng.uniform(0.35, 0.55) * along)
        pieces.append(
            box("lid_field", (-size[0], size[0]), (-size[1], size[1]), (z[1], z[1] + rng.uniform(0.01, 0.05)))
        )
    grip = rng.choice(["lip", "knob", "none"], p=[0.35, 0.25, 0.4])
    if grip == "lip":
        wide, out = rng.uniform(0.2, 0.8) * across, rng.uniform(0.03, 0.1)
        pieces.append(
            box("handle", (-wide, wide), (-along - out, -along + 0.02), (z[0], z[0] + 0.7 * min(sheet, 0.08)))
        )
    elif grip == "knob":
        at = -rng.uniform(0.6, 0.85) * along
        radius = min(rng.uniform(0.03, 0.07), 0.12 * along)
        pieces.append(rod("handle", (0, at, z[0] + 0.5 * sheet), (0, at, z[1] + rng.uniform(0.04, 0.1)), radius))
    part = Part("rotation_lid", "hinge", (-1, 0, 0), rng.uniform(1.1, 1.55), tuple(pieces), (0, along, CLEAR))
    return body.object("FlipCap", rng, (), [Pose(quarter(turns).turn, (*middle, 0.0)).part(part)])


def _lathe(name: str, outline: np.ndarray, profile: list[tuple[float, float]]) -> list[Piece]:
    """Frusta of one outline [n, 2] between the (radius, height) of a profile."""
    return [
        loft(name, level(outline, (r0, r0), y0), level(outline, (r1, r1), y1))
        for (r0, y0), (r1, y1) in zip(profile, profile[1:], strict=False)
    ]


def _vessel(rng: np.random.Generator) -> tuple[list[Piece], float, float, float]:
    """A body along y; the radius of its round neck, the height of its mouth and that of its shoulder (m)."""
    slim = rng.random() < 0.35  # a pen, a stick, a tube
    height = rng.uniform(0.9, 1.6)
    radius = height * (rng.uniform(0.05, 0.13) if slim else rng.uniform(0.17, 0.6))
    neck = radius * (rng.uniform(0.6, 0.9) if slim else rng.uniform(0.3, 0.95))
    collar = height + (rng.uniform(0.0, 0.5) * radius if neck < 0.8 * radius else 0.0)
    mouth = collar + rng.uniform(0.08, 0.3)
    flat = rng.random() < 0.3
    outline = circle(SIDES)
    if flat:
        deep = rng.uniform(0.4, 1.0)
        outline = chamfered((1.0, deep), rng.uniform(0.05, 0.3) * deep)
        neck = min(neck, 0.9 * deep * radius)
    waist = rng.uniform(0.75, 1.1)
    profile = [
        (waist * radius, 0.0),
        (radius, rng.uniform(0.2, 0.7) * height),
        (rng.uniform(0.8, 1.0) * radius, height),
    ]
    pieces = _lathe("body", outline, profile)
    if collar > height + 0.01:
        least = neck / float(np.abs(outline).max(0).min()) if flat else neck
        pieces += _lathe("shoulder", outline, [(profile[-1][0], height), (1.02 * least, collar)])
    pieces.append(rod("neck", (0, collar - 0.01, 0), (0, mouth, 0), neck, sides=SIDES))
    if rng.random() < 0.15 and not slim:  # a mug's or a can's handle
        out = radius + rng.uniform(0.12, 0.3)
        low, high = 0.25 * height, 0.7 * height
        inside = 0.6 * radius
        ends = [(inside, low, 0.0), (out, low, 0.0), (out, high, 0.0), (inside, high, 0.0)]
        pieces += [rod("handle", a, b, 0.04) for a, b in zip(ends, ends[1:], strict=False)]
    return pieces, neck, mouth, collar


def _cap(rng: np.random.Generator, neck: float, mouth: float, collar: float) -> tuple[list[Piece], float, float]:
    """A cap over the neck: its pieces, how far (m) its skirt reaches down, and its outer radius."""
    # Corners of the neck reach its radius, flats of the skirt only cos(pi / sides) of theirs.
    inner = (neck + CLEAR) / float(np.cos(np.pi / SIDES))
    outer = inner + rng.uniform(0.02, 0.05) + rng.choice([0.0, 0.15]) * rng.random() * neck
    bottom = collar + CLEAR + rng.uniform(0.0, 0.5) * (mouth - collar - CLEAR)
    roof = mouth + CLEAR
    top = roof + rng.uniform(0.03, 0.12)
    rim = circle(SIDES)
    cap = wall("lid_wall", rim, (bottom, roof), (outer, outer), (outer, outer), outer - inner)
    kind = rng.choice(["plain", "dome", "spout", "tall"], p=[0.4, 0.25, 0.2, 0.15])
    cap.append(rod("lid_surface", (0, roof, 0), (0, top, 0), outer, sides=SIDES))
    if kind == "dome":
        cap.append(
            rod(
                "lid_surface", (0, top, 0), (0, top + rng.uniform(0.2, 0.8) * outer, 0), outer, 0.4 * outer, sides=SIDES
            )
        )
    elif kind == "spout":
        thin = rng.uniform(0.25, 0.6) * outer
        cap.append(
            rod("spout", (0, top - 0.01, 0), (0, top + rng.uniform(0.08, 0.3), 0), thin, rng.uniform(0.3, 1.2) * thin)
        )
    elif kind == "tall":
        cap.append(
            rod("lid_surface", (0, top, 0), (0, top + rng.uniform(0.1, 0.5), 0), outer, 0.9 * outer, sides=SIDES)
        )
    return cap, mouth - bottom, outer


def _ribs(rng: np.random.Generator, radius: float, mouth: float, collar: float) -> list[Piece]:
    """What fingers hold on to: ribs all around, two wings, or nothing."""
    kind = rng.choice(["ribs", "wings", "none"], p=[0.5, 0.25, 0.25])
    low, high = collar + CLEAR + 0.5 * (mouth - collar), mouth + 0.03
    within = radius - 0.018  # the thinnest skirt is 0.02 thick
    if kind == "ribs":
        count, size = int(rng.integers(6, 13)), 0.05 * radius + 0.006
        angles = 2 * np.pi * np.arange(count) / count
        at = max(0.98 * radius, within + size)
        spots = [(at * float(np.cos(a)), at * float(np.sin(a))) for a in angles]
        return [rod("lid_rib", (x, low, z), (x, high, z), size, sides=6) for x, z in spots]
    if kind == "wings":
        thin, reach = 0.12 * radius + 0.01, radius + rng.uniform(0.04, 0.15)
        return [box("handle", x, (low, high), (-thin, thin)) for x in ((-reach, -within), (within, reach))]
    return []


def _laid(rng: np.random.Generator, spec: ObjectSpec) -> ObjectSpec:
    """The object standing, leaning or lying with its cap to the viewer or a side; then turned."""
    kind = rng.choice(["stands", "leans", "lies"], p=[0.6, 0.15, 0.25])
    if kind == "stands":
        return yaw(rng.uniform(-np.pi, np.pi)).spec(spec)
    angle = np.pi / 2 if kind == "lies" else rng.uniform(0.15, 0.9)
    spin = yaw(rng.uniform(-np.pi, np.pi))
    tilted = Pose(Rotation.from_rotvec([angle, 0, 0])).spec(spin.spec(spec))  # its top to the front
    return any_yaw(rng, 0.0).spec(tilted)
