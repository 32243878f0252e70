"""The cache of parsed objects: the same object, read anew whenever anything changed, never a broken entry."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

import numpy as np
import pytest

from fb3d_rl.assets import partnet_mobility
from fb3d_rl.assets.articulation import ArticulatedObject, Mesh
from fb3d_rl.assets.folders import find_folders
from fb3d_rl.assets.partnet_mobility import load_object, load_objects


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache."""
    monkeypatch.setenv("FB3D_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def folder(tmp_path: Path, procedural_root: Path) -> Path:
    return Path(shutil.copytree(next(procedural_root.glob("*Microwave*")), tmp_path / "m"))


@pytest.fixture
def parses(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """The objects that were parsed."""
    parsed: list[Path] = []
    read = partnet_mobility.PartNetReader.read

    def counted(self: partnet_mobility.PartNetReader) -> object:
        parsed.append(self.folder)
        return read(self)

    monkeypatch.setattr(partnet_mobility.PartNetReader, "read", counted)
    return parsed


def assert_same(a: ArticulatedObject, b: ArticulatedObject) -> None:
    """To the bit, types included."""

    def meshes(left: tuple[Mesh, ...], right: tuple[Mesh, ...]) -> None:
        for x, y in zip(left, right, strict=True):
            for p, q in ((x.vertices, y.vertices), (x.faces, y.faces)):
                assert p.dtype == q.dtype and p.shape == q.shape and p.tobytes() == q.tobytes()

    assert (a.id, a.category, a.urdf, a.dropped, a.lost) == (b.id, b.category, b.urdf, b.dropped, b.lost)
    for one, two in zip(a.links, b.links, strict=True):
        assert (one.name, one.semantic, one.parent) == (two.name, two.semantic, two.parent)
        meshes(one.visuals, two.visuals)
        meshes(one.collisions, two.collisions)
        if one.joint is None or two.joint is None:
            assert one.joint is two.joint
            continue
        assert (one.joint.name, one.joint.type, one.joint.limits) == (two.joint.name, two.joint.type, two.joint.limits)
        np.testing.assert_array_equal(one.joint.origin, two.joint.origin)
        np.testing.assert_array_equal(one.joint.axis, two.joint.axis)


def test_an_object_is_parsed_once(own: Path, folder: Path, parses: list[Path]) -> None:
    urdf = folder / "mobility.urdf"
    box = "<visual><geometry><torus/></geometry></visual>"
    urdf.write_text(urdf.read_text().replace("<visual", f"{box}<visual", 1))
    first = load_object(folder)
    moved = folder.rename(folder.with_name("elsewhere"))
    second = load_object(moved)
    assert first.lost
    assert len(parses) == 1 and second.id == "elsewhere" and second.urdf.parent == moved
    moved.rename(folder)
    assert_same(first, load_object(folder))
    assert len(list(own.rglob("*/*"))) == 1  # and no partial file


@pytest.mark.parametrize("changed", ["mobility.urdf", "semantics.txt", "mesh", "name"])
def test_whatever_changes_is_seen(own: Path, folder: Path, parses: list[Path], changed: str) -> None:
    """Also with the file's size and date as they were."""
    load_object(folder)
    meshes = sorted(folder.glob("textured_objs/*.obj"))
    if changed == "name":  # two meshes change places
        meshes[0].rename(folder / "x.obj")
        meshes[1].rename(meshes[0])
        (folder / "x.obj").rename(meshes[1])
    else:
        path = meshes[0] if changed == "mesh" else folder / changed
        text = path.read_bytes()
        place = text.index(b"v ") + 2 if changed == "mesh" else text.rindex(b"0" if b"0" in text else b"_")
        path.write_bytes(text[:place] + b"1" + text[place + 1 :])
    load_object(folder)
    assert len(parses) == 2


def test_a_broken_entry_is_made_anew(own: Path, folder: Path, parses: list[Path]) -> None:
    good = load_object(folder)
    (entry,) = own.glob("objects/*")
    content = entry.read_bytes()
    rng = np.random.default_rng(0)
    broken = [b"", content[:10], content[: len(content) // 2], content + b"\0"]
    for place in rng.integers(len(content), size=40).tolist():
        broken.append(content[:place] + bytes([content[place] ^ (1 << int(rng.integers(8)))]) + content[place + 1 :])
    for number, bad in enumerate(broken):
        entry.write_bytes(bad)
        assert_same(load_object(folder), good)
        assert len(parses) == number + 2 and entry.read_bytes() == content


def test_without_a_cache_objects_are_read_all_the_same(
    tmp_path: Path, folder: Path, parses: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("FB3D_CACHE", str(tmp_path / "file"))
    assert_same(load_object(folder), load_object(folder))
    assert len(parses) == 2


def test_a_full_disk_costs_the_cache_alone(
    own: Path,
    folder: Path,
    parses: list[Path],
    full_disk: Callable[[int], AbstractContextManager[None]],
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("FB3D_CACHE_WARNED", "")  # so that it is as before in the end
    monkeypatch.delenv("FB3D_CACHE_WARNED")
    with full_disk(1000):
        assert_same(load_object(folder), load_object(folder))
    assert len(parses) == 2
    assert not [path for path in own.rglob("*") if path.is_file()]
    said = capfd.readouterr().err.splitlines()
    assert len(said) == 1 and str(own) in said[0] and "FB3D_CACHE" in said[0], said


@pytest.mark.slow
@pytest.mark.alone
def test_real_objects_are_read_ten_times_as_fast_again(own: Path, real_root: Path, parses: list[Path]) -> None:
    folders = find_folders(real_root).values()
    begin = time.process_time()
    first, _ = load_objects(folders)
    parsing = time.process_time() - begin
    begin = time.process_time()
    again, _ = load_objects(folders)
    reading = time.process_time() - begin
    assert len(parses) == len(folders)
    for one, two in zip(first, again, strict=True):
        assert_same(one, two)
    assert reading < 0.1 * parsing, (reading, parsing)
