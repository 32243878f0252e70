"""Archives from strangers: what they hold lies in the target, which is whole or not there."""

from __future__ import annotations

import io
import tarfile
import zipfile
from pathlib import Path

import numpy as np
import pytest

from fb3d_rl.assets import archive as module
from fb3d_rl.assets.archive import unpack
from fb3d_rl.errors import UserError

NAMES = ("../out.txt", "a/../../out.txt", "..\\out.txt", "good/1/mobility.urdf")


def files(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if not path.is_dir()}


def as_zip(path: Path, names: tuple[str, ...]) -> Path:
    with zipfile.ZipFile(path, "w") as file:
        for name in names:
            file.writestr(name, "text")
    return path


def as_tar(path: Path, *entries: tarfile.TarInfo) -> Path:
    with tarfile.open(path, "w:gz") as file:
        for entry in entries:
            entry.size = 4 if entry.isreg() else 0
            file.addfile(entry, io.BytesIO(b"text"))
    return path


def link(name: str, to: str, kind: bytes = tarfile.SYMTYPE) -> tarfile.TarInfo:
    entry = tarfile.TarInfo(name)
    entry.type, entry.linkname = kind, to
    return entry


def test_good_archives_are_unpacked(tmp_path: Path) -> None:
    seen: list[int] = []
    unpack(as_zip(tmp_path / "a.zip", ("x/1/a.txt", "b.txt")), tmp_path / "new/zip", seen.append)
    assert files(tmp_path / "new") == {"zip/x/1/a.txt", "zip/b.txt"} and sum(seen) == 8
    unpack(as_tar(tmp_path / "a.tar.gz", tarfile.TarInfo("x/1/a.txt"), link("x/b.txt", "1/a.txt")), tmp_path / "tar")
    assert files(tmp_path / "tar") == {"x/1/a.txt", "x/b.txt"}


def test_nothing_of_a_zip_leaves_the_target(tmp_path: Path) -> None:
    absolute = tmp_path / "absolute.txt"
    unpack(as_zip(tmp_path / "a.zip", (*NAMES, str(absolute))), tmp_path / "below/out")
    assert not absolute.exists()
    assert {path.name for path in tmp_path.iterdir()} == {"a.zip", "below"}
    assert [path.name for path in (tmp_path / "below").iterdir()] == ["out"]
    assert "good/1/mobility.urdf" in files(tmp_path / "below/out")


@pytest.mark.parametrize(
    "entries",
    [
        [tarfile.TarInfo("../out.txt")],
        [tarfile.TarInfo("a/../../out.txt")],
        [link("a", "/etc/passwd")],
        [link("a", "../.."), tarfile.TarInfo("a/out.txt")],
        [link("a", "../secret", tarfile.LNKTYPE)],
        [link("a", "", tarfile.FIFOTYPE)],
    ],
)
def test_tars_that_leave_the_target_are_refused(tmp_path: Path, entries: list[tarfile.TarInfo]) -> None:
    path = as_tar(tmp_path / "a.tar.gz", tarfile.TarInfo("good.txt"), *entries)
    with pytest.raises(UserError, match="cannot be unpacked"):
        unpack(path, tmp_path / "below/out")
    assert {path.name for path in tmp_path.iterdir()} == {"a.tar.gz", "below"}
    assert not any((tmp_path / "below").iterdir())


def test_damaged_archives_end_in_one_sentence(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for good in (as_zip(tmp_path / "a.zip", ("x/1/a.txt",)), as_tar(tmp_path / "a.tar.gz", tarfile.TarInfo("a.txt"))):
        content, refused = good.read_bytes(), 0
        for number in range(60):
            place = int(rng.integers(len(content)))
            cut = content[:place] if number % 3 == 0 else content[:place] + rng.bytes(1) + content[place + 1 :]
            good.write_bytes(cut)
            out = tmp_path / f"{good.name}{number}"
            try:
                unpack(good, out)
            except UserError as error:
                assert str(good) in str(error) and not out.exists()
                refused += 1
        assert 20 <= refused < 60, "a cut archive is always refused, a changed date does no harm"


def test_what_does_not_fit_or_is_in_the_way_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = as_zip(tmp_path / "a.zip", (*NAMES, "more.txt"))
    with pytest.raises(UserError, match="exists"):
        unpack(path, tmp_path)
    with pytest.raises(UserError, match="no file"):
        unpack(tmp_path / "nowhere.zip", tmp_path / "out")
    usage = module.shutil.disk_usage(tmp_path)
    monkeypatch.setattr(module.shutil, "disk_usage", lambda _: usage._replace(free=19))
    for bad in (path, as_tar(tmp_path / "a.tar.gz", *(tarfile.TarInfo(f"{k}.txt") for k in range(5)))):
        with pytest.raises(UserError, match="free"):
            unpack(bad, tmp_path / "out")
    assert not (tmp_path / "out").exists()
