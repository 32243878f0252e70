"""Convex pieces: the one kind of mesh that procedural objects are built from.

Frame of all pieces: the mesh frame of PartNet-Mobility, y up and z to the front, in metres.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

Vector = tuple[float, float, float]
Range = tuple[float, float]
"""Lower and upper end along one axis, in metres."""


@dataclass(frozen=True)
class Piece:
    """A convex watertight triangle mesh.

    Attributes:
        name: PartNet's name of the kind of piece, such as "handle".
        vertices: [V, 3] m, mesh frame.
        faces: [F, 3] vertex indices, counter-clockwise seen from outside.
    """

    name: str
    vertices: npt.NDArray[np.float64]
    faces: npt.NDArray[np.int64]

    def transformed(self, scale: float, shift: npt.NDArray[np.float64]) -> Piece:
        """The piece at scale * vertices + shift, with shift [3] in metres."""
        return replace(self, vertices=self.vertices * scale + shift)


def loft(name: str, lower: npt.ArrayLike, upper: npt.ArrayLike) -> Piece:
    """The solid between two convex polygons of equally many corners.

    Own code instead of trimesh's primitives: one loft gives boxes, prisms, frusta and wall sectors alike, and
    its vertex order does not change with a library's version, so neither do the bytes of a generated object.

    Args:
        name: Name of the piece.
        lower: [n, 3] corners in order.
        upper: [n, 3] the corners that the lower ones are joined to.
    """
    vertices = np.concatenate([np.asarray(lower, dtype=float), np.asarray(upper, dtype=float)])
    n = len(vertices) // 2
    k = np.arange(n)
    after = (k + 1) % n
    fan = np.arange(1, n - 1)
    first = np.zeros_like(fan)
    faces = np.concatenate(
        [
            np.stack([first, fan + 1, fan], 1),
            np.stack([first + n, fan + n, fan + 1 + n], 1),
            np.stack([k, after, after + n], 1),
            np.stack([k, after + n, k + n], 1),
        ]
    )
    corners = vertices[faces] - vertices.mean(0)
    if np.linalg.det(corners).sum() < 0:  # six times the signed volume: the polygons ran the other way round
        faces = faces[:, ::-1]
    return Piece(name, vertices, faces)


def box(name: str, x: Range, y: Range, z: Range) -> Piece:
    """An axis-aligned box.

    Raises:
        ValueError: If a range is empty.
    """
    if not (x[0] < x[1] and y[0] < y[1] and z[0] < z[1]):
        raise ValueError(f"piece {name}: empty box x={x} y={y} z={z}")
    floor = [(x[0], z[0]), (x[1], z[0]), (x[1], z[1]), (x[0], z[1])]
    return loft(name, [(a, y[0], b) for a, b in floor], [(a, y[1], b) for a, b in floor])


def around(name: str, x: Range, y: Range, z: Range, hole: tuple[Range, Range], lying: bool = False) -> list[Piece]:
    """Four boxes of the slab x, y, z around a hole through it: left and right of it, then on its two other sides.

    The hole has ranges in x and y, or in x and z if the slab is `lying`; there is none along the third axis.
    """
    hole_x, hole_c = hole
    c = z if lying else y
    parts = [((x[0], hole_x[0]), c), ((hole_x[1], x[1]), c), (hole_x, (c[0], hole_c[0])), (hole_x, (hole_c[1], c[1]))]
    return [box(name, a, y, b) if lying else box(name, a, b, z) for a, b in parts]


def housing(x: Range, y: Range, z: Range, sheet: float) -> list[Piece]:
    """Five panels, ``sheet`` m thick, of a hollow box that is open at the front."""
    inner = (x[0] + sheet, x[1] - sheet)
    return [
        box("side_panel", (x[0], inner[0]), y, z),
        box("side_panel", (inner[1], x[1]), y, z),
        box("bottom_panel", inner, (y[0], y[0] + sheet), z),
        box("top_panel", inner, (y[1] - sheet, y[1]), z),
        box("back_panel", inner, (y[0] + sheet, y[1] - sheet), (z[0], z[0] + sheet)),
    ]


def circle(sides: int, phase: float = 0.5) -> npt.NDArray[np.float64]:
    """Corners [sides, 2] of a regular polygon on the unit circle; phase 0.5 lays its flats along the axes."""
    angle = 2 * np.pi * (np.arange(sides) + phase) / sides
    return np.stack([np.cos(angle), np.sin(angle)], 1)


def rectangle() -> npt.NDArray[np.float64]:
    """Corners [4, 2] of the square from -1 to 1."""
    return np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)])


def rod(
    name: str, start: Vector, end: Vector, radius: float, end_radius: float | None = None, sides: int = 12
) -> Piece:
    """A round rod, or a truncated cone if end_radius (m) is given, between the points start and end."""
    a, b = np.asarray(start), np.asarray(end)
    along = (b - a) / np.linalg.norm(b - a)
    u = np.cross(along, np.eye(3)[np.argmin(np.abs(along))])
    u /= np.linalg.norm(u)
    rim = circle(sides) @ np.stack([u, np.cross(along, u)])
    return loft(name, a + radius * rim, b + (radius if end_radius is None else end_radius) * rim)


def level(outline: npt.NDArray[np.float64], half: tuple[float, float], y: float) -> npt.NDArray[np.float64]:
    """A unit outline [n, 2] in x and z, stretched to the half sizes `half` and laid at height y: [n, 3]."""
    return np.stack([outline[:, 0] * half[0], np.full(len(outline), y), outline[:, 1] * half[1]], 1)


def slab(
    name: str, outline: npt.NDArray[np.float64], y: Range, lower: tuple[float, float], upper: tuple[float, float]
) -> Piece:
    """A solid with the unit outline [n, 2], of half sizes (x, z) `lower` at y[0] and `upper` at y[1]."""
    return loft(name, level(outline, lower, y[0]), level(outline, upper, y[1]))


def wall(
    name: str,
    outline: npt.NDArray[np.float64],
    y: Range,
    lower: tuple[float, float],
    upper: tuple[float, float],
    thickness: float,
) -> list[Piece]:
    """A hollow wall of convex sectors, one per side of the unit outline [n, 2].

    `lower` and `upper` are the outer half sizes (x, z) at y[0] and y[1]; the inside is `thickness` smaller.
    """
    rings = [
        (level(outline, half, h), level(outline, (half[0] - thickness, half[1] - thickness), h))
        for half, h in ((lower, y[0]), (upper, y[1]))
    ]
    pieces = []
    for i in range(len(outline)):
        j = (i + 1) % len(outline)
        quads = [(outer[i], outer[j], inner[j], inner[i]) for outer, inner in rings]
        pieces.append(loft(name, quads[0], quads[1]))
    return pieces
