"""Catalogs: procedural objects in two disjoint halves, and the objects below a root that a split names."""

from __future__ import annotations

import json
import logging
import shutil
from pathlib import Path

import pytest

from fb3d_rl.assets.catalog import folder_entries, lost_geometry, partnet_catalog, procedural_catalog
from fb3d_rl.assets.partnet_mobility import load_object
from fb3d_rl.assets.splits import CATEGORIES, TRAIN_CATEGORIES
from fb3d_rl.errors import UserError
from fb3d_rl.procedural import FAMILIES


def contents(root: Path) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()}


def test_procedural_halves_are_disjoint_and_repeatable(tmp_path: Path) -> None:
    first = procedural_catalog(tmp_path / "a", ["Microwave", "KitchenPot"], 2, 1, seed=3)
    again = procedural_catalog(tmp_path / "b", ["Microwave", "KitchenPot"], 2, 1, seed=3)
    assert [(e.id, e.category, e.split) for e in first] == [(e.id, e.category, e.split) for e in again]
    assert contents(tmp_path / "a") == contents(tmp_path / "b")
    assert [e.split for e in first] == ["train_train"] * 4 + ["train_test"] * 2
    assert len({(e.folder / "mobility.urdf").read_bytes() for e in first}) == len(first)
    for entry in first:
        obj = load_object(entry.folder)
        assert (obj.id, obj.category) == (entry.id, entry.category)


def test_objects_that_lost_geometry_are_named_and_many_are_counted(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    entries = procedural_catalog(tmp_path, ["Microwave"], 7, 0, seed=0)
    for entry in entries[:6]:
        urdf = entry.folder / "mobility.urdf"
        urdf.write_text(urdf.read_text().replace("<visual", "<visual><geometry><torus/></geometry></visual><visual", 1))
    (entries[6].folder / "semantics.txt").unlink()  # no geometry
    loaded = partnet_catalog(str(tmp_path), "all")
    lost = lost_geometry(entry.load() for entry in loaded)
    assert set(lost) == {entry.id for entry in entries[:6]}
    told = [record.getMessage() for record in caplog.records]
    assert len(told) == 6 and all("<torus> in place of a mesh" in line for line in told[:5])
    assert [line.split()[1].strip(":") for line in told[:5]] == list(lost)[:5] and "1 more" in told[5]
    caplog.clear()
    folder_entries(entries[0].folder)[0].load()  # as launch/view.py does
    assert [record.getMessage() for record in caplog.records] == told[:1]


def test_another_seed_makes_other_objects(tmp_path: Path) -> None:
    ids = [e.id for seed in range(3) for e in procedural_catalog(tmp_path / str(seed), ["Microwave"], 1, 1, seed)]
    assert len(set(ids)) == 6
    assert len({(path / "mobility.urdf").read_bytes() for path in tmp_path.glob("*/*/*")}) == 6


def test_evaluation_makes_no_training_objects_and_the_same_held_out_ones(tmp_path: Path) -> None:
    both = procedural_catalog(tmp_path / "a", ["Microwave"], 2, 2, seed=0)
    held_out = procedural_catalog(tmp_path / "b", ["Microwave"], 0, 2, seed=0)
    assert [e.id for e in held_out] == [e.id for e in both if e.split == "train_test"]
    assert contents(tmp_path / "a/train_test") == contents(tmp_path / "b/train_test")


def test_unseen_categories_are_a_split_of_their_own(tmp_path: Path) -> None:
    made = procedural_catalog(tmp_path / "a", ["Microwave"], 1, 2, seed=0, unseen=["Laptop", "Bucket"])
    assert [(e.category, e.split) for e in made] == [
        ("Microwave", "train_train"),
        *[("Microwave", "train_test")] * 2,
        *[("Laptop", "test")] * 2,
        *[("Bucket", "test")] * 2,
    ]
    # What is held out of the training categories does not depend on them.
    without = procedural_catalog(tmp_path / "b", ["Microwave"], 1, 2, seed=0)
    assert [e.id for e in without] == [e.id for e in made if e.split != "test"]
    with pytest.raises(UserError, match="Laptop is trained on"):
        procedural_catalog(tmp_path / "c", ["Laptop"], 1, 1, seed=0, unseen=["Laptop"])
    assert not (tmp_path / "c").exists()


def test_words_stand_for_umpnets_categories(tmp_path: Path) -> None:
    made = procedural_catalog(tmp_path / "a", ["train"], 1, 0, seed=0)
    assert [e.category for e in made] == [name for name in FAMILIES if name in TRAIN_CATEGORIES]
    made = procedural_catalog(tmp_path / "b", ["Box", "all"], 1, 0, seed=0)
    assert sorted(e.category for e in made) == sorted(CATEGORIES)
    with pytest.raises(UserError, match="Laptop is trained on"):
        procedural_catalog(tmp_path / "c", ["train"], 1, 1, seed=0, unseen=["Laptop"])


@pytest.mark.parametrize(("categories", "word"), [(["Microwave", "Spaceship"], "Spaceship"), ([], "empty")])
def test_unknown_families_are_refused(tmp_path: Path, categories: list[str], word: str) -> None:
    with pytest.raises(UserError, match=word):
        procedural_catalog(tmp_path, categories, 1, 1, seed=0)
    assert not any(tmp_path.iterdir())


@pytest.fixture
def root(tmp_path: Path, procedural_root: Path) -> Path:
    """A root with a microwave and a cabinet (categories to train on), a pot (a category to test on) and a wreck."""
    root = tmp_path / "root"
    shutil.copytree(procedural_root, root)
    wreck = next(root.glob("*Microwave*")).with_name("wreck")
    shutil.copytree(next(root.glob("*Microwave*")), wreck)
    (wreck / "mobility.urdf").write_text("<robot>")
    return root


def test_a_root_is_read_broken_objects_are_named(root: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        entries = partnet_catalog(str(root), "all")
    assert sorted(e.category for e in entries) == ["KitchenPot", "Microwave", "StorageFurniture"]
    assert all(e.folder == root / e.id for e in entries)
    assert "wreck" in caplog.text
    by_category = {e.category: e.split for e in entries}
    assert by_category["KitchenPot"] == "test" and by_category["Microwave"].startswith("train_")


def test_splits_cover_a_root_once(root: Path) -> None:
    every = [e.id for e in partnet_catalog(str(root), "all")]
    parts: list[str] = []
    for split in ("train_train", "train_test", "test"):
        try:
            entries = partnet_catalog(str(root), split)
        except UserError:
            continue
        assert {e.split for e in entries} == {split}
        parts += [e.id for e in entries]
    assert sorted(parts) == sorted(every)


def test_a_split_file_replaces_the_lists(root: Path, tmp_path: Path) -> None:
    pot = next(root.glob("*KitchenPot*")).name
    content = {"train": {"KitchenPot": {"train": [pot], "test": []}}, "test": {}}
    (tmp_path / "mine.json").write_text(json.dumps(content))
    entries = partnet_catalog(str(root), "train_train,KitchenPot", str(tmp_path / "mine.json"))
    assert {e.id: e.split for e in entries}[pot] == "train_train"


def test_what_cannot_be_used_is_refused(root: Path, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    for bad, split, word in (
        (None, "all", "not set"),
        (str(tmp_path / "nowhere"), "all", "no folder"),
        (str(tmp_path / "empty"), "all", "no object"),
        (str(root), "Nonsense", "Nonsense"),
        (str(root), "wreck", "wreck"),
    ):
        with pytest.raises(UserError, match=word):
            partnet_catalog(bad, split)


def test_real_splits_hold_the_listed_objects(real_root: Path) -> None:
    from fb3d_rl.assets.folders import find_folders
    from fb3d_rl.assets.splits import read_split

    table, ids = read_split(), find_folders(real_root)
    chosen = [name for name in ids if name in table][:3]
    for entry in partnet_catalog(str(real_root), ",".join(chosen)):
        assert entry.split == table[entry.id]
