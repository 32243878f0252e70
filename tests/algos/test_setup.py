"""From a configuration to the objects that a run trains on and is evaluated on."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from fb3d_rl.algos.run import run_evaluation
from fb3d_rl.algos.setup import env_options, eval_entries, flow_policy_options, one_object, settled, train_entries
from fb3d_rl.assets.options import AssetsOptions
from fb3d_rl.assets.partnet_mobility import read_category
from fb3d_rl.errors import UserError
from fb3d_rl.models.artflownet import ArtFlowNet


def test_mixed_objects_are_trained_on_and_only_real_ones_evaluated(tmp_path: Path, procedural_root: Path) -> None:
    microwaves = [path.name for path in procedural_root.glob("*Microwave*")]
    root, out = str(procedural_root), tmp_path / "run"
    mixed = AssetsOptions("partnet_mobility", root, "Microwave", "KitchenPot", None, ["Laptop"], [], 3, 0, 0.0)
    entries = train_entries(mixed, out, seed=1)
    train, held_out = entries.train, entries.held_out
    assert sorted(e.category for e in train) == ["Laptop"] * 3 + ["Microwave"] * len(microwaves)
    assert held_out and {e.category for e in held_out} == {"KitchenPot"}

    alone = AssetsOptions("partnet_mobility", root, "Microwave", "KitchenPot", None, [], [], 3, 0, 0.0)
    assert [e.id for e in train_entries(alone, tmp_path / "alone", seed=1).train] == sorted(microwaves)
    assert not (tmp_path / "alone").exists()


def test_procedural_objects_beside_real_ones_are_evaluated_as_splits_of_their_own(
    tmp_path: Path, procedural_root: Path
) -> None:
    root = str(procedural_root)
    both = AssetsOptions("partnet_mobility", root, "Microwave", "KitchenPot", None, ["Laptop"], ["Box"], 2, 1, 0.0)
    entries = train_entries(both, tmp_path / "train", seed=1)
    train, held_out = entries.train, entries.held_out
    assert {(e.category, e.split) for e in train if e.category != "Microwave"} == {("Laptop", "train_train")}
    real, made = held_out[:-2], held_out[-2:]
    assert {e.category for e in real} == {"KitchenPot"}
    assert [(e.category, e.split) for e in made] == [("Laptop", "procedural_train_test"), ("Box", "procedural_test")]
    assert not {e.id for e in train} & {e.id for e in held_out}
    again = eval_entries(replace(both, split="KitchenPot"), tmp_path / "eval", seed=1)
    assert [(e.id, e.split) for e in again] == [(e.id, e.split) for e in held_out], "launch/evaluate.py has the same"

    with pytest.raises(UserError, match=r"assets\.categories: the list is empty"):
        train_entries(replace(both, categories=[]), tmp_path / "none", seed=1)


def test_unseen_categories_are_evaluated_and_not_trained_on(tmp_path: Path) -> None:
    assets = AssetsOptions("procedural", None, "all", "train_test", None, ["Laptop"], ["Box", "Bucket"], 2, 1, 0.0)
    entries = train_entries(assets, tmp_path / "train", seed=1)
    train, held_out = entries.train, entries.held_out
    assert [(e.category, e.split) for e in train] == [("Laptop", "train_train")] * 2
    assert [(e.category, e.split) for e in held_out] == [("Laptop", "train_test"), ("Box", "test"), ("Bucket", "test")]
    assert [e.id for e in eval_entries(assets, tmp_path / "eval", seed=1)] == [e.id for e in held_out]


def test_validation_objects_are_split_off_the_training_objects(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assets = AssetsOptions("procedural", None, "all", "train_test", None, ["Laptop", "Box"], [], 10, 2, 0.2)
    entries = train_entries(assets, tmp_path / "a", seed=1)
    assert Counter(e.category for e in entries.validation) == {"Laptop": 2, "Box": 2}
    assert {e.split for e in entries.validation} == {"train_train"}
    ids = [{e.id for e in part} for part in (entries.train, entries.validation, entries.held_out)]
    assert [len(part) for part in ids] == [16, 4, 4] and len(set.union(*ids)) == 24
    assert {e.id for e in train_entries(assets, tmp_path / "b", seed=1).validation} == ids[1], "a stable choice"
    none = train_entries(replace(assets, validation_share=0.0), tmp_path / "c", seed=1)
    assert {e.id for e in none.train} == ids[0] | ids[1] and not none.validation
    assert "note" not in capsys.readouterr().out
    single = train_entries(replace(assets, categories=["Box"], train_count=1), tmp_path / "d", seed=1)
    assert len(single.train) == 1 and not single.validation
    assert "no validation during training" in capsys.readouterr().out


def test_an_object_is_named_by_its_folder_its_id_or_its_category(
    tmp_path: Path, procedural_root: Path, config: Callable[[str, list[str]], Any]
) -> None:
    microwave = next(path for path in procedural_root.iterdir() if read_category(path) == "Microwave")
    real = ["assets=partnet_mobility", f"assets.root={procedural_root}"]

    def named(*overrides: str) -> tuple[str, str]:
        obj = one_object(config("view", list(overrides)), tmp_path)
        return obj.category, obj.id

    for word in ("Microwave", microwave.name):
        assert named(*real, f"object={word}") == ("Microwave", microwave.name)
    assert named(f"object={microwave}") == ("Microwave", microwave.name)
    assert named(*real)[1] == min(path.name for path in procedural_root.iterdir())

    made = eval_entries(config("view", ["seed=3"]).assets, tmp_path / "all", 3)
    assert named("seed=3") == (made[0].category, made[0].id)
    assert named("seed=3", f"object={made[-1].id}") == (made[-1].category, made[-1].id)
    assert named("object=Laptop")[0] == "Laptop", "a family that assets.categories lacks"
    numbers = shutil.copytree(microwave, tmp_path / "root" / "10098")
    assert named("assets=partnet_mobility", f"assets.root={numbers.parent}", "object=10098")[1] == "10098"


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["object=Spaceship"], ["Spaceship", "Microwave"]),
        (["assets=partnet_mobility", "assets.root=ROOT", "object=Laptop"], ["Laptop", "3 ids", "KitchenPot"]),
        (["object=ROOT"], ["holds 3 objects", "object=ID"]),
        (["assets=partnet_mobility", "assets.root=nowhere"], ["assets.root", "nowhere"]),
    ],
)
def test_an_object_that_is_not_there_is_named(
    tmp_path: Path,
    procedural_root: Path,
    config: Callable[[str, list[str]], Any],
    overrides: list[str],
    words: list[str],
) -> None:
    with pytest.raises(UserError) as error:
        one_object(config("view", [word.replace("ROOT", str(procedural_root)) for word in overrides]), tmp_path)
    assert all(word in str(error.value) for word in words), error.value


@pytest.mark.parametrize(
    ("name", "words", "trained_with_mask", "expected"),
    [
        ("train", [], None, ("target", "target")),
        ("train", ["algo=artflownet_no_mask"], None, ("none", "any")),
        ("train", ["algo=artflownet_no_mask_vpa"], None, ("none", "any")),
        ("train", ["algo=artflownet_no_mask", "policy.mask=target"], None, ("target", "target")),
        ("train", ["algo=dagger"], None, ("target", "target")),
        ("train", ["algo=artflownet_no_mask", "env.suction.hold=target"], None, ("none", "target")),
        ("evaluate", [], None, ("target", "target")),
        ("evaluate", ["policy.mask=none"], None, ("none", "any")),
        ("evaluate", [], False, ("none", "any")),
        ("evaluate", ["policy.mask=target"], False, ("target", "target")),
        ("evaluate", ["env.suction.hold=any"], True, ("target", "any")),
        ("view", [], False, ("none", "any")),
    ],
)
def test_the_mask_follows_from_the_network_unless_it_is_named(
    name: str,
    words: list[str],
    trained_with_mask: bool | None,
    expected: tuple[str, str],
    config: Callable[[str, list[str]], Any],
) -> None:
    cfg = settled(config(name, words), trained_with_mask)
    assert (flow_policy_options(cfg).mask, env_options(cfg).suction.hold) == expected
    assert settled(cfg) == cfg, "what is settled stays so"


def test_a_network_that_reads_the_mask_is_not_evaluated_without(
    tmp_path: Path, config: Callable[[str, list[str]], Any]
) -> None:
    ArtFlowNet(neighbors=8).save_pretrained(path := tmp_path / "net.safetensors")  # one that was never without
    cfg = config("evaluate", ["policy=artflownet", f"checkpoint={path}", "policy.mask=none", "assets.eval_count=1"])
    with pytest.raises(UserError, match=r"trained with the mask.*policy\.mask=target"):
        run_evaluation(cfg, tmp_path)
