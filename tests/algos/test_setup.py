"""From a configuration to the objects that a run trains on and is evaluated on."""

from __future__ import annotations

from pathlib import Path

from fb3d_rl.algos.setup import eval_entries, train_entries
from fb3d_rl.config import AssetsConfig


def test_mixed_objects_are_trained_on_and_only_real_ones_evaluated(tmp_path: Path, procedural_root: Path) -> None:
    microwaves = [path.name for path in procedural_root.glob("*Microwave*")]
    root, out = str(procedural_root), tmp_path / "run"
    mixed = AssetsConfig("partnet_mobility", root, "Microwave", "KitchenPot", None, ["Laptop"], [], 3, 1)
    train, held_out = train_entries(mixed, out, seed=1)
    assert sorted(e.category for e in train) == ["Laptop"] * 3 + ["Microwave"] * len(microwaves)
    assert held_out and {e.category for e in held_out} == {"KitchenPot"}

    alone = AssetsConfig("partnet_mobility", root, "Microwave", "KitchenPot", None, [], [], 3, 1)
    assert [e.id for e in train_entries(alone, tmp_path / "alone", seed=1)[0]] == sorted(microwaves)
    assert not (tmp_path / "alone").exists()


def test_unseen_categories_are_evaluated_and_not_trained_on(tmp_path: Path) -> None:
    assets = AssetsConfig("procedural", None, "all", "train_test", None, ["Laptop"], ["Box", "Bucket"], 2, 1)
    train, held_out = train_entries(assets, tmp_path / "train", seed=1)
    assert [(e.category, e.split) for e in train] == [("Laptop", "train_train")] * 2
    assert [(e.category, e.split) for e in held_out] == [("Laptop", "train_test"), ("Box", "test"), ("Bucket", "test")]
    assert [e.id for e in eval_entries(assets, tmp_path / "eval", seed=1)] == [e.id for e in held_out]
