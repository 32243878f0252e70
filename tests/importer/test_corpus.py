"""A folder of URDFs as people write them, half of them broken: imported by one command, and changed at random."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from fb3d_rl.assets.partnet_mobility import load_object
from fb3d_rl.errors import UserError
from fb3d_rl.importer.files import find_files
from fb3d_rl.importer.frames import Frame
from fb3d_rl.importer.reading import read_file
from fb3d_rl.kinematics.tree import KinematicTree
from launch.objects import main
from tests.assets import test_urdf as urdfs
from tests.assets.test_urdf import BROKEN, DOOR, FORMATS, LIMITS, NAMED, SCALES, SHAPES, geometry, mesh, robot, written

from .test_files import assert_same, cupboard


def good() -> Iterator[tuple[str, dict[str, bytes]]]:
    """URDFs that can be read, each with its files; FOLDER is theirs."""
    solid = {"a.obj": written("obj")["a.obj"]}
    for kind in FORMATS:
        if kind in trimesh.available_formats():
            yield robot(mesh(f"a.{kind}")), written(kind)
    for shape, _ in SHAPES:
        yield robot(geometry(shape, origin='<origin xyz="1 2 3" rpy="0.1 0.2 0.3"/>')), {}
    for name, file in NAMED:
        yield robot(mesh(name)), {file: solid["a.obj"]}
    for scale in SCALES:
        yield robot(mesh("a.obj", f'scale="{scale}"')), solid
    for kind, limit, _ in LIMITS:
        yield robot(hinge=DOOR.replace("revolute", kind).replace('<limit lower="0" upper="1.5"/>', limit)), {}
    for tag in ("visual", "collision"):
        yield robot(geometry('<mesh filename="a.obj"/>', (tag,))), solid
    for kind in ("planar", "floating", "continuous"):
        yield robot(hinge=DOOR.replace("revolute", kind)), {}
    yield robot(more='<link name="world"/>'), {}
    yield urdfs.RICH, solid


def test_a_folder_of_all_kinds_is_imported_by_one_command(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """What can be read is written as the folder of the same object; of each of the others there is one sentence."""
    monkeypatch.setenv("COLUMNS", "400")
    whole, broken = list(good()), [urdf for urdf, _ in BROKEN]
    assert len(whole) >= 45 and len(broken) >= 30
    for number, (urdf, files) in enumerate(whole):
        folder = tmp_path / f"in/good{number}/my_cab"
        text = urdf.replace("FOLDER", folder.as_posix()).encode()
        for name, content in {f"good{number}.urdf": text, **files}.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(content)
    for number, urdf in enumerate(broken):
        (tmp_path / f"in/broken{number}").mkdir()
        (tmp_path / f"in/broken{number}/broken{number}.urdf").write_text(urdf)
        (tmp_path / f"in/broken{number}/a.obj").write_bytes(written("obj")["a.obj"])
    command = ["import", str(tmp_path / "in"), "--out", str(tmp_path / "out"), "--scale", "m", "--front", "-x"]
    assert main(command) == 1
    said = capsys.readouterr().out
    assert f"{len(whole)} objects" in said and f"{len(broken)} cannot be used" in said
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == sorted(f"good{k}" for k in range(len(whole)))
    for number in range(len(whole)):
        folder = tmp_path / f"in/good{number}/my_cab"
        (folder / f"good{number}.urdf").rename(folder / "mobility.urdf")
        (folder / "semantics.txt").write_text("")
        imported, direct = load_object(tmp_path / f"out/good{number}"), load_object(folder)
        assert_same(imported, direct)
        remarks = json.loads((tmp_path / f"out/good{number}/meta.json").read_text())["remarks"]
        assert remarks == list(direct.dropped)


def fuzz(folder: Path, seed: int, count: int) -> None:
    """Read changed files in recognised units and axes: an object that stands and opens, or one sentence."""
    rng = np.random.default_rng(seed)
    sources = [urdfs.RICH, cupboard(), cupboard(1000.0), cupboard(100.0)]
    read = 0
    folder.mkdir()
    (folder / "a.obj").write_bytes(written("obj")["a.obj"])
    for k in range(count):
        path = folder / "a.urdf"
        path.write_bytes(urdfs.mutated(rng, sources[k % len(sources)].encode()))
        try:
            [source] = find_files(path)
            obj = read_file(source, Frame(up="y" if k % 3 == 0 else "z"))
        except UserError as error:
            assert "a" in str(error) and "\n" not in str(error)
            continue
        read += 1
        assert KinematicTree.from_object(obj).forward(torch.zeros(len(obj.movable))).isfinite().all()
        for link in obj.links:
            assert all(math.isfinite(float(np.abs(each.vertices).max(initial=0.0))) for each in link.visuals)
    assert count // 20 < read < count


def test_changed_files_end_in_an_object_or_a_sentence(tmp_path: Path) -> None:
    fuzz(tmp_path / "in", 0, 200)


@pytest.mark.parametrize("kind", FORMATS)
def test_a_changed_mesh_ends_in_an_object_or_a_sentence(tmp_path: Path, kind: str) -> None:
    if kind not in trimesh.available_formats():
        pytest.skip(f"trimesh reads no .{kind} here")
    rng, files = np.random.default_rng(0), written(kind)
    for _ in range(60):
        name = list(files)[rng.integers(len(files))]
        content = bytearray(files[name])
        for at in rng.integers(len(content), size=rng.integers(1, 6)):
            content[at : at + rng.integers(3)] = rng.bytes(rng.integers(3))
        folder = urdfs.put(tmp_path / "a17", robot(mesh(f"a.{kind}")), {**files, name: bytes(content)})
        try:
            obj = load_object(folder)
        except UserError as error:
            assert "a17" in str(error) and "\n" not in str(error)
            continue
        assert all(np.isfinite(each.vertices).all() for link in obj.links for each in link.visuals)


@pytest.mark.slow
def test_many_changed_files_end_in_an_object_or_a_sentence(tmp_path: Path) -> None:
    fuzz(tmp_path / "in", 1, 2000)
