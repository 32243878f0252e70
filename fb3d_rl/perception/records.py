"""The points of PLY and PCD files: a header in text that names the fields, then one record for each point.

Read with NumPy: plyfile is under the GPL, trimesh turns a text PLY line by line into a mesh, and pypcd4 needs two
compiled packages and refuses headers that PCL reads. Compressed points are unpacked by h5py.
"""

from __future__ import annotations

import io
import os
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fb3d_rl.errors import UserError

Fields = dict[str, NDArray[Any]]
"""Arrays [N] by the names of the fields, in lower case."""

_HEADER = 1 << 16
"""Bytes within which a header ends."""

_NUMBERS = 10_000
"""Numbers of a point; descriptors have some hundred."""

MARK = 32
"""Bytes of a mark behind compressed data: as many as LZF keeps as they are in one piece."""

LZF_GAIN = 88
"""LZF makes of one byte at most so many: of three 264."""

_PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8", "int64": "i8", "uint64": "u8",
}  # fmt: skip


def read_ply(data: bytes) -> Fields:
    """The vertices of a PLY file, ascii or binary of either byte order.

    Raises:
        UserError: the file is none, cut, or its vertices hold lists; the sentence begins after the file's name.
        ValueError: a number in it is none.
    """
    lines, start = _header(data, "end_header")
    if lines[0].strip() != "ply":
        raise UserError('does not begin with "ply"')
    order, elements = "", list[tuple[str, int, list[tuple[str, str]]]]()
    for words in map(str.split, lines[1:]):
        if words[:1] == ["format"]:
            order = {"ascii": "text", "binary_little_endian": "<", "binary_big_endian": ">"}.get(words[1], "")
        elif words[:1] == ["element"]:
            elements.append((words[1], _count(words[2]), []))
        elif words[:1] == ["property"]:
            kind = "list" if words[1] == "list" else _PLY_TYPES[words[1]]
            elements[-1][2].append((words[-1].lower(), kind))
    if not order:
        raise UserError("names no format: ascii, binary_little_endian or binary_big_endian")
    for name, count, properties in elements:
        lists = any(kind == "list" for _, kind in properties)
        if name == "vertex":
            if lists:
                raise UserError("has vertices that hold lists: export them as plain points")
            return _records(data, start, properties, count, order)
        if order == "text":
            for _ in range(count):
                start = data.index(b"\n", start) + 1
        elif lists:
            raise UserError(f"has lists before its vertices ({name}): export them as plain points")
        else:
            start += count * _dtype(properties, order).itemsize
    raise UserError("holds no vertices")


def read_pcd(data: bytes) -> tuple[Fields, NDArray[np.float64] | None]:
    """The points of a PCD file (ascii, binary or binary_compressed), and where its sensor stood [3], if it says so.

    Raises:
        UserError: the file is none or cut; the sentence begins after the file's name.
        ValueError: a number in it is none.
    """
    lines, start = _header(data, "data ")
    header = {words[0].lower(): words[1:] for words in map(str.split, lines) if words}
    names, sizes, types = header["fields"], header["size"], header["type"]
    counts = [_count(word) for word in header.get("count", ["1"] * len(names))]
    if not len(names) == len(sizes) == len(types) == len(counts):
        raise UserError("has a header whose FIELDS, SIZE, TYPE and COUNT differ in length")
    if sum(counts) > _NUMBERS:
        raise UserError(f"announces {sum(counts)} numbers for each point")
    points = (
        _count(header["points"][0]) if "points" in header else _count(header["width"][0]) * _count(header["height"][0])
    )
    properties = []
    for i, (name, kind, size, count) in enumerate(zip(names, types, sizes, counts, strict=True)):
        code = {"F": "f", "I": "i", "U": "u"}[kind.upper()] + size
        # Fields named _ are padding, and there may be several.
        parts = (
            [f"{name.lower()}" if name != "_" else f"_{i}"] if count == 1 else [f"{name}_{i}_{k}" for k in range(count)]
        )
        properties += [(part, code) for part in parts]
    form = header["data"][0].lower()
    if form == "ascii":
        fields = _records(data, start, properties, points, "text")
    elif form == "binary":
        fields = _records(data, start, properties, points, "<")
    elif form == "binary_compressed":
        packed, unpacked_size = (int(x) for x in np.frombuffer(data, "<u4", 2, start))
        if len(data) < start + 8 + packed:
            raise UserError(f"is cut: {packed} bytes of points are announced, {len(data) - start - 8} are there")
        if unpacked_size < points * _dtype(properties, "<").itemsize:
            raise UserError(f"announces {points} points in {unpacked_size} bytes, which is too few")
        unpacked, fields, at = unpack_lzf(data[start + 8 : start + 8 + packed], unpacked_size), {}, 0
        for name, code in properties:  # one field after the other
            fields[name] = np.frombuffer(unpacked, f"<{code}", points, at)
            at += fields[name].nbytes
    else:
        raise UserError(f"has DATA {form}: ascii, binary or binary_compressed is known")
    place = np.array([float(word) for word in header.get("viewpoint", ["0"])[:3]])
    return fields, place if place.shape == (3,) and place.any() and np.isfinite(place).all() else None


def _header(data: bytes, last: str) -> tuple[list[str], int]:
    """The lines up to the one that begins with ``last``, without comments, and where the rest begins."""
    lines, start = [], 0
    while start < min(len(data), _HEADER):
        end = data.find(b"\n", start)
        if end < 0:
            break
        line, start = data[start:end].decode("latin-1").strip(), end + 1
        if not line.startswith(("#", "comment", "obj_info")):
            lines.append(line)
        if (line.lower() + " ").startswith(last):
            return lines, start
    raise UserError("has no header that ends")


def _count(word: str) -> int:
    number = int(word)
    if not 0 <= number < 2**40:
        raise UserError(f"announces {number} points")
    return number


def _dtype(properties: list[tuple[str, str]], order: str) -> np.dtype[Any]:
    return np.dtype([(name, order + code) for name, code in properties])


def _records(data: bytes, start: int, properties: list[tuple[str, str]], count: int, order: str) -> Fields:
    """``count`` records of scalars from ``start`` on: binary in this byte order ("<" or ">"), or "text"."""
    names = [name for name, _ in properties]
    if len(set(names)) < len(names) or not names:
        raise UserError("names a field twice" if names else "has points without fields")
    if order != "text":
        kind = _dtype(properties, order)
        there = max(0, len(data) - start) // kind.itemsize
        if there < count:
            raise UserError(f"is cut: {count} points are announced, {there} are there")
        records = np.frombuffer(data, kind, count, start)
        return {name: records[name] for name in names}
    if count == 0 or not data[start:].strip():
        table = np.empty((0, len(names)))
    else:
        table = np.loadtxt(io.BytesIO(data[start:]), ndmin=2, max_rows=count, usecols=range(len(names)), comments=None)
    if len(table) < count:
        raise UserError(f"is cut: {count} points are announced, {len(table)} are there")
    return dict(zip(names, table.T, strict=True))


def unpack_lzf(packed: bytes, size: int) -> NDArray[np.uint8]:
    """What LibLZF compressed into ``packed``: ``size`` bytes.

    HDF5's filter of this name unpacks it, as the one chunk of a data set in memory. It does not say how much came out:
    a mark behind the data has to be found where they are to end.

    Raises:
        UserError: it is no such data.
    """
    import h5py  # late: few files are compressed

    mark, out = os.urandom(MARK), np.empty(0, dtype=np.uint8)
    if size <= LZF_GAIN * len(packed) and len(packed) <= 2 * size:
        with h5py.File("lzf", "w", driver="core", backing_store=False) as file:
            chunk = (size + MARK,)
            data = file.create_dataset("lzf", chunk, "u1", chunks=chunk, compression="lzf")
            data.id.write_direct_chunk((0,), b"".join((packed, bytes([MARK - 1]), mark)))
            try:
                out = data[:]
            except OSError:
                pass
    if out[size:].tobytes() != mark:
        raise UserError("is damaged: its compressed points cannot be unpacked")
    return out[:size]
