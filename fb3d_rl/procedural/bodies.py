"""Random bodies of mechanisms, and poses in which parts are put on them.

A mechanism is designed in the frame of a mount: z points out of the body's surface, which is the plane z = 0, x to the
right and y upwards along it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from fb3d_rl.procedural.shapes import Piece, Range, Vector, around, box, circle, loft, rod, slab
from fb3d_rl.procedural.spec import ObjectSpec, Part

Half = tuple[float, float]
"""Half sizes of a rectangle along x and y, m."""
FRONT_YAW = 1.15
"""How far (rad) an object is turned at most whose parts are in front: farther, and a camera before it sees none."""


@dataclass(frozen=True)
class Pose:
    """A rigid motion: points are turned, then shifted (m)."""

    turn: Rotation
    shift: Vector = (0.0, 0.0, 0.0)

    def point(self, values: npt.ArrayLike) -> Vector:
        """A point, moved."""
        x, y, z = (self.turn.apply(values) + self.shift).tolist()
        return x, y, z

    def pieces(self, pieces: Iterable[Piece]) -> tuple[Piece, ...]:
        """Pieces, moved."""
        return tuple(replace(piece, vertices=self.turn.apply(piece.vertices) + self.shift) for piece in pieces)

    def part(self, part: Part) -> Part:
        """A part with its joint, moved."""
        x, y, z = self.turn.apply(part.axis).tolist()
        # A slider's link frame is the object's own.
        origin = part.origin if part.joint == "slider" else self.point(part.origin)
        return replace(part, axis=(x, y, z), origin=origin, pieces=self.pieces(part.pieces))

    def spec(self, spec: ObjectSpec) -> ObjectSpec:
        """A whole object, moved."""
        return replace(spec, body=self.pieces(spec.body), parts=tuple(self.part(part) for part in spec.parts))


def yaw(angle: float) -> Pose:
    """A turn about the vertical, rad."""
    return Pose(Rotation.from_rotvec([0.0, angle, 0.0]))


def pitch(angle: float, shift: Vector = (0.0, 0.0, 0.0)) -> Pose:
    """The pose of a mount whose normal points to the front at 0, and to the top at pi / 2."""
    return Pose(Rotation.from_rotvec([-angle, 0.0, 0.0]), shift)


def quarter(turns: int, shift: Vector = (0.0, 0.0, 0.0)) -> Pose:
    """Quarter turns in a mount's plane: what pointed to y points to -x after one."""
    return Pose(Rotation.from_rotvec([0.0, 0.0, turns * np.pi / 2]), shift)


def any_yaw(rng: np.random.Generator, pitch_angle: float) -> Pose:
    """A yaw at which a mount of this pitch is seen from the front: any for one on top, up to the side for others."""
    if pitch_angle > 1.2:
        return yaw(rng.uniform(-np.pi, np.pi))
    return yaw(rng.uniform(-FRONT_YAW, FRONT_YAW) if rng.random() < 0.6 else rng.uniform(-0.3, 0.3))


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """A number whose logarithm is uniform."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def prism(name: str, corners: Sequence[tuple[float, float]] | npt.NDArray[np.float64], z: Range) -> Piece:
    """A convex polygon in x and y, extruded along z."""
    return loft(name, [(a, b, z[0]) for a, b in corners], [(a, b, z[1]) for a, b in corners])


def chamfered(half: Half, cut: float) -> npt.NDArray[np.float64]:
    """Corners [8, 2] of a rectangle of these half sizes whose corners are cut off by `cut` m."""
    a, b = half
    corner = [(a, b - cut), (a - cut, b)]
    quads = [
        corner,
        [(-x, y) for x, y in corner[::-1]],
        [(-x, -y) for x, y in corner],
        [(x, -y) for x, y in corner[::-1]],
    ]
    return np.array([point for quad in quads for point in quad])


def ring(name: str, outer: float, inner: float, z: Range, sides: int = 16) -> list[Piece]:
    """A flat ring around the z axis, of convex sectors."""
    rim = circle(sides)
    return [prism(name, [*(outer * rim[[i, i - 1]]), *(inner * rim[[i - 1, i]])], z) for i in range(sides)]


def holed(name: str, half: Half, hole: Half, z: Range, is_round: bool = False) -> list[Piece]:
    """A rectangular plate with a rectangular hole in its middle, or a round one of radius hole[0] in a square one."""
    (x, y), (hole_x, hole_y) = (((-a, a), (-b, b)) for a, b in (half, hole))
    pieces = around(name, x, y, z, (hole_x, hole_y))
    if is_round:  # sectors between the circle and a square, whose corners are corners of sectors
        rim = circle(16, phase=0.0)
        square = rim / np.abs(rim).max(1, keepdims=True)
        inner, outer = 0.92 * hole[0] * rim, hole[0] * square
        pieces += [prism(name, [outer[i], outer[i - 1], inner[i - 1], inner[i]], z) for i in range(16)]
    return pieces


@dataclass(frozen=True)
class Body:
    """A body about 2 m across with the rectangle on it that carries parts.

    Attributes:
        pieces: Its meshes, mesh frame; none of them reaches beyond the mount's plane.
        mount: The pose of the mount.
        half: The half sizes of the mount's rectangle, m.
        pitch: The mount's angle, rad: 0 in front, pi / 2 on top.
        radius: Of the circle around the mount's rectangle that is the body's outline, m; 0 unless it is a cylinder.
    """

    pieces: tuple[Piece, ...]
    mount: Pose
    half: Half
    pitch: float
    radius: float = 0.0

    def object(
        self, category: str, rng: np.random.Generator, fixed: Iterable[Piece], parts: Iterable[Part]
    ) -> ObjectSpec:
        """The body with fixed pieces and parts on its mount, given in the mount's frame, turned by some yaw."""
        placed = tuple(self.mount.part(part) for part in parts)
        spec = ObjectSpec(category, "free", "body", (*self.pieces, *self.mount.pieces(fixed)), placed)
        return any_yaw(rng, self.pitch).spec(spec)


def draw_body(rng: np.random.Generator, top: float = 0.35, slanted: float = 0.2, round_share: float = 0.25) -> Body:
    """A random body: a box, one with its edges cut, a cylinder or a wedge, often with blocks, a foot or a stand.

    Args:
        rng: The generator.
        top: Probability that the mount is on top.
        slanted: Probability that it is on a slope.
        round_share: Probability that the body is a cylinder along the mount's normal, unless it is slanted.
    """
    kind = rng.choice(["top", "slanted", "front"], p=[top, slanted, 1 - top - slanted])
    # Sizes in the mount's frame: along x, along y, and how deep the body reaches behind the mount.
    half, deep = (log_uniform(rng, 0.3, 0.9), log_uniform(rng, 0.3, 0.9)), log_uniform(rng, 0.12, 1.3)
    if is_round := bool(kind != "slanted" and rng.random() < round_share):
        half = (half[0], half[0])
    scale = 1.9 / float(np.linalg.norm([2 * half[0], 2 * half[1], deep]))
    half, deep = (scale * half[0], scale * half[1]), scale * deep
    if kind == "slanted":
        return _wedge(rng, half)
    angle = np.pi / 2 if kind == "top" else 0.0
    local, inside = _core(rng, half, deep, is_round)
    low = -half[1] if kind == "front" else -deep  # the body's lowest level
    mount = pitch(angle)
    pieces = list(mount.pieces(local))
    pieces += _extras(rng, half, deep, kind == "top", low, is_round)
    return Body(tuple(pieces), mount, inside, angle, half[0] if is_round else 0.0)


def _core(rng: np.random.Generator, half: Half, deep: float, is_round: bool) -> tuple[list[Piece], Half]:
    """The main block behind the plane z = 0, and the half sizes of the rectangle that fits on it."""
    z = (-deep, 0.0)
    if is_round:
        rim = circle(int(rng.choice([12, 16, 24])))
        taper = rng.uniform(0.7, 1.15)
        lower = np.column_stack([half[0] * taper * rim, np.full(len(rim), z[0])])
        upper = np.column_stack([half[0] * rim, np.zeros(len(rim))])
        return [loft("body", lower, upper)], (0.66 * half[0], 0.66 * half[0])
    if rng.random() < 0.35:
        cut = rng.uniform(0.1, 0.45) * min(half)
        inside = (half[0] - 0.4 * cut, half[1] - 0.4 * cut)
        return [prism("body", chamfered(half, cut), z)], inside
    if rng.random() < 0.3:  # a smaller block behind
        split, share = -rng.uniform(0.3, 0.8) * deep, rng.uniform(0.5, 0.9)
        front = box("body", (-half[0], half[0]), (-half[1], half[1]), (split, 0.0))
        back = box("body", (-share * half[0], share * half[0]), (-half[1], (2 * share - 1) * half[1]), (z[0], split))
        return [front, back], half
    return [box("body", (-half[0], half[0]), (-half[1], half[1]), z)], half


def _extras(rng: np.random.Generator, half: Half, deep: float, on_top: bool, low: float, is_round: bool) -> list[Piece]:
    """Blocks beside or behind the body, a foot or a stand, in the mesh frame and behind the mount's plane."""
    pieces = []
    wide, front, back = half[0], (half[1] if on_top else 0.0), (-half[1] if on_top else -deep)
    high = 0.0 if on_top else half[1]
    middle = (front + back) / 2
    if rng.random() < 0.3:  # beside it
        sign, size = rng.choice([-1, 1]), rng.uniform(0.15, 0.6)
        near, far = sorted((0.0 if is_round else sign * 0.9 * wide, sign * (wide + size)))
        y = (low, low + rng.uniform(0.3, 0.95) * (high - low))
        z = (back, front - rng.uniform(0.02, 0.4) * (front - back))
        pieces.append(box("side_block", (near, far), y, z))
    under = rng.random()
    if under < 0.2:  # a foot
        out = rng.uniform(0.0, 0.2)
        z = (back - out, front if not on_top else front + out)
        pieces.append(box("foot", (-wide - out, wide + out), (low - rng.uniform(0.03, 0.08), low), z))
    elif under < 0.35:  # a stand
        tall, thick, spread = rng.uniform(0.15, 0.7), rng.uniform(0.03, 0.1), rng.uniform(0.15, 0.35)
        pieces.append(rod("stem", (0.0, low - tall, middle), (0.0, low + 0.02, middle), thick))
        spread = min(spread, 2 * (front - middle)) if not on_top else spread
        pieces += Pose(Rotation.identity(), (0.0, low - tall, middle)).pieces(
            [slab("foot", circle(16), (-0.04, 0.0), (spread, spread), (spread, spread))]
        )
    elif under < 0.5 and (on_top or not is_round):  # four feet
        tall, thick = rng.uniform(0.03, 0.4), rng.uniform(0.015, 0.05)
        inset = 0.55 * wide if is_round else 2 * thick
        if min(wide, (front - back) / 2) > max(inset, 4 * thick):
            for x in (-wide + inset, wide - inset):
                for z_at in (back + inset, front - inset):
                    pieces.append(rod("leg", (x, low - tall, z_at), (x, low + 0.01, z_at), thick, sides=8))
    return pieces


def _wedge(rng: np.random.Generator, half: Half) -> Body:
    """A console: a prism whose upper front face slopes."""
    angle = rng.uniform(0.35, 1.2)
    wide, length = half[0], 2 * half[1]
    rise, run = length * float(np.cos(angle)), length * float(np.sin(angle))
    lip, shelf = rng.uniform(0.03, 0.35), rng.uniform(0.02, 0.4)
    corners = [(run / 2, -rise / 2), (run / 2, -rise / 2 - lip), (-run / 2 - shelf, -rise / 2 - lip)]
    corners += [(-run / 2 - shelf, rise / 2), (-run / 2, rise / 2)]
    body = loft("body", [(-wide, y, z) for z, y in corners], [(wide, y, z) for z, y in corners])
    pieces = [body]
    if rng.random() < 0.3:  # a tower behind it
        tower = rng.uniform(0.2, 0.6)
        pieces.append(
            box(
                "tower",
                (-rng.uniform(0.4, 1.0) * wide, rng.uniform(0.4, 1.0) * wide),
                (-rise / 2 - lip, rise / 2 + rng.uniform(-0.2, 0.0) * rise),
                (-run / 2 - shelf - tower, -run / 2 - shelf),
            )
        )
    return Body(tuple(pieces), pitch(angle), (wide, length / 2), angle)
