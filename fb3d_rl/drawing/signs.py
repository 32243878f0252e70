"""What is drawn beside the bodies of a scene: arrows of a flow, a suction cup, captions."""

from __future__ import annotations

import os
from collections.abc import Sequence

import matplotlib
import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import ImageFont

from fb3d_rl.assets.articulation import Mesh
from fb3d_rl.drawing.bodies import Color, srgb

FREE, HOLDING, FLOW = srgb("#e5383b"), srgb("#14c99a"), srgb("#ff8c1a")
INK, FAINT, TRACK = "#22262b", "#6b7480", "#dfe4ea"


def _turned(profile: Sequence[tuple[float, float]], sections: int) -> Mesh:
    """The surface that a line of points (radius, height) makes when it turns about the z axis."""
    made = trimesh.creation.revolve(np.array(profile), sections=sections)
    return Mesh(np.asarray(made.vertices, dtype=np.float64), np.asarray(made.faces, dtype=np.int64))


def cup_mesh(gripper: Sequence[Sequence[Mesh]]) -> Mesh:
    """A suction cup at the fingers' ends, about the hand's x axis: drawn only, not simulated."""
    end = max(float(mesh.vertices[:, 0].max()) for meshes in gripper for mesh in meshes)
    made = _turned([(0, -0.06), (0.014, -0.06), (0.016, -0.04), (0.036, 0.002), (0, 0.002)], 24)
    return Mesh(made.vertices[:, [2, 0, 1]] + [end, 0, 0], made.faces)


_ARROW = _turned([(0, 0), (0.32, 0), (0.32, 1), (1, 1), (0, 2)], 8)
"""Shaft from height 0 to 1, head from 1 to 2; stretched for each arrow."""


def arrow_mesh(starts: NDArray[np.float64], vectors: NDArray[np.float64], radius: float) -> list[Mesh]:
    """A mesh of solid arrows with that head ``radius`` from ``starts`` [A, 3] along ``vectors`` [A, 3], m."""
    length = np.linalg.norm(vectors, axis=-1)[:, None]
    size = np.minimum(radius, length / 3)
    head = 2.2 * size
    along = vectors / length
    side = np.cross(along, np.eye(3)[np.abs(along).argmin(1)])
    side /= np.linalg.norm(side, axis=-1, keepdims=True)
    x, y, z = _ARROW.vertices.T
    forward = np.minimum(z, 1) * (length - head) + np.maximum(z - 1, 0) * head + 0.02 * length
    vertices = starts[:, None] + forward[..., None] * along[:, None]
    vertices += size[..., None] * (x[:, None] * side[:, None] + y[:, None] * np.cross(along, side)[:, None])
    faces = _ARROW.faces + len(_ARROW.vertices) * np.arange(len(starts))[:, None, None]
    return [Mesh(vertices.reshape(-1, 3), faces.reshape(-1, 3))]


def font(size: int, bold: bool = False) -> ImageFont.FreeTypeFont:
    """A font that comes with matplotlib, so that pictures are the same on all machines."""
    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(os.path.join(matplotlib.get_data_path(), "fonts", "ttf", name), size)


def hex_color(color: Color) -> str:
    """A colour as HTML and Pillow write it."""
    return "#" + "".join(f"{round(255 * part):02x}" for part in color)
