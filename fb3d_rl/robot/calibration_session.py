"""Samples for a calibration: drawn in a simulated cell, or read from a folder of pictures and poses of a robot."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.transform import Rotation

from fb3d_rl.camera.views import View, look_at
from fb3d_rl.errors import UserError
from fb3d_rl.files import write_text
from fb3d_rl.perception.depth import Intrinsics, read_distortion, read_intrinsics
from fb3d_rl.robot.calibration_poses import Reachable, choose_poses, within
from fb3d_rl.robot.marker import Marker, draw

Array = NDArray[np.float64]

LENS = Intrinsics(610.0, 610.0, 639.5, 359.5, 1280, 720)
"""The colour camera of an Azure Kinect at 1280 x 720, about."""

VIEW, CENTRE, DISTANCE = View(150.0, 30.0), np.array([0.55, 0.0, 0.3]), 1.07
"""Where the simulated camera should be: across the workspace from the arm, looking down on its centre (m, base)."""

REACH = within(0.3, 0.9, 0.1)
"""Where the simulated arm puts its flange."""

POSES, CAMERA = ("poses.json", "poses.csv"), ("camera.json", "camera.yaml", "camera.yml")
QUATERNION = ("qw", "qx", "qy", "qz")


@dataclass(frozen=True)
class Truth:
    """What a simulated cell knows."""

    camera: Array
    """T_base_camera [4, 4], m."""
    mount: Array
    """T_flange_marker [4, 4], m."""


class Session:
    """Pictures of a marker on the flange, and where the robot said that the flange was.

    Args:
        names: of the pictures, files below ``folder`` if that is given.
        flange: T_base_flange [N, 4, 4], m, as the robot tells them.
        lens: the camera.
        folder: where the pictures are.
        pictures: the pictures [N, H, W] themselves, in place of a folder.
        truth: of a simulated cell.
    """

    def __init__(
        self,
        names: list[str],
        flange: Array,
        lens: Intrinsics,
        folder: Path | None = None,
        pictures: list[NDArray[np.uint8]] | None = None,
        truth: Truth | None = None,
    ) -> None:
        self.names, self.flange, self.lens, self.truth = names, flange, lens, truth
        self._folder, self._pictures = folder, pictures

    def pictures(self) -> Iterator[NDArray[np.uint8]]:
        """The grey pictures [H, W], one after the other.

        Raises:
            UserError: one cannot be read, or is of another size than the camera's.
        """
        if self._pictures is not None:
            yield from self._pictures
        elif self._folder is not None:
            for name in self.names:
                yield _picture(self._folder / name, self.lens)

    def write(self, folder: Path) -> None:
        """Write a folder that :func:`read_session` reads."""
        folder.mkdir(parents=True, exist_ok=True)
        rows: list[dict[str, Any]] = []
        for name, pose, picture in zip(self.names, self.flange, self.pictures(), strict=True):
            Image.fromarray(picture).save(folder / name)
            rows.append({"image": name, "T_base_flange": pose.tolist()})
        write_text(folder / POSES[0], json.dumps(rows, indent=1) + "\n")
        lens = self.lens
        camera = {name: getattr(lens, name) for name in ("fx", "fy", "cx", "cy", "width", "height")}
        write_text(folder / CAMERA[0], json.dumps({**camera, "distortion": lens.distortion}, indent=1) + "\n")


def simulate(
    samples: int,
    seed: int,
    marker: Marker,
    reachable: Reachable = REACH,
    robot_noise: tuple[float, float] = (0.05, 0.0005),
    blur: float = 0.6,
    noise: float = 3.0,
) -> Session:
    """Take samples in a cell whose camera and marker are some centimetres and degrees off where they should be.

    Args:
        samples: how many.
        seed: of everything that is drawn.
        marker: the marker on the flange.
        reachable: poses of the flange that the arm reaches.
        robot_noise: standard deviations along each axis of the flange's true pose from the one that the robot tells,
            degrees and m.
        blur: standard deviation of the lens's blur, pixels.
        noise: standard deviation of the sensor's noise, grey levels.
    """
    import cv2

    rng = np.random.default_rng(seed)
    camera, mount = look_at(VIEW, CENTRE, DISTANCE), np.eye(4)
    mount[2, 3] = 0.03  # a plate on the flange
    truth = Truth(camera @ _jitter(rng, 1, 2.0, 0.02)[0], mount @ _jitter(rng, 1, 2.0, 0.005)[0])
    flange = choose_poses(samples, camera, mount, marker, LENS, reachable, rng)
    actual = flange @ _jitter(rng, samples, *robot_noise)
    size = (int(LENS.width or 0), int(LENS.height or 0))
    pictures = []
    for seen in np.linalg.inv(truth.camera) @ actual @ truth.mount:
        # A dim, uneven background.
        coarse = rng.uniform(60.0, 160.0, (7, 12)).astype(np.float32)
        background = cv2.resize(coarse, size, interpolation=cv2.INTER_CUBIC).astype(np.float32)
        picture = draw(background, seen, marker, LENS, light=rng.uniform(0.7, 1.0))
        grain = noise * rng.standard_normal(picture.shape, np.float32)
        levels = cv2.GaussianBlur(picture, (0, 0), blur) + grain
        pictures.append(np.clip(np.rint(levels), 0, 255).astype(np.uint8))
    return Session([f"{i:03}.png" for i in range(samples)], flange, LENS, pictures=pictures, truth=truth)


def _jitter(rng: np.random.Generator, count: int, degrees: float, metres: float) -> Array:
    """Small random transforms [count, 4, 4]; the standard deviations are those along each axis."""
    transforms = np.tile(np.eye(4), (count, 1, 1))
    transforms[:, :3, :3] = Rotation.from_rotvec(np.radians(degrees) * rng.standard_normal((count, 3))).as_matrix()
    transforms[:, :3, 3] = metres * rng.standard_normal((count, 3))
    return transforms


def read_session(folder: Path) -> Session:
    """Read a folder of pictures, ``poses.json`` or ``poses.csv``, and ``camera.json`` or ``camera.yaml``.

    Each row of the poses names its ``image`` and has either ``T_base_flange`` (JSON only, 4 x 4) or ``x y z`` (m) and
    the quaternion ``qw qx qy qz``.

    Raises:
        UserError: a file is missing or is not what it should be.
    """
    if not folder.is_dir():
        raise UserError(f"{folder} is no folder; give one with pictures, {POSES[0]} and {CAMERA[0]}")
    file = _one_of(folder, POSES)
    lens_file = _one_of(folder, CAMERA)
    lens = read_intrinsics(lens_file)._replace(distortion=read_distortion(lens_file))
    rows = _rows(file)
    names = [str(row.get("image") or "") for row in rows]
    for i, name in enumerate(names):
        if not name or not (folder / name).is_file():
            raise UserError(f"{file}: row {i + 1} names the image {name!r}, which is not in {folder}")
    if not rows:
        raise UserError(f"{file} has no rows; write one for each image")
    return Session(names, np.stack([_pose(row, file, i) for i, row in enumerate(rows)]), lens, folder)


def _one_of(folder: Path, names: tuple[str, ...]) -> Path:
    for name in names:
        if (folder / name).is_file():
            return folder / name
    raise UserError(f"{folder} has no {' or '.join(names)}; docs/robot.md describes the files")


def _rows(file: Path) -> list[dict[str, Any]]:
    try:
        if file.suffix == ".csv":
            return list(csv.DictReader(file.read_text("utf-8-sig").splitlines(), skipinitialspace=True))
        rows = yaml.safe_load(file.read_text("utf-8").replace("\t", " "))  # JSON is YAML
    except (OSError, UnicodeDecodeError, csv.Error, yaml.YAMLError, RecursionError, ValueError) as error:
        raise UserError(f"{file} cannot be read: {' '.join(str(error).split())}") from error
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise UserError(f"{file} is no list of rows, each with an image and a pose")
    return rows


def _pose(row: dict[str, Any], file: Path, i: int) -> Array:
    """T_base_flange [4, 4] of a row."""
    pose = np.eye(4)
    try:
        if "T_base_flange" in row:
            pose = np.array(row["T_base_flange"], dtype=np.float64).reshape(4, 4)
        else:
            quaternion = np.array([row[name] for name in QUATERNION], dtype=np.float64)
            if not abs(math.hypot(*quaternion) - 1.0) < 0.01:
                raise ValueError("the quaternion qw qx qy qz is not of length 1")
            pose[:3, :3] = Rotation.from_quat(np.roll(quaternion, -1)).as_matrix()
            pose[:3, 3] = [row[name] for name in "xyz"]
    except KeyError as error:
        lacks = f"row {i + 1} has no {error.args[0]}"
        raise UserError(f"{file}: {lacks}; give x y z qw qx qy qz, or T_base_flange as 4 x 4 numbers") from error
    except (TypeError, ValueError) as error:
        raise UserError(f"{file}: row {i + 1} is no pose ({' '.join(str(error).split())})") from error
    rotation = pose[:3, :3]
    off = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if not (np.isfinite(pose).all() and off < 1e-2 and np.linalg.det(rotation) > 0 and (pose[3] == (0, 0, 0, 1)).all()):
        raise UserError(f"{file}: row {i + 1} is no rigid pose of finite numbers")
    if np.abs(pose[:3, 3]).max() > 10.0:
        raise UserError(f"{file}: row {i + 1} is {np.abs(pose[:3, 3]).max():.0f} m away; give metres, not millimetres")
    pose[:3, :3] = Rotation.from_matrix(rotation).as_matrix()  # rounded numbers are not quite a rotation
    return pose


def _picture(path: Path, lens: Intrinsics) -> NDArray[np.uint8]:
    try:
        with Image.open(path) as image:
            pixels = np.asarray(image.convert("L"))
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise UserError(f"{path} is damaged or no image ({error})") from error
    height, width = pixels.shape
    if lens.width is not None and (lens.width, lens.height) != (width, height):
        raise UserError(
            f"{path} has {width} x {height} pixels, but the intrinsics are those of {lens.width} x {lens.height}"
        )
    return pixels
