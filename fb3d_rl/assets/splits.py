"""Which objects are for training and which for testing.

UMPNet's lists (Xu, He, Song, RA-L 2022) are the reference: ``train_train`` (training instances of eleven categories),
``train_test`` (held-out instances of the same categories) and ``test`` (ten unseen categories).
"""

from __future__ import annotations

import hashlib
import json
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path

from fb3d_rl.errors import UserError

SPLITS = ("train_train", "train_test", "test")
UMPNET_SPLIT = Path(__file__).with_name("umpnet_split.json")
"""UMPNet's own file: {"train": {category: {"train": ids, "test": ids}}, "test": {category: {"test": ids}}}."""

TRAIN_CATEGORIES = (
    "FoldingChair", "Kettle", "Laptop", "Microwave", "Refrigerator", "Stapler", "StorageFurniture", "Switch",
    "Toilet", "TrashCan", "Window",
)  # fmt: skip

TEST_CATEGORIES = (
    "Box", "Bucket", "Dishwasher", "Door", "KitchenPot", "Oven", "Phone", "Safe", "Table", "WashingMachine",
)  # fmt: skip

CATEGORIES = TRAIN_CATEGORIES + TEST_CATEGORIES

HELD_OUT_SHARE = 0.2

WORD_FILES = (".txt", ".json")


def read_split(path: str | Path = UMPNET_SPLIT) -> dict[str, str]:
    """Read a split file in UMPNet's format: object id -> split name.

    Raises:
        UserError: the file is missing or has another format.
    """
    try:
        content = json.loads(Path(path).read_text(encoding="utf-8"))
        return {
            str(name): "test" if half == "test" else f"train_{part}"
            for half in ("train", "test")
            for parts in content[half].values()
            for part, names in parts.items()
            for name in names
        }
    except (OSError, ValueError, KeyError, AttributeError, TypeError) as error:
        raise UserError(f"the split file {path} is missing or not in UMPNet's format ({error!r})") from error


def split_of(name: str, category: str, table: Mapping[str, str]) -> str:
    """Split of an object: by the table, else by its category and a stable hash of its id.

    Objects of unseen categories are test objects; one in five of the training categories is held out.
    """
    if name in table:
        return table[name]
    if category not in TRAIN_CATEGORIES:
        return "test"
    return "train_test" if zlib.crc32(name.encode()) % 1000 < 1000 * HELD_OUT_SHARE else "train_train"


def validation_ids(categories: Mapping[str, str], share: float) -> set[str]:
    """Training objects that are kept for validation: of each category ``share``, rounded, by a stable hash of the ids.

    Where that rounds to none, the largest category with two objects or more gives one.

    Args:
        categories: object id -> category of the training objects.
        share: from 0, for none at all, to below 1.
    """
    ids: dict[str, list[str]] = {}
    for name in sorted(categories, key=lambda name: hashlib.sha256(name.encode()).hexdigest()):
        ids.setdefault(categories[name], []).append(name)
    chosen = {name for names in ids.values() for name in names[: round(share * len(names))]}
    largest = max(ids.values(), key=len, default=[])
    return chosen or set(largest[: int(share > 0 and len(largest) > 1)])


def select_ids(
    categories: Mapping[str, str], split: str | int | Sequence[object], table: Mapping[str, str]
) -> list[str]:
    """Ids that ``split`` names, sorted.

    Args:
        categories: object id -> category of all objects there are.
        split: "all", a split's name, a category, an object id, or a file of such words (one to a line in .txt, a list
            in .json); or several of them, in a list or with commas.
        table: object id -> split, from :func:`read_split`.

    Raises:
        UserError: a word names nothing, or nothing is selected.
    """
    known_categories = set(categories.values())
    chosen: set[str] = set()
    given = str(split).split(",") if isinstance(split, (str, int)) else [str(word) for word in split]
    words = [word for name in filter(None, map(str.strip, given)) for word in _words(name)]
    for word in words:
        name = word.replace("-", "_")
        if word == "all":
            chosen.update(categories)
        elif name in SPLITS:
            chosen.update(i for i, category in categories.items() if split_of(i, category, table) == name)
        elif word in categories:
            chosen.add(word)
        elif word in known_categories:
            chosen.update(i for i, category in categories.items() if category == word)
        else:
            raise UserError(
                f"assets.split: {word!r} is no split ({', '.join(SPLITS)}, all), category or object id of this root"
            )
    if not chosen:
        raise UserError(f"assets.split: no object of this root belongs to {split!r}")
    return sorted(chosen)


def _words(name: str) -> list[str]:
    """The word itself, or those in the file of this name.

    Raises:
        UserError: the file is missing or holds no list of words.
    """
    path = Path(name)
    if path.suffix not in WORD_FILES:
        return [name]
    try:
        text = path.read_text(encoding="utf-8")
        words = json.loads(text) if path.suffix == ".json" else text.split()
        if not isinstance(words, list) or not all(isinstance(word, (str, int)) for word in words):
            raise ValueError("it is no list of words")
    except (OSError, ValueError, RecursionError) as error:
        raise UserError(
            f"assets.split: {name} cannot be read as a list of splits, categories or ids ({error}); "
            "a file in UMPNet's format goes to assets.split_file"
        ) from error
    return [str(word) for word in words]
