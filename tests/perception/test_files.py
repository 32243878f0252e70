"""Every format gives the same cloud; what is broken ends in one sentence that names the file."""

from __future__ import annotations

import json
import struct
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from fb3d_rl.errors import UserError
from fb3d_rl.perception.files import read_cloud
from fb3d_rl.perception.records import unpack_lzf

RNG = np.random.default_rng(0)
POINTS = RNG.uniform(-1, 1, (60, 3)).astype(np.float32)
PART = POINTS[:, 2] > 0


def _records(order: str, float_: str = "f4") -> NDArray[Any]:
    kinds = [("red", "u1"), ("x", order + float_), ("y", order + float_), ("z", order + float_), ("mask", order + "i4")]
    records = np.zeros(len(POINTS), dtype=kinds)
    for k, axis in enumerate("xyz"):
        records[axis] = POINTS[:, k]
    records["mask"] = PART
    return records


def ply(form: str, float_: str = "f4", line: str = "\n") -> bytes:
    records = _records(">" if "big" in form else "<", float_)
    kind = {"f4": "float", "f8": "double"}[float_]
    header = ["ply", f"format {form} 1.0", "comment a scan", f"element vertex {len(POINTS)}", "property uchar red"]
    header += [f"property {kind} {axis}" for axis in "xyz"] + ["property int mask", "element face 1"]
    header += ["property list uchar int vertex_indices", "end_header", ""]
    face = b"\x03" + np.arange(3, dtype=">i4" if "big" in form else "<i4").tobytes()
    body = records.tobytes() + face
    if form == "ascii":
        lines = [" ".join(str(value) for value in record.tolist()) for record in records]
        body = (line.join([*lines, "3 0 1 2"]) + line).encode()
    return line.join(header).encode() + body


def pack_lzf(data: bytes) -> bytes:
    """Literals and, where the byte before repeats, a back reference."""
    out, i = bytearray(), 0
    while i < len(data):
        run = 0
        while i > 0 and run < 264 and i + run < len(data) and data[i + run] == data[i - 1]:
            run += 1
        if run >= 9:
            out += bytes([7 << 5, run - 9, 0])
            i += run
        elif run >= 3:
            out += bytes([(run - 2) << 5, 0])
            i += run
        else:
            out += bytes([0, data[i]])
            i += 1
    return bytes(out)


def pcd(form: str, viewpoint: str = "0 0 0 1 0 0 0") -> bytes:
    records = np.zeros(len(POINTS), dtype=[(a, "<f4") for a in "xyz"] + [("_", "u1", (4,)), ("mask", "<u2")])
    for k, axis in enumerate("xyz"):
        records[axis] = POINTS[:, k]
    records["mask"] = PART
    header = f"# .PCD v.7\nVERSION .7\nFIELDS x y z _ mask\nSIZE 4 4 4 1 2\nTYPE F F F U U\nCOUNT 1 1 1 4 1\n"  # noqa: F541
    header += f"WIDTH 10\nHEIGHT {len(POINTS) // 10}\nVIEWPOINT {viewpoint}\nPOINTS {len(POINTS)}\nDATA {form}\n"
    if form == "ascii":
        rows = [
            f"{x!r} {y!r}  {z!r} 0 0 0 0 {m}" for (x, y, z), m in zip(POINTS.tolist(), PART.astype(int), strict=True)
        ]
        return (header + "\n".join(rows) + "\n").encode()
    if form == "binary":
        return header.encode() + records.tobytes()
    columns = b"".join(np.ascontiguousarray(records[name].T).tobytes() for name in records.dtype.names or ())
    packed = pack_lzf(columns)
    return header.encode() + struct.pack("<II", len(packed), len(columns)) + packed


def _npy(**arrays: NDArray[Any]) -> bytes:
    import io

    out = io.BytesIO()
    if "only" in arrays:
        np.save(out, arrays["only"])
    else:
        np.savez(out, **arrays)
    return out.getvalue()


def _rows(split: str, head: str = "") -> bytes:
    rows = [split.join([*map(repr, xyz), str(int(m))]) for xyz, m in zip(POINTS.tolist(), PART, strict=True)]
    return (head + "\n".join(rows) + "\n").encode()


FORMATS: dict[str, tuple[str, bytes]] = {
    "ply ascii": ("a.ply", ply("ascii")),
    "ply ascii, Windows": ("a.ply", ply("ascii", line="\r\n")),
    "ply little": ("a.PLY", ply("binary_little_endian")),
    "ply big, double": ("a.ply", ply("binary_big_endian", "f8")),
    "pcd ascii": ("a.pcd", pcd("ascii")),
    "pcd binary": ("a.pcd", pcd("binary")),
    "pcd compressed": ("a.pcd", pcd("binary_compressed")),
    "npz": ("a.npz", _npy(points=POINTS, part_mask=PART)),
    "npz organised": ("a.npz", _npy(xyz=POINTS.reshape(6, 10, 3), mask=PART.reshape(6, 10))),
    "npy fields": ("a.npy", _npy(only=_records(">"))),
    "xyz": ("a.xyz", _rows(" ")),
    "csv": ("a.csv", _rows(",", "X,Y,Z,mask\n")),
    "txt": ("a.txt", _rows("\t", "# x y z mask\n")),
}


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_gives_the_same_cloud(tmp_path: Path, name: str) -> None:
    file, content = FORMATS[name]
    (tmp_path / file).write_bytes(content)
    cloud = read_cloud(tmp_path / file, mask="column3" if name == "xyz" else None)
    np.testing.assert_array_equal(cloud.points.astype(np.float32), POINTS)
    assert cloud.mask is not None and cloud.mask.tolist() == PART.tolist()
    assert not cloud.remarks and cloud.total == 60 and cloud.camera is None and not cloud.optical


@pytest.mark.parametrize(
    "name", ["ply ascii", "ply little", "ply big, double", "pcd ascii", "pcd binary", "pcd compressed"]
)
def test_other_readers_find_the_same(tmp_path: Path, name: str) -> None:
    file, content = FORMATS[name]
    path = tmp_path / file.lower()
    path.write_bytes(content.replace(b"  ", b" ") if "ascii" in name else content)  # pypcd4 takes single spaces only
    if path.suffix == ".ply":
        import trimesh

        vertices = trimesh.load(path, process=False).vertices
    else:
        vertices = pytest.importorskip("pypcd4").PointCloud.from_path(path).numpy(("x", "y", "z"))
    np.testing.assert_allclose(read_cloud(path).points, np.asarray(vertices)[:60], atol=1e-6)


def test_millimetres_zeros_and_marks_are_recognised(tmp_path: Path) -> None:
    points = POINTS * 1000
    points[3], points[5], points[7] = 0, np.nan, 1e30
    np.save(tmp_path / "a.npy", points)
    cloud = read_cloud(tmp_path / "a.npy")
    keep = np.setdiff1d(np.arange(60), [3, 5, 7])
    np.testing.assert_allclose(cloud.points, POINTS[keep], rtol=1e-6)
    assert cloud.rows.tolist() == keep.tolist() and "3 of 60" in cloud.remarks[0] and "millimetres" in cloud.remarks[1]
    assert len(read_cloud(tmp_path / "a.npy", scale=1).remarks) == 1
    np.testing.assert_allclose(read_cloud(tmp_path / "a.npy", scale=0.01).points, 10 * POINTS[keep], rtol=1e-6)


def test_masks_by_field_id_box_and_file(tmp_path: Path) -> None:
    label = np.where(PART, 7, 2)
    np.savez(tmp_path / "a.npz", points=POINTS, label=label)
    np.save(tmp_path / "other.npy", np.where(PART, 0.9, 0.2))
    np.savetxt(tmp_path / "other.txt", PART)
    file = tmp_path / "a.npz"
    for mask in ("label:7", str(tmp_path / "other.npy"), str(tmp_path / "other.txt"), "box:-2,-2,0,2,2,2"):
        marked = read_cloud(file, mask).mask
        assert marked is not None and marked.tolist() == PART.tolist(), mask
    assert read_cloud(file).mask is None
    for mask, word in (
        ("label", "ids 2, 7"), ("label:1", "no point"), ("nothing", "label"), ("box:1,2", "two opposite"),
        ("box:5,5,5,6,6,6", "reaches from"), ("label:x", "number"), (str(file), "nothing"),
    ):  # fmt: skip
        with pytest.raises(UserError, match=word if word != "nothing" else "."):
            read_cloud(file, mask)


def test_the_viewpoint_of_a_pcd_is_the_camera(tmp_path: Path) -> None:
    (tmp_path / "a.pcd").write_bytes(pcd("binary", "1 2 3 1 0 0 0"))
    camera = read_cloud(tmp_path / "a.pcd").camera
    assert camera is not None and camera.tolist() == [1, 2, 3]


K = {"fx": 50.0, "fy": 40.0, "cx": 15.5, "cy": 11.5}
MATRIX = [50.0, 0, 15.5, 0, 40.0, 11.5, 0, 0, 1]
OPENCV = "%YAML:1.0\n---\nK: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: " + str(MATRIX)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.json", json.dumps(K)),
        ("intrinsics.json", json.dumps({"color": K | {"width": 32, "height": 24}})),
        ("intrinsics.yaml", OPENCV),
        ("a.yaml", "camera_matrix:\n  rows: 3\n  cols: 3\n  data: " + str(MATRIX)),
        ("camera.json", json.dumps({"intrinsic_matrix": np.reshape(MATRIX, (3, 3)).T.reshape(-1).tolist()})),
        ("a.json", json.dumps({"0": {"cam_K": MATRIX, "depth_scale": 1.0}})),
        ("a.json", json.dumps({"ppx": 15.5, "ppy": 11.5, "fx": 50, "fy": 40, "depth_scale": 0.001})),
        ("a.json", json.dumps({"fx": 100, "fy": 80, "cx": 31.5, "cy": 23.5, "width": 64, "height": 48})),
    ],
)
def test_a_depth_image_with_any_intrinsics(tmp_path: Path, name: str, text: str) -> None:
    depth = RNG.integers(500, 2000, (24, 32)).astype(np.uint16)
    depth[0, :5] = 0
    Image.fromarray(depth).save(tmp_path / "a.png")
    (tmp_path / name).write_text(text)
    cloud = read_cloud(tmp_path / "a.png")
    assert cloud.optical and cloud.total == 24 * 32 and len(cloud.points) == 24 * 32 - 5
    x, y, z = cloud.points.T
    row, column = np.divmod(cloud.rows, 32)
    np.testing.assert_allclose(z, depth[row, column] / 1000, rtol=1e-6)
    np.testing.assert_allclose(50 * x / z + 15.5, column, atol=1e-3)
    np.testing.assert_allclose(40 * y / z + 11.5, row, atol=1e-3)
    assert read_cloud(tmp_path / "a.png", depth_scale=5000).points[:, 2].max() < 0.4


def _broken() -> dict[str, tuple[str, bytes]]:
    good = {name: content for name, (_, content) in FORMATS.items()}
    little, ascii_, binary, packed = (good[n] for n in ("ply little", "ply ascii", "pcd binary", "pcd compressed"))
    return {
        "empty ply": ("a.ply", b""),
        "empty pcd": ("a.pcd", b""),
        "empty npy": ("a.npy", b""),
        "empty npz": ("a.npz", b""),
        "empty xyz": ("a.xyz", b""),
        "empty png": ("a.png", b""),
        "cut ply": ("a.ply", little[:-900]),
        "cut ascii": ("a.ply", ascii_[:-1500]),
        "cut pcd": ("a.pcd", binary[:-50]),
        "cut compressed": ("a.pcd", packed[:-50]),
        "cut npz": ("a.npz", good["npz"][:-100]),
        "cut npy": ("a.npy", _npy(only=POINTS)[:-9]),
        "header without end": ("a.ply", little[:100]),
        "no ply": ("a.ply", b"solid\nend_header\n"),
        "no format": ("a.ply", little.replace(b"format binary_little_endian 1.0\n", b"")),
        "other format": ("a.ply", little.replace(b"binary_little_endian", b"binary_middle_endian")),
        "unknown type": ("a.ply", little.replace(b"float x", b"quad x")),
        "no x": ("a.ply", little.replace(b"float x", b"float u")),
        "twice x": ("a.ply", little.replace(b"float y", b"float x")),
        "huge": ("a.ply", little.replace(b"vertex 60", b"vertex 99999999999")),
        "huge ascii": ("a.ply", ascii_.replace(b"vertex 60", b"vertex 99999999999")),
        "negative": ("a.ply", little.replace(b"vertex 60", b"vertex -60")),
        "no vertex": ("a.ply", little.replace(b"vertex", b"vertix")),
        "list vertex": ("a.ply", little.replace(b"property uchar red", b"property list uchar int red")),
        "words": ("a.ply", ascii_.replace(b"0.", b"zero", 3)),
        "count of words": ("a.ply", little.replace(b"vertex 60", b"vertex many")),
        "pcd of no fields": ("a.pcd", binary.replace(b"FIELDS x y z _ mask\n", b"")),
        "pcd lengths": ("a.pcd", binary.replace(b"SIZE 4 4 4", b"SIZE 4 4")),
        "pcd type": ("a.pcd", binary.replace(b"TYPE F", b"TYPE Q")),
        "pcd size": ("a.pcd", binary.replace(b"SIZE 4", b"SIZE 3")),
        "pcd data": ("a.pcd", binary.replace(b"DATA binary", b"DATA zipped")),
        "pcd huge": ("a.pcd", binary.replace(b"POINTS 60", b"POINTS 4000000000")),
        "pcd damaged": ("a.pcd", packed[:-300] + b"\xff" * 300),
        "pickle": ("a.npy", _npy(only=np.array([{"a": 1}], dtype=object))),
        "text npz": ("a.npz", b"no archive"),
        "no cloud": ("a.npz", _npy(a=np.zeros(3), b=np.zeros((4, 4)))),
        "npy in npz": ("a.npz", _npy(only=POINTS)),
        "two columns": ("a.xyz", b"1 2\n3 4\n5 6\n"),
        "ragged": ("a.xyz", b"1 2 3\n4 5\n6 7 8\n"),
        "prose": ("a.txt", b"here are no points\n" * 5),
        "all zero": ("a.npy", _npy(only=np.zeros((9, 3)))),
        "all nan": ("a.npy", _npy(only=np.full((9, 3), np.nan))),
        "no rows": ("a.npy", _npy(only=np.zeros((0, 3)))),
        "strings": ("a.npy", _npy(only=np.array([["a", "b", "c"]]))),
        "one axis": ("a.npy", _npy(only=np.zeros(30))),
        "suffix": ("a.stl", b"solid"),
        "depth alone": ("a.png", b"\x89PNG\r\n"),
    }


BROKEN = _broken()


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_file_is_one_sentence_that_names_it(tmp_path: Path, name: str) -> None:
    file, content = BROKEN[name]
    (tmp_path / file).write_bytes(content)
    with pytest.raises(UserError, match=file.replace(".", r"\.")) as caught:
        read_cloud(tmp_path / file)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 400


def test_a_picture_is_no_depth_and_intrinsics_have_to_fit(tmp_path: Path) -> None:
    Image.fromarray(np.zeros((4, 4, 3), np.uint8)).save(tmp_path / "a.png")
    (tmp_path / "a.json").write_text(json.dumps(K | {"width": 64, "height": 64}))
    with pytest.raises(UserError, match="mode RGB"):
        read_cloud(tmp_path / "a.png")
    Image.fromarray(np.ones((24, 32), np.uint16)).save(tmp_path / "a.png")
    with pytest.raises(UserError, match="64 x 64"):
        read_cloud(tmp_path / "a.png")
    for text in (
        "{",
        "[]",
        '{"fx": 1}',
        '{"fx": -1, "fy": 1, "cx": 1, "cy": 1}',
        '{"K": [1, 2]}',
        "a: [",
        '{"fx": "a"}',
    ):
        (tmp_path / "a.json").write_text(text)
        with pytest.raises(UserError, match=r"a\.json"):
            read_cloud(tmp_path / "a.png")
    (tmp_path / "a.json").unlink()
    with pytest.raises(UserError, match="intrinsics="):
        read_cloud(tmp_path / "a.png")
    with pytest.raises(UserError, match="no file"):
        read_cloud(tmp_path / "b.ply")


def test_lzf() -> None:
    data = b"abc" * 100 + bytes(600) + b"x" * 5
    assert unpack_lzf(pack_lzf(data), len(data)).tobytes() == data
    overlapping = bytes([2]) + b"abc" + bytes([7 << 5, 20, 2])  # 29 bytes from three before
    assert unpack_lzf(overlapping, 32).tobytes() == (b"abc" * 11)[:32]
    assert not len(unpack_lzf(b"", 0))
    packed = pack_lzf(data)
    broken = [(packed[:-1], len(data)), (packed, 10), (packed, len(data) - 1), (packed, len(data) + 1)]
    for wrong, size in (*broken, (bytes([255, 255, 255]), 9), (b"", 4), (packed, 2**32 - 1)):
        with pytest.raises(UserError):
            unpack_lzf(wrong, size)


def _fuzz(tmp_path: Path, seeds: range, read: Callable[[Path], Any]) -> int:
    """Read files with some bytes changed, cut or repeated; returns how many were read all the same."""
    kinds, fine = list(FORMATS), 0
    for seed in seeds:
        rng = np.random.default_rng(seed)
        file, content = FORMATS[kinds[seed % len(kinds)]]
        data = bytearray(content)
        for _ in range(rng.integers(1, 6)):
            at = int(rng.integers(min(len(data), 300 if rng.random() < 0.7 else len(data))))
            match rng.integers(4):
                case 0:
                    data[at] = int(rng.integers(256))
                case 1:
                    del data[at : at + int(rng.integers(1, 40))]
                case 2:
                    data[at:at] = data[at : at + int(rng.integers(1, 40))]
                case 3:
                    data[at : at + 1] = str(int(rng.integers(10**10))).encode()
        path = tmp_path / file.lower()
        path.write_bytes(data)
        try:
            cloud = read(path)
            assert np.isfinite(cloud.points).all() and cloud.points.shape == (len(cloud.rows), 3)
            fine += 1
        except UserError as error:
            assert path.name in str(error) and "\n" not in str(error)
    return fine


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.timeout(60)
def test_changed_bytes_never_crash(tmp_path: Path) -> None:
    assert 20 < _fuzz(tmp_path, range(300), read_cloud) < 280


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.timeout(200)
def test_many_more_changed_bytes_never_crash(tmp_path: Path) -> None:
    assert _fuzz(tmp_path, range(300, 2300), read_cloud) > 100


def test_a_recording_says_what_it_needs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rosbags", None)
    (tmp_path / "a.bag").write_bytes(b"#ROSBAG V2.0")
    with pytest.raises(UserError, match=r'a\.bag is a recording of ROS, which needs rosbags: pip install "fb3d_rl'):
        read_cloud(tmp_path / "a.bag")
