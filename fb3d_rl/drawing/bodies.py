"""The content of a picture: rigid bodies of coloured meshes, and the surfaces that rays hit."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from fb3d_rl.assets.articulation import ArticulatedObject, Mesh
from fb3d_rl.camera.embree import triangle_scene

F32 = NDArray[np.float32]
Color = tuple[float, float, float]

CREASE = 40.0
"""Faces that meet at less than this angle (degrees) are shaded as one smooth surface."""

GAMMA = 2.2
"""Colours are sRGB numbers; light adds up in their powers of this."""

OPAQUE, SIGN = 1000, 2000
"""The first numbers of opaque bodies and of signs in a picture."""


def srgb(code: str) -> Color:
    """The color of a code such as "#3f7fd0"."""
    red, green, blue = (int(code[i : i + 2], 16) / 255 for i in (1, 3, 5))
    return red, green, blue


STATIC, MOVABLE, TARGET, GRIPPER = srgb("#cdd2d9"), srgb("#aebccd"), srgb("#3f7fd0"), srgb("#3a3f47")


def link_colors(obj: ArticulatedObject, *links: int) -> list[Color]:
    """Colors of the object's links: those that ``links`` carry, other movable ones, static ones."""
    target = {i for each in links for i in obj.descendants(each)}
    movable = {i for each in obj.movable for i in obj.descendants(each)}
    return [TARGET if i in target else MOVABLE if i in movable else STATIC for i in range(len(obj.links))]


@dataclass
class Surface:
    """The surfaces that S rays hit: distance (m), unit normal towards the eye, linear colour and the body's number.

    ``behind`` is the colour of a sign that this hides, black where there is none.
    """

    distance: F32
    normal: F32
    color: F32
    body: NDArray[np.int16]
    behind: F32

    def take(self, where: NDArray[np.intp]) -> Surface:
        return Surface(*(values[where] for values in vars(self).values()))

    def joined(self, other: Surface) -> Surface:
        return Surface(*(np.concatenate(pair) for pair in zip(vars(self).values(), vars(other).values(), strict=True)))

    def put(self, where: NDArray[np.intp], other: Surface, body: int) -> NDArray[np.intp]:
        """Copy the entries of ``other`` [len(where)] that are nearer; return their indices."""
        nearer = other.distance < self.distance[where]
        taken = where[nearer]
        self.distance[taken], self.normal[taken] = other.distance[nearer], other.normal[nearer]
        self.color[taken], self.body[taken] = other.color[nearer], body
        if body >= SIGN:
            veiled = ~nearer & (self.body[where] < OPAQUE)
            self.behind[where[veiled]] = other.color[veiled]
        return taken

    def copy(self) -> Surface:
        return Surface(*(values.copy() for values in vars(self).values()))


@dataclass(frozen=True, eq=False)
class Part:
    """Meshes of one colour [3] (sRGB, 0 to 1) at T_body_part [4, 4] in a body's frame."""

    meshes: Sequence[Mesh]
    color: Color
    pose: NDArray[np.float64] = field(default_factory=lambda: np.eye(4))


class Body:
    """A rigid body made of parts, with one static Embree scene in its own frame.

    The sense in which faces turn does not matter: both of their sides are seen.

    Args:
        parts: the parts.
        sign: whether this is a sign such as an arrow, which casts and gets no shadow and is visible, faintly, through
            other bodies.
        opaque: whether it hides signs completely.
    """

    def __init__(self, parts: Iterable[Part], sign: bool = False, opaque: bool = False) -> None:
        self.sign = sign
        self.rank = SIGN if sign else OPAQUE if opaque else 0
        corners, normals, colors = [np.zeros((0, 3, 3))], [np.zeros((0, 3, 3))], [np.zeros((0, 3))]
        for part in parts:
            rotation, shift = part.pose[:3, :3], part.pose[:3, 3]
            for mesh in (mesh for mesh in part.meshes if len(mesh.faces)):
                corners.append(mesh.vertices[mesh.faces] @ rotation.T + shift)
                normals.append(_corner_normals(mesh) @ rotation.T)
                colors.append(np.tile(np.power(part.color, GAMMA), (len(mesh.faces), 1)))
        triangles = np.concatenate(corners).astype(np.float32)
        self._points: F32 = triangles.reshape(-1, 3)
        self.normals: F32 = np.concatenate(normals).astype(np.float32)
        """Unit normals [F, 3, 3] at the corners of all faces."""
        self._colors: F32 = np.concatenate(colors).astype(np.float32)
        self.centre, self.half = np.zeros(3), np.zeros(3)
        self._scene = None
        if len(triangles):
            low, high = (ends.astype(np.float64) for ends in (self._points.min(0), self._points.max(0)))
            self.centre, self.half = 0.5 * (low + high), 0.5 * (high - low)
            """Centre [3] and half extents [3] (m) of the bounding box in the body's frame."""
            self._scene = triangle_scene(triangles)
        self.radius = float(np.linalg.norm(self.half))

    def outline(self) -> NDArray[np.float64]:
        """Points [64, 3] (m) of the body that reach furthest, in its own frame; none of an empty body."""
        if not len(self._points):
            return np.zeros((0, 3))
        return self._points[(self._points @ spread(64).T.astype(np.float32)).argmax(0)].astype(np.float64)

    def hit(self, pose: NDArray[np.float64], eye: NDArray[np.float64], rays: F32) -> tuple[NDArray[np.intp], Surface]:
        """Which of the unit ``rays`` [R, 3] from ``eye`` [3] hit the body at T_world_body ``pose``, and where."""
        if self._scene is None or not len(rays):
            none = np.zeros((0, 3), dtype=np.float32)
            return np.zeros(0, dtype=np.intp), Surface(none[:, 0], none, none, np.zeros(0, dtype=np.int16), none)
        rotation = pose[:3, :3].astype(np.float32)
        origin = (pose[:3, :3].T @ (eye - pose[:3, 3])).astype(np.float32)
        found = self._scene.run(np.tile(origin, (len(rays), 1)), rays @ rotation, output=True)
        which = np.flatnonzero(found["primID"] >= 0)
        triangle, u, v = (found[key][which] for key in ("primID", "u", "v"))
        corners = self.normals[triangle]
        normal = corners[:, 0] * (1 - u - v)[:, None] + corners[:, 1] * u[:, None] + corners[:, 2] * v[:, None]
        normal = unit(normal) @ rotation.T
        normal *= np.where(dot(normal, rays[which]) > 0, -1, 1).astype(np.float32)[:, None]
        body = np.zeros(len(which), dtype=np.int16)
        return which, Surface(found["tfar"][which], normal, self._colors[triangle], body, np.zeros_like(normal))

    def blocks(self, pose: NDArray[np.float64], origins: F32, rays: F32, reach: float) -> NDArray[np.bool_]:
        """Whether the body at ``pose`` lies within ``reach`` m on each of the unit ``rays`` [R, 3] from ``origins``."""
        if self._scene is None or not len(rays):
            return np.zeros(len(rays), dtype=bool)
        rotation = pose[:3, :3].astype(np.float32)
        starts = (origins - pose[:3, 3].astype(np.float32)) @ rotation
        limits = np.full(len(rays), reach, dtype=np.float32)
        return np.asarray(self._scene.run(starts, rays @ rotation, limits, query="OCCLUDED") >= 0)

    def shades(self, pose: NDArray[np.float64], points: F32, direction: F32, slope: float) -> NDArray[np.intp]:
        """Which of ``points`` [3, P] may have the body in the cone of that ``slope`` about the ``direction`` [3]."""
        x, y, z = (pose[:3, :3] @ self.centre + pose[:3, 3]).astype(np.float32)[:, None] - points
        along = x * direction[0] + y * direction[1] + z * direction[2]
        limit = self.radius + slope * np.maximum(along, 0)
        return np.flatnonzero((x * x + y * y + z * z - along * along < limit * limit) & (along > -self.radius))

    def near(self, pose: NDArray[np.float64], points: F32, normals: F32, reach: float) -> NDArray[np.intp]:
        """Which of ``points`` [3, P] may have the body within ``reach`` m on the side of their ``normals`` [P, 3]."""
        centre = (pose[:3, :3] @ self.centre + pose[:3, 3]).astype(np.float32)
        x, y, z = points - centre[:, None]
        within = np.flatnonzero(x * x + y * y + z * z < (self.radius + reach) ** 2)
        to_body, half = pose[:3, :3].T.astype(np.float32), self.half.astype(np.float32)[:, None]
        local, normal = to_body @ points[:, within] - (to_body @ centre)[:, None], to_body @ normals[within].T
        away = np.maximum(np.abs(local) - half, 0)
        # How far the bounding box's highest corner is above the surface.
        height = (np.abs(normal) * half - normal * local).sum(0)
        return within[((away * away).sum(0) < reach * reach) & (height > 0)]


Placed = tuple[Body, NDArray[np.float64]]
"""A body and its pose T_world_body [4, 4]."""


def spread(count: int) -> NDArray[np.float64]:
    """Points [count, 3] spread over the unit sphere from its top to its bottom, on a golden spiral."""
    number = np.arange(count)
    z = 1.0 - 2.0 * (number + 0.5) / count
    angle, ring = np.pi * (3.0 - np.sqrt(5.0)) * number, np.sqrt(1.0 - z * z)
    return np.stack([ring * np.cos(angle), ring * np.sin(angle), z], axis=-1)


def dot(a: F32, b: F32) -> F32:
    """Dot products [R] of the rows of two [R, 3]."""
    return np.asarray(a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2])


def unit(a: F32) -> F32:
    """The rows of [R, 3] at length 1."""
    return np.divide(a, np.maximum(np.sqrt(dot(a, a)), 1e-6)[:, None], dtype=np.float32)


def _corner_normals(mesh: Mesh) -> NDArray[np.float64]:
    """Unit normals [F, 3, 3] at the faces' corners: area-weighted mean over the faces that meet smoothly there."""
    triangles = mesh.vertices[mesh.faces]
    area = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    unit = area / np.maximum(np.linalg.norm(area, axis=-1, keepdims=True), 1e-12)
    _, welded = np.unique(np.round(mesh.vertices, 5), axis=0, return_inverse=True)
    vertex = welded.reshape(-1)[mesh.faces].reshape(-1)
    order = np.argsort(vertex, kind="stable")
    _, start, count = np.unique(vertex[order], return_index=True, return_counts=True)
    # All pairs of corners at one vertex, in runs with the same first corner.
    number = np.repeat(count, count)
    begin = np.cumsum(number) - number
    second = np.repeat(np.repeat(start, count) - begin, number) + np.arange(number.sum())
    mine, other = np.repeat(order, number) // 3, order[second] // 3
    cosine = (unit[mine] * unit[other]).sum(-1)
    weight = np.where(np.abs(cosine) >= np.cos(np.radians(CREASE)), np.sign(cosine), 0.0)
    normals = np.empty((len(vertex), 3))
    normals[order] = np.add.reduceat(area[other] * weight[:, None], begin, axis=0)
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
    return normals.reshape(-1, 3, 3)
