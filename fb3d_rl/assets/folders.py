"""Find objects on disk, in the folder layouts in which PartNet-Mobility is distributed.

- the dataset's own: ``<id>/mobility.urdf``;
- UMPNet's archive (Xu, He, Song, RA-L 2022): ``mobility_dataset/<Category>/<id>/mobility.urdf``, ``split-full.json``;
- ManiSkill's assets: ``<id>/mobility_cvx.urdf`` or ``<id>/mobility_fixed.urdf``.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from fb3d_rl.errors import UserError

URDFS = ("mobility_cvx.urdf", "mobility_fixed.urdf", "mobility.urdf")
"""An object's URDF, the first that is there: ManiSkill's order, since it made the former two to simulate well."""

SPLIT_FILE = "split-full.json"
"""UMPNet's split file, which its archive contains."""

MANISKILL = "maniskill"
"""A root of this name is ManiSkill's own asset folder."""

DEPTH = 3
"""How many levels below the root objects are searched for."""


def find_urdf(folder: Path) -> Path | None:
    """The URDF of an object's folder; None if it holds no object."""
    return next((folder / name for name in URDFS if (folder / name).is_file()), None)


def find_root(root: str | Path) -> Path:
    """The folder that ``assets.root`` means: its path, or ManiSkill's asset folder for the word "maniskill"."""
    if str(root) == MANISKILL:
        return Path(os.environ.get("MS_ASSET_DIR", "~/.maniskill")).expanduser() / "data/partnet_mobility/dataset"
    return Path(root).expanduser()


def find_folders(root: str | Path) -> dict[str, Path]:
    """Folders of the objects at or below ``root`` by id, which is the folder's name; sorted.

    Raises:
        UserError: ``root`` does not exist, holds no object, or holds two of the same id.
    """
    folder = find_root(root)
    if not folder.is_dir():
        how = (
            "fetch it with `python -m mani_skill.utils.download_asset partnet_mobility`"
            if str(root) == MANISKILL
            else "give the folder that holds <id>/mobility.urdf"
        )
        raise UserError(f"assets.root: {folder} is no folder; {how}")
    folders: dict[str, Path] = {}
    for path in _objects(folder, DEPTH):
        name = path.resolve().name if path == folder else path.name
        if name in folders:
            raise UserError(f"assets.root: {folders[name]} and {path} have the same id; remove one of them")
        folders[name] = path
    if not folders:
        raise UserError(
            f"assets.root: {folder} holds no object; expected <id>/{URDFS[-1]} or <Category>/<id>/{URDFS[-1]} below it"
        )
    return dict(sorted(folders.items()))


def find_split_file(root: str | Path) -> Path | None:
    """UMPNet's split file at the root or one folder below it; None if it is not there."""
    folder = find_root(root)
    return next(iter(sorted([*folder.glob(SPLIT_FILE), *folder.glob(f"*/{SPLIT_FILE}")])), None)


def _objects(folder: Path, depth: int) -> Iterator[Path]:
    """Object folders. They are not searched themselves: each holds thousands of meshes and pictures."""
    if find_urdf(folder):
        yield folder
    elif depth:
        for child in sorted(folder.iterdir()):
            if child.is_dir() and not child.name.startswith("."):
                yield from _objects(child, depth - 1)
