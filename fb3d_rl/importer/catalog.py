"""From paths that a user names to objects: PartNet-Mobility folders as they are, files of other makers imported."""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path

from rich.progress import track

from fb3d_rl import procedural
from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.assets.catalog import Entry, partnet_catalog, warn_of_lost_geometry
from fb3d_rl.assets.folders import MANISKILL, find_folders
from fb3d_rl.assets.options import AssetsOptions
from fb3d_rl.assets.partnet_mobility import listed, load_object, load_usable
from fb3d_rl.assets.splits import UMPNET_SPLIT, read_split, select_ids, split_of
from fb3d_rl.errors import UserError
from fb3d_rl.importer.files import Source, find_files
from fb3d_rl.importer.folders import write_folder
from fb3d_rl.importer.frames import Frame
from fb3d_rl.importer.reading import read_file

log = logging.getLogger(__name__)


def frame_of(assets: AssetsOptions) -> Frame:
    """The units and axes that a configuration names."""
    return Frame(assets.metres, assets.up, assets.front)


def files_catalog(
    assets: AssetsOptions, split: str | int | Sequence[object] = "all", out: Path | None = None
) -> list[Entry]:
    """The objects in the files that ``assets`` names; those that cannot be used are left out and named.

    What was changed to read an object is logged.

    Args:
        assets: root, packages, units and axes, category and split_file.
        split: which of them, see :func:`fb3d_rl.assets.splits.select_ids`.
        out: folder in which the objects are written as PartNet-Mobility folders, which entries then are of; without it
            they are held in memory.

    Raises:
        UserError: there is no file, an unknown split, or no object that can be used.
    """
    sources = {source.id: source for source in find_files(assets.paths, assets.packages, assets.body)}
    frame, category = frame_of(assets), assets.category
    table = read_split(assets.split_file or UMPNET_SPLIT)
    categories = {name: category or source.category for name, source in sources.items()}
    entries, reasons = [], []
    for name in track(select_ids(categories, split, table), "objects", transient=True):
        try:
            obj, remarks = imported(sources[name], frame, category, out, replaced=True)
        except UserError as error:
            reasons.append(str(error))
            log.warning("skipped: %s", error)
            continue
        if remarks:
            log.info("object %s: %s", obj.id, listed(remarks))
        entries.append(Entry(obj.urdf.parent, obj.category, split_of(obj.id, obj.category, table), obj))
    if not entries:
        raise UserError(f"no object can be used ({len(reasons)} cannot be read; the first: {reasons[0]})")
    warn_of_lost_geometry(entry.load() for entry in entries)
    return entries


def imported(
    source: Source, frame: Frame, category: str | None, out: Path | None, replaced: bool = False
) -> tuple[ArticulatedObject, tuple[str, ...]]:
    """The object of a file, read back from the folder ``out/<id>`` if there is an ``out``; and the remarks on it.

    Raises:
        UserError: it cannot be used, or the folder exists and is not to be ``replaced``.
    """
    obj = read_file(source, frame, category)
    return obj if out is None else load_usable(write_folder(obj, out, replaced)), obj.dropped


def given_catalog(assets: AssetsOptions, split: str | int | Sequence[object], out: Path | None = None) -> list[Entry]:
    """The objects that are not procedural: below a PartNet-Mobility root, or in files (:func:`files_catalog`)."""
    if assets.source == "files":
        return files_catalog(assets, split, out)
    return partnet_catalog(assets.paths[0], split, assets.split_file)


def path_catalog(path: str | Path, split: str | int | Sequence[object] = "all") -> list[Entry]:
    """The objects at a path: a PartNet-Mobility root, or else files in their recognised units and axes.

    Raises:
        UserError: there is no object, or none that can be used.
    """
    if holds_folders(path):
        return partnet_catalog(str(path), split)
    return files_catalog(AssetsOptions(source="files", root=str(path)), split)


def holds_folders(path: str | Path) -> bool:
    """Whether a path is that of PartNet-Mobility objects, or of nothing at all, which their catalog says best."""
    if str(path) == MANISKILL or not Path(path).expanduser().exists():
        return True
    if Path(path).expanduser().is_file():
        return False
    try:
        return bool(find_folders(path))
    except UserError:
        try:
            find_files(path)
        except UserError:
            return True
        return False


def find_objects(
    objects: Iterable[ArticulatedObject] | str | Path | None, split: str | int | Sequence[object] = "all"
) -> list[ArticulatedObject]:
    """The objects that a user of the library names.

    Args:
        objects: the objects themselves, the folder or file of one object, or the folder of many; a cabinet, a microwave
            and a pot, made anew, unless given.
        split: which of a folder of many, see :func:`fb3d_rl.assets.splits.select_ids`.

    Raises:
        UserError: a folder holds no object, or none that can be used.
    """
    if objects is None:
        with tempfile.TemporaryDirectory() as folder:
            names = procedural.generate(Path(folder), ("StorageFurniture", "Microwave", "KitchenPot"), 1, seed=0)
            return [load_object(Path(folder) / name) for name in names]
    if isinstance(objects, (str, Path)):
        return [entry.load() for entry in path_catalog(objects, split)]
    return list(objects)
