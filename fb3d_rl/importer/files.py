"""Find the files that describe objects, whatever they are called and however they are laid out."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from fb3d_rl.assets.folders import URDFS, find_urdf
from fb3d_rl.assets.partnet_mobility import LARGEST_TEXT
from fb3d_rl.assets.splits import CATEGORIES
from fb3d_rl.errors import UserError

SUFFIXES = (".urdf", ".xml", ".mjcf")
"""Of the files that are looked at in a folder; a file that is named by itself may have any."""

HEAD = 8192
"""In so many bytes the root element of a description has to begin."""

LAYOUT = ("urdf", "urdfs", "robots", "model", "models", "xml", "mjcf")
"""Folders of a package (as in ROS) beside which its meshes lie; the package is the folder above."""

KINDS = (b"robot", b"mujoco")
"""Root elements of files that describe an object."""

COMMENT = re.compile(rb"<!--.*?(?:-->|\Z)", re.DOTALL)

INCLUDE = re.compile(rb"<include\s+file\s*=\s*[\"']([^\"']+)[\"']")

DEPTH = 6
"""How many levels below a root files are searched for."""


@dataclass(frozen=True)
class Source:
    """A file that describes an object.

    Attributes:
        path: the file.
        id: the object's id: the file's name without its suffix, or the folder's for a PartNet-Mobility object.
        category: of UMPNet's 21, the one after which a folder above the file is named; else "unknown".
        packages: folders besides the file's own that its meshes may be in.
        body: the body that is taken, with those that it carries, of an MJCF; None for all of them.
    """

    path: Path
    id: str
    category: str
    packages: tuple[Path, ...] = ()
    body: str | None = None

    @property
    def partnet(self) -> bool:
        """Whether it is a PartNet-Mobility object."""
        return self.path.name in URDFS


def find_files(
    roots: str | Path | Sequence[str | Path], packages: Sequence[str | Path] = (), body: str | None = None
) -> list[Source]:
    """The objects in files: each of ``roots`` is a file, or a folder in which they are looked for.

    Args:
        roots: a path, or several.
        packages: folders in which ``package://NAME/...`` is looked for.
        body: the body that is taken of each.

    Raises:
        UserError: a path does not exist, or no description is found.
    """
    named = [Path(root).expanduser() for root in ([roots] if isinstance(roots, (str, Path)) else roots)]
    further = tuple(Path(package).expanduser() for package in packages)
    for folder in further:
        if not folder.is_dir():
            raise UserError(f"assets.packages: {folder} is no folder; give the folder of a package")
    found: dict[Path, Source] = {}
    for root in named:
        if not root.exists():
            raise UserError(f"{root} does not exist; give the file of an object or a folder of such files")
        for path in [root] if root.is_file() else _whole(list(_descriptions(root, DEPTH))):
            folders = path.resolve().parents if root.is_dir() else ()
            inside = [folder for folder in folders if folder.is_relative_to(root.resolve())]
            # MJCF has no packages, but its paths climb: all that was named may be read.
            shared = inside[-1:] if root_of(path) == b"mujoco" else _package(path, inside)
            found.setdefault(path.resolve(), Source(path, _name(path), _category(path), (*shared, *further), body))
    if not found:
        where = ", ".join(map(str, named)) or "an empty list"
        raise UserError(f"no object is described in {where}; expected files such as NAME.urdf or NAME.xml")
    return _distinct(list(found.values()))


def _descriptions(folder: Path, depth: int) -> Iterator[Path]:
    """The files below a folder that describe an object, one of a PartNet-Mobility object's folder."""
    if urdf := find_urdf(folder):
        yield urdf
        return
    entries = sorted(os.scandir(folder), key=lambda entry: entry.name)
    for entry in entries:
        if entry.name.startswith("."):
            continue
        if entry.is_file() and Path(entry.name).suffix.lower() in SUFFIXES:
            if Path(entry.name).suffix.lower() == ".urdf" or root_of(Path(entry.path)) in KINDS:
                yield Path(entry.path)
        elif depth and entry.is_dir():
            yield from _descriptions(Path(entry.path), depth - 1)


def _whole(paths: Sequence[Path]) -> list[Path]:
    """The files without those that another one of them includes: parts of it, such as its meshes or a room."""
    parts: set[Path] = set()
    for path in paths:
        if root_of(path) == b"mujoco" and path.stat().st_size <= LARGEST_TEXT:
            names = INCLUDE.findall(COMMENT.sub(b"", path.read_bytes()).replace(b"\\", b"/"))
            parts |= {(path.parent / os.fsdecode(name)).resolve() for name in names}
    return [path for path in paths if path.resolve() not in parts] or list(paths)


def root_of(path: Path) -> bytes:
    """The root element of an XML file, by its head; b"" if there is none."""
    try:
        with path.open("rb") as stream:
            found = re.search(rb"<([\w.:-]+)", COMMENT.sub(b"", stream.read(HEAD)))
    except OSError:
        return b""
    return found[1] if found else b""


def _name(path: Path) -> str:
    return path.resolve().parent.name if path.name in URDFS else path.stem


def _category(path: Path) -> str:
    above = [folder.name for folder in path.resolve().parents]
    return next((name for name in above[:3] if name in CATEGORIES), "unknown")


def _package(path: Path, inside: Sequence[Path]) -> Iterator[Path]:
    """The package that a file belongs to, if that is inside of the folder that was named."""
    folder = path.resolve().parent
    for above in inside:
        if above != folder and (
            (above / "package.xml").is_file() or (above == folder.parent and folder.name in LAYOUT)
        ):
            yield above
            return


def _distinct(sources: list[Source]) -> list[Source]:
    """The sources, those of the same id with the names of their folders before it."""
    for level in range(1, DEPTH + 1):
        counts = Counter(source.id for source in sources)
        if max(counts.values()) == 1:
            break
        sources = [
            replace(source, id=f"{source.path.resolve().parents[level - 1 + source.partnet].name}_{source.id}")
            if counts[source.id] > 1
            else source
            for source in sources
        ]
    counts = Counter(source.id for source in sources)
    if max(counts.values()) > 1:
        twice = [str(source.path) for source in sources if counts[source.id] > 1]
        raise UserError(f"{twice[0]} and {twice[1]} have the same id; rename one of them")
    return sorted(sources, key=lambda source: source.id)
