"""Read a URDF: links, joints, and the meshes of its visual and collision elements.

The files come from anyone, so nothing in them is trusted: XML entities are refused, mesh paths may not leave the
object's folder, sizes are bounded, and every flaw ends in one clear sentence (:class:`fb3d_rl.errors.UserError`).
"""

from __future__ import annotations

import math
import struct
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn
from xml.etree.ElementTree import ParseError

import numpy as np
import trimesh
from defusedxml import ElementTree
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fb3d_rl.assets.articulation import Joint, JointType, Link, Mesh
from fb3d_rl.assets.cache import Parsed
from fb3d_rl.errors import UserError
from fb3d_rl.interrupt import Deferred

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

JOINT_TYPES: tuple[JointType, ...] = ("revolute", "continuous", "prismatic", "fixed")
MESHES = (".obj", ".stl")

MOST_LINKS = 1000

DECOMPOSED = "mobility_cvx.urdf"
"""ManiSkill's URDF whose collision files hold several convex pieces each."""

BROKEN = (ValueError, LookupError, AttributeError, TypeError, ArithmeticError, MemoryError, struct.error)
"""What the parsers of meshes raise for files that are no meshes."""

FARTHEST = 1e4
"""Largest coordinate (m) that is accepted; a joint limit (m or rad) beyond it counts as infinite."""

CORNERS = 4
"""The least number of corners of a solid; a moving collision mesh with fewer collides as a thin plate."""


class UrdfReader:
    """Reads one URDF; keeps the meshes read so far, since visuals and collisions share them.

    Args:
        folder: the object's folder, named like the object; its meshes must be inside of it.
        urdf: the file.
    """

    def __init__(self, folder: Path, urdf: Path) -> None:
        self.folder = folder
        self.urdf = urdf
        self.files: dict[Path, tuple[NDArray[np.float64], NDArray[np.int64]]] = {}
        self.placed: dict[tuple[str, bytes, bytes, bool], Mesh] = {}
        self.dropped: list[str] = []
        self.lost: list[str] = []

    def parse(self) -> Element:
        try:
            return ElementTree.fromstring(self.urdf.read_bytes())
        except (LookupError, ValueError) as error:  # the XML declaration names an encoding that Python's parser lacks
            raise ParseError(str(error)) from error

    def read(self) -> Parsed:
        """The links, parents first, and the remarks on what was read.

        Raises:
            UserError: something is missing or broken.
            ParseError, DefusedXmlException: the URDF is no well-formed XML or holds entities.
        """
        robot = self.parse()
        elements: dict[str, Element] = {}
        for element in robot.findall("link"):
            name = self.attribute(element, "name")
            if name in elements:
                self.fail(f"two links are called {name!r}")
            elements[name] = element
        if len(elements) > MOST_LINKS:
            self.fail(f"{len(elements)} links are more than the {MOST_LINKS} that are read")
        joints: dict[str, tuple[str, Joint]] = {}
        for element in robot.findall("joint"):
            parent, child, joint = self.joint(element)
            if parent not in elements or child not in elements:
                self.fail(f"joint {joint.name} joins {parent!r} and {child!r}, but one of them is no link")
            if child in joints:
                self.fail(f"link {child!r} is the child of two joints")
            joints[child] = (parent, joint)
        semantics = self.semantics()
        links: list[Link] = []
        for name in self.parents_first(elements, joints):
            carried = joints.get(name)
            links.append(
                Link(
                    name=name,
                    semantic=semantics.get(name, ""),
                    parent=-1 if carried is None else [link.name for link in links].index(carried[0]),
                    joint=None if carried is None else carried[1],
                    visuals=self.shapes(elements[name], "visual"),
                    collisions=self.shapes(elements[name], "collision"),
                )
            )
        lost = tuple(dict.fromkeys(self.lost))
        return tuple(links), (*lost, *dict.fromkeys(self.dropped)), lost

    def fail(self, what: str) -> NoReturn:
        raise UserError(f"object {self.folder.name}: {what}; correct or remove {self.urdf}")

    def attribute(self, element: Element, name: str) -> str:
        value = element.get(name)
        if value is None:
            self.fail(f"a <{element.tag}> has no attribute {name!r}")
        return value

    def numbers(self, text: str | None, count: int, default: float) -> NDArray[np.float64]:
        """Parse ``count`` finite numbers from an attribute; a missing attribute is ``default`` repeated."""
        if text is None:
            return np.full(count, default)
        try:
            values = np.array([float(word) for word in text.split()])
        except ValueError:
            values = np.array([math.nan])
        if values.shape != (count,) or not np.isfinite(values).all():
            self.fail(f"{text!r} is not a list of {count} finite numbers")
        return values

    def origin(self, element: Element) -> NDArray[np.float64]:
        """T_parent_child [4, 4] of an ``<origin xyz rpy>``; URDF's rpy turns about the fixed x, y, z axes."""
        transform = np.eye(4)
        origin = element.find("origin")
        if origin is not None:
            transform[:3, 3] = self.numbers(origin.get("xyz"), 3, 0.0)
            transform[:3, :3] = Rotation.from_euler("xyz", self.numbers(origin.get("rpy"), 3, 0.0)).as_matrix()
            if abs(transform).max() > FARTHEST:
                self.fail(f"an origin lies {abs(transform).max():.3g} m away")
        return transform

    def joint(self, element: Element) -> tuple[str, str, Joint]:
        name, kind = self.attribute(element, "name"), self.attribute(element, "type")
        if kind not in JOINT_TYPES:
            self.fail(f"joint {name} has the type {kind!r}, not one of {', '.join(JOINT_TYPES)}")
        ends = [element.find(end) for end in ("parent", "child")]
        if ends[0] is None or ends[1] is None:
            self.fail(f"joint {name} lacks its parent or child")
        parent, child = (self.attribute(end, "link") for end in ends if end is not None)
        axis, limits = np.zeros(3), (0.0, 0.0)
        if kind != "fixed":
            axis_element = element.find("axis")
            axis = self.numbers(None if axis_element is None else axis_element.get("xyz"), 3, 0.0)
            if axis_element is None:
                axis[0] = 1.0  # URDF's default
            length = float(np.linalg.norm(axis))
            if not 1e-9 <= length < math.inf:
                self.fail(f"joint {name} has an axis of length {length:.3g}")
            axis = axis / length
            limits = (-math.inf, math.inf) if kind == "continuous" else self.limits(element, name)
        joint_type: JointType = kind
        return parent, child, Joint(name, joint_type, self.origin(element), axis, limits)

    def limits(self, element: Element, name: str) -> tuple[float, float]:
        """Limits of a revolute or prismatic joint; missing or infinite ones stay infinite: nothing to open."""
        limit = element.find("limit")
        if limit is None:
            self.dropped.append(f"limits of joint {name}: missing")
            return (-math.inf, math.inf)
        try:
            lower, upper = float(limit.get("lower", "0")), float(limit.get("upper", "0"))
        except ValueError:
            lower, upper = math.nan, math.nan
        if math.isnan(lower) or math.isnan(upper):
            self.fail(f"joint {name} has limits that are no numbers")
        if lower > upper:
            self.dropped.append(f"limits of joint {name}: lower above upper, swapped")
            lower, upper = upper, lower
        if max(abs(lower), abs(upper)) > FARTHEST:
            return (-math.inf, math.inf)
        return (lower, upper)

    def parents_first(self, links: Iterable[str], joints: dict[str, tuple[str, Joint]]) -> list[str]:
        """Order the links so that each comes after its parent; refuse loops and several roots."""
        names = list(links)
        roots = [name for name in names if name not in joints]
        if len(roots) != 1:
            self.fail(f"the joint tree has {len(roots)} roots where one is needed")
        children: dict[str, list[str]] = {name: [] for name in names}
        for child, (parent, _) in joints.items():
            children[parent].append(child)
        order = list(roots)
        for name in order:
            order.extend(children[name])
        if len(order) != len(names):
            self.fail("the joint tree has a loop")
        return order

    def shapes(self, link: Element, tag: str) -> tuple[Mesh, ...]:
        """The meshes of a link's ``<visual>`` or ``<collision>`` elements; all other shapes are lost."""
        meshes: list[Mesh] = []
        others: Counter[str] = Counter()
        for element in link.findall(tag):
            mesh = element.find("geometry/mesh")
            shapes = [shape for shape in element.iterfind("geometry/*") if shape is not mesh]
            others.update(f"<{shape.tag}>" for shape in shapes)
            if mesh is None:
                others["no shape"] += not shapes
                continue
            filename = self.attribute(mesh, "filename")
            placed = self.place(
                filename, self.numbers(mesh.get("scale"), 3, 1.0), self.origin(element), tag == "visual"
            )
            if tag == "collision" and self.urdf.name == DECOMPOSED:
                meshes += self.pieces(placed, filename)
            elif len(placed.faces):
                meshes.append(placed)
                if tag == "collision":
                    self.remark_corners(placed, filename)
        self.lost += [
            f"{count} {tag}{'s' * (count > 1)} of {link.get('name')}: {shape} in place of a mesh"
            for shape, count in (+others).items()
        ]
        return tuple(meshes)

    def place(self, filename: str, scale: NDArray[np.float64], transform: NDArray[np.float64], seen: bool) -> Mesh:
        """A file's mesh, scaled and moved by ``transform`` [4, 4]; the same for the same arguments.

        ``seen``: cameras alone use it, so repeated points and triangles are removed. Collision meshes are left as they
        are, since the simulator computes hulls from them.
        """
        key = (filename, scale.tobytes(), transform.tobytes(), seen)
        if key not in self.placed:
            vertices, faces = self.mesh(filename)
            with np.errstate(over="ignore", invalid="ignore"):
                corners = (vertices * scale)[faces]
                sides = corners[:, 1:] - corners[:, :1]
                if not np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=-1).sum() > 0:
                    self.lost.append(f"{filename}: no surface")
                    faces = faces[:0]
                if seen and len(faces):
                    vertices, faces = _each_once(vertices, faces)
                moved = (vertices * scale) @ transform[:3, :3].T + transform[:3, 3]
            if len(faces) and not abs(moved).max() <= FARTHEST:
                self.fail(f"the mesh {filename} reaches {abs(moved).max():.3g} m from its link")
            # Mirroring turns the outside of a surface inside.
            self.placed[key] = Mesh(moved, faces[:, ::-1] if np.prod(np.sign(scale)) < 0 else faces)
        return self.placed[key]

    def pieces(self, whole: Mesh, filename: str) -> list[Mesh]:
        """The convex pieces of a link that were written as one file."""
        bodies = trimesh.Trimesh(whole.vertices, whole.faces).split(only_watertight=False)
        meshes = [Mesh(np.asarray(body.vertices), np.asarray(body.faces)) for body in bodies]
        for mesh in meshes:
            self.remark_corners(mesh, filename)
        return meshes

    def remark_corners(self, mesh: Mesh, filename: str) -> None:
        if len(np.unique(mesh.vertices[np.unique(mesh.faces)].astype(np.float32), axis=0)) < CORNERS:
            self.dropped.append(
                f"{filename}: fewer than {CORNERS} distinct vertices; where it moves, it collides as a thin plate"
            )

    def mesh(self, filename: str) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        path = (self.folder / filename).resolve()
        if path in self.files:
            return self.files[path]
        if not path.is_relative_to(self.folder.resolve()):
            self.fail(f"the mesh path {filename!r} leaves the object's folder")
        if path.suffix.lower() not in MESHES:
            self.fail(f"the mesh {filename} is no {' or '.join(MESHES)} file")
        if not path.is_file():
            self.fail(f"the mesh {filename} is missing")
        try:
            with Deferred():  # trimesh catches every exception while it looks for the file
                loaded = trimesh.load_mesh(path, process=False, skip_materials=True)
            vertices = np.asarray(loaded.vertices, dtype=np.float64).reshape(-1, 3)
            faces = np.asarray(loaded.faces, dtype=np.int64).reshape(-1, 3)
        except BROKEN as error:
            raise UserError(f"object {self.folder.name}: the mesh {filename} is broken ({error})") from error
        if len(faces) and (faces.min() < 0 or faces.max() >= len(vertices) or not np.isfinite(vertices).all()):
            self.fail(f"the mesh {filename} has vertices that are missing or no numbers")
        self.files[path] = (vertices, faces)
        return self.files[path]

    def semantics(self) -> dict[str, str]:
        """Link name -> semantic name; a URDF alone names nothing."""
        return {}


def _each_once(
    vertices: NDArray[np.float64], faces: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """The same surface without repeats.

    PartNet's files hold a point for each corner and triangles for each side; a fifth of the points and half of the
    triangles are left.
    """
    first, number = trimesh.grouping.unique_rows(vertices, keep_order=True)
    faces = number[faces]
    return vertices[first], faces[np.sort(trimesh.grouping.unique_rows(np.sort(faces, axis=1))[0])]
