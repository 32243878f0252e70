"""What is wrong with an object: joints without a range, parts without a surface, parts that run into others."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from fb3d_rl.assets.articulation import ArticulatedObject, Mesh
from fb3d_rl.assets.partnet_mobility import load_object
from fb3d_rl.errors import UserError
from fb3d_rl.kinematics.opening import LARGEST, openable_links, opening_range, standing_bounds
from fb3d_rl.kinematics.tree import KinematicTree

SAMPLES = 400
"""Number of points on a part's surface whose motion is followed while it opens."""

DEPTH = 0.01
"""How deep (m) a point must be inside another part's hull to count."""

BLOCKED = 0.15
"""Share of a part's points that must get into others for the part to count as blocked."""

SHARES = (0.03, 0.1, 0.25, 0.5, 0.75)
"""How far the part is open in the states that are checked, as a share of its range."""


@dataclass(frozen=True)
class Finding:
    """One flaw.

    Attributes:
        what: a sentence.
        serious: whether the object, or a part of it, cannot be used because of it; else it is only worth knowing.
    """

    what: str
    serious: bool


@dataclass(frozen=True)
class Verdict:
    """What is known about one folder.

    Attributes:
        id: the folder's name.
        category: empty if the object cannot be read.
        openable: how many parts open.
        findings: the flaws, the serious ones first.
    """

    id: str
    category: str
    openable: int
    findings: tuple[Finding, ...]

    @property
    def usable(self) -> bool:
        return not any(finding.serious for finding in self.findings)

    def entry(self) -> dict[str, object]:
        """The verdict as JSON takes it."""
        return {**asdict(self), "usable": self.usable}


def examine(folder: Path) -> Verdict:
    """The verdict on an object's folder; that an object cannot be read is a flaw too."""
    try:
        obj = load_object(folder)
    except UserError as error:
        return Verdict(folder.name, "", 0, (Finding(str(error), serious=True),))
    return Verdict(obj.id, obj.category, len(openable_links(obj)), tuple(findings(obj)))


def findings(obj: ArticulatedObject) -> list[Finding]:
    """The flaws of an object that could be read, the serious ones first."""
    flaws = [*_size(obj), *_joints(obj), *_surfaces(obj), *_blocked(obj)]
    flaws += [
        Finding(f"{'left out' if what in obj.lost else 'noted'} while reading: {what}", serious=False)
        for what in obj.dropped
    ]
    return sorted(flaws, key=lambda finding: not finding.serious)


def _size(obj: ArticulatedObject) -> Iterable[Finding]:
    size = float(np.linalg.norm(np.diff(standing_bounds(obj), axis=0)))
    if size > LARGEST:
        yield Finding(f"measures {size:.4g} m across: millimetres? `assets=files` takes them as such", serious=False)
    for joint in map(obj.joint_of, obj.movable):
        if joint.type == "prismatic" and LARGEST < joint.limits[1] - joint.limits[0] < np.inf:
            yield Finding(f"joint {joint.name} slides {joint.limits[1] - joint.limits[0]:.4g} m", serious=False)


def _joints(obj: ArticulatedObject) -> Iterable[Finding]:
    if not obj.movable:
        yield Finding("no joint moves", serious=True)
        return
    if not openable_links(obj):
        yield Finding("no part opens: all joints are without end, move too little, or are controls", serious=True)
    closed, _ = opening_range(obj)
    for link, (lower, upper), rest in zip(obj.movable, obj.limits, closed, strict=True):
        name = f"{obj.links[link].name} ({obj.links[link].semantic or 'no name'})"
        if not np.isfinite([lower, upper]).all():
            yield Finding(f"{name}: no finite limits, so no open end", serious=False)
        elif lower == upper:
            yield Finding(f"{name}: equal limits, so it cannot move", serious=False)
        elif rest == upper:
            yield Finding(f"{name}: flipped axis, closed at the upper limit",
                          serious=False)  # fmt: skip


def _surfaces(obj: ArticulatedObject) -> Iterable[Finding]:
    for link in obj.movable:
        if not any(obj.links[i].visuals for i in obj.descendants(link)):
            yield Finding(f"{obj.links[link].name}: the moving part has no mesh", serious=True)
    if not any(link.visuals for link in obj.links):
        yield Finding("no link has a mesh", serious=True)


def _blocked(obj: ArticulatedObject) -> Iterable[Finding]:
    """Parts that get into others while they open: from a wrong axis, or an overlap at rest.

    The other parts are replaced by the hulls of their meshes. A hull that the part is inside of when closed, as a door
    is in its frame, does not count.
    """
    openable = openable_links(obj)
    if not openable:
        return
    tree = KinematicTree.from_object(obj)
    closed, opened = opening_range(obj)
    at_rest = tree.forward(torch.as_tensor(closed)).numpy()
    for link in openable:
        carried = set(obj.descendants(link))
        own = [(i, mesh) for i in carried for mesh in obj.links[i].visuals]
        if not own:
            continue
        hulls = [
            hull
            for i, other in enumerate(obj.links)
            if i not in carried
            for mesh in other.visuals
            if (hull := _half_spaces(mesh, at_rest[i])) is not None
        ]
        joint, worst, samples = obj.movable.index(link), 0.0, _samples(own)
        before = _inside(_placed(samples, at_rest), hulls)
        for share in SHARES:
            state = closed.copy()
            state[joint] += share * (opened[joint] - closed[joint])
            now = _inside(_placed(samples, tree.forward(torch.as_tensor(state)).numpy()), hulls)
            worst = max(worst, float((now & ~before.any(0)).any(1).mean()) if now.size else 0.0)
        if worst > BLOCKED:
            name = f"{obj.links[link].name} ({obj.links[link].semantic or 'no name'})"
            yield Finding(f"{name}: {worst:.0%} of it runs into other parts while it opens", serious=False)


def _samples(meshes: list[tuple[int, Mesh]]) -> list[tuple[int, NDArray[np.float64]]]:
    """Points [., 3] spread over each mesh, in its link's frame, with the link."""
    count, samples = max(3, SAMPLES // len(meshes)), []
    for i, mesh in meshes:
        solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
        points, _ = trimesh.sample.sample_surface(solid, count, seed=0)
        samples.append((i, np.asarray(points)))
    return samples


def _placed(samples: list[tuple[int, NDArray[np.float64]]], poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """All samples [S, 3] where the links stand at ``poses`` [L, 4, 4]."""
    return np.concatenate([points @ poses[i, :3, :3].T + poses[i, :3, 3] for i, points in samples])


def _half_spaces(mesh: Mesh, pose: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Planes [F, 4] whose product with (x, y, z, 1) is negative inside the mesh's hull; none of a flat mesh."""
    try:
        return np.asarray(ConvexHull(mesh.vertices @ pose[:3, :3].T + pose[:3, 3]).equations)
    except (QhullError, ValueError):
        return None


def _inside(points: NDArray[np.float64], hulls: list[NDArray[np.float64]]) -> NDArray[np.bool_]:
    """Whether each of the points [S, 3] is deep inside each hull: [S, H]."""
    inside = [(points @ planes[:, :3].T + planes[:, 3]).max(1) < -DEPTH for planes in hulls]
    return np.stack(inside, axis=1) if inside else np.zeros((len(points), 0), dtype=bool)
