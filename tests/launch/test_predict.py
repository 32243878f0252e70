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
from PIL import Image

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


def write_all(folder: Path, cloud: Any, part: Any) -> dict[Path, str]:
    """The cloud in each format, and what to give as ``mask=`` ("": nothing)."""
    rows = np.c_[cloud, part]
    np.savez(folder / "a.npz", points=cloud, mask=part)
    np.save(folder / "b.npy", cloud)
    np.save(folder / "mask.npy", part)
    np.savetxt(folder / "c.csv", rows, delimiter=",", header="x,y,z,mask", fmt="%.9g")
    np.savetxt(folder / "g.xyz", rows, fmt="%.9g")
    records = np.zeros(len(cloud), dtype=[(axis, "<f4") for axis in "xyz"] + [("mask", "u1")])
    for k, axis in enumerate("xyz"):
        records[axis] = cloud[:, k]
    records["mask"] = part
    properties = "".join(f"property float {axis}\n" for axis in "xyz") + "property uchar mask\n"
    header = f"element vertex {len(cloud)}\n{properties}end_header\n"
    (folder / "d.ply").write_bytes(b"ply\nformat binary_little_endian 1.0\n" + header.encode() + records.tobytes())
    lines = "\n".join(" ".join(map(str, record)) for record in records.tolist()) + "\n"
    (folder / "e.ply").write_text(f"ply\nformat ascii 1.0\n{header}{lines}")
    fields = "FIELDS x y z mask\nSIZE 4 4 4 1\nTYPE F F F U\nCOUNT 1 1 1 1\n"
    fields += f"WIDTH {len(cloud)}\nHEIGHT 1\nPOINTS {len(cloud)}\nDATA "
    columns = b"".join(records[name].tobytes() for name in records.dtype.names)
    plain = b"".join(bytes([len(piece) - 1]) + piece for piece in pieces(columns, 32))  # LZF without repetitions
    sizes = np.array([len(plain), len(columns)], "<u4").tobytes()
    (folder / "f.pcd").write_bytes(f"{fields}binary\n".encode() + records.tobytes())
    (folder / "h.pcd").write_bytes(f"{fields}ascii\n{lines}".encode())
    (folder / "i.pcd").write_bytes(f"{fields}binary_compressed\n".encode() + sizes + plain)
    masks = {"b.npy": str(folder / "mask.npy"), "g.xyz": "column3"}
    return {path: masks.get(path.name, "") for path in sorted(folder.glob("?.*"))}


def pieces(data: bytes, size: int) -> list[bytes]:
    return [data[start : start + size] for start in range(0, len(data), size)]


def check(folder: Path, cloud: Any, part: Any) -> None:
    net = ArtFlowNet.from_pretrained()
    expected = fb3d_rl.plan(cloud, part, model=net)
    files = write_all(folder, cloud, part)
    assert len(files) == 9
    for mask in {*files.values()}:
        alike = [str(path) for path, needed in files.items() if needed == mask]
        assert main([*alike, f"out={folder / 'out'}", *([f"mask={mask}"] if mask else [])]) == 0
    for file in files:
        assert_planned(folder / "out" / file.stem, expected)
        again = read_cloud(folder / "out" / f"{file.stem}.flow.ply")
        np.testing.assert_array_equal(again.points, np.load(folder / "out" / f"{file.stem}.npz")["points"])
        assert again.mask is not None and again.mask.tolist() == part.tolist()


def assert_planned(name: Path, expected: fb3d_rl.Plan, atol: float = 1e-6) -> None:
    """The files of this name hold the plan."""
    found = json.loads(name.with_suffix(".json").read_text())
    for key in NUMBERS:
        np.testing.assert_allclose(found["hypotheses"][0][key], getattr(expected, key), atol=atol)
    np.testing.assert_allclose(np.load(name.with_suffix(".npz"))["flow"], expected.flow, atol=atol)


def check_depth(folder: Path, posed: Posed, link: int, view: View, seed: int) -> None:
    """A depth image, its mask, its camera's intrinsics and pose give the plan of the points that were rounded."""
    rng = np.random.default_rng(seed)
    poses = posed.poses(posed.closed + 0.3 * (posed.opened - posed.closed))
    points, links = posed.camera.capture(poses, view, further=False)
    pose, size, focal, per_metre = posed.camera.pose(view), 192, 260.0, 10000
    seen = (points - pose[:3, 3]) @ pose[:3, :3]
    u, v = (np.round(focal * seen[:, k] / seen[:, 2] + 95.5).astype(int) for k in range(2))
    depth, marked = np.zeros((size, size), np.uint16), np.zeros((size, size), np.uint8)
    depth[v, u] = np.round(per_metre * (seen[:, 2] + 0.003 * rng.normal(size=len(seen))))
    marked[v, u] = np.isin(links, list(posed.obj.descendants(link)))
    Image.fromarray(depth).save(folder / "depth.png")
    Image.fromarray(marked).save(folder / "mask.png")
    camera = {"fx": focal, "fy": focal, "cx": 95.5, "cy": 95.5, "depth_scale": per_metre}
    (folder / "depth.json").write_text(json.dumps(camera))
    np.savetxt(folder / "pose.txt", pose)
    given = [f"mask={folder / 'mask.png'}", f"camera={folder / 'pose.txt'}", f"out={folder / 'out'}"]
    assert main([str(folder / "depth.png"), *given]) == 0
    v, u = depth.nonzero()
    z = (depth[v, u] / per_metre).astype(np.float64)
    cloud = np.c_[(u - 95.5) / focal * z, (v - 95.5) / focal * z, z] @ pose[:3, :3].T + pose[:3, 3]
    # The file's points are float32 in the camera's frame.
    assert_planned(folder / "out/depth", fb3d_rl.plan(cloud, marked[v, u] > 0, pose), atol=2e-5)


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 20))])
def test_a_depth_image_gives_the_plan_of_its_points(
    tmp_path: Path, procedural_objects: dict[str, ArticulatedObject], seed: int
) -> None:
    posed = Posed(list(procedural_objects.values())[seed % len(procedural_objects)])
    view = View(float(np.random.default_rng(seed).uniform(-40, 40)), 30.0)
    check_depth(tmp_path, posed, posed.openable[seed % len(posed.openable)], view, seed)


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
