"""Read an object from its file, and bring it to metres and PartNet-Mobility's axes.

A reader is chosen by the root element of the file: :data:`READERS`.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from fb3d_rl.assets.articulation import ArticulatedObject, Link
from fb3d_rl.assets.cache import Parsed
from fb3d_rl.assets.options import UNITS
from fb3d_rl.assets.partnet_mobility import LARGEST_TEXT, load_object, named_errors
from fb3d_rl.assets.urdf import UrdfReader
from fb3d_rl.errors import UserError
from fb3d_rl.importer.files import Source, root_of
from fb3d_rl.importer.frames import UNIT_NAMES, Frame, in_metres, upright
from fb3d_rl.importer.mjcf import MjcfReader
from fb3d_rl.importer.names import part_name
from fb3d_rl.kinematics.opening import LARGEST, openable_links
from fb3d_rl.kinematics.validation import Finding, Verdict, findings

MIXED = 100.0
"""Meshes so many times as large as the distances between joints are in other units than these."""

MILLI = 500.0
"""Meshes so many times as large are in millimetres, smaller ones in centimetres: links are as large as these distances
or a few times as large."""


class FileReader(UrdfReader):
    """Reads a URDF that stands alone: its links' names tell what they are.

    Args:
        source: the file.
        unit: metres in one unit of the mesh files.
    """

    def __init__(self, source: Source, unit: float = 1.0) -> None:
        super().__init__(source.path.parent, source.path, source.packages, unit)
        self.id = source.id

    @property
    def name(self) -> str:
        """The object's id: its folder may hold several."""
        return self.id

    def semantics(self) -> dict[str, str]:
        """Link name -> the last word in it that is a known name of a part."""
        names = {
            element.get("name", ""): part_name(element.get("name", "")) for element in self.parse().findall("link")
        }
        return {name: found for name, found in names.items() if found}


def read_urdf(source: Source) -> Parsed:
    """The links of a URDF, with its meshes in the unit of its joints.

    Raises:
        UserError: something is missing or broken.
    """
    links, dropped, lost = FileReader(source).read()
    size, distance = _extents(links)
    if size <= LARGEST or not 0.0 < MIXED * distance < size:
        return links, dropped, lost
    unit = "mm" if size > MILLI * distance else "cm"
    links, dropped, lost = FileReader(source, UNITS[unit]).read()
    return links, (*dropped, f"lengths: the meshes are taken as {UNIT_NAMES[unit]}, the joints as metres"), lost


def read_mjcf(source: Source) -> Parsed:
    """The links of an MJCF, or of one body in it.

    Raises:
        UserError: something is missing or broken, or the package mujoco is.
    """
    return MjcfReader(source).read()


READERS: dict[bytes, Callable[[Source], Parsed]] = {b"robot": read_urdf, b"mujoco": read_mjcf}
"""The reader of each kind of file, by the root element."""


def read_file(source: Source, frame: Frame | None = None, category: str | None = None) -> ArticulatedObject:
    """Read an object.

    A PartNet-Mobility object keeps its axes unless others are asked for.

    Args:
        source: the file.
        frame: the file's units and axes; recognised unless given.
        category: the object's category; that of its file (meta.json beside it, a folder's name) unless given.

    Raises:
        UserError: the object cannot be used; says why.
    """
    frame = frame or Frame()
    if source.partnet:
        obj = replace(load_object(source.path.parent), id=source.id)
    else:
        links, dropped, lost = _parsed(source)
        obj = ArticulatedObject(source.id, _category(source), source.path, links, dropped, lost)
    obj = replace(obj, category=category or obj.category)
    if not any(link.visuals for link in obj.links):
        raise UserError(f"object {obj.id}: no link has a shape, so there is nothing to see; add them to {source.path}")
    moved = in_metres(obj, frame.scale)
    if not (source.partnet and frame.front == "auto" and frame.up == "z"):
        moved = upright(moved, frame.up, frame.front)
    return moved if moved is obj else replace(moved, content="")


def _parsed(source: Source) -> Parsed:
    path = source.path
    with named_errors(source.id, path):
        if path.stat().st_size > LARGEST_TEXT:
            raise UserError(
                f"object {source.id}: {path} is larger than the {LARGEST_TEXT / 2**20:.0f} MiB that are read"
            )
        kind = root_of(path)
        if source.body is not None and kind != b"mujoco":
            raise UserError(
                f"object {source.id}: assets.body={source.body} names a body of an MJCF, which {path} is not"
            )
        return READERS.get(kind, read_urdf)(source)


def _category(source: Source) -> str:
    """The category in the meta.json beside the file, else that of the folders above."""
    try:
        meta = json.loads((source.path.parent / "meta.json").read_text(encoding="utf-8"))
        return str(meta["model_cat"])
    except (OSError, ValueError, LookupError, TypeError, RecursionError):
        return source.category


def _extents(links: Sequence[Link]) -> tuple[float, float]:
    """The diagonal (m) of the largest link, and the largest distance (m) that a joint has or makes."""
    size = max(
        (float(np.linalg.norm(np.ptp(mesh.vertices, axis=0))) for link in links for mesh in link.visuals), default=0.0
    )
    joints = [link.joint for link in links if link.joint is not None]
    distances = [float(np.linalg.norm(joint.origin[:3, 3])) for joint in joints]
    distances += [
        abs(end) for joint in joints if joint.type == "prismatic" for end in joint.limits if math.isfinite(end)
    ]
    return size, max(distances, default=0.0)


def examine_file(source: Source, frame: Frame | None = None, category: str | None = None) -> Verdict:
    """The verdict on an object's file; that it cannot be read is a flaw too."""
    try:
        obj = read_file(source, frame, category)
    except UserError as error:
        return Verdict(source.id, "", 0, (Finding(str(error), serious=True),))
    return Verdict(obj.id, obj.category, len(openable_links(obj)), tuple(findings(obj)))
