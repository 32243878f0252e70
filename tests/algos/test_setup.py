"""From a configuration to the objects that a run trains on and is evaluated on."""

from __future__ import annotations

from pathlib import Path

from fb3d_rl.algos.setup import train_entries
from fb3d_rl.config import AssetsConfig


def test_mixed_objects_are_trained_on_and_only_real_ones_evaluated(tmp_path: Path, procedural_root: Path) -> None:
    microwaves = [path.name for path in procedural_root.glob("*Microwave*")]
    root, out = str(procedural_root), tmp_path / "run"
    mixed = AssetsConfig("partnet_mobility", root, "Microwave", "KitchenPot", None, ["Laptop"], 3, 1)
    train, held_out = train_entries(mixed, out, seed=1)
    assert sorted(e.category for e in train) == ["Laptop"] * 3 + ["Microwave"] * len(microwaves)
    assert held_out and {e.category for e in held_out} == {"KitchenPot"}

    alone = AssetsConfig("partnet_mobility", root, "Microwave", "KitchenPot", None, [], 3, 1)
    assert [e.id for e in train_entries(alone, tmp_path / "alone", seed=1)[0]] == sorted(microwaves)
    assert not (tmp_path / "alone").exists()
