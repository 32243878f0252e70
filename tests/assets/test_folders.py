"""Layouts: the data set's own, UMPNet's archive and ManiSkill's assets are found with the same option."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from fb3d_rl.assets.catalog import partnet_catalog
from fb3d_rl.assets.folders import find_folders, find_split_file
from fb3d_rl.errors import UserError
from fb3d_rl.importer.catalog import find_objects


def test_objects_are_found_up_to_three_folders_deep(tmp_path: Path, procedural_root: Path) -> None:
    objects = sorted(procedural_root.iterdir())
    shutil.copytree(objects[0], tmp_path / "b")
    shutil.copytree(objects[1], tmp_path / "x/y/a")
    shutil.copytree(objects[2], tmp_path / "x/y/z/too_deep")
    shutil.copytree(objects[2], tmp_path / ".partial/hidden")
    shutil.copytree(objects[2], tmp_path / "b/textured_objs/inside")
    (tmp_path / "no_object").mkdir()
    assert find_folders(tmp_path) == {"a": tmp_path / "x/y/a", "b": tmp_path / "b"}
    assert list(find_folders(tmp_path)) == ["a", "b"]
    assert find_folders(tmp_path / "b") == {"b": tmp_path / "b"}  # one object's own folder


def test_what_is_no_root_is_refused(tmp_path: Path, procedural_root: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match="no folder"):
        find_folders(tmp_path / "nowhere")
    with pytest.raises(UserError, match="no object"):
        find_folders(tmp_path / "empty")
    for category in ("A", "B"):
        shutil.copytree(next(procedural_root.iterdir()), tmp_path / category / "1")
    with pytest.raises(UserError, match="same id"):
        find_folders(tmp_path)


@pytest.mark.parametrize("above", ["", "mobility_dataset"])
def test_umpnets_archive(tmp_path: Path, procedural_root: Path, above: str) -> None:
    """Its own split file decides, and its folders name the categories of objects that do not."""
    root = tmp_path / above
    for folder in procedural_root.iterdir():
        category = folder.name.split("-")[1]
        shutil.copytree(folder, root / category / folder.name)
        (root / category / folder.name / "meta.json").unlink()
    pot = next(root.glob("KitchenPot/*")).name
    (root / "split-full.json").write_text(
        json.dumps({"train": {"KitchenPot": {"train": [pot], "test": []}}, "test": {}})
    )
    assert find_split_file(tmp_path) == root / "split-full.json"
    entries = {entry.category: entry for entry in partnet_catalog(str(tmp_path), "all")}
    assert set(entries) == {"KitchenPot", "Microwave", "StorageFurniture"}
    assert entries["KitchenPot"].split == "train_train"
    assert entries["KitchenPot"].folder == root / "KitchenPot" / pot
    assert entries["KitchenPot"].load().category == "KitchenPot"


def test_maniskills_assets(tmp_path: Path, procedural_root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MS_ASSET_DIR", str(tmp_path))
    with pytest.raises(UserError, match="download_asset"):
        find_folders("maniskill")
    folder = next(procedural_root.glob("*Microwave*"))
    target = tmp_path / "data/partnet_mobility/dataset/7128"
    shutil.copytree(folder, target)
    (target / "mobility.urdf").rename(target / "mobility_fixed.urdf")
    (obj,) = find_objects("maniskill")
    assert (obj.id, obj.category, obj.urdf) == ("7128", "Microwave", target / "mobility_fixed.urdf")


def test_the_asset_folder_is_maniskills() -> None:
    """The place that the package itself names, without importing it."""
    from mani_skill import ASSET_DIR

    from fb3d_rl.assets.folders import find_root

    assert find_root("maniskill") == ASSET_DIR / "partnet_mobility" / "dataset"
