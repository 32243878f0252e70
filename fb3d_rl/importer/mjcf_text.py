"""The text of an MJCF as MuJoCo may compile it: one document, with its includes in it and its meshes in memory.

The files come from anyone. MuJoCo opens none of them: includes and meshes are found and read here, in the object's
folder and its packages only, sizes are bounded, and what is no part of the geometry (textures, sensors, plugins ...) is
left out or refused before.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn
from xml.etree.ElementTree import ParseError, tostring

from defusedxml import ElementTree

from fb3d_rl.assets.mesh_files import MeshFiles
from fb3d_rl.assets.partnet_mobility import LARGEST_OBJECT, LARGEST_TEXT
from fb3d_rl.assets.urdf import MOST_LINKS
from fb3d_rl.importer.files import COMMENT, SUFFIXES, Source

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

KEPT = frozenset(
    "compiler default asset mesh worldbody body geom joint freejoint inertial frame replicate equality".split()
)
"""The elements that say where the geometry is and how it moves; all others are left out."""

REFUSED = frozenset("extension plugin composite flexcomp flex attach model".split())
"""Elements that make geometry which cannot be read."""

FILES = frozenset(("material", "hfield", "texture"))
"""Attributes of kept elements that name what is left out."""

MESH = frozenset("name class file scale refpos refquat vertex face inertia maxhullvert builtin params".split())
"""The attributes of a mesh that its geometry depends on."""

MESHES = (".obj", ".stl", ".msh")

SETTLED = "assetdir meshdir texturedir strippath discardvisual fusestatic usethread".split()
"""Attributes of ``<compiler>`` that are dealt with here, or that would remove what is looked for."""

LENIENT = {"boundmass": "1e-3", "boundinertia": "1e-6", "balanceinertia": "true", "usethread": "false"}
"""What the compiler is told first: masses do not matter here. The file's own words come after it."""

NUMBERS = itertools.count()
"""Names of meshes, never the same twice: MuJoCo keeps the meshes that it has read, and gives one of the same name and
content again though it has another ``refpos``."""

DEEPEST = 90
MOST_ELEMENTS = 10_000


@dataclass
class Text:
    """A document for MuJoCo.

    Attributes:
        root: its ``<mujoco>``.
        assets: name -> content of the mesh files that it names.
        unit_named: whether it says in which unit its angles are.
    """

    root: Element
    assets: dict[str, bytes] = field(default_factory=dict)

    @property
    def unit_named(self) -> bool:
        return any(element.get("angle") for element in self.root.iter("compiler"))

    @property
    def largest_turn(self) -> float:
        """The largest number in its Euler angles and axis-angles."""
        words = [word for element in self.root.iter() for word in element.get("euler", "").split()]
        words += [word for element in self.root.iter() for word in element.get("axisangle", "").split()[3:]]
        try:
            return max((abs(float(word)) for word in words), default=0.0)
        except ValueError:  # MuJoCo reads other spellings, too
            return math.inf

    def xml(self, angle: str | None = None) -> str:
        """The document, with a unit of angles if it is given."""
        lenient = ElementTree.fromstring("<compiler/>")
        lenient.attrib.update(LENIENT if angle is None else {**LENIENT, "angle": angle})
        self.root.insert(0, lenient)
        text: str = tostring(self.root, encoding="unicode")
        self.root.remove(lenient)
        return text


class Composer:
    """Puts the document of one object together.

    Args:
        source: the file.
        fail: raises a UserError that says what is wrong.
        say: takes a remark.
        lose: takes a remark on geometry that is not read.
    """

    def __init__(
        self,
        source: Source,
        fail: Callable[[str], NoReturn],
        say: Callable[[str], None],
        lose: Callable[[str], None],
    ) -> None:
        self.source, self.fail, self.say, self.lose = source, fail, say, lose
        self.files = MeshFiles(source.path.parent, source.packages, fail, say)
        self.seen = {source.path.resolve()}
        self.bytes = self.mesh_bytes = 0

    def compose(self) -> Text:
        """The document.

        Raises:
            UserError: it is no MJCF that can be read, names files outside of its folders, or is too large.
            ParseError, DefusedXmlException: it is no well-formed XML or holds entities.
            OSError: a file cannot be read.
        """
        root = self._parse(self.source.path)
        if root.tag != "mujoco":
            self.fail(f"the file is no MJCF, since it holds a <{root.tag}> and no <mujoco>")
        self._expand(root, root.tag, self.source.path.parent, 0)
        self._bound(root, 1, [0, 0])
        return Text(root, self._meshes(root))

    def _parse(self, path: Path) -> Element:
        self.bytes += path.stat().st_size
        if self.bytes > LARGEST_TEXT:
            self.fail(f"the file and its includes are larger than the {LARGEST_TEXT / 2**20:.0f} MiB that are read")
        try:
            # MuJoCo allows comments that are no XML, such as <!-- ---- -->
            root: Element = ElementTree.fromstring(COMMENT.sub(b"", path.read_bytes()))
        except (LookupError, ValueError) as error:  # the XML declaration names an encoding that Python's parser lacks
            raise ParseError(str(error)) from error
        return root

    def _expand(self, element: Element, tag: str, folder: Path, depth: int) -> None:
        """Replace the includes below an element, a ``tag``, by what they mean, and take out what is not read."""
        if depth > DEEPEST:
            self.fail(f"its elements are nested more than {DEEPEST} deep")
        kept: list[Element] = []
        for child in element:
            if child.tag == "include":
                kept += self._included(child, tag, folder, depth)
            elif self._kept(tag, child):
                kept.append(child)
                self._expand(child, child.tag, folder, depth + 1)
        element[:] = kept

    def _included(self, include: Element, tag: str, folder: Path, depth: int) -> list[Element]:
        """What an include means, below an element ``tag``."""
        name = (include.get("file") or self.fail("an <include> has no attribute 'file'")).replace("\\", "/")
        # MuJoCo looks beside the main file first, then beside the file that includes.
        beside = not (self.source.path.parent / name).is_file() and (folder / name).is_file()
        path = self.files.find(str(folder / name) if beside else name, "include", SUFFIXES).resolve()
        if path in self.seen:
            self.fail(f"{name} is included twice")
        self.seen.add(path)
        root = self._parse(path)
        if root.tag == "robot":
            self.fail(f"it includes {name}, a URDF; read that file by itself")
        self._expand(root, tag, path.parent, depth + 1)
        return list(root)

    def _kept(self, parent: str, child: Element) -> bool:
        """Whether an element is read; if so its attributes are made plain."""
        tag = child.tag
        if tag in REFUSED:
            self.fail(f"it has a <{tag}>, whose geometry cannot be read; save the model without it")
        if parent == "equality" and tag != "joint":
            if self.source.body is None:  # else it may be one of a robot
                self.say(f"equality {child.get('name') or tag}: a <{tag}>, not read; its ends move by themselves")
            return False
        if tag == "geom" and "hfield" in (child.get("type"), *child.attrib):
            self.lose(f"geom {child.get('name') or child.get('hfield')}: a height field in place of a mesh")
            return False
        if tag == "deformable":
            self.lose("a <deformable>, which is no mesh")
        if tag not in KEPT or (parent == "asset" and tag != "mesh"):
            return False
        for key in FILES & set(child.attrib) if tag != "mesh" else set(child.attrib) - MESH:
            del child.attrib[key]
        return True

    def _bound(self, element: Element, times: int, counts: list[int]) -> None:
        """Refuse documents of too many elements; ``times`` is how often this one is replicated, ``counts`` goes on."""
        for child in element:
            number = times
            if child.tag == "replicate":
                text = child.get("count", "").strip()
                if not (text.isdecimal() and len(text) < 12):
                    self.fail(f"a <replicate> has count={text[:20]!r}")
                number *= int(text)
            counts[0] += number * (child.tag == "body")
            counts[1] += number
            if counts[0] >= MOST_LINKS or counts[1] > MOST_ELEMENTS:
                self.fail(f"it has more than the {MOST_LINKS - 1} bodies or {MOST_ELEMENTS} elements that are read")
            self._bound(child, number, counts)

    def _meshes(self, root: Element) -> dict[str, bytes]:
        """Read the mesh files; the meshes then have the names of these contents in place of paths."""
        told: dict[str, str] = {}
        for compiler in root.iter("compiler"):
            found = {key: compiler.attrib.pop(key) for key in SETTLED if key in compiler.attrib}
            told.update({"meshdir": found.get("assetdir", told.get("meshdir", "")), **found})
        assets: dict[str, bytes] = {}
        for asset in root.iter("asset"):
            for mesh in asset.iter("mesh"):
                if (name := mesh.get("file")) is None:
                    continue
                if told.get("strippath") == "true":
                    name = re.split(r"[/\\]", name)[-1]
                path = self.files.find(str(Path(told.get("meshdir", "")) / name), "mesh", MESHES)
                mesh.set("name", mesh.get("name") or Path(name.replace("\\", "/")).stem)
                key = f"{next(NUMBERS)}{path.suffix.lower()}"
                mesh.set("file", key)
                self.mesh_bytes += path.stat().st_size
                if self.mesh_bytes > LARGEST_OBJECT:
                    self.fail(f"its meshes have more than the {LARGEST_OBJECT / 2**20:.0f} MiB that are read")
                assets[key] = path.read_bytes()
        return assets
