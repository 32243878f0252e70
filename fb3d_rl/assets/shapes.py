"""Surfaces of shapes that need no file, and what readers of descriptions do with the surfaces of a link."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import trimesh
from numpy.typing import NDArray

from fb3d_rl.assets.articulation import Mesh


def solid(kind: str, size: NDArray[np.float64], transform: NDArray[np.float64]) -> Mesh:
    """The mesh of a primitive, centred, its axis along z, moved by a transform [4, 4].

    Args:
        kind: box, sphere, ellipsoid, cylinder or capsule.
        size: the sides (box), the radius (sphere), three radii (ellipsoid), or radius and length (m); a capsule's is
            without its caps.
        transform: where it is put.
    """
    if kind == "box":
        made = trimesh.creation.box(size)
    elif kind in ("sphere", "ellipsoid"):
        made = trimesh.creation.icosphere(radius=size[0] if kind == "sphere" else 1.0)
        if kind == "ellipsoid":
            made.apply_scale(size)
    else:
        made = getattr(trimesh.creation, kind)(radius=size[0], height=size[1])
    vertices = np.asarray(made.vertices, dtype=np.float64) - np.mean(made.bounds, axis=0)
    return Mesh(vertices @ transform[:3, :3].T + transform[:3, 3], np.asarray(made.faces, dtype=np.int64))


def each_once(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """The same surface without repeats.

    PartNet's files hold a point for each corner and triangles for each side; a fifth of the points and half of the
    triangles are left.
    """
    first, number = trimesh.grouping.unique_rows(vertices, keep_order=True)
    faces = number[faces]
    return vertices[first], faces[np.sort(trimesh.grouping.unique_rows(np.sort(faces, axis=1))[0])]


def completed(
    link: str, visuals: tuple[Mesh, ...], collisions: tuple[Mesh, ...], say: Callable[[str], None]
) -> tuple[tuple[Mesh, ...], tuple[Mesh, ...]]:
    """What of a link is seen and what is touched; where it lacks one kind, the other's, and a remark says so."""
    if visuals and not collisions:
        say(f"link {link}: no collision, so its visual is touched too")
    elif collisions and not visuals:
        say(f"link {link}: no visual, so its collision is seen too")
    return visuals or collisions, collisions or visuals
