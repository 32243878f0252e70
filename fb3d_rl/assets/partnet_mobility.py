"""Read PartNet-Mobility folders: ``mobility.urdf``, ``semantics.txt``, ``meta.json`` and ``textured_objs/*.obj``.

The objects come from anyone, so nothing in them is trusted: sizes are bounded, and every flaw ends in one clear
sentence (:class:`fb3d_rl.errors.UserError`).
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import ParseError

from defusedxml import DefusedXmlException
from rich.progress import track

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.assets.cache import cached, digest_of
from fb3d_rl.assets.folders import URDFS, find_urdf
from fb3d_rl.assets.mesh_files import MESHES
from fb3d_rl.assets.splits import CATEGORIES
from fb3d_rl.assets.urdf import UrdfReader
from fb3d_rl.errors import UserError

LARGEST_TEXT = 16 * 2**20
"""Most bytes of a URDF and of the files beside it."""

LARGEST_OBJECT = 2**30
"""Most bytes of an object's meshes together."""

REMARKS = 3
"""At most this many remarks on an object are shown in one line."""


class PartNetReader(UrdfReader):
    """Reads one object's URDF and the semantic names of its links beside it."""

    def semantics(self) -> dict[str, str]:
        """Link name -> semantic name, of lines such as ``link_0 hinge door``; a missing file names nothing."""
        path = self.folder / "semantics.txt"
        if not path.is_file():
            self.dropped.append("semantics.txt: missing")
            return {}
        lines = (line.split() for line in path.read_text(encoding="utf-8", errors="replace").splitlines())
        return {words[0]: words[2] for words in lines if len(words) >= 3}


def load_object(folder: str | Path) -> ArticulatedObject:
    """Read one object's folder.

    Meshes are given in their link's frame (the URDF's visual and collision origins applied), their faces turned where
    the scale mirrors. Meshes without area and shapes that are no meshes are left out and named in ``lost``.

    Raises:
        UserError: the folder, the URDF or a mesh is missing or broken; the message names it.
    """
    folder = Path(folder)
    urdf = _urdf_of(folder)
    with named_errors(folder.name, urdf):
        category = read_category(folder)
        content = digest_of(folder, _sources(folder, urdf))
        links, dropped, lost = cached(content, PartNetReader(folder, urdf).read)
        return ArticulatedObject(folder.name, category, urdf, links, dropped, lost, content)


@contextmanager
def named_errors(name: str, path: Path) -> Iterator[None]:
    """What is wrong with the file ``path``, or a file that it names, as a UserError that names the object."""
    try:
        yield
    except (ParseError, DefusedXmlException) as error:
        raise UserError(f"object {name}: {path} is no well-formed XML ({error}); restore the file") from error
    except OSError as error:
        raise UserError(f"object {name}: {error.filename} cannot be read ({error.strerror})") from error


def content_of(folder: Path) -> str:
    """The digest of what an object is read from (:attr:`~ArticulatedObject.content`), without reading its meshes.

    Raises:
        UserError: the folder holds no object, or one that is too large.
    """
    return digest_of(folder, _sources(folder, _urdf_of(folder)))


def _urdf_of(folder: Path) -> Path:
    urdf = find_urdf(folder)
    others = sorted(folder.glob("*.urdf"))
    if urdf is None and len(others) == 1:  # of another name
        return others[0]
    if urdf is None:
        raise UserError(
            f"object {folder.name}: {folder / URDFS[-1]} does not exist, so the folder is no PartNet-Mobility object"
        )
    return urdf


def load_usable(folder: str | Path) -> ArticulatedObject:
    """As :func:`load_object`, for an object that a camera has to see.

    Raises:
        UserError: as there, or no link has a mesh.
    """
    obj = load_object(folder)
    if not any(link.visuals for link in obj.links):
        why = f": {listed(obj.lost)}" if obj.lost else ""
        raise UserError(
            f"object {obj.id}: no link has a visual mesh, so there is nothing to see{why}; give its links meshes "
            f"({', '.join(MESHES)})"
        )
    return obj


def listed(remarks: Sequence[str]) -> str:
    """Some remarks in one line: the first ones, and how many more there are."""
    shown = "; ".join(remarks[:REMARKS])
    return shown + (f"; and {len(remarks) - REMARKS} more" if len(remarks) > REMARKS else "")


def read_category(folder: Path) -> str:
    """Category of an object: from its meta.json, else the name of the folder above, as in UMPNet's archive.

    Raises:
        UserError: meta.json is broken.
    """
    path = folder / "meta.json"
    if not path.is_file():
        return folder.parent.name if folder.parent.name in CATEGORIES else "unknown"
    _bound(folder, path)
    try:
        meta = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise UserError(f"object {folder.name}: {path} is no valid JSON ({error})") from error
    return str(meta.get("model_cat", "unknown")) if isinstance(meta, dict) else "unknown"


def _sources(folder: Path, urdf: Path) -> list[Path]:
    """The files that an object is read from; too large ones are refused."""
    texts = [path for path in (urdf, folder / "semantics.txt") if path.is_file()]
    _bound(folder, *texts)
    inside, text = folder.resolve(), urdf.read_bytes().lower()
    # PartNet's formats always; others lie beside many objects (pictures of points, for one) and do not belong to them.
    kinds = [suffix for suffix in MESHES if suffix in (".obj", ".stl") or suffix.encode() in text]
    meshes = sorted(
        path
        for path in folder.rglob("*")
        if path.suffix.lower() in (*kinds, *[".bin"] * (".gltf" in kinds))
        and path.is_file()
        # The reader refuses a link out of the folder; its target is not to be opened before.
        and (not path.is_symlink() or path.resolve().is_relative_to(inside))
    )
    size = sum(path.stat().st_size for path in meshes)
    if size > LARGEST_OBJECT:
        raise UserError(
            f"object {folder.name}: its meshes have {size / 2**20:.0f} MiB, more than the {LARGEST_OBJECT / 2**20:.0f} "
            "that are read; simplify them or remove the object"
        )
    return texts + meshes


def _bound(folder: Path, *texts: Path) -> None:
    for path in texts:
        if path.stat().st_size > LARGEST_TEXT:
            raise UserError(
                f"object {folder.name}: {path} is larger than the {LARGEST_TEXT / 2**20:.0f} MiB that are read; "
                "restore the file or remove the object"
            )


@dataclass(frozen=True)
class Skipped:
    """An object that could not be read, and the reason as a sentence."""

    id: str
    reason: str


def load_objects(folders: Collection[Path]) -> tuple[list[ArticulatedObject], list[Skipped]]:
    """Read objects; broken ones are skipped and named.

    Raises:
        UserError: not one object is left.
    """
    objects: list[ArticulatedObject] = []
    skipped: list[Skipped] = []
    for folder in track(folders, "objects", transient=True):
        try:
            objects.append(load_usable(folder))
        except UserError as error:
            skipped.append(Skipped(folder.name, str(error)))
    if not objects:
        first = f"; the first: {skipped[0].reason}" if skipped else ""
        raise UserError(f"no object can be used ({len(skipped)} are broken{first})")
    return objects, skipped
