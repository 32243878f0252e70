"""The commands take files of other makers: import, validate, list, preview; training, evaluation and the live page."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from fb3d_rl.algos.setup import eval_entries, one_object, train_entries
from fb3d_rl.assets.partnet_mobility import load_object
from fb3d_rl.errors import UserError
from tests.conftest import Launch

from .test_files import cupboard, put


def test_files_are_imported_as_folders_and_what_was_changed_is_said(tmp_path: Path, launch: Launch) -> None:
    put(tmp_path / "in/small.urdf")
    put(tmp_path / "in/large.urdf", cupboard(1000.0))
    arguments = ["import", "in", "--out", "out", "--category", "Safe", "--front", "-x"]
    done = launch("objects.py", *arguments, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "millimetres" in " ".join(done.stdout.split()) and "2 objects: out; 0 cannot" in done.stdout
    assert load_object(tmp_path / "out/large").category == "Safe"
    again = launch("objects.py", *arguments, cwd=tmp_path)
    assert again.returncode == 2 and "exists already" in again.stderr
    other = launch("objects.py", "import", "--front=+x", "in/small.urdf", "--scale", "cm", "--out", "cm", cwd=tmp_path)
    assert other.returncode == 0 and "0.01 times" in (said := " ".join(other.stdout.split())) and "faced +x" in said
    wrong = launch("objects.py", "import", "in", "--front", "-z", "--out", "no", cwd=tmp_path)
    assert wrong.returncode == 2 and "--front" in wrong.stderr
    put(tmp_path / "broken.urdf", "<sdf/>")
    broken = launch("objects.py", "import", "broken.urdf", "in/small.urdf", "--out", "two", cwd=tmp_path)
    assert broken.returncode == 1 and "no URDF" in " ".join(broken.stdout.split())
    assert [folder.name for folder in (tmp_path / "two").iterdir()] == ["small"]


def test_files_are_validated_listed_and_drawn_as_they_are(tmp_path: Path, launch: Launch) -> None:
    put(tmp_path / "in/a.urdf")
    put(tmp_path / "in/bad.urdf", "<robot/>")
    checked = launch("objects.py", "validate", "in", "--workers", "1", cwd=tmp_path)
    assert checked.returncode == 1
    verdicts = {entry["id"]: entry for entry in json.loads((tmp_path / "in/validation.json").read_text())}
    assert verdicts["a"]["usable"] and verdicts["a"]["openable"] == 2 and not verdicts["bad"]["usable"]
    one = launch("objects.py", "validate", "in/a.urdf", "--workers", "1", "--out", "one.json", cwd=tmp_path)
    assert one.returncode == 0 and len(json.loads((tmp_path / "one.json").read_text())) == 1
    listed = launch("objects.py", "list", "in", cwd=tmp_path)
    assert listed.returncode == 0 and "1 door, 1 drawer" in listed.stdout
    drawn = launch("objects.py", "preview", "in/a.urdf", "--out", "a.png", cwd=tmp_path)
    assert drawn.returncode == 0 and (tmp_path / "a.png").stat().st_size > 1000


def test_the_commands_find_the_objects(tmp_path: Path, config: Callable[[str, list[str]], Any]) -> None:
    for name in "abc":
        put(tmp_path / f"in/{name}.urdf")
    files = ["assets=files", f"assets.root={tmp_path / 'in'}"]
    evaluated = eval_entries(config("evaluate", ["policy=expert", *files]).assets, tmp_path / "out", 0)
    assert [entry.id for entry in evaluated] == ["a", "b", "c"]
    given = ["assets.split=a", "assets.eval_split=[b,c]", "assets.validation_share=0"]
    trained = train_entries(config("train", [*files, *given]).assets, tmp_path / "run", 0)
    assert [entry.id for entry in trained.train] == ["a"] and [entry.id for entry in trained.held_out] == ["b", "c"]
    assert trained.train[0].folder == tmp_path / "run/objects/a"  # what flow samples are drawn of, in other processes
    assert one_object(config("view", files), tmp_path / "view").id == "a"
    assert one_object(config("view", [*files, "object=c"]), tmp_path / "view").id == "c"
    assert one_object(config("view", [f"object={tmp_path / 'in/b.urdf'}"]), tmp_path / "view").id == "b"
    with pytest.raises(UserError, match="assets.root is not set"):
        config("view", ["assets=files"])
    with pytest.raises(UserError, match="assets.scale"):
        config("view", [*files, "assets.scale=0"])


@pytest.mark.slow
def test_the_expert_opens_a_foreign_object_as_it_comes(tmp_path: Path, launch: Launch) -> None:
    """It faces +y, in millimetres, of boxes, and has no collisions."""
    text = cupboard(1000.0).replace("<collision>", "<!--").replace("</collision>", "-->")
    world = (
        '<joint name="w" type="fixed"><origin rpy="0 0 -1.570796"/><parent link="world"/><child link="body"/></joint>'
    )
    put(tmp_path / "in/a.urdf", text.replace("</robot>", f'<link name="world"/>{world}</robot>'))
    done = launch(
        "evaluate.py", "policy=expert", "assets=files", "assets.root=in", "collector=direct", "evaluation.videos=0",
        "data.eval_samples=1", "evaluation.repeats=3", "hydra.run.dir=out", cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    with (tmp_path / "out/rows.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert {row["semantic"] for row in rows} == {"door", "drawer"}
    assert len(rows) >= 4 and all(row["success"] == "True" for row in rows)
