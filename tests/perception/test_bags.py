"""Recordings of ROS, written with the rosbags package, hold the clouds that were put into them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fb3d_rl.errors import UserError
from fb3d_rl.perception.bags import TYPES, points_of
from fb3d_rl.perception.files import read_cloud
from launch.predict import main

rosbags = pytest.importorskip("rosbags", reason="rosbags is not installed; it is an extra")

from rosbags import rosbag1, rosbag2  # noqa: E402
from rosbags.typesys import Stores, get_typestore  # noqa: E402

POINTS = np.random.default_rng(0).normal(size=(60, 3)).astype(np.float32)
PART = np.arange(60) % 3 == 0
CODES = {np.dtype(kind): code for code, kind in TYPES.items()}
KINDS = ["bag", "folder", "db3", "mcap folder", "mcap"]


def layout(order: str = "<", xyz: str = "f4", gap: int = 0) -> np.dtype[Any]:
    """Points whose coordinates do not come first, among other fields, with ``gap`` bytes after each."""
    kinds = [("intensity", order + "u2"), ("z", order + xyz), ("rgb", order + "f4"), ("y", order + xyz),
             ("x", order + xyz), ("normal", order + "f4", 3), ("mask", "u1")]  # fmt: skip
    packed = np.dtype(kinds)
    offsets = [packed.fields[name][1] + 3 * k for k, name in enumerate(packed.names)]
    formats = [packed.fields[name][0] for name in packed.names]
    return np.dtype({"names": packed.names, "formats": formats, "offsets": offsets,
                     "itemsize": packed.itemsize + 3 * len(kinds) + gap})  # fmt: skip


def message(types: Any, points: Any = POINTS, kind: np.dtype[Any] | None = None, height: int = 1, pad: int = 0,
            frame: str = "map") -> Any:  # fmt: skip
    """A PointCloud2 of points in so many rows, with ``pad`` bytes after each row."""
    kind = layout() if kind is None else kind
    records = np.zeros(len(points), kind)
    for k, axis in enumerate("xyz"):
        records[axis] = points[:, k]
    records["normal"] = points
    if "mask" in kind.names:
        records["mask"] = PART
    rows = records.view("u1").reshape(height, -1)
    data = np.pad(rows, ((0, 0), (0, pad))).reshape(-1)
    fields = [
        types.types["sensor_msgs/msg/PointField"](
            name=name, offset=kind.fields[name][1], datatype=CODES[kind[name].base.newbyteorder("<")],
            count=int(np.prod(kind[name].shape)),
        )
        for name in kind.names
    ]  # fmt: skip
    stamp = types.types["builtin_interfaces/msg/Time"](sec=1, nanosec=2)
    header = types.types["std_msgs/msg/Header"]
    header = header(seq=0, stamp=stamp, frame_id=frame) if "seq" in header.__annotations__ else header(stamp, frame)
    return types.types["sensor_msgs/msg/PointCloud2"](
        header=header, height=height, width=len(points) // height, fields=fields,
        is_bigendian=kind["x"].base.str[0] == ">", point_step=kind.itemsize, row_step=rows.shape[1] + pad, data=data,
        is_dense=False,
    )  # fmt: skip


def write(folder: Path, how: str, topics: dict[str, list[dict[str, Any]]]) -> Path:
    """A recording with these messages on each topic, and with a text on /chatter."""
    first = how == "bag"
    types = get_typestore(Stores.ROS1_NOETIC if first else Stores.ROS2_HUMBLE)
    path = folder / ("x.bag" if first else "recorded")
    if first:
        writer: Any = rosbag1.Writer(path)
    else:
        plugin = rosbag2.StoragePlugin.MCAP if "mcap" in how else rosbag2.StoragePlugin.SQLITE3
        writer = rosbag2.Writer(path, version=9, storage_plugin=plugin)
    pack = types.serialize_ros1 if first else types.serialize_cdr
    with writer:
        text = "std_msgs/msg/String"
        writer.write(writer.add_connection("/chatter", text, typestore=types), 0, pack(types.types[text]("hi"), text))
        for topic, messages in topics.items():
            connection = writer.add_connection(topic, "sensor_msgs/msg/PointCloud2", typestore=types)
            for k, given in enumerate(messages):
                made = message(types, **given)
                writer.write(connection, 10 + k, pack(made, made.__msgtype__))
    if how in ("db3", "mcap"):
        [path] = path.glob(f"*.{how}")
    return path


@pytest.mark.parametrize("how", KINDS)
def test_every_kind_of_recording_gives_its_cloud(tmp_path: Path, how: str) -> None:
    clouds = [{"points": POINTS + k, "frame": "map"} for k in range(3)]
    path = write(tmp_path, how, {"/camera/points": clouds})
    for k in range(3):
        cloud = read_cloud(path, message=k)
        np.testing.assert_array_equal(cloud.points, POINTS + k)
        assert cloud.mask is not None and cloud.mask.tolist() == PART.tolist()
        assert cloud.camera is None and not cloud.optical
        assert cloud.remarks == (f"topic /camera/points, message {k}, frame map",)
    with pytest.raises(UserError, match=r"has 3 messages on /camera/points: message=3 is none"):
        read_cloud(path, message=3)


@pytest.mark.parametrize("how", ["bag", "folder"])
def test_topics_are_chosen_by_name(tmp_path: Path, how: str) -> None:
    path = write(tmp_path, how, {"/b": [{"points": POINTS + 1}], "/a": [{}]})
    np.testing.assert_array_equal(read_cloud(path, topic="/b").points, POINTS + 1)
    with pytest.raises(UserError, match=r"several topics with clouds, /a, /b: choose one with topic="):
        read_cloud(path)
    with pytest.raises(UserError, match="no clouds on /chatter: choose from /a, /b"):
        read_cloud(path, topic="/chatter")


@pytest.mark.parametrize("how", ["bag", "mcap"])
@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize("xyz", ["f4", "f8"])
def test_any_layout_of_the_points(tmp_path: Path, how: str, order: str, xyz: str) -> None:
    """Either byte order, floats and doubles, fields in any place, organised with gaps, some points missing."""
    points = POINTS.copy()
    points[[3, 17]] = np.nan
    given = {"points": points, "kind": layout(order, xyz, gap=5), "height": 6, "pad": 11,
             "frame": "camera_depth_optical_frame"}  # fmt: skip
    cloud = read_cloud(write(tmp_path, how, {"/x": [given]}))
    kept = np.isfinite(points).all(1)
    np.testing.assert_array_equal(cloud.points, points[kept])
    assert cloud.rows.tolist() == kept.nonzero()[0].tolist() and cloud.total == 60
    assert cloud.mask is not None and cloud.mask.tolist() == PART[kept].tolist()
    assert cloud.optical and cloud.camera is not None and not cloud.camera.any()


def test_a_field_of_several_numbers_is_as_many_fields(tmp_path: Path) -> None:
    found = points_of(message(get_typestore(Stores.ROS2_HUMBLE)))
    assert list(found) == ["intensity", "z", "rgb", "y", "x", "normal_0", "normal_1", "normal_2", "mask"]
    for k in range(3):
        np.testing.assert_array_equal(found[f"normal_{k}"], POINTS[:, k])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"width": 61}, "announces 1 x 61 points"),
        ({"point_step": 4}, "ends outside of a point of 4 bytes"),
        ({"height": 2, "row_step": 3}, "announces 2 x 60 points"),
        ({"height": 2**32 - 1, "width": 2**32 - 1}, "announces"),
    ],
)
def test_sizes_that_do_not_fit_are_said(change: dict[str, int], words: str) -> None:
    made = message(get_typestore(Stores.ROS2_HUMBLE))
    for name, value in change.items():
        setattr(made, name, value)
    with pytest.raises(UserError, match=words):
        points_of(made)


@pytest.mark.parametrize("how", KINDS)
def test_a_damaged_recording_is_one_sentence(tmp_path: Path, how: str) -> None:
    """Cut anywhere, or with any bytes changed."""
    path = write(tmp_path, how, {"/x": [{}]})
    file = path if path.is_file() else next(iter(path.glob("*.*[3p]")))
    content, rng = file.read_bytes(), np.random.default_rng(0)
    refused = 0
    for k in range(60):
        changed = np.frombuffer(content, "u1").copy()
        if k % 3 == 0:
            changed = changed[: rng.integers(len(changed))]
        else:
            changed[rng.integers(len(changed), size=1 + k)] = rng.integers(256, size=1 + k)
        file.write_bytes(changed.tobytes())
        try:
            read_cloud(path)
        except UserError as error:
            refused += 1
            assert str(path) in str(error) and "\n" not in str(error)
    assert refused > 10
    with pytest.raises(UserError, match=r"There is no file"):
        read_cloud(tmp_path / "none.bag")
    (tmp_path / "folder").mkdir()
    with pytest.raises(UserError, match=r"There is no file|no kind"):
        read_cloud(tmp_path / "folder")


def test_the_command_plans_for_a_recording(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(1)
    box = rng.uniform(-0.5, 0.5, (2500, 3))
    face = rng.integers(3, size=len(box))
    box[np.arange(len(box)), face] = -0.5
    path = write(tmp_path, "folder", {"/a": [{}], "/b": [{}, {"points": box.astype("f4"), "kind": plain()}]})
    assert main([str(path), f"out={tmp_path / 'out'}", "topic=/b", "message=1"]) == 0
    assert "topic /b, message 1, frame map" in capsys.readouterr().out
    about = json.loads((tmp_path / "out" / "recorded.json").read_text())
    assert about["reading"] == ["topic /b, message 1, frame map"]
    assert main([str(path), f"out={tmp_path / 'out'}", "topic=/b", "message=-1"]) == 2
    assert "message=-1: give a whole number" in capsys.readouterr().err


def plain() -> np.dtype[Any]:
    return np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("normal", "<f4", 3), ("ring", "<u2")])
