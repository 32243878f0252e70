"""Find and read the mesh files that a description of an object names.

The names come from anyone: whatever they look like, no file outside the object's folder and its packages is opened,
and every flaw ends in one clear sentence.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NoReturn
from urllib.parse import unquote

import numpy as np
import trimesh
from numpy.typing import NDArray

from fb3d_rl.interrupt import Deferred

MESHES = (".obj", ".stl", ".dae", ".ply", ".off", ".glb", ".gltf")

PACKAGES = {".dae": "pycollada"}
"""The package that trimesh needs to read a format."""

EXTRA = "meshes"
"""The extra of this package that installs them."""

SCHEME = re.compile(r"(\w+)://(.*)", re.DOTALL)

Surface = tuple[NDArray[np.float64], NDArray[np.int64]]
"""Vertices [V, 3] and faces [F, 3]."""


class MeshFiles:
    """Reads the meshes of one object; each file once.

    Args:
        folder: the object's folder, to which relative paths belong.
        packages: further folders whose files may be read: package://NAME means the one of this name.
        fail: raises a UserError that says what is wrong.
        say: takes a remark.
    """

    def __init__(
        self, folder: Path, packages: Sequence[Path], fail: Callable[[str], NoReturn], say: Callable[[str], None]
    ) -> None:
        self.folder = folder
        self.roots = [folder.resolve(), *(package.resolve() for package in packages)]
        self.fail, self.say = fail, say
        self.read: dict[Path, Surface] = {}

    def surface(self, filename: str) -> Surface:
        """The surface that a file describes, in metres where the file says its unit.

        Raises:
            UserError: the name leads out of the object's folders or to no mesh, or the file is broken.
        """
        path = self.find(filename)
        if path not in self.read:
            self.read[path] = self._load(path, filename)
        return self.read[path]

    def find(self, filename: str, what: str = "mesh", kinds: Sequence[str] = MESHES) -> Path:
        """The file that a name means: a path, or an address such as package://NAME/PATH or file:///PATH.

        Args:
            filename: the name.
            what: what messages call the file.
            kinds: the suffixes that it may have.

        Raises:
            UserError: as in :meth:`surface`.
        """
        left = False
        found: Path | None = None
        try:
            for place in self._places(filename.strip()):
                path = place.resolve()
                if not any(path.is_relative_to(root) for root in self.roots):
                    left = True
                elif path.is_file():
                    found = path
                    break
        except (OSError, ValueError, RuntimeError) as error:  # a name that no file can have, or links in a circle
            self.fail(f"the {what} path {filename!r} cannot be followed ({error})")
        if found is None and left:
            self.fail(
                f"the {what} path {filename!r} leaves the object's folder {self.folder}; copy the file into it, or "
                "name the package's folder: assets.packages=[DIR]"
            )
        if (found or Path(filename)).suffix.lower() not in kinds:
            self.fail(f"the {what} {filename} is no {', '.join(kinds[:-1])} or {kinds[-1]} file")
        if found is None:
            hint = "; a package of another folder is to be named: assets.packages=[DIR]" if "://" in filename else ""
            self.fail(f"the {what} {filename} is missing in {self.folder}{hint}")
        return found

    def _places(self, name: str) -> Iterator[Path]:
        """Where a file of this name may lie, the likeliest place first."""
        scheme, rest = match.groups() if (match := SCHEME.match(name)) else ("", name)
        spellings = list(dict.fromkeys([rest, unquote(rest), unquote(rest).replace("\\", "/")]))
        if scheme in ("", "file"):
            yield from (self.folder / text.removeprefix("localhost") for text in spellings)
            return
        if scheme not in ("package", "model"):
            self.fail(f"{name} is no file of this machine; download it into the object's folder")
        split = [text.partition("/")[::2] for text in spellings]
        for package, path in split:
            yield from (root / path.lstrip("/") for root in self.roots if root.name == package)
            yield from (root / package / path.lstrip("/") for root in self.roots)
        for package, path in split:
            for root in self.roots:
                if (root / path.lstrip("/")).is_file():
                    self.say(f"package://{package}: taken to be the folder {root.name}")
                yield root / path.lstrip("/")

    def _load(self, path: Path, filename: str) -> Surface:
        kind = path.suffix.lower()
        if kind[1:] not in trimesh.available_formats():
            self.fail(
                f"the mesh {filename} can be read with the package {PACKAGES.get(kind, 'trimesh[easy]')} only: "
                f"pip install 'fb3d_rl[{EXTRA}]'"
            )
        if kind == ".dae":
            self._plain(path, filename)
        try:
            # trimesh catches every exception in some places, an interruption too
            with Deferred(), path.open("rb") as stream:
                loaded = trimesh.load_mesh(
                    stream, kind[1:], resolver=Within(path.parent, self.roots), process=False, skip_materials=True
                )
            unit = trimesh.units.unit_conversion(loaded.units, "meters") if kind == ".dae" and loaded.units else 1.0
            vertices = np.asarray(loaded.vertices, dtype=np.float64).reshape(-1, 3) * unit
            faces = np.asarray(loaded.faces, dtype=np.int64).reshape(-1, 3)
        except OSError:
            raise
        except Exception as error:  # noqa: BLE001 - the parsers of seven formats raise what they like
            self.fail(f"the mesh {filename} is broken ({' '.join(str(error).split()) or type(error).__name__})")
        if len(faces) and (faces.min() < 0 or faces.max() >= len(vertices) or not np.isfinite(vertices).all()):
            self.fail(f"the mesh {filename} has vertices that are missing or no numbers")
        return vertices, faces

    def _plain(self, path: Path, filename: str) -> None:
        """Refuse XML that declares entities, which may read other files or grow without bound, and archives."""
        content = path.read_bytes()
        if (
            b"<!DOCTYPE" in content
            or b"<!ENTITY" in content
            or not content.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"<")
        ):
            self.fail(f"the mesh {filename} is no plain XML in UTF-8 without entities; save it anew")


class Within(trimesh.resolvers.Resolver):
    """Gives trimesh the buffers beside a mesh, from folders that may be read only.

    Args:
        folder: the mesh's folder.
        roots: the folders, resolved.
    """

    def __init__(self, folder: Path, roots: Sequence[Path]) -> None:
        self.folder, self.roots = folder, roots

    def get(self, key: str) -> bytes:
        path = (self.folder / unquote(key)).resolve()
        if not any(path.is_relative_to(root) for root in self.roots):
            raise ValueError(f"{key} leaves the object's folder")
        if not path.is_file():
            raise ValueError(f"{key} is missing")
        return path.read_bytes()

    def write(self, name: str, data: object) -> None:
        raise NotImplementedError

    def namespaced(self, namespace: str) -> Within:
        return Within(self.folder / namespace, self.roots)

    def keys(self) -> list[str]:
        return []
