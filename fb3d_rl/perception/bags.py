"""Clouds in recordings of ROS: messages of type PointCloud2 in a ROS 1 .bag, or a ROS 2 folder, .db3 or .mcap."""

from __future__ import annotations

import itertools
import sqlite3
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fb3d_rl.errors import UserError
from fb3d_rl.perception.records import Fields

BAGS = (".bag", ".db3", ".mcap")
"""Files of recordings; a folder is one if it holds :data:`ABOUT`."""

ABOUT = "metadata.yaml"

MESSAGE = "sensor_msgs/msg/PointCloud2"

TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""NumPy's type for each number that a PointField's datatype takes."""

OPTICAL = ("_optical", "_optical_frame")
"""Ends of the names of a camera's own frame: x right, y down, z forward (REP 103)."""


def is_bag(path: Path) -> bool:
    """Whether a path is that of a recording, by its name."""
    return path.suffix.lower() in BAGS or (path / ABOUT).is_file()


def read_bag(path: Path, topic: str | None, message: int) -> tuple[Fields, bool, str]:
    """The points of one message, row after row; whether they are in a camera's own frame; and what was read.

    Args:
        path: the recording.
        topic: its topic; None if there is one only.
        message: the place of the message among those of the topic, from 0 on.

    Raises:
        UserError: rosbags is not installed, there is no such topic or message, or the recording is damaged; the
            sentence begins after the file's name.
    """
    rosbag1, rosbag2, typesys, errors = _rosbags()
    first = path.suffix.lower() == ".bag"
    # Definitions in the recording are not read: those of other messages may be anything, and this one is the same.
    types = typesys.get_typestore(typesys.Stores.ROS1_NOETIC if first else typesys.Stores.ROS2_HUMBLE)
    try:
        with (rosbag1 if first else rosbag2).Reader(path) as reader:
            clouds = [connection for connection in reader.connections if connection.msgtype == MESSAGE]
            topic = _chosen({connection.topic for connection in clouds}, topic)
            wanted = [connection for connection in clouds if connection.topic == topic]
            found = next(itertools.islice(reader.messages(wanted), message, None), None)
            if found is None:
                there = sum(1 for _ in reader.messages(wanted))
                raise UserError(f"has {there} messages on {topic}: message={message} is none, they count from 0")
            content = (types.deserialize_ros1 if first else types.deserialize_cdr)(bytes(found[2]), MESSAGE)
    except errors as error:
        why = " ".join(str(error).split())[:120] or type(error).__name__
        raise UserError(f"is damaged or no recording of ROS ({why})") from error
    frame = str(content.header.frame_id)
    return points_of(content), frame.endswith(OPTICAL), f"topic {topic}, message {message}, frame {frame or 'unnamed'}"


def _chosen(topics: set[str], topic: str | None) -> str:
    known = ", ".join(sorted(topics))
    if not topics:
        raise UserError(f"holds no messages of type {MESSAGE}")
    if topic is None and len(topics) > 1:
        raise UserError(f"holds several topics with clouds, {known}: choose one with topic=")
    if topic is not None and topic not in topics:
        raise UserError(f"has no clouds on {topic}: choose from {known}")
    return topic or known


def points_of(message: Any) -> Fields:
    """The fields [H * W] of a PointCloud2, of any layout and byte order; a field of several numbers is as many fields.

    Raises:
        UserError: its sizes do not fit together.
    """
    order = ">" if message.is_bigendian else "<"
    height, width, step = int(message.height), int(message.width), int(message.point_step)
    stride, data = int(message.row_step), np.ascontiguousarray(message.data, dtype=np.uint8)
    names: list[str] = []
    kinds, places = list[str](), list[int]()
    for field in message.fields:
        if field.datatype not in TYPES:
            raise UserError(f"has a field {field.name} of the unknown datatype {field.datatype}")
        kind, count = np.dtype(order + TYPES[field.datatype]), int(field.count) or 1  # some drivers write 0
        if field.offset + count * kind.itemsize > step:
            raise UserError(f"has a field {field.name} that ends outside of a point of {step} bytes")
        parts = [field.name] if count == 1 else [f"{field.name}_{k}" for k in range(count)]
        names += [name.lower() for name in parts]
        kinds += [kind.str] * count
        places += [int(field.offset) + k * kind.itemsize for k in range(count)]
    if len(set(names)) < len(names):
        raise UserError("names a field twice")
    stride = stride if height > 1 else step * width  # of one row some drivers write 0
    if width and height and (step < 1 or stride < step * width or len(data) < stride * (height - 1) + step * width):
        raise UserError(f"announces {height} x {width} points of {step} bytes, but holds {len(data)} bytes")
    layout = np.dtype({"names": names, "formats": kinds, "offsets": places, "itemsize": max(step, 1)})
    if not width or not height:
        return {name: np.empty(0, layout[name]) for name in names}
    records: NDArray[Any] = np.ndarray((height, width), layout, data.data, strides=(stride, step))
    return {name: records[name].reshape(-1) for name in names}


def _rosbags() -> tuple[Any, Any, Any, tuple[type[Exception], ...]]:
    """Packages for ROS 1, for ROS 2 and for types; and the errors that they raise on damaged files."""
    try:
        import apsw
        from rosbags import rosbag1, rosbag2, typesys
        from rosbags.serde import SerdeError
    except ImportError as error:
        raise UserError('is a recording of ROS, which needs rosbags: pip install "fb3d_rl[rosbags]"') from error
    own = (rosbag1.ReaderError, rosbag2.ReaderError, typesys.TypesysError, SerdeError, apsw.Error)
    plain = (ValueError, LookupError, TypeError, AssertionError, OSError, EOFError, RuntimeError, OverflowError)
    return rosbag1, rosbag2, typesys, (*own, *plain, struct.error, sqlite3.Error)
