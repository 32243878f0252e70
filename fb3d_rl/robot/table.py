"""Objects of any size as they stand on the robot's table."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import trimesh

from fb3d_rl.assets.articulation import ArticulatedObject, Joint, Link, Mesh
from fb3d_rl.errors import UserError
from fb3d_rl.kinematics.opening import openable_links, opening_range, standing_bounds
from fb3d_rl.robot.simulated import TableObject

DIAGONAL = 0.45
"""Of a table object's bounding box, m."""

DENSITY = 100.0
"""Of the convex hulls of its parts, kg/m^3: they are hollow (:attr:`fb3d_rl.env.options.EnvOptions.density`)."""

MASSES = (0.05, 5.0)
"""The smallest and the largest mass of a part, kg."""

TURN = (-70.0, -35.0)
"""How its front is turned from the robot's direction towards the camera's, degrees: a hand that follows a lid from the
front over the top and down behind it meets its joints' limits, one that follows it sideways does not."""

PLACE = (0.62, 0.0)
"""Where it stands, m."""

ABOUT = 0.03
"""How far from there at most in x and y, m."""


def scaled(obj: ArticulatedObject, factor: float) -> ArticulatedObject:
    """The object with all lengths multiplied."""

    def meshes(own: tuple[Mesh, ...]) -> tuple[Mesh, ...]:
        return tuple(Mesh(mesh.vertices * factor, mesh.faces) for mesh in own)

    def joint(own: Joint | None) -> Joint | None:
        if own is None:
            return None
        origin, (low, high) = own.origin.copy(), own.limits
        origin[:3, 3] *= factor
        limits = (factor * low, factor * high) if own.type == "prismatic" else (low, high)
        return replace(own, origin=origin, limits=limits)

    def link(own: Link) -> Link:
        return replace(own, joint=joint(own.joint), visuals=meshes(own.visuals), collisions=meshes(own.collisions))

    return replace(obj, links=tuple(map(link, obj.links)))


def masses_of(obj: ArticulatedObject) -> tuple[float, ...]:
    """Plausible masses of an object's links [L], kg."""
    volumes = [sum(_volume(mesh) for mesh in link.collisions) for link in obj.links]
    return tuple(float(np.clip(DENSITY * volume, *MASSES)) for volume in volumes)


def _volume(mesh: Mesh) -> float:
    try:
        return float(trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).convex_hull.volume)
    except Exception:  # noqa: BLE001, Qhull's own error, of a flat mesh
        return 0.0


def on_table(obj: ArticulatedObject, seed: int, part: str | None = None, diagonal: float = DIAGONAL) -> TableObject:
    """An object of a table's size, closed, at a place in the workspace.

    Args:
        obj: the object, of any size.
        seed: draws where it stands.
        part: name of the link to open; the one with the largest surface unless given.
        diagonal: of its bounding box on the table, m.

    Raises:
        UserError: it has no such part, or nothing to open.
    """
    links = openable_links(obj)
    if not links:
        raise UserError(f"object {obj.id} has no part that opens; choose another one")
    if part is not None and part not in [obj.links[i].name for i in links]:
        names = ", ".join(obj.links[i].name for i in links)
        raise UserError(f"object {obj.id} has no part {part!r} that opens; choose from {names}")
    small = scaled(obj, diagonal / float(np.linalg.norm(np.ptp(standing_bounds(obj), axis=0))))
    areas = [sum(trimesh.Trimesh(m.vertices, m.faces, process=False).area for m in obj.links[i].visuals) for i in links]
    link = links[int(np.argmax(areas))] if part is None else obj.index(part)
    rng = np.random.default_rng(seed)
    x, y = np.array(PLACE) + rng.uniform(-ABOUT, ABOUT, 2)
    turn = float(np.radians(rng.uniform(*TURN)))
    start = tuple(opening_range(small)[0].tolist())
    return TableObject(small, link, start, (float(x), float(y), turn), masses_of(small))
