"""launch/objects.py: objects are made and drawn, and mistakes are named before anything is written."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from PIL import Image

from fb3d_rl.assets.folders import find_folders
from fb3d_rl.assets.partnet_mobility import load_object
from launch.objects import main


def test_objects_are_made_and_drawn(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made = tmp_path / "made"
    assert main(["generate", "--out", str(made), "--categories", "Phone,Switch", "--count", "2", "--seed", "4"]) == 0
    assert "4 objects of 2 categories" in capsys.readouterr().out
    objects = [load_object(made / name) for name in find_folders(made)]
    assert sorted(obj.category for obj in objects) == ["Phone", "Phone", "Switch", "Switch"]

    sheet = tmp_path / "below" / "sheet.png"
    assert main(["preview", str(made), "--out", str(sheet), "--each", "1"]) == 0
    assert "2 of 4 objects" in capsys.readouterr().out
    assert min(Image.open(sheet).size) > 100


@pytest.mark.slow
def test_kinds_of_objects_are_compared(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name, seed in (("ours", "0"), ("theirs", "1")):
        made = ["generate", "--out", str(tmp_path / name), "--categories", "Laptop,Phone", "--seed", seed]
        assert main([*made, "--count", "4" if name == "ours" else "5"]) == 0
    kinds, out = [str(tmp_path / "ours"), str(tmp_path / "theirs")], tmp_path / "compared.json"
    assert main(["compare", *kinds, "--workers", "1", "--out", str(out)]) == 0
    assert "4 / 5" in capsys.readouterr().out
    found = json.loads(out.read_text())["categories"]
    assert sorted(item["category"] for item in found) == ["Laptop", "Phone"]
    assert all(item["counts"] == [4, 5] and 0 <= item["told"] <= 1 for item in found)
    shutil.rmtree(tmp_path / "theirs" / "proc-Laptop-1-0000")
    shutil.rmtree(tmp_path / "theirs" / "proc-Laptop-1-0001")
    assert main(["compare", *kinds, "--workers", "1"]) == 0
    assert "Laptop" not in capsys.readouterr().out.split("Told apart")[0], "too few"


@pytest.mark.slow
def test_objects_are_validated(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["generate", "--out", str(tmp_path), "--categories", "Phone,Switch", "--count", "1"]) == 0
    assert main(["validate", str(tmp_path), "--workers", "1"]) == 0
    phone, switch = json.loads((tmp_path / "validation.json").read_text())
    assert (phone["category"], phone["usable"], phone["findings"]) == ("Phone", True, [])
    (tmp_path / switch["id"] / "mobility.urdf").write_text("<robot>")
    assert main(["validate", str(tmp_path), "--workers", "1", "--out", str(tmp_path / "again.json")]) == 1
    assert "1 cannot be used" in capsys.readouterr().out
    assert [entry["usable"] for entry in json.loads((tmp_path / "again.json").read_text())] == [True, False]


def test_objects_are_listed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["generate", "--out", str(tmp_path), "--categories", "Oven,Laptop", "--count", "2"]) == 0
    capsys.readouterr()
    assert main(["list", str(tmp_path)]) == 0
    text = capsys.readouterr().out
    assert "4 objects of 2 categories" in text and "proc-Laptop-0-0001" in text and "1 screen" in text
    assert main(["list", str(tmp_path), "--split", "Oven"]) == 0
    text = capsys.readouterr().out
    assert "2 objects of 1 categories: 2 test" in text and "Laptop" not in text


def test_archives_are_unpacked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made = tmp_path / "made"
    assert main(["generate", "--out", str(made), "--categories", "Phone", "--count", "2"]) == 0
    archive = shutil.make_archive(str(tmp_path / "objects"), "xztar", made)
    assert main(["unpack", archive, "--out", str(tmp_path / "out")]) == 0
    assert "2 objects" in capsys.readouterr().out
    assert sorted(find_folders(tmp_path / "out")) == sorted(find_folders(made))


@pytest.mark.parametrize(("word", "count", "without"), [("all", 21, ""), ("train", 11, "Box"), ("test", 10, "Laptop")])
def test_categories_by_split(tmp_path: Path, word: str, count: int, without: str) -> None:
    assert main(["generate", "--out", str(tmp_path), "--categories", word, "--count", "1"]) == 0
    categories = {name.split("-")[1] for name in find_folders(tmp_path)}
    assert len(categories) == count and without not in categories


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["generate", "--out", "OUT", "--categories", "Spoon"], "Spoon"),
        (["generate", "--out", "OUT", "--count", "0"], "at least 1"),
        (["generate", "--out", "OUT", "--seed", "-1"], "seed"),
        (["preview", "OUT", "--out", "sheet.png"], "is no folder"),
        (["list", "OUT"], "is no folder"),
        (["unpack", "OUT", "--out", "OUT"], "is no file"),
        (["preview", "OUT", "--out", "sheet.jpg"], ".png"),
        (["preview", "OUT", "--out", "sheet.png", "--each", "0"], "--each"),
    ],
)
def test_mistakes(tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], says: str) -> None:
    assert main([str(tmp_path / "out") if word == "OUT" else word for word in arguments]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and says in error and error.count("\n") == 1
    assert not any(tmp_path.iterdir())
