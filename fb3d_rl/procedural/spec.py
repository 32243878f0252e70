"""What a procedural object is, and how it is written as a PartNet-Mobility folder."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt

from fb3d_rl.procedural.shapes import Piece, Vector

DECIMALS = 6
"""Written text is rounded to this, so that the last bits of a machine's sine do not change the bytes."""
ROOT_RPY = "1.570796326794897 0 -1.570796326794897"
"""PartNet-Mobility's root rotation: mesh frame (y up, front +z) to world frame (z up, front -x)."""


@dataclass(frozen=True)
class Part:
    """A movable part, joined to the body; joint position 0 is closed, `upper` is open.

    Attributes:
        name: PartNet's semantic name, such as "rotation_door".
        joint: "hinge" (revolute) or "slider" (prismatic).
        axis: Unit joint axis, mesh frame; positive motion opens.
        upper: Upper joint limit, rad or m.
        pieces: The part's meshes.
        origin: A point of the hinge's axis, m. A slider's link frame is the object's own, as in PartNet.
    """

    name: str
    joint: Literal["hinge", "slider"]
    axis: Vector
    upper: float
    pieces: tuple[Piece, ...]
    origin: Vector = (0.0, 0.0, 0.0)

    def moved(self, scale: float, shift: npt.NDArray[np.float64]) -> Part:
        """The part with its points at scale * point + shift, with shift [3] in metres."""
        pieces = tuple(piece.transformed(scale, shift) for piece in self.pieces)
        if self.joint == "slider":
            return replace(self, pieces=pieces, upper=scale * self.upper)
        x, y, z = (scale * np.asarray(self.origin) + shift).tolist()
        return replace(self, pieces=pieces, origin=(x, y, z))


@dataclass(frozen=True)
class ObjectSpec:
    """An articulated object: a fixed body and the parts that move on it.

    Attributes:
        category: PartNet-Mobility category.
        body_joint: PartNet's word for the body's joint: "heavy", "free" or "static".
        body_name: PartNet's semantic name of the body, such as "furniture_body".
        body: The body's meshes.
        parts: The movable parts.
    """

    category: str
    body_joint: Literal["heavy", "free", "static"]
    body_name: str
    body: tuple[Piece, ...]
    parts: tuple[Part, ...]

    def bounds(self) -> npt.NDArray[np.float64]:
        """Lower and upper corner [2, 3] of the closed object's bounding box, m, mesh frame."""
        pieces = [*self.body, *(piece for part in self.parts for piece in part.pieces)]
        points = np.concatenate([piece.vertices for piece in pieces])
        return np.stack([points.min(0), points.max(0)])

    def normalised(self, diagonal: float = 2.0) -> ObjectSpec:
        """The object with its bounding box's centre at 0 and this diagonal (m): PartNet's is 2."""
        low, high = self.bounds()
        scale = diagonal / float(np.linalg.norm(high - low))
        shift = -scale * (low + high) / 2
        body = tuple(piece.transformed(scale, shift) for piece in self.body)
        return replace(self, body=body, parts=tuple(part.moved(scale, shift) for part in self.parts))


def write_object(spec: ObjectSpec, folder: Path, object_id: str) -> None:
    """Write the object's files into the existing, empty folder."""
    (folder / "textured_objs").mkdir()
    robot = ET.Element("robot", name=f"partnet_{object_id}")
    ET.SubElement(robot, "link", name="base")
    semantics, mobility = [], []
    links = [*((part, part.pieces) for part in spec.parts), (None, spec.body)]
    number = 0
    for index, (part, pieces) in enumerate(links):
        link = ET.SubElement(robot, "link", name=f"link_{index}")
        origin = (0.0, 0.0, 0.0) if part is None else part.origin
        numbered = dict(enumerate(pieces, start=number + 1))
        number += len(pieces)
        for piece_id, piece in numbered.items():
            _write_mesh(piece, piece_id, origin, link, folder)
        _add_joint(robot, part, index, body=len(spec.parts))
        joint, name = (spec.body_joint, spec.body_name) if part is None else (part.joint, part.name)
        semantics.append(f"link_{index} {joint} {name}")
        mobility.append({
            "id": index,
            "parent": -1 if part is None else len(spec.parts),
            "joint": joint,
            "name": name,
            "parts": [{"id": piece_id, "name": piece.name, "children": []} for piece_id, piece in numbered.items()],
            "jointData": {} if part is None else _joint_data(part),
        })  # fmt: skip
    ET.indent(robot, "\t")
    low, high = spec.bounds()
    texts = {
        "mobility.urdf": '<?xml version="1.0" ?>\n' + ET.tostring(robot, encoding="unicode") + "\n",
        "semantics.txt": "\n".join(semantics) + "\n",
        "mobility_v2.json": json.dumps(mobility, separators=(",", ":")),
        "meta.json": json.dumps({"model_id": object_id, "anno_id": object_id, "model_cat": spec.category}),
        "bounding_box.json": json.dumps({"min": _rounded(low), "max": _rounded(high)}),
    }
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="ascii", newline="\n")


def _write_mesh(piece: Piece, number: int, origin: Vector, link: ET.Element, folder: Path) -> None:
    """Write a piece's file, and add it to the link, whose frame has its origin (m, mesh frame) there."""
    mesh = f"textured_objs/original-{number}.obj"
    (folder / mesh).write_text(_obj(piece), encoding="ascii", newline="\n")
    visual = ET.SubElement(link, "visual", name=f"{piece.name}-{number}")
    for element in (visual, ET.SubElement(link, "collision")):
        ET.SubElement(element, "origin", xyz=_vector(-value for value in origin))
        ET.SubElement(ET.SubElement(element, "geometry"), "mesh", filename=mesh)


def _add_joint(robot: ET.Element, part: Part | None, index: int, body: int) -> None:
    """Add the joint of link ``index``: between a part and link ``body``, or, without a part, of the body itself."""
    joint = ET.SubElement(robot, "joint", name=f"joint_{index}", type=_urdf_type(part))
    if part is None:
        ET.SubElement(joint, "origin", rpy=ROOT_RPY, xyz="0 0 0")
    else:
        ET.SubElement(joint, "origin", xyz=_vector(part.origin))
        ET.SubElement(joint, "axis", xyz=_vector(part.axis))
    ET.SubElement(joint, "child", link=f"link_{index}")
    ET.SubElement(joint, "parent", link="base" if part is None else f"link_{body}")
    if part is not None:
        ET.SubElement(joint, "limit", lower="0", upper=_number(part.upper))


def _joint_data(part: Part) -> dict[str, object]:
    """PartNet's own table of a joint, which gives hinges in degrees, sliders in metres."""
    upper = float(np.degrees(part.upper)) if part.joint == "hinge" else part.upper
    return {
        "axis": {"origin": _rounded(part.origin), "direction": _rounded(part.axis)},
        "limit": {"a": 0, "b": _rounded([upper])[0], "noLimit": False},
    }


def _urdf_type(part: Part | None) -> str:
    if part is None:
        return "fixed"
    return "revolute" if part.joint == "hinge" else "prismatic"


def _rounded(values: Iterable[float]) -> list[float]:
    return [round(float(value), DECIMALS) + 0.0 for value in values]  # + 0.0 turns -0.0 into 0.0


def _number(value: float) -> str:
    return f"{_rounded([value])[0]:.{DECIMALS}f}"


def _vector(values: Iterable[float]) -> str:
    return " ".join(_number(value) for value in values)


def _obj(piece: Piece) -> str:
    vertices = np.round(piece.vertices, DECIMALS) + 0.0
    lines = f"v %.{DECIMALS}f %.{DECIMALS}f %.{DECIMALS}f\n" * len(vertices) % tuple(vertices.ravel())
    return f"o {piece.name}\n" + lines + "f %d %d %d\n" * len(piece.faces) % tuple((piece.faces + 1).ravel())
