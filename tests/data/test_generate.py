"""Sets of samples: the same whoever draws them, reused only if finished and made from the same recipe."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path

import pytest
import torch
from tensordict import TensorDictBase

from fb3d_rl import contract
from fb3d_rl.assets.partnet_mobility import load_object
from fb3d_rl.camera.raycast import CameraOptions
from fb3d_rl.data.generate import DONE, generate_samples, load_samples
from fb3d_rl.data.samples import SampleOptions
from fb3d_rl.errors import UserError

OPTIONS = SampleOptions(points=256, camera=CameraOptions(resolution=32))
COUNT = 11


@pytest.fixture(scope="module")
def folders(procedural_root: Path) -> list[Path]:
    return sorted(procedural_root.iterdir())


def draw(
    out: Path, folders: list[Path], seed: int = 0, options: SampleOptions = OPTIONS, workers: int = 0
) -> TensorDictBase:
    return generate_samples(out, folders, COUNT, seed, options, workers)


def same(a: TensorDictBase, b: TensorDictBase) -> bool:
    return bool((a.contiguous() == b.contiguous()).all())


def test_rows_keep_the_contract_and_objects_take_turns(tmp_path: Path, folders: list[Path]) -> None:
    calls: list[int] = []
    rows = generate_samples(tmp_path / "s", folders, COUNT, 0, OPTIONS, 0, calls.append)
    assert rows.batch_size == torch.Size([COUNT])
    contract.check(rows, "sample")
    counts = torch.bincount(rows["object"], minlength=len(folders))
    assert counts.max() - counts.min() <= 1
    assert calls == sorted(calls) and calls[-1] == COUNT
    for row in rows:
        norm = row["privileged", "flow"].norm(dim=-1)
        assert norm.max() == pytest.approx(1.0, abs=1e-6)
        assert torch.equal(row["observation", "part_mask"], norm > 1e-4)
        links = load_object(folders[int(row["object"])]).links
        assert int(row["target"]) == -1 or links[int(row["target"])].joint is not None


def test_a_folder_that_is_listed_twice_is_drawn_twice_as_often(tmp_path: Path, folders: list[Path]) -> None:
    rows = generate_samples(tmp_path / "s", [folders[0], folders[1], folders[0]], 12, 0, OPTIONS, 0)
    assert torch.bincount(rows["object"]).tolist() == [8, 4]
    for row in rows:
        assert int(row["target"]) < len(load_object(folders[int(row["object"])]).links)
    assert not torch.equal(rows[0]["observation", "points"], rows[1]["observation", "points"])


def test_rows_follow_from_the_seed(tmp_path: Path, folders: list[Path]) -> None:
    first, again = draw(tmp_path / "a", folders), draw(tmp_path / "b", folders)
    other = draw(tmp_path / "c", folders, seed=1)
    assert same(first, again)
    assert not torch.equal(first["observation", "points"], other["observation", "points"])


@pytest.mark.slow
def test_workers_make_no_difference(tmp_path: Path, folders: list[Path]) -> None:
    assert same(draw(tmp_path / "a", folders, workers=0), draw(tmp_path / "b", folders, workers=2))


def test_a_finished_set_is_reused(tmp_path: Path, folders: list[Path]) -> None:
    rows = draw(tmp_path / "s", folders)
    rows["observation", "points"][0] = 42.0  # a mark in the file, which only a new drawing would remove
    again = draw(tmp_path / "s", folders)
    assert (again["observation", "points"][0] == 42.0).all()


@pytest.mark.parametrize("change", ["points", "camera", "seed", "folders", "count"])
def test_another_recipe_never_removes_a_finished_set(tmp_path: Path, folders: list[Path], change: str) -> None:
    out = tmp_path / "s"
    kept = draw(out, folders).clone()
    options, seed, chosen, count = OPTIONS, 0, folders, COUNT
    if change == "points":
        options = dataclasses.replace(OPTIONS, points=200)
    elif change == "camera":
        options = dataclasses.replace(OPTIONS, camera=CameraOptions(resolution=24))
    elif change == "seed":
        seed = 1
    elif change == "folders":
        chosen = folders[:2]
    else:
        count = COUNT + 1
    key = {"points": "options", "camera": "options", "folders": "objects"}.get(change, change)
    with pytest.raises(UserError, match=f"with other {key};"):
        generate_samples(out, chosen, count, seed, options, 0)
    assert same(load_samples(out), kept)
    rows = generate_samples(tmp_path / "fresh", chosen, count, seed, options, 0)
    assert rows["observation", "points"].shape == (count, options.points, 3)


def test_a_set_is_known_by_the_content_of_its_objects_wherever_they_lie(tmp_path: Path, folders: list[Path]) -> None:
    rows = draw(tmp_path / "s", folders)
    rows["observation", "points"][0] = 42.0
    moved = [Path(shutil.copytree(folder, tmp_path / "moved" / folder.name)) for folder in folders]
    assert (draw(tmp_path / "s", moved)["observation", "points"][0] == 42.0).all()
    urdf = moved[0] / "mobility.urdf"
    urdf.write_text(urdf.read_text() + "\n")
    with pytest.raises(UserError, match="with other objects"):
        draw(tmp_path / "s", moved)


def test_a_half_written_set_is_drawn_anew(tmp_path: Path, folders: list[Path]) -> None:
    expected = draw(tmp_path / "whole", folders).clone()
    rows = draw(tmp_path / "half", folders)
    rows["observation", "points"][5:] = 0.0
    (tmp_path / "half" / DONE).unlink()
    assert same(draw(tmp_path / "half", folders), expected)
    assert (tmp_path / "half" / DONE).is_file()


@pytest.fixture
def block(tmp_path: Path, folders: list[Path]) -> Path:
    """An object whose joints are all fixed."""
    folder = tmp_path / "block"
    folder.mkdir()
    shutil.copytree(folders[0] / "textured_objs", folder / "textured_objs")
    urdf = (folders[0] / "mobility.urdf").read_text()
    (folder / "mobility.urdf").write_text(urdf.replace('"revolute"', '"fixed"').replace('"prismatic"', '"fixed"'))
    return folder


def test_rows_of_objects_that_show_nothing_are_copies_of_others(
    tmp_path: Path, folders: list[Path], block: Path
) -> None:
    rows = draw(tmp_path / "s", [block, *folders[:1]])
    contract.check(rows, "sample")
    assert (rows["object"] == 1).all()
    assert (rows["privileged", "flow"].norm(dim=-1).amax(-1) > 0.99).all()
    distinct = {row["observation", "points"].numpy().tobytes() for row in rows}
    assert len(distinct) == COUNT // 2
    done = json.loads((tmp_path / "s" / DONE).read_text())
    assert done["refilled"] == COUNT - COUNT // 2


def test_nothing_to_open_is_refused_and_leaves_no_finished_set(tmp_path: Path, block: Path) -> None:
    with pytest.raises(UserError, match="can be opened"):
        draw(tmp_path / "s", [block])
    assert not (tmp_path / "s" / DONE).exists()


def cut(file: Path, share: float) -> None:
    content = file.read_bytes()
    file.write_bytes(content[: int(share * len(content))])


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_a_set_that_was_cut_is_refused_and_drawn_anew(tmp_path: Path, folders: list[Path], share: float) -> None:
    whole = draw(tmp_path / "whole", folders).clone()
    names = sorted(path.relative_to(tmp_path / "whole") for path in (tmp_path / "whole").rglob("*") if path.is_file())
    assert len(names) > 6
    for k, name in enumerate(names):
        out = tmp_path / str(k)
        shutil.copytree(tmp_path / "whole", out)
        cut(out / name, share)
        if name.name != DONE:  # of which only that it is there is asked
            with pytest.raises(UserError, match=f"{out} are damaged"):
                load_samples(out)
            (out / name).unlink()
            with pytest.raises(UserError, match=f"{out} are damaged"):
                load_samples(out)
        assert same(draw(out, folders), whole)
        assert same(load_samples(out), whole)
