"""Read a URDF: links, joints, and the meshes of its visual and collision elements.

URDFs are read as people write them: what the format leaves open or what is often wrong gets a sensible value, and a
remark says so (docs/objects.md lists the rules). The files come from anyone, so nothing in them is trusted: XML
entities are refused, mesh paths may not leave the object's folder and its packages, sizes are bounded, and every flaw
ends in one clear sentence (:class:`fb3d_rl.errors.UserError`).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn
from xml.etree.ElementTree import ParseError

import numpy as np
import trimesh
from defusedxml import ElementTree
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fb3d_rl.assets.articulation import Joint, JointType, Link, Mesh, Mimic
from fb3d_rl.assets.cache import Parsed
from fb3d_rl.assets.mesh_files import MeshFiles
from fb3d_rl.assets.shapes import completed, each_once, solid
from fb3d_rl.assets.urdf_joints import FARTHEST, FASTENED, followed, limited
from fb3d_rl.errors import UserError

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

JOINT_TYPES: tuple[JointType, ...] = ("revolute", "continuous", "prismatic", "fixed")
MIMIC = (("multiplier", 1.0), ("offset", 0.0))
"""The attributes of a ``<mimic>`` with URDF's defaults."""

MOST_LINKS = 1000

DECOMPOSED = "mobility_cvx.urdf"
"""ManiSkill's URDF whose collision files hold several convex pieces each."""

PRIMITIVES = {
    "box": ("size",),
    "cylinder": ("radius", "length"),
    "sphere": ("radius",),
    "capsule": ("radius", "length"),
}
"""The shapes that need no file, with the attributes that give their size."""

XACRO = "http://www.ros.org/wiki/xacro", "http://ros.org/wiki/xacro", "http://wiki.ros.org/xacro"

CORNERS = 4
"""The least number of corners of a solid; a moving collision mesh with fewer collides as a thin plate."""


class UrdfReader:
    """Reads one URDF; keeps the meshes read so far, since visuals and collisions share them.

    Args:
        folder: the object's folder, named like the object; relative paths are of files in it.
        urdf: the file.
        packages: further folders that its meshes may be in.
        unit: metres in one unit of the mesh files, beside their scale.
    """

    def __init__(self, folder: Path, urdf: Path, packages: Sequence[Path] = (), unit: float = 1.0) -> None:
        self.folder = folder
        self.urdf = urdf
        self.unit = unit
        self.dropped: list[str] = []
        self.lost: list[str] = []
        self.files = MeshFiles(folder, packages, self.fail, self.dropped.append)
        self.placed: dict[tuple[str, bytes, bytes, bool], Mesh] = {}

    def parse(self) -> Element:
        """The ``<robot>``, its tags without namespaces.

        Raises:
            UserError: it is no URDF, or one whose macros were not expanded.
            ParseError, DefusedXmlException: it is no well-formed XML or holds entities.
        """
        text = self.urdf.read_bytes()
        try:
            robot: Element = ElementTree.fromstring(text)
        except (LookupError, ValueError) as error:  # the XML declaration names an encoding that Python's parser lacks
            raise ParseError(str(error)) from error
        except ParseError:
            if b"<xacro:" in text:
                self.fail_as_xacro("<xacro:...>")
            raise
        for element in robot.iter():
            space, brace, tag = element.tag.rpartition("}")
            if space[1:] in XACRO:
                self.fail_as_xacro(f"<xacro:{tag}>")
            element.tag = tag
            for value in element.attrib.values():
                if "${" in value or "$(" in value:
                    self.fail_as_xacro(value)
        if robot.tag != "robot":
            self.fail(f"the file is no URDF, since it holds a <{robot.tag}> and no <robot>")
        return robot

    def fail_as_xacro(self, what: str) -> NoReturn:
        raise UserError(
            f"object {self.name}: {self.urdf} holds what xacro is to expand ({what}); run "
            f"`xacro {self.urdf.name} > expanded.urdf` and read that file"
        )

    @property
    def name(self) -> str:
        """What messages call the object."""
        return self.folder.name

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
        joints = followed(joints, self.fail, self.dropped.append)
        semantics = self.semantics()
        links: dict[str, Link] = {}
        for name in self.parents_first(self.joined(elements, joints), joints):
            carried = joints.get(name)
            visuals, collisions = self.surfaces(elements[name])
            links[name] = Link(
                name=name,
                semantic=semantics.get(name, ""),
                parent=-1 if carried is None else list(links).index(carried[0]),
                joint=None if carried is None else carried[1],
                visuals=visuals,
                collisions=collisions,
            )
        found = limited(list(links.values()), self.dropped.append)
        lost = tuple(dict.fromkeys(self.lost))
        return found, (*lost, *dict.fromkeys(self.dropped)), lost

    def joined(self, links: dict[str, Element], joints: dict[str, tuple[str, Joint]]) -> list[str]:
        """The names of the links, without those that hold nothing and that no joint joins, such as a "world"."""
        ends = {*joints, *(parent for parent, _ in joints.values())}
        alone = [name for name, link in links.items() if name not in ends and link.find("visual") is None
                 and link.find("collision") is None]  # fmt: skip
        if not ends or not alone:
            return list(links)
        self.dropped.append(f"link {', '.join(alone)}: empty and joined to nothing, left out")
        return [name for name in links if name not in alone]

    def fail(self, what: str) -> NoReturn:
        raise UserError(f"object {self.name}: {what}; correct or remove {self.urdf}")

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
        """Parent, child and joint, whose limits are those of the file: infinite where it has none."""
        name, kind = self.attribute(element, "name"), self.attribute(element, "type")
        if kind in FASTENED:
            self.dropped.append(f"joint {name}: {kind}, read as fixed")
            kind = "fixed"
        if kind not in JOINT_TYPES:
            self.fail(f"joint {name} has the type {kind!r}, not one of {', '.join((*JOINT_TYPES, *FASTENED))}")
        ends = [element.find(end) for end in ("parent", "child")]
        if ends[0] is None or ends[1] is None:
            self.fail(f"joint {name} lacks its parent or child")
        parent, child = (self.attribute(end, "link") for end in ends if end is not None)
        axis, limits, mimic = np.zeros(3), (0.0, 0.0), None
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
            mimic = self.mimic(element)
        joint_type: JointType = kind
        return parent, child, Joint(name, joint_type, self.origin(element), axis, limits, mimic)

    def limits(self, element: Element, name: str) -> tuple[float, float]:
        """The limits of a revolute or prismatic joint; infinite if both are missing."""
        limit = element.find("limit")
        ends = {} if limit is None else {end: limit.get(end) for end in ("lower", "upper")}
        if not any(ends.values()):
            return (-math.inf, math.inf)
        try:
            lower, upper = (float(end or 0.0) for end in ends.values())  # URDF's default
        except ValueError:
            lower, upper = math.nan, math.nan
        if math.isnan(lower) or math.isnan(upper):
            self.fail(f"joint {name} has limits that are no numbers")
        return (lower, upper)

    def mimic(self, element: Element) -> Mimic | None:
        """The joint that a joint follows."""
        mimic = element.find("mimic")
        if mimic is None:
            return None
        multiplier, offset = (self.numbers(mimic.get(key), 1, value)[0] for key, value in MIMIC)
        return Mimic(self.attribute(mimic, "joint"), float(multiplier), float(offset))

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

    def surfaces(self, link: Element) -> tuple[tuple[Mesh, ...], tuple[Mesh, ...]]:
        """The meshes of a link that are seen and those that are touched; where it lacks one kind, the other's."""
        visuals, collisions = self.shapes(link, "visual"), self.shapes(link, "collision")
        return completed(str(link.get("name")), visuals, collisions, self.dropped.append)

    def shapes(self, link: Element, tag: str) -> tuple[Mesh, ...]:
        """The meshes of a link's ``<visual>`` or ``<collision>`` elements; shapes of unknown kinds are lost."""
        meshes: list[Mesh] = []
        others: Counter[str] = Counter()
        for element in link.findall(tag):
            shapes = element.findall("geometry/*")
            others["no shape"] += not shapes
            for shape in shapes:
                if shape.tag in PRIMITIVES:
                    meshes.append(self.primitive(shape, self.origin(element)))
                elif shape.tag == "mesh":
                    meshes += self.meshes(shape, self.origin(element), tag)
                else:
                    others[f"<{shape.tag}>"] += 1
        self.lost += [
            f"{count} {tag}{'s' * (count > 1)} of {link.get('name')}: {shape} in place of a mesh"
            for shape, count in (+others).items()
        ]
        return tuple(meshes)

    def primitive(self, shape: Element, transform: NDArray[np.float64]) -> Mesh:
        """The mesh of a box, cylinder, sphere or capsule, all centred, the axis along z; moved by a transform."""
        size = np.concatenate(
            [self.numbers(self.attribute(shape, key), 3 if key == "size" else 1, 0.0) for key in PRIMITIVES[shape.tag]]
        )
        if not (size > 0).all() or size.max() > FARTHEST:
            self.fail(f"a <{shape.tag}> has the size {' '.join(f'{value:g}' for value in size)}")
        return solid(shape.tag, size, transform)

    def meshes(self, mesh: Element, transform: NDArray[np.float64], tag: str) -> list[Mesh]:
        """The meshes of a ``<mesh>``: none if it has no surface, several of a decomposed part."""
        filename = self.attribute(mesh, "filename")
        placed = self.place(filename, self.scale(mesh, filename), transform, tag == "visual")
        if tag == "collision" and self.urdf.name == DECOMPOSED:
            return self.pieces(placed, filename)
        if len(placed.faces) and tag == "collision":
            self.remark_corners(placed, filename)
        return [placed] if len(placed.faces) else []

    def scale(self, mesh: Element, filename: str) -> NDArray[np.float64]:
        """The scale of a mesh along its three axes; one number is for all of them."""
        text = mesh.get("scale")
        scale = self.numbers(text, 1 if text is not None and len(text.split()) == 1 else 3, 1.0)
        if not scale.all():
            self.fail(f'the mesh {filename} has scale="{text}", which leaves no solid; give three factors other than 0')
        return self.unit * np.broadcast_to(scale, 3)

    def place(self, filename: str, scale: NDArray[np.float64], transform: NDArray[np.float64], seen: bool) -> Mesh:
        """A file's mesh, scaled and moved by ``transform`` [4, 4]; the same for the same arguments.

        ``seen``: cameras alone use it, so repeated points and triangles are removed. Collision meshes are left as they
        are, since the simulator computes hulls from them.
        """
        key = (filename, scale.tobytes(), transform.tobytes(), seen)
        if key not in self.placed:
            vertices, faces = self.files.surface(filename)
            with np.errstate(over="ignore", invalid="ignore"):
                corners = (vertices * scale)[faces]
                sides = corners[:, 1:] - corners[:, :1]
                if not np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=-1).sum() > 0:
                    self.lost.append(f"{filename}: no surface")
                    faces = faces[:0]
                if seen and len(faces):
                    vertices, faces = each_once(vertices, faces)
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

    def semantics(self) -> dict[str, str]:
        """Link name -> semantic name; a URDF alone names nothing."""
        return {}
