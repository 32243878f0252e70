"""Random kinematic chains and hand-made objects for the tests of flow."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from fb3d_rl.assets.articulation import ArticulatedObject, Joint, JointType, Link, Mesh


def pose(xyz: ArrayLike = (0, 0, 0), turn: Rotation | None = None) -> np.ndarray:
    transform = np.eye(4)
    transform[:3, 3] = xyz
    if turn is not None:
        transform[:3, :3] = turn.as_matrix()
    return transform


def box(extents: ArrayLike, centre: ArrayLike = (0, 0, 0)) -> Mesh:
    """A box whose long triangles are cut up no further."""
    made = trimesh.creation.box(extents=extents, transform=pose(centre))
    return Mesh(np.array(made.vertices, dtype=np.float64), np.array(made.faces, dtype=np.int64))


def joint(
    kind: JointType,
    axis: ArrayLike = (0, 0, 0),
    limits: tuple[float, float] = (0.0, 0.0),
    origin: np.ndarray | None = None,
) -> Joint:
    return Joint("j", kind, np.eye(4) if origin is None else origin, np.array(axis, dtype=np.float64), limits)


def make(*parts: tuple[int, Joint | None, str, Sequence[Mesh]], category: str = "Test") -> ArticulatedObject:
    """An object of (parent, joint, semantic, meshes) for each link."""
    links = tuple(
        Link(f"link_{i}", semantic, parent, connection, tuple(meshes), tuple(meshes))
        for i, (parent, connection, semantic, meshes) in enumerate(parts)
    )
    return ArticulatedObject("made", category, Path("none.urdf"), links)


def random_chain(rng: np.random.Generator, links: int = 7) -> ArticulatedObject:
    """A tree with every joint type, any axes and origins: link i hangs on a random earlier link."""
    kinds: list[JointType] = ["revolute", "prismatic", "continuous", "fixed"]
    parts: list[tuple[int, Joint | None, str, Sequence[Mesh]]] = [(-1, None, "", ())]
    for i in range(1, links):
        kind = kinds[(i - 1) % 4] if i <= 4 else kinds[rng.integers(4)]
        axis = rng.normal(size=3)
        axis = np.zeros(3) if kind == "fixed" else axis / np.linalg.norm(axis)
        limits = {"fixed": (0.0, 0.0), "continuous": (-np.inf, np.inf)}.get(kind, (-1.0, 1.0))
        origin = pose(rng.normal(size=3), Rotation.random(rng=rng))
        parts.append((int(rng.integers(i)), joint(kind, axis, limits, origin), "", (box((0.2, 0.3, 0.4)),)))
    return make(*parts)
