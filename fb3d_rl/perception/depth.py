"""Points of a depth image (16-bit PNG) and the intrinsics of its camera (JSON or YAML)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from numpy.typing import NDArray
from PIL import Image

from fb3d_rl.errors import UserError

MATRICES = ("K", "k", "cam_K", "camera_matrix", "intrinsic_matrix", "intrinsics", "intrinsic")
"""Names of 3 x 3 matrices: ROS, BOP, OpenCV, Open3D and others."""

NUMBERS = {"fx": ("fx",), "fy": ("fy",), "cx": ("cx", "ppx"), "cy": ("cy", "ppy")}
"""Names of the four numbers; ppx and ppy are RealSense's."""

DISTORTIONS = ("D", "d", "distortion_coefficients", "dist_coeffs", "distortion", "coeffs")
"""Names of the coefficients of distortion: ROS, OpenCV, RealSense and others."""


class Intrinsics(NamedTuple):
    """A pinhole camera: focal lengths and principal point in pixels; units of the image in a metre, if it says so."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int | None = None
    height: int | None = None
    per_metre: float | None = None
    distortion: tuple[float, ...] = ()
    """OpenCV's coefficients k1, k2, p1, p2, k3 ...; only :func:`read_distortion` reads them."""


def read_depth(path: Path) -> NDArray[np.float32]:
    """A depth image [H, W] in its own units, 0 where nothing was measured.

    Raises:
        UserError: it is no 16-bit image of one channel.
    """
    try:
        with Image.open(path) as image:
            mode, pixels = image.mode, np.asarray(image)
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise UserError(f"{path} is damaged or no image ({error}): export it anew.") from error
    if pixels.ndim != 2 or mode not in ("I", "I;16", "I;16B", "I;16L", "F"):
        raise UserError(f"{path} is a picture of mode {mode}: depth is 16 bits in one channel.")
    return pixels.astype(np.float32)


def read_intrinsics(path: Path) -> Intrinsics:
    """The intrinsics in a JSON or YAML file as OpenCV, ROS, Open3D, BOP or RealSense write it, or fx, fy, cx and cy.

    Raises:
        UserError: it is none, or the numbers make no camera.
    """
    return intrinsics_in(_content(path), str(path))


def intrinsics_in(content: Any, name: str) -> Intrinsics:
    """The intrinsics in what a file or a message holds, see :func:`read_intrinsics`.

    Raises:
        UserError: it holds none; ``name`` is what it is called.
    """
    try:
        return _intrinsics(_flat(content))
    except (KeyError, TypeError, ValueError, IndexError, OverflowError) as error:
        names = "fx, fy, cx and cy, or a 3 x 3 matrix such as K"
        raise UserError(f"{name} does not tell a camera's intrinsics: give {names}.") from error


def read_distortion(path: Path) -> tuple[float, ...]:
    """The coefficients of distortion in a file of intrinsics; none if it has none.

    Raises:
        UserError: they are none of OpenCV's pinhole models.
    """
    found = _flat(_content(path))
    given = next((found[name] for name in DISTORTIONS if name in found), ())
    try:
        numbers = tuple(np.asarray(given, dtype=np.float64).ravel().tolist())
    except (TypeError, ValueError):
        numbers = (math.nan,)
    fisheye = str(found.get("distortion_model", "")).lower() in ("equidistant", "fisheye", "kannala_brandt4")
    if fisheye or len(numbers) not in (0, 4, 5, 8, 12, 14) or not all(map(math.isfinite, numbers)):
        raise UserError(
            f"{path} has a distortion that is not OpenCV's k1, k2, p1, p2, k3 ... (4, 5, 8, 12 or 14 numbers): "
            f"undistort the images and leave it out."
        )
    return numbers


def _content(path: Path) -> Any:
    try:
        text = path.read_text("utf-8").replace("!!opencv-matrix", "").replace("%YAML:1.0", "")
        return yaml.safe_load(text.replace("\t", " "))  # JSON is YAML
    except (OSError, UnicodeDecodeError, yaml.YAMLError, RecursionError, ValueError) as error:
        raise UserError(f"{path} is neither JSON nor YAML: {' '.join(str(error).split())}.") from error


def _flat(content: Any, deep: int = 0) -> dict[str, Any]:
    """All entries of nested groups by their own names; of groups in lists those of the only one."""
    if isinstance(content, list) and len(content) == 1:
        content = content[0]
    if not isinstance(content, dict) or deep > 4:
        return {}
    found: dict[str, Any] = {}
    for name, value in content.items():
        if isinstance(value, dict) and "data" in value:
            value = value["data"]
        found |= _flat(value, deep + 1)
        found[str(name)] = value
    return found


def _intrinsics(found: dict[str, Any]) -> Intrinsics:
    for name in MATRICES:
        if name in found and not isinstance(found[name], dict):
            matrix = np.array(found[name], dtype=np.float64).reshape(3, 3)
            if matrix[0, 2] == matrix[1, 2] == 0:  # by columns, as Open3D writes it
                matrix = matrix.T
            fx, fy, cx, cy = matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]
            break
    else:
        fx, fy, cx, cy = (float(found[_first(names, found)]) for names in NUMBERS.values())
    if not all(map(math.isfinite, (fx, fy, cx, cy))) or min(fx, fy) <= 0:
        raise ValueError("focal lengths are positive")
    size = [int(found[name]) if name in found else None for name in ("width", "height")]
    per_metre = None
    if (scale := float(found.get("depth_scale") or 0)) > 0:
        # Units in a metre (1000, 5000), millimetres in a unit (BOP), or metres in a unit (RealSense).
        per_metre = scale if scale > 1 else 1000 / scale if "cam_K" in found else 1 / scale
    return Intrinsics(float(fx), float(fy), float(cx), float(cy), size[0], size[1], per_metre)


def _first(names: Sequence[str], found: dict[str, Any]) -> str:
    return next((name for name in names if name in found), names[0])


def points_of(depth: NDArray[np.float32], camera: Intrinsics, per_metre: float) -> NDArray[np.float32]:
    """Points [H * W, 3] (m) in the camera's frame, x right, y down, z forward; NaN where nothing was measured.

    Args:
        depth: [H, W], 0 where nothing was measured.
        camera: of an image of the same shape, or of a larger or smaller one of the same proportions.
        per_metre: units of ``depth`` in a metre.

    Raises:
        UserError: the camera's image has other proportions.
    """
    height, width = depth.shape
    shrink = 1.0 if camera.width is None else width / max(camera.width, 1)
    if camera.height is not None and camera.width is not None and abs(camera.height * shrink - height) > 1:
        raise UserError(
            f"the intrinsics are those of an image of {camera.width} x {camera.height}, "
            f"the depth image has {width} x {height}"
        )
    z = np.where(depth > 0, depth, np.nan) / np.float32(per_metre)
    # Of pixel centres: halving an image moves them by a quarter of its pixels.
    x = (np.arange(width) + 0.5 - (camera.cx + 0.5) * shrink) / (camera.fx * shrink)
    y = (np.arange(height) + 0.5 - (camera.cy + 0.5) * shrink) / (camera.fy * shrink)
    return np.stack([z * x[None], z * y[:, None], z], -1).reshape(-1, 3).astype(np.float32)
