"""Write an object as a PartNet-Mobility folder."""

from __future__ import annotations

import json
import shutil
import tempfile
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fb3d_rl.assets.articulation import ArticulatedObject, Joint, Mesh
from fb3d_rl.errors import UserError

KINDS = {"revolute": "hinge", "continuous": "hinge", "prismatic": "slider", "fixed": "static"}
"""PartNet-Mobility's word for each type of joint."""


def write_folder(obj: ArticulatedObject, out: Path, replaced: bool = False) -> Path:
    """Write an object as ``out/<id>``: mobility.urdf, semantics.txt, meta.json and a mesh file for each shape.

    The folder appears complete or not at all. Numbers are written with all their digits.

    Args:
        obj: the object.
        out: the folder of object folders; made if it is not there.
        replaced: whether a folder that is there already is replaced.

    Raises:
        UserError: the folder is there already.
    """
    folder = out / obj.id
    if folder.exists() and not replaced:
        raise UserError(f"{folder} exists already; choose another --out or remove it")
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".partial-", dir=out) as partial:
        made = Path(partial) / "object"
        (made / "textured_objs").mkdir(parents=True)
        _write(obj, made)
        if folder.exists():
            shutil.rmtree(folder)
        made.rename(folder)
    return folder


def _write(obj: ArticulatedObject, folder: Path) -> None:
    robot = ET.Element("robot", name=obj.id)
    names = _names(link.name for link in obj.links)
    written: dict[int, str] = {}
    semantics = []
    for link, name in zip(obj.links, names, strict=True):
        element = ET.SubElement(robot, "link", name=name)
        for tag, meshes in (("visual", link.visuals), ("collision", link.collisions)):
            for mesh in meshes:
                if id(mesh) not in written:
                    written[id(mesh)] = f"textured_objs/original-{len(written) + 1}.obj"
                    (folder / written[id(mesh)]).write_text(_obj(mesh), encoding="ascii", newline="\n")
                ET.SubElement(
                    ET.SubElement(ET.SubElement(element, tag), "geometry"), "mesh", filename=written[id(mesh)]
                )
        if link.semantic and link.joint is not None:
            semantics.append(f"{name} {KINDS[link.joint.type]} {'_'.join(link.semantic.split())}")
    for link, name in zip(obj.links, names, strict=True):
        if link.joint is not None:
            _write_joint(robot, link.joint, names[link.parent], name)
    ET.indent(robot, "\t")
    text = '<?xml version="1.0" encoding="utf-8"?>\n' + ET.tostring(robot, encoding="unicode") + "\n"
    meta = {"model_cat": obj.category, "source": obj.urdf.name, "remarks": obj.dropped}
    (folder / "mobility.urdf").write_text(text, encoding="utf-8", newline="\n")
    (folder / "semantics.txt").write_text("\n".join([*semantics, ""]), encoding="utf-8", newline="\n")
    (folder / "meta.json").write_text(json.dumps(meta, indent=1) + "\n", encoding="utf-8", newline="\n")


def _names(names: Iterable[str]) -> list[str]:
    """The names without spaces, which semantics.txt does not know; distinct."""
    found: list[str] = []
    for name in names:
        plain = "_".join(name.split()) or "link"
        while plain in found:
            plain += "_"
        found.append(plain)
    return found


def _write_joint(robot: ET.Element, joint: Joint, parent: str, child: str) -> None:
    element = ET.SubElement(robot, "joint", name=joint.name, type=joint.type)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Gimbal lock")  # one of its solutions is as good as another
        rpy = Rotation.from_matrix(joint.origin[:3, :3]).as_euler("xyz")
    ET.SubElement(element, "origin", xyz=_numbers(joint.origin[:3, 3]), rpy=_numbers(rpy))
    ET.SubElement(element, "parent", link=parent)
    ET.SubElement(element, "child", link=child)
    if not joint.movable:
        return
    ET.SubElement(element, "axis", xyz=_numbers(joint.axis))
    if joint.type != "continuous":
        ET.SubElement(element, "limit", lower=repr(float(joint.limits[0])), upper=repr(float(joint.limits[1])))
    if joint.mimic is not None:
        name, multiplier, offset = joint.mimic
        ET.SubElement(element, "mimic", joint=name, multiplier=repr(float(multiplier)), offset=repr(float(offset)))


def _numbers(values: NDArray[Any]) -> str:
    return " ".join(repr(float(value) + 0.0) for value in values)


def _obj(mesh: Mesh) -> str:
    lines = [f"v {_numbers(vertex)}" for vertex in mesh.vertices]
    return "\n".join([*lines, *("f {} {} {}".format(*(face + 1)) for face in mesh.faces), ""])
