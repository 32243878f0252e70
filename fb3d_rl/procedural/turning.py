"""Families of what turns on a base: swivels and wheels."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from fb3d_rl.procedural.bodies import Pose, any_yaw, chamfered, draw_body, log_uniform, pitch, prism, ring, yaw
from fb3d_rl.procedural.controls import CLEAR
from fb3d_rl.procedural.shapes import Piece, box, circle, rod, slab
from fb3d_rl.procedural.spec import ObjectSpec, Part


def swivel(rng: np.random.Generator) -> ObjectSpec:
    """A head that turns on its stand about the vertical, nods in a yoke, or a cover that turns off a stick."""
    kind = rng.choice(["stand", "yoke", "cover"], p=[0.45, 0.35, 0.2])
    return {"stand": _on_stand, "yoke": _in_yoke, "cover": _cover}[str(kind)](rng)


def _foot(rng: np.random.Generator, tall: float, reach: float) -> list[Piece]:
    """A round, square or starred foot with a stem up to the height `tall`."""
    sheet, thick = rng.uniform(0.03, 0.1), rng.uniform(0.03, 0.12)
    kind = rng.choice(["round", "square", "star"])
    pieces = [rod("stem", (0, 0.5 * sheet, 0), (0, tall, 0), thick)]
    if kind == "star":
        count = int(rng.integers(3, 6))
        for a in 2 * np.pi * np.arange(count) / count:
            tip = (reach * float(np.cos(a)), 0.03, reach * float(np.sin(a)))
            pieces.append(rod("foot", (0, sheet + 0.03, 0), tip, 0.03, sides=8))
    else:
        outline = circle(16) if kind == "round" else chamfered((1.0, rng.uniform(0.6, 1.0)), 0.1)
        pieces.append(slab("foot", outline, (0.0, sheet), (reach, reach), (0.95 * reach, 0.95 * reach)))
    return pieces


def _head(rng: np.random.Generator) -> list[Piece]:
    """A lamp's, camera's or screen's head, or a seat, above y = 0; it points to +z."""
    kind = rng.choice(["blocks", "spot", "screen", "seat", "globe"], p=[0.3, 0.2, 0.2, 0.2, 0.1])
    wide, tall, deep = rng.uniform(0.2, 0.5), rng.uniform(0.2, 0.7), rng.uniform(0.2, 0.5)
    if kind == "blocks":
        lens = rng.uniform(0.3, 0.8) * min(wide, tall / 2)
        return [
            box("head", (-wide, wide), (0.0, tall), (-deep, deep)),
            rod("lens", (0, tall / 2, deep), (0, tall / 2, deep + rng.uniform(0.05, 0.3)), lens),
        ]
    if kind == "spot":
        end = (0.0, tall, deep + rng.uniform(0.1, 0.5))
        return [
            rod("arm", (0, 0, 0), (0, 0.6 * tall, 0), 0.05),
            rod("head", (0.0, 0.5 * tall, -0.3 * deep), end, 0.4 * wide, rng.uniform(0.5, 1.0) * wide, sides=16),
        ]
    if kind == "screen":
        return [
            rod("arm", (0, 0, 0), (0, 0.3 * tall, 0), 0.06),
            box("screen", (-1.5 * wide, 1.5 * wide), (0.25 * tall, 0.25 * tall + tall), (0.0, rng.uniform(0.04, 0.12))),
        ]
    if kind == "seat":
        sheet = rng.uniform(0.05, 0.12)
        back = rng.uniform(0.04, 0.1)
        return [
            slab("seat", chamfered((1.0, 1.0), 0.2), (0.0, sheet), (wide, deep), (wide, deep)),
            box("backrest", (-0.8 * wide, 0.8 * wide), (sheet, sheet + tall), (-0.9 * deep, -0.9 * deep + back)),
        ]
    radius = rng.uniform(0.3, 0.5)
    levels = np.linspace(-np.pi / 2, np.pi / 2, 8)
    sizes = [(max(radius * float(np.cos(a)), 0.1 * radius), radius * (1 + float(np.sin(a)))) for a in levels]
    return [
        slab("globe", circle(16), (low, high), (a, a), (b, b))
        for (a, low), (b, high) in zip(sizes, sizes[1:], strict=False)
    ]


def _on_stand(rng: np.random.Generator) -> ObjectSpec:
    tall, reach = rng.uniform(0.25, 1.2), rng.uniform(0.25, 0.55)
    body = _foot(rng, tall, reach)
    tilt = rng.uniform(-0.4, 0.4) if tall > 0.7 and rng.random() < 0.3 else 0.0
    # The head starts off to one side, and its middle lies before it.
    sign, upper = rng.choice([-1.0, 1.0]), rng.uniform(0.9, 2.6)
    start = -sign * rng.uniform(0.3, 0.7) * upper
    head = yaw(start).pieces(_head(rng))
    part = Part("head", "hinge", (0, float(sign), 0), upper, head)
    lean = 0.2 * abs(np.sin(tilt))
    part = Pose(Rotation.from_rotvec([0, 0, tilt]), (0.0, tall + CLEAR + lean, 0.0)).part(part)
    spec = ObjectSpec("Swivel", "free", "base", tuple(body), (part,))
    return yaw(rng.uniform(-0.8, 0.8) if rng.random() < 0.7 else rng.uniform(-np.pi, np.pi)).spec(spec)


def _in_yoke(rng: np.random.Generator) -> ObjectSpec:
    """A head between two cheeks that nods about the axis x."""
    wide, tall, deep = log_uniform(rng, 0.15, 0.7), log_uniform(rng, 0.15, 0.6), log_uniform(rng, 0.06, 0.5)
    cheek = rng.uniform(0.03, 0.08)
    radius = float(np.hypot(tall, deep)) + 0.12
    pivot = radius + rng.uniform(0.02, 0.4)
    out, size = wide + CLEAR, rng.uniform(0.05, 0.12)
    body = [
        box(
            "cheek",
            (sign * out, sign * out + cheek) if sign > 0 else (-out - cheek, -out),
            (0.0, pivot + size),
            (-size, size),
        )
        for sign in (-1, 1)
    ]
    sheet = rng.uniform(0.03, 0.08)
    reach = rng.uniform(0.3, 0.6)
    body.append(box("foot", (-out - cheek, out + cheek), (-sheet, 0.0), (-reach, reach)))
    if rng.random() < 0.4:
        low = Pose(Rotation.identity(), (0.0, -sheet - 0.6, 0.0))
        body += low.pieces(_foot(rng, 0.6, rng.uniform(0.25, 0.5)))
    pieces = [box("head", (-wide, wide), (-tall, tall), (-deep, deep))]
    if rng.random() < 0.5:
        lens = rng.uniform(0.3, 0.9) * min(wide, tall)
        pieces = [*pieces, rod("lens", (0, 0, deep), (0, 0, deep + 0.1), lens)]
    if rng.random() < 0.3:
        pieces = [
            rod("head", (-wide, 0, 0), (wide, 0, 0), max(tall, deep)),
            box("handle", (-0.5 * wide, 0.5 * wide), (-0.05, 0.05), (0.0, radius)),
        ]
    sign, upper = rng.choice([-1.0, 1.0]), rng.uniform(0.6, 1.5)
    start = -sign * rng.uniform(0.3, 0.8) * upper
    pose = Pose(Rotation.from_rotvec([start, 0, 0]), (0.0, pivot, 0.0))
    part = pose.part(Part("head", "hinge", (float(sign), 0, 0), upper, tuple(pieces)))
    return any_yaw(rng, 0.0).spec(ObjectSpec("Swivel", "free", "base", tuple(body), (part,)))


def _cover(rng: np.random.Generator) -> ObjectSpec:
    """A stick between the two plates of a cover that is pinned to it at one end, as on a memory stick."""
    long, wide, sheet = rng.uniform(0.6, 0.9), rng.uniform(0.15, 0.3), rng.uniform(0.04, 0.1)
    plug, thin = rng.uniform(0.2, 0.4), 0.75
    body = [box("body", (-long, long - plug), (-wide, wide), (-sheet, sheet))]
    body.append(box("plug", (long - plug, long), (-thin * wide, thin * wide), (-thin * sheet, thin * sheet)))
    steel, gap = rng.uniform(0.02, 0.05), sheet + CLEAR
    pivot = -long + wide
    # A plate's web runs along the long side that it turns away from, farther out than the stick's corners sweep.
    length = rng.uniform(1.2, 1.6) * long
    out = wide + CLEAR
    plates = [box("cover", (-0.9 * wide, length), (-wide, wide), z) for z in ((gap, gap + steel), (-gap - steel, -gap))]
    web = box("cover", (0.6 * length, length), (out, out + steel), (-gap - steel, gap + steel))
    bridges = [box("cover", (0.6 * length, length), (wide, out), z) for z in ((gap, gap + steel), (-gap - steel, -gap))]
    part = Part("cover", "hinge", (0, 0, 1), rng.uniform(1.4, 3.0), (*plates, *bridges, web))
    part = Pose(Rotation.identity(), (pivot, 0.0, 0.0)).part(part)
    spec = ObjectSpec("Swivel", "free", "body", tuple(body), (part,))
    angle = float(rng.choice([np.pi / 2, 0.0], p=[0.6, 0.4]))
    return any_yaw(rng, angle).spec(pitch(angle).spec(spec))


def wheel(rng: np.random.Generator) -> ObjectSpec:
    """One to four wheels, hand wheels, fans, dials or cranks on a body."""
    body = draw_body(rng, top=0.15, slanted=0.1)
    count = int(rng.integers(1, 5))
    columns = max(1, min(count, int(body.half[0] / 0.22)))
    room = body.half[0] / columns
    radius = rng.uniform(0.6, 0.97) * (room if columns > 1 else max(room, min(0.5, 1.5 * room)))
    low = columns > 1 and body.pitch == 0.0 and rng.random() < 0.6  # a cart's
    y = -body.half[1] + rng.uniform(0.0, 0.5) * radius if low else rng.uniform(-0.3, 0.3) * body.half[1]
    stand = rng.uniform(0.02, 0.15)
    kind, sign = rng.choice(["disc", "spokes", "fan", "crank"], p=[0.3, 0.35, 0.15, 0.2]), rng.choice([-1.0, 1.0])
    fixed, parts = [], []
    for k in range(columns):
        x = -body.half[0] + (2 * k + 1) * room
        pose = Pose(Rotation.from_rotvec([0, 0, rng.uniform(-np.pi, np.pi)]), (x, y, stand + CLEAR))
        fixed.append(rod("axle", (x, y, -0.02), (x, y, stand), 0.15 * radius))
        upper = rng.uniform(0.9, 3.1)
        pieces = _wheel(rng, str(kind), radius)
        parts.append(pose.part(Part("wheel", "hinge", (0, 0, float(sign)), upper, tuple(pieces))))
    return body.object("Wheel", rng, fixed, parts)


def _wheel(rng: np.random.Generator, kind: str, radius: float) -> list[Piece]:
    """A wheel about z, above the plane z = 0."""
    deep, hub = rng.uniform(0.15, 0.5) * radius, rng.uniform(0.12, 0.3) * radius
    pieces = [rod("hub", (0, 0, 0), (0, 0, deep), hub)]
    count = int(rng.integers(3, 7))
    angles = 2 * np.pi * np.arange(count) / count
    if kind == "disc":
        pieces = [rod("wheel", (0, 0, 0), (0, 0, deep), radius, rng.uniform(0.85, 1.0) * radius, sides=20)]
        pieces.append(rod("hub", (0, 0, deep - 0.005), (0, 0, deep + rng.uniform(0.01, 0.06)), hub))
        spots = [(0.65 * radius * float(np.cos(a)), 0.65 * radius * float(np.sin(a))) for a in angles]
        pieces += [rod("nut", (x, y, deep - 0.005), (x, y, deep + 0.03), 0.1 * radius, sides=8) for x, y in spots]
    elif kind == "spokes":
        thick = rng.uniform(0.1, 0.3) * radius
        pieces += ring("rim", radius, radius - thick, (0.1 * deep, 0.9 * deep))
        for a in angles:
            end = ((radius - 0.5 * thick) * float(np.cos(a)), (radius - 0.5 * thick) * float(np.sin(a)), 0.5 * deep)
            pieces.append(rod("spoke", (0, 0, 0.5 * deep), end, 0.3 * deep, sides=6))
    elif kind == "fan":
        sheet, wide = 0.25 * deep, rng.uniform(0.2, 0.35) * radius
        reach = float(np.sqrt(radius**2 - wide**2))
        corners = [(0.5 * hub, -0.4 * wide), (reach, -wide), (reach, wide), (0.5 * hub, 0.4 * wide)]
        pieces += [
            piece
            for a in angles
            for piece in Pose(Rotation.from_rotvec([0, 0, a])).pieces(
                [prism("blade", corners, (deep / 2, deep / 2 + sheet))]
            )
        ]
    else:
        reach, wide = 0.85 * radius, rng.uniform(0.08, 0.15) * radius
        pieces.append(box("arm", (0.0, radius), (-wide, wide), (0.4 * deep, 0.7 * deep + 0.02)))
        grip = rng.uniform(0.1, 0.3)
        pieces.append(rod("handle", (reach, 0, 0.6 * deep), (reach, 0, deep + grip), 1.2 * wide))
    return pieces
