"""From an assets setting to object folders: procedural objects made on the fly, or a PartNet-Mobility root."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.progress import Progress

from fb3d_rl import procedural
from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.assets.folders import find_folders, find_split_file
from fb3d_rl.assets.partnet_mobility import listed, load_objects, load_usable, read_category
from fb3d_rl.assets.splits import CATEGORIES, TRAIN_CATEGORIES, UMPNET_SPLIT, read_split, select_ids, split_of
from fb3d_rl.errors import UserError

log = logging.getLogger(__name__)

MOST_NAMED = 5
"""At most this many objects that lost geometry are named in the log; the others are counted."""


@dataclass(frozen=True)
class Entry:
    """An object of a catalog: its folder, category and split, and the object itself if it was read already."""

    folder: Path
    category: str
    split: str
    known: ArticulatedObject | None = None

    @property
    def id(self) -> str:
        return self.folder.name if self.known is None else self.known.id

    def load(self) -> ArticulatedObject:
        """The object; it is read now unless it was before.

        Raises:
            UserError: it cannot be used.
        """
        if self.known is not None:
            return self.known
        obj = load_usable(self.folder)
        warn_of_lost_geometry([obj])
        return obj


LOST_GEOMETRY = "lost_geometry"
"""Key of a summary: the geometry that could not be read of the run's objects, by their ids."""


def lost_geometry(objects: Iterable[ArticulatedObject]) -> dict[str, list[str]]:
    """Remarks on the geometry in the objects' files that could not be read, by id; objects without any are left out."""
    return {obj.id: list(obj.lost) for obj in objects if obj.lost}


def warn_of_lost_geometry(objects: Iterable[ArticulatedObject]) -> None:
    """Log which objects lost geometry while they were read: they differ from what their files describe."""
    lost = lost_geometry(objects)
    for name, remarks in list(lost.items())[:MOST_NAMED]:
        log.warning("object %s: geometry left out while reading: %s", name, listed(remarks))
    if len(lost) > MOST_NAMED:
        log.warning(
            "geometry was left out of %d more objects; launch/objects.py validate DIR names it", len(lost) - MOST_NAMED
        )


def expand(categories: Sequence[str]) -> list[str]:
    """The names of families that words name: themselves, or one of these.

    "all" is UMPNet's 21 categories, "train" its 11 training categories, "test" the 10 others; "mechanisms" is the kinds
    of motion on bodies of any kind, :data:`fb3d_rl.procedural.MECHANISMS`. Look-alikes are in none of them: name them
    singly.
    """
    groups = {
        "all": [name for name in procedural.FAMILIES if name in CATEGORIES],
        "train": [name for name in procedural.FAMILIES if name in TRAIN_CATEGORIES],
        "test": [name for name in procedural.FAMILIES if name in CATEGORIES and name not in TRAIN_CATEGORIES],
        "mechanisms": list(procedural.MECHANISMS),
    }
    return list(dict.fromkeys(name for word in categories for name in groups.get(word, [word])))


def procedural_catalog(
    out: Path, categories: Sequence[str], count: int, held_out: int, seed: int, unseen: Sequence[str] = ()
) -> list[Entry]:
    """Make procedural objects below ``out``.

    Args:
        out: the folder.
        categories: families to train on, see :func:`expand`: each gives the split
            "train_train" ``count`` objects and "train_test" ``held_out`` others; 0 for none.
        count: see above.
        held_out: see above.
        seed: of the objects.
        unseen: further families; each gives the split "test" ``held_out`` objects.

    Raises:
        UserError: a category has no procedural family, or is to be trained on and unseen.
    """
    categories, unseen = expand(categories), expand(unseen)
    both = [name for name in unseen if name in categories]
    if both:
        raise UserError(
            f"assets.unseen_categories: {', '.join(both)} is trained on; take it out of one of the two lists"
        )
    unknown = [name for name in (*categories, *unseen) if name not in procedural.FAMILIES]
    if unknown or not categories:
        wrong = ", ".join(unknown) or "the list is empty"
        raise UserError(f"assets.categories: {wrong}; choose from {', '.join(procedural.FAMILIES)}")
    # Held-out objects come from another seed, so no training object can be among them.
    wanted = [
        (split, names, number, part_seed)
        for split, names, number, part_seed in (
            ("train_train", categories, count, 2 * seed),
            ("train_test", categories, held_out, 2 * seed + 1),
            ("test", unseen, held_out, 2 * seed + 1),
        )
        if number and names
    ]
    entries = []
    with Progress(transient=True) as bar:
        task = bar.add_task("objects", total=sum(number * len(names) for _, names, number, _ in wanted))
        for split, names, number, part_seed in wanted:
            ids = procedural.generate(out / split, names, number, part_seed, lambda: bar.advance(task))
            entries += [Entry(out / split / name, _category(out / split / name), split) for name in ids]
    return entries


def partnet_catalog(
    root: str | None, split: str | int | Sequence[object], split_file: str | None = None
) -> list[Entry]:
    """The objects below a PartNet-Mobility root that ``split`` selects; broken ones are left out and named.

    Objects that lost geometry while they were read are named too.

    Args:
        root: see :mod:`fb3d_rl.assets.folders`.
        split: see :func:`fb3d_rl.assets.splits.select_ids`.
        split_file: a file in UMPNet's format; unless given, the one in the root, else UMPNet's own lists.

    Raises:
        UserError: no such root, no object in it, an unknown split, or no usable object left.
    """
    if not root:
        raise UserError("assets.root is not set; give the folder that holds PartNet-Mobility objects: assets.root=DIR")
    folders = find_folders(root)
    table = read_split(split_file or find_split_file(root) or UMPNET_SPLIT)
    categories = {name: _category(folder) for name, folder in folders.items()}
    chosen = select_ids(categories, split, table)
    objects, skipped = load_objects([folders[name] for name in chosen])
    for item in skipped:
        log.warning("skipped: %s", item.reason)
    warn_of_lost_geometry(objects)
    return [Entry(obj.urdf.parent, obj.category, split_of(obj.id, obj.category, table), obj) for obj in objects]


def entry_of(entries: Sequence[Entry], word: str | None = None) -> Entry:
    """The entry with this id, or the first of this category; the first of all without a word.

    Raises:
        UserError: no entry has the word as its id or category.
    """
    named = [entry for entry in entries if word in (None, entry.id)]
    matching = named or [entry for entry in entries if entry.category == word]
    if not matching:
        ids, categories = [entry.id for entry in entries], sorted({entry.category for entry in entries})
        raise UserError(
            f"object={word} is no folder, none of the {len(ids)} ids ({', '.join(ids[:3])}, ...) and none of the "
            f"categories {', '.join(categories)}"
        )
    return matching[0]


def folder_entries(root: str | Path) -> list[Entry]:
    """The objects at or below ``root`` (see :mod:`fb3d_rl.assets.folders`), of no split; none of them is read yet.

    Raises:
        UserError: no such root, or no object in it.
    """
    return [Entry(folder, _category(folder), "") for folder in find_folders(root).values()]


def _category(folder: Path) -> str:
    try:
        return read_category(folder)
    except (OSError, UserError):
        return "unknown"  # load_object says what is wrong with a broken file
