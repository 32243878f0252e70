"""launch/predict.py: files of any format in, the same plan out; a broken one stops no other."""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fb3d_rl
from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.camera.views import View
from fb3d_rl.models.artflownet import ArtFlowNet
from fb3d_rl.perception.files import read_cloud
from fb3d_rl.scene.posed import Posed
from launch.predict import main

NUMBERS = ("contact_point", "pull", "standoff", "precontact_point", "rotation", "quaternion")


@pytest.fixture
def seen(procedural_objects: dict[str, ArticulatedObject], request: pytest.FixtureRequest) -> tuple[Any, Any]:
    """A noisy cloud of one of the objects [N, 3] f32, and which points are on its part."""
    seed = int(getattr(request, "param", 0))
    rng = np.random.default_rng(seed)
    posed = Posed(list(procedural_objects.values())[seed % len(procedural_objects)])
    link = posed.openable[seed % len(posed.openable)]
    poses = posed.poses(posed.closed + rng.random() * (posed.opened - posed.closed))
    points, links = posed.camera.capture(poses, View(float(rng.uniform(-40, 40)), 30.0), further=False)
    rows = rng.permutation(len(points))[:2500]
    cloud = (points[rows] + rng.normal(size=(len(rows), 3)) * 0.003).astype(np.float32)
    part = np.isin(links[rows], list(posed.obj.descendants(link)))
    if not part.any():
        part[:50] = True
    return cloud, part


def write_all(folder: Path, cloud: Any, part: Any) -> list[Path]:
    """The cloud in each format."""
    np.savez(folder / "a.npz", points=cloud, mask=part)
    np.save(folder / "b.npy", np.c_[cloud, part])
    np.savetxt(folder / "c.csv", np.c_[cloud, part], delimiter=",", header="x,y,z,mask", fmt="%.9g")
    records = np.zeros(len(cloud), dtype=[(axis, "<f4") for axis in "xyz"] + [("mask", "u1")])
    for k, axis in enumerate("xyz"):
        records[axis] = cloud[:, k]
    records["mask"] = part
    properties = "".join(f"property float {axis}\n" for axis in "xyz") + "property uchar mask\n"
    header = f"element vertex {len(cloud)}\n{properties}end_header\n"
    (folder / "d.ply").write_bytes(b"ply\nformat binary_little_endian 1.0\n" + header.encode() + records.tobytes())
    lines = "\n".join(" ".join(map(str, record)) for record in records.tolist())
    (folder / "e.ply").write_text(f"ply\nformat ascii 1.0\n{header}{lines}\n")
    fields = "FIELDS x y z mask\nSIZE 4 4 4 1\nTYPE F F F U\nCOUNT 1 1 1 1\n"
    shape = f"WIDTH {len(cloud)}\nHEIGHT 1\nPOINTS {len(cloud)}\nDATA binary\n"
    (folder / "f.pcd").write_bytes((fields + shape).encode() + records.tobytes())
    return sorted(folder.glob("?.*"))


def check(folder: Path, cloud: Any, part: Any) -> None:
    net = ArtFlowNet.from_pretrained()
    expected = fb3d_rl.plan(cloud, part, model=net)
    files = [path for path in write_all(folder, cloud, part) if path.suffix != ".npy"]
    assert main([*map(str, files), f"out={folder / 'out'}"]) == 0
    for file in files:
        found = json.loads((folder / "out" / f"{file.stem}.json").read_text())
        for name in NUMBERS:
            np.testing.assert_allclose(found["hypotheses"][0][name], getattr(expected, name), atol=1e-6)
        arrays = np.load(folder / "out" / f"{file.stem}.npz")
        np.testing.assert_allclose(arrays["flow"], expected.flow, atol=1e-6)
        again = read_cloud(folder / "out" / f"{file.stem}.flow.ply")
        np.testing.assert_array_equal(again.points, arrays["points"])
        assert again.mask is not None and again.mask.tolist() == part.tolist()


def test_every_format_gives_the_plan_that_python_gives(tmp_path: Path, seen: tuple[Any, Any]) -> None:
    check(tmp_path, *seen)


@pytest.mark.slow
@pytest.mark.parametrize("seen", range(1, 20), indirect=True)
def test_so_it_is_for_many_clouds(tmp_path: Path, seen: tuple[Any, Any]) -> None:
    check(tmp_path, *seen)


def test_a_broken_cloud_stops_no_other(
    tmp_path: Path, seen: tuple[Any, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    cloud, part = seen
    np.savez(tmp_path / "good.npz", points=1000 * cloud)
    (tmp_path / "broken.ply").write_bytes(b"ply\n")
    box = ",".join(f"{x:.4f}" for x in (*cloud[part].min(0), *cloud[part].max(0)))
    words = [str(tmp_path / name) for name in ("broken.ply", "good.npz", "missing.pcd")]
    assert main([*words, f"out={tmp_path / 'out'}", f"mask=box:{box}"]) == 2
    said = capsys.readouterr()
    assert said.out.startswith(f"{words[1]}: touch (") and said.out.count("\n") == 1 and "millimetres" in said.out
    assert [line.split()[0] for line in said.err.splitlines()] == ["error:"] * 2
    assert "broken.ply" in said.err and "missing.pcd" in said.err
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        "good.flow.ply", "good.html", "good.json", "good.npz"
    ]  # fmt: skip
    page = (tmp_path / "out" / "good.html").read_text()
    assert "How to open good.npz" in page and "hypothesis-1" in page and "http-equiv" in page and "mask=box:" in page


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["out=x"], "no cloud"), (["a.npy", "colour=red"], "colour= is unknown"), (["a.npy", "tilt=much"], "tilt=much"),
        (["a.npy", "up=1,2"], "3 numbers"), (["a.npy", "scale=-1"], "scale=-1"),
        (["a.npy", "foreground=no"], "true, false"), (["a.npy", "camera=here"], "camera=here"),
        (["a.npy", "checkpoint=nowhere.pt"], "nowhere.pt"),
        (["a.npy", "out=a.npy"], "is a file"), (["a.npy", "mask=nothing"], "mask=nothing"),
    ],
)  # fmt: skip
def test_mistakes_are_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], words: list[str], says: str
) -> None:
    monkeypatch.chdir(tmp_path)
    np.save("a.npy", np.random.default_rng(0).random((50, 3)))
    assert main(words) == 2
    said = capsys.readouterr().err
    assert says in said and said.startswith("error: ") and said.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["a.npy"], "nothing is written"


HUGE = """
import resource, sys, time
import numpy as np
rng = np.random.default_rng(0)
box = rng.uniform(-0.5, 0.5, (10_000_000, 3)).astype("f4")
box[np.arange(len(box)), rng.integers(3, size=len(box))] = -0.5
np.savez("a.npz", points=box, mask=box[:, 1] > 0)
records = np.zeros(len(box), dtype=[(axis, "<f4") for axis in "xyz"] + [("mask", "u1")])
for k, axis in enumerate("xyz"):
    records[axis] = box[:, k]
records["mask"] = box[:, 1] > 0
lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(box)}",
         *(f"property float {axis}" for axis in "xyz"), "property uchar mask", "end_header", ""]
with open("b.ply", "wb") as file:
    file.write("\\n".join(lines).encode())
    file.write(records.data.cast("B"))
"""


@pytest.mark.slow
@pytest.mark.alone
def test_ten_million_points_as_a_whole_command(tmp_path: Path) -> None:
    """In less than 10 s and 4 GiB, counted in processor time, since other programs may run beside it."""
    subprocess.run([sys.executable, "-c", HUGE], cwd=tmp_path, check=True)
    command = [sys.executable, str(Path(main.__code__.co_filename)), f"out={tmp_path / 'out'}"]
    for file in ("a.npz", "b.ply"):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run([*command, str(tmp_path / file)], check=True, env=os.environ | {"OMP_NUM_THREADS": "1"})
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        assert after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime < 10
        assert after.ru_maxrss < 4 * 2**20
    first, second = (np.load(tmp_path / "out" / f"{name}.npz") for name in "ab")
    assert np.array_equal(first["flow"], second["flow"]) and len(first["flow"]) == 10_000_000
