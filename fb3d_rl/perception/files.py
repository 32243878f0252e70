"""Clouds in files of others: PLY, PCD, NPY, NPZ, text, ROS recordings, and depth images with their intrinsics."""

from __future__ import annotations

import tokenize
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from fb3d_rl.errors import UserError
from fb3d_rl.perception.arrays import as_mask, as_points, finite, near_origin, places
from fb3d_rl.perception.bags import BAGS, is_bag, read_bag
from fb3d_rl.perception.depth import points_of, read_depth, read_intrinsics
from fb3d_rl.perception.records import Fields, read_pcd, read_ply

MASKS = ("part_mask", "mask", "scalar_part_mask", "scalar_mask")
"""Fields of a file that are taken for the mask of the part unless another is named."""

CLOUDS = ("points", "xyz", "vertices", "cloud", "pos", "arr_0")
"""Arrays of an NPZ file that are taken for the cloud."""

IMAGES = (".png", ".tif", ".tiff")
"""Images of depth, and of masks of these."""

INTRINSICS = (
    "{stem}.json",
    "{stem}.yaml",
    "{stem}.yml",
    "intrinsics.json",
    "intrinsics.yaml",
    "camera.json",
    "camera.yaml",
)
"""Where the intrinsics of a depth image are looked for, beside it."""

DEPTH_PER_METRE = 1000.0
"""Units in a metre of a depth image that does not say it: millimetres, as most depth cameras write."""

MILLIMETRES = 50.0
"""A cloud that spans more is one in millimetres: 50 m seen at once, or 5 cm."""

DAMAGE = (
    ValueError, LookupError, TypeError, OverflowError, EOFError, SyntaxError, OSError, RuntimeError,
    tokenize.TokenError, zipfile.BadZipFile, zlib.error,
)  # fmt: skip
"""What Python, NumPy and Pillow raise on a damaged file."""


@dataclass(frozen=True, eq=False)
class CloudFile:
    """The points of a file.

    Attributes:
        points: [N, 3] m, in the file's own frame, only those that were measured.
        mask: [N] bool, the part to open; None if the file says nothing.
        camera: [3] where the camera stood, m, in that frame; None if the file does not say.
        optical: whether the frame is the camera's own: x right, y down, z forward.
        rows: [N] the places of the points in the file.
        total: points in the file, those that are missing included.
        remarks: what was recognised, one sentence each.
    """

    points: NDArray[Any]
    mask: NDArray[np.bool_] | None
    camera: NDArray[np.float64] | None
    optical: bool
    rows: NDArray[np.int64]
    total: int
    remarks: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class _Raw:
    """What a file holds: points [N, 3], other fields [N], and as of :class:`CloudFile`."""

    points: NDArray[Any]
    fields: Fields
    camera: NDArray[np.float64] | None = None
    optical: bool = False
    remark: str = ""


def read_cloud(
    path: str | Path,
    mask: str | None = None,
    scale: float | None = None,
    intrinsics: str | Path | None = None,
    depth_scale: float | None = None,
    topic: str | None = None,
    message: int = 0,
) -> CloudFile:
    """Read the cloud of a file.

    Args:
        path: .ply, .pcd, .npy, .npz, .xyz, .txt, .csv, .pts or .asc; a 16-bit .png (.tif) of depth; or a recording of
            ROS with messages of type PointCloud2: .bag, .db3, .mcap, or a folder (needs rosbags).
        mask: the part to open: the name of a field (or array) of the file; "FIELD:ID", those of its points with this
            number; "box:X,Y,Z,X,Y,Z", what is between two corners, in metres in the file's frame; or a second file
            with a number for each point: .npy, .npz, .txt, or .png for a depth image. Numbers mean what
            :func:`~fb3d_rl.perception.arrays.as_mask` says. None: a field named part_mask or mask, if there is one.
        scale: metres in a unit of the file; None: 1, or 0.001 for a cloud that spans more than 50.
        intrinsics: of a depth image's camera, .json or .yaml; None: a file of that name beside the image, or
            intrinsics.json.
        depth_scale: units of a depth image in a metre; None: what the intrinsics say, else 1000.
        topic: of a recording; None if it has clouds on one only.
        message: which of the topic's messages, from 0 on.

    Raises:
        UserError: a file is missing, damaged or something else; the sentence names it.
    """
    file = Path(path)
    kind, recording = file.suffix.lower(), is_bag(file)
    if not file.is_file() and not (recording and file.is_dir()):
        raise UserError(f"There is no file {file}: check the path.")
    if recording:
        raw = _read(file, lambda bag: _message(bag, topic, message))
    elif kind in READERS:
        raw = _read(file, READERS[kind])
    elif kind in IMAGES:
        raw = _depth_image(file, intrinsics, depth_scale)
    else:
        raise UserError(f"{file} is of no kind that is read: {', '.join((*READERS, *IMAGES, *BAGS))}.")
    points = as_points(raw.points)
    if not len(points):
        raise UserError(f"{file} holds no points.")
    cleaned, _ = near_origin_of(file, points)
    measured = finite(cleaned) & (points.abs().sum(1) != 0)
    rows = places(measured).numpy()
    if len(rows) < 3:
        raise UserError(f"{file} holds {len(rows)} measured points: all others are zero or not finite.")
    everything = len(rows) == len(points)
    cloud, remarks = points.numpy() if everything else points.numpy()[rows], [raw.remark] if raw.remark else []
    if not everything:
        remarks.append(f"{len(points) - len(rows):,} of {len(points):,} points are missing (zero or not finite)")
    span = float(np.linalg.norm(np.subtract(*np.percentile(cloud[:: max(1, len(cloud) // 10_000)], (99, 1), axis=0))))
    if scale is None and span > MILLIMETRES:
        scale = 0.001
        remarks.append(f"the cloud spans {span:,.0f}: taken for millimetres (scale=1: metres)")
    if scale is not None and scale != 1:
        cloud = cloud * cloud.dtype.type(scale)
    camera = None if raw.camera is None else raw.camera * (scale or 1.0)
    marked = _mask(file, mask, raw.fields, len(points), rows, cloud)
    return CloudFile(cloud, marked, camera, raw.optical, rows, len(points), tuple(remarks))


def near_origin_of(file: Path, points: Any) -> Any:
    """:func:`near_origin` whose error names the file."""
    try:
        return near_origin(points)
    except UserError as error:
        raise UserError(f"{file}: {error}") from error


def _read(file: Path, reader: Callable[[Path], _Raw]) -> _Raw:
    """What the reader reads; what it stumbles over in a damaged file is one sentence."""
    try:
        return reader(file)
    except UserError as error:
        raise UserError(f"{file} {error}.") from error
    except DAMAGE as error:
        why = " ".join(str(error).split())[:120]
        raise UserError(f"{file} is damaged or no {file.suffix.lower()} file ({why}): export it anew.") from error
    except MemoryError as error:
        raise UserError(f"{file} is larger than the memory.") from error


def _of_fields(fields: Fields, camera: NDArray[np.float64] | None = None) -> _Raw:
    lower = {name.lower(): values for name, values in fields.items()}
    if not {"x", "y", "z"} <= lower.keys():
        raise UserError(f"has the fields {', '.join(list(fields)[:8])}, but no x, y and z")
    points = np.stack([lower[axis] for axis in "xyz"], axis=1)
    return _Raw(points, {name: values for name, values in lower.items() if name not in ("x", "y", "z")}, camera)


def _ply(file: Path) -> _Raw:
    return _of_fields(read_ply(file.read_bytes()))


def _pcd(file: Path) -> _Raw:
    return _of_fields(*read_pcd(file.read_bytes()))


def _message(bag: Path, topic: str | None, message: int) -> _Raw:
    fields, optical, remark = read_bag(bag, topic, message)
    raw = _of_fields(fields, np.zeros(3) if optical else None)
    return replace(raw, optical=optical, remark=remark)


def _of_array(array: NDArray[Any], others: Fields) -> _Raw:
    """A cloud of an array [N, 3 or more], organised [H, W, 3 or more], or structured."""
    if array.dtype.names is not None:
        flat = array.reshape(-1)
        return _of_fields({name: flat[name] for name in array.dtype.names} | others)
    if array.dtype.kind not in "fiu" or array.ndim not in (2, 3) or not 3 <= array.shape[-1] <= 16:
        raise UserError(f"holds {array.dtype} {list(array.shape)}: a cloud is [N, 3] or [H, W, 3] numbers")
    rows = array.reshape(-1, array.shape[-1])
    return _Raw(rows[:, :3], others)


def _npy(file: Path) -> _Raw:
    with file.open("rb") as stream:
        return _of_array(np.load(stream, allow_pickle=False), {})


def _npz(file: Path) -> _Raw:
    with file.open("rb") as stream:  # numpy leaves a file open that is no archive
        content = np.load(stream, allow_pickle=False)
        if not isinstance(content, np.lib.npyio.NpzFile):
            raise UserError("is no .npz file but one array: name it .npy")
        arrays = {name: content[name] for name in content.files}
    if {"x", "y", "z"} <= arrays.keys():
        return _of_fields({name: values.reshape(-1) for name, values in arrays.items()})
    clouds = [name for name, values in arrays.items() if values.ndim in (2, 3) and values.shape[-1] == 3]
    name = next((name for name in CLOUDS if name in arrays), clouds[0] if len(clouds) == 1 else None)
    if name is None:
        raise UserError(f"has the arrays {', '.join(list(arrays)[:8]) or 'none'}: name the cloud points")
    rest = {key: values.reshape(-1) for key, values in arrays.items() if key != name and values.dtype.kind in "fiub"}
    return _of_array(arrays[name], rest)


def _text(file: Path) -> _Raw:
    """Columns with spaces, tabs, commas or semicolons between them; the first three are x, y and z unless named."""
    with file.open("rb") as stream:
        lines = [stream.readline(1 << 16).decode("latin-1") for _ in range(100)]
    split = next((mark for mark in ";,\t" if sum(mark in line for line in lines) > sum(map(bool, lines)) / 2), None)
    split = None if split == "\t" else split
    names: list[str] = []
    for skipped, line in enumerate(lines):  # noqa: B007, read after the loop
        words = line.lstrip("#/ ").strip().split(split)
        try:
            if [float(word) for word in words if word.strip()][2:] and not line.startswith(("#", "//")):
                break
        except ValueError:
            names = [word.strip(' "').lower() for word in words]
    else:
        raise UserError("has no line of three numbers among its first hundred")
    table = np.loadtxt(file, delimiter=split, skiprows=skipped, ndmin=2, encoding="latin-1")
    if table.shape[1] < 3:
        raise UserError(f"has {table.shape[1]} columns: three are needed")
    if len(names) == table.shape[1] and {"x", "y", "z"} <= {*names}:
        return _of_fields(dict(zip(names, table.T, strict=True)))
    return _Raw(table[:, :3], {f"column{i}": table[:, i] for i in range(3, table.shape[1])})


def _depth_image(file: Path, intrinsics: str | Path | None, depth_scale: float | None) -> _Raw:
    depth = read_depth(file)
    beside = (file.with_name(name.format(stem=file.stem)) for name in INTRINSICS)
    about = Path(intrinsics) if intrinsics else next((path for path in beside if path.is_file()), None)
    if about is None:
        raise UserError(f"{file} is a depth image, whose camera has to be known: give intrinsics=FILE.json.")
    if not about.is_file():
        raise UserError(f"There are no intrinsics at {about}: check the path.")
    camera = read_intrinsics(about)
    units = depth_scale or camera.per_metre or DEPTH_PER_METRE
    try:
        points = points_of(depth, camera, units)
    except UserError as error:
        raise UserError(f"{file}: {error}.") from error
    remark = "" if depth_scale or camera.per_metre else f"depth is taken for {units:g} units in a metre (depth_scale=)"
    return _Raw(points, {}, np.zeros(3), optical=True, remark=remark)


READERS: dict[str, Callable[[Path], _Raw]] = {
    ".ply": _ply, ".pcd": _pcd, ".npz": _npz, ".npy": _npy,
    ".xyz": _text, ".txt": _text, ".csv": _text, ".pts": _text, ".asc": _text,
}  # fmt: skip
"""What reads each kind of file that needs no other one."""


def _mask(
    file: Path, mask: str | None, fields: Fields, total: int, rows: NDArray[np.int64], cloud: NDArray[Any]
) -> NDArray[np.bool_] | None:
    """The mask that ``mask`` names (:func:`read_cloud`) of the points at ``rows``; ``cloud`` are they."""
    if mask is None:
        name = next((name for name in MASKS if name in fields), None)
        return None if name is None else _checked(fields[name], total, f"{name} of {file}")[rows]
    if mask.startswith("box:"):
        return in_box(cloud, mask)
    name, _, number = mask.partition(":")
    by_name = {key.lower(): values for key, values in fields.items()}
    if name.lower() in by_name:
        values = by_name[name.lower()]
        if number:
            values = values == _number(number, mask)
        return _checked(values, total, f"{name} of {file}")[rows]
    if Path(mask).is_file():
        return _checked(_mask_file(Path(mask)), total, f"mask {mask}")[rows]
    known = ", ".join(list(fields)[:12]) or "none"
    raise UserError(f"mask={mask} is neither a file, a box nor a field of {file} (it has {known}).")


def in_box(cloud: NDArray[Any], box: str) -> NDArray[np.bool_]:
    """Which points [N, 3] are inside "box:X,Y,Z,X,Y,Z", of two opposite corners.

    Raises:
        UserError: it is none, or nothing is inside.
    """
    ends = [_number(word, box) for word in box.removeprefix("box:").split(",")]
    if len(ends) != 6:
        raise UserError(f"mask={box} is no box: give box:X,Y,Z,X,Y,Z, two opposite corners in metres.")
    corners = np.array(ends).reshape(2, 3)
    inside = ((cloud >= corners.min(0)) & (cloud <= corners.max(0))).all(1)
    if not inside.any():
        low, high = (", ".join(f"{x:.3g}" for x in end) for end in (cloud.min(0), cloud.max(0)))
        raise UserError(f"mask={box} holds no point: the cloud reaches from ({low}) to ({high}) m.")
    return np.asarray(inside)


def _number(word: str, mask: str) -> float:
    try:
        return float(word)
    except ValueError as error:
        raise UserError(f"mask={mask}: {word!r} is no number.") from error


def _checked(values: NDArray[Any], total: int, name: str) -> NDArray[np.bool_]:
    marked: NDArray[np.bool_] = as_mask(values, total, name).numpy()
    if not marked.any():
        raise UserError(f"The {name} marks no point.")
    return marked


def _mask_file(file: Path) -> NDArray[Any]:
    """The numbers of a second file, one for each point."""
    try:
        if file.suffix.lower() in IMAGES:
            with Image.open(file) as image:
                pixels = np.asarray(image)
            return pixels.reshape(-1) if pixels.ndim == 2 else pixels.reshape(-1, pixels.shape[-1])[:, 0]
        if file.suffix.lower() in (".npy", ".npz"):
            with file.open("rb") as stream:
                content: Any = np.load(stream, allow_pickle=False)
                if isinstance(content, np.lib.npyio.NpzFile):
                    name = next((name for name in (*MASKS, *content.files) if name in content.files), None)
                    content = np.empty(0) if name is None else content[name]
                return np.asarray(content).reshape(-1)
        return np.loadtxt(file, ndmin=1, delimiter="," if "," in file.read_text("latin-1")[:1000] else None).reshape(-1)
    except DAMAGE as error:
        raise UserError(f"{file} is damaged or no mask ({' '.join(str(error).split())[:120]}).") from error
