"""Families of what folds out: blades, arms of scissors and pliers, and legs."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from fb3d_rl.procedural.bodies import Half, Pose, any_yaw, chamfered, draw_body, pitch, prism, quarter
from fb3d_rl.procedural.controls import CLEAR
from fb3d_rl.procedural.shapes import Piece, Range, box, rod
from fb3d_rl.procedural.spec import ObjectSpec, Part


def folding_blade(rng: np.random.Generator) -> ObjectSpec:
    """A pocket knife with one to four blades, or scissors or pliers with one moving arm, flat or on edge."""
    body, parts = _shears(rng) if rng.random() < 0.35 else _knife(rng)
    angle = rng.choice([np.pi / 2, rng.uniform(0.4, 1.2), 0.0], p=[0.5, 0.25, 0.25])
    roll = quarter(0 if rng.random() < 0.5 else int(rng.integers(4)))
    spec = ObjectSpec("FoldingBlade", "free", "body", tuple(body), tuple(parts))
    return any_yaw(rng, float(angle)).spec(pitch(float(angle)).spec(roll.spec(spec)))


def _knife(rng: np.random.Generator) -> tuple[list[Piece], list[Part]]:
    """Scales with blades in layers between them, or on one scale; a blade lies along x and turns out to y."""
    long, wide = rng.uniform(0.7, 0.95), rng.uniform(0.1, 0.22)  # half sizes of the scales
    sheet, steel = rng.uniform(0.03, 0.08), rng.uniform(0.02, 0.05)
    count = int(rng.choice([1, 2, 3, 4], p=[0.5, 0.25, 0.15, 0.1]))
    outline = chamfered((long, wide), rng.uniform(0.2, 0.8) * wide)
    layers = count * (steel + CLEAR) + CLEAR
    body = [prism("scale", outline, (-sheet, 0.0))]
    if rng.random() < 0.6:
        body.append(prism("scale", outline, (layers, layers + sheet)))
        body.append(box("spacer", (-0.6 * long, 0.6 * long), (-wide, -0.75 * wide), (0.0, layers)))
    parts = []
    for layer in range(count):
        low = CLEAR + layer * (steel + CLEAR)
        left = layer % 2 == 0
        out = rng.uniform(1.25, 1.9) * wide  # how far the edge of the closed blade lies from the scales' middle
        reach = rng.uniform(1.2, 1.75) * long
        pivot = -long + 0.6 * wide
        tang, back = 0.55 * wide, -rng.uniform(0.3, 0.6) * wide
        corners = [(-tang, 0.0), (-0.5 * tang, -0.5 * wide), (0.2 * wide, -0.55 * wide)]
        corners += [
            (reach, max(back, -0.5 * wide) + 0.2 * wide),
            (0.85 * reach, 0.6 * out),
            (0.6 * reach, out),
            (0.3 * wide, 0.9 * out),
        ]
        blade = prism("blade", corners, (low, low + steel))
        part = Part("rotation_blade", "hinge", (0, 0, 1), rng.uniform(1.4, 3.0), (blade,))
        moved = Pose(Rotation.identity(), (pivot, 0.0, 0.0)).part(part)
        if not left:  # the mirror image, from the other end
            moved = _mirrored(moved)
        parts.append(moved)
    return body, parts


def _mirrored(part: Part) -> Part:
    """A hinge about z, mirrored in x = 0."""
    pieces = []
    for piece in part.pieces:
        n = len(piece.vertices) // 2
        corners = piece.vertices * (-1, 1, 1)
        z = (float(corners[0, 2]), float(corners[n, 2]))
        pieces.append(prism(piece.name, corners[:n, :2], z))
    return Part(part.name, part.joint, (0, 0, -1), part.upper, tuple(pieces), (-part.origin[0], *part.origin[1:]))


def _shears(rng: np.random.Generator) -> tuple[list[Piece], list[Part]]:
    """Two arms, one above the other, that cross at a pivot."""
    jaw, grip = rng.uniform(0.3, 0.9), rng.uniform(0.6, 1.0)
    wide, sheet = rng.uniform(0.04, 0.09), rng.uniform(0.03, 0.07)
    start = rng.uniform(0.05, 0.3)  # half the angle between the closed grips
    is_ring = rng.random() < 0.5
    curve = rng.uniform(0.5, 1.5) * wide

    def arm(z: Range, side: float) -> list[Piece]:
        blade = [(-wide, -wide), (0.5 * jaw, -wide), (jaw, -0.2 * wide), (0.5 * jaw, wide), (-wide, wide)]
        end = (-grip, -curve)
        half = 0.7 * wide
        bar = [(0.0, wide), (0.0, -wide), (end[0], end[1] - half), (end[0], end[1] + half)]
        pieces = [prism("blade", [(x, side * y) for x, y in corners], z) for corners in (blade, bar)]
        if is_ring:
            radius, middle = 2.2 * wide, (end[0] - 2.0 * wide, end[1] - 1.2 * wide)
            angles = 2 * np.pi * np.arange(13) / 12
            spots = [
                (middle[0] + radius * np.cos(a), side * (middle[1] + radius * np.sin(a)), (z[0] + z[1]) / 2)
                for a in angles
            ]
            pieces += [
                rod("handle", a, b, 0.45 * (z[1] - z[0]), sides=8) for a, b in zip(spots, spots[1:], strict=False)
            ]
        turn = Pose(Rotation.from_rotvec([0, 0, side * start]))
        return list(turn.pieces(pieces))

    below, above = (0.0, sheet), (sheet + CLEAR, 2 * sheet + CLEAR)
    part = Part("leg", "hinge", (0, 0, -1), rng.uniform(0.5, 1.3), tuple(arm(above, -1.0)))
    return arm(below, 1.0), [part]


def folding_leg(rng: np.random.Generator) -> ObjectSpec:
    """Legs, stands or temples that lie along a body, one to four, and are folded out; or arms that are swung out."""
    body = draw_body(rng, top=0.45, slanted=0.1, round_share=0.15)
    parts = _swung_arms(rng, body.half) if rng.random() < 0.3 else _legs(rng, body.half)
    return body.object("FoldingLeg", rng, (), parts)


def _legs(rng: np.random.Generator, half: Half) -> list[Part]:
    """Bars, plates or frames side by side along the mount, each hinged at one of its ends."""
    turns = int(rng.integers(4))
    across, along = half if turns % 2 == 0 else half[::-1]
    most = max(1, min(4, int(across / 0.1)))
    count = int(rng.integers(1, most + 1))
    room = across / count
    wide = rng.uniform(0.3, 0.85) * room
    sheet = min(rng.uniform(0.03, 0.09), 0.5 * along)
    upper = rng.uniform(1.2, 1.55)
    alternate, kind = rng.random() < 0.5, rng.choice(["bar", "frame"], p=[0.7, 0.3])
    length = rng.uniform(0.7, 1.0) * 2 * along
    parts = []
    for k in range(count):
        at = -across + (2 * k + 1) * room
        z = (CLEAR, CLEAR + sheet)
        y = (along - length, along)
        if kind == "bar" or wide < 3 * sheet:
            pieces = [box("leg", (at - wide, at + wide), y, z)]
            if rng.random() < 0.4:  # a foot
                pieces.append(box("foot", (at - wide, at + wide), (y[0], y[0] + 0.06), (z[1], z[1] + 0.05)))
        else:
            pieces = [
                box("leg", (at - wide, at - wide + sheet), y, z),
                box("leg", (at + wide - sheet, at + wide), y, z),
                box("leg", (at - wide + sheet, at + wide - sheet), (y[0], y[0] + sheet), z),
            ]
        part = Part("leg", "hinge", (-1, 0, 0), upper, tuple(pieces), (0.0, along, CLEAR))
        if alternate and k % 2:  # hinged at the other end: half a turn about the leg's own middle
            part = Pose(quarter(2).turn, (2 * at, 0.0, 0.0)).part(part)
        parts.append(quarter(turns).part(part))
    return parts


def _swung_arms(rng: np.random.Generator, half: Half) -> list[Part]:
    """One or two arms flat on the mount, hinged near its edge, that swing out beyond it."""
    turns = int(rng.integers(4))
    across, along = half if turns % 2 == 0 else half[::-1]
    sheet, wide = rng.uniform(0.03, 0.1), min(rng.uniform(0.04, 0.12), 0.4 * along, 0.4 * across)
    length = max(rng.uniform(0.8, 1.6) * across, 0.3)
    upper = rng.uniform(1.0, 2.6)
    count = 2 if rng.random() < 0.4 and 3 * wide < along else 1
    parts = []
    for k in range(count):
        # Hinged at the right, it points to the left and swings out upwards; a second one is its half turn.
        pivot = (across - wide, along - wide, 0.0)
        z = (CLEAR, CLEAR + sheet)
        pieces = (
            box("leg", (-length, 0.0), (-0.7 * wide, 0.7 * wide), z),
            rod("leg", (0, 0, z[0]), (0, 0, z[1] + rng.choice([0.0, 0.02])), wide),
        )
        part = Part("leg", "hinge", (0, 0, -1), upper, pieces)
        part = Pose(Rotation.identity(), pivot).part(part)
        parts.append(quarter(turns + 2 * k).part(part))
    return parts
