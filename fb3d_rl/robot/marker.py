"""Square ArUco markers: how a camera sees one, and where it is by a picture.

A marker's frame has its origin in the centre, x to the right, y to the upper side and z out of the marker; a camera's
has x right, y down, z forward; pixel (0, 0) is the centre of the first pixel.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from fb3d_rl.errors import UserError
from fb3d_rl.perception.depth import Intrinsics

Array = NDArray[np.float64]

SUPERSAMPLE = 8
"""A drawn marker's pixels are means of so many samples in rows and in columns."""


@dataclass(frozen=True)
class Marker:
    """A marker as it is printed."""

    side: float = 0.1
    """Length of the black square's side, m."""
    dictionary: str = "4X4_50"
    """OpenCV's name of the set that the marker is of, without DICT_."""
    id: int = 0

    @property
    def corners(self) -> Array:
        """The black square's corners [4, 3] (m) in the marker's frame: upper left, upper right, lower right, left."""
        return 0.5 * self.side * np.array([[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.0]])


class Sighting(NamedTuple):
    """A marker in a picture."""

    pose: Array
    """T_camera_marker [4, 4], m."""
    rays: Array
    """Its corners [4, 2] as x / z and y / z in the camera's frame."""


def project(pose: Array, points: Array, camera: Intrinsics) -> Array:
    """Pixels [..., P, 2] of ``points`` [P, 3] at T_camera_points [..., 4, 4], by a camera without distortion."""
    seen = points @ np.swapaxes(pose[..., :3, :3], -1, -2) + pose[..., None, :3, 3]
    return seen[..., :2] / seen[..., 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy)


def draw(
    picture: NDArray[np.float32], pose: Array, marker: Marker, camera: Intrinsics, light: float = 1.0
) -> NDArray[np.float32]:
    """Draw a marker and a white rim of one cell into a grey picture [H, W], antialiased; returns the picture.

    Args:
        picture: grey levels, 0 to 255; changed in place.
        pose: T_camera_marker [4, 4]; the marker faces the camera and lies before it.
        marker: the marker.
        camera: without distortion.
        light: brightness of white, 1 for 230 grey levels.
    """
    import cv2

    family = _dictionary(marker)
    cells = family.markerSize + 2
    black_and_white = cv2.aruco.generateImageMarker(family, marker.id, cells).astype(np.float32)
    texture = light * (25.0 + 205.0 / 255.0 * np.pad(black_and_white, 1, constant_values=255.0))
    corners = project(pose, marker.corners * (1.0 + 2.0 / cells), camera)
    height, width = picture.shape
    low = np.clip(np.floor(corners.min(0)).astype(int), 0, (width, height))
    high = np.clip(np.ceil(corners.max(0)).astype(int) + 1, 0, (width, height))
    if (high <= low).any():
        return picture
    across, down = (
        np.arange(low[axis] * SUPERSAMPLE, high[axis] * SUPERSAMPLE) / SUPERSAMPLE + 0.5 / SUPERSAMPLE - 0.5
        for axis in (0, 1)
    )
    # Where each sample's ray meets the marker's plane, in cells from the rim's upper left corner.
    x, y, w = (
        row[0] * ((across - camera.cx) / camera.fx) + row[1] * ((down - camera.cy) / camera.fy)[:, None] + row[2]
        for row in np.linalg.inv(np.column_stack([pose[:3, :2], pose[:3, 3]]))
    )
    column, row = (np.floor(0.5 * cells + 1.0 + sign * cells / marker.side * at / w) for sign, at in ((1, x), (-1, y)))
    covered = (column >= 0) & (column < cells + 2) & (row >= 0) & (row < cells + 2)
    drawn = np.where(
        covered, texture[np.where(covered, row, 0).astype(int), np.where(covered, column, 0).astype(int)], 0
    )
    shape = (high[1] - low[1], SUPERSAMPLE, high[0] - low[0], SUPERSAMPLE)
    window = picture[low[1] : high[1], low[0] : high[0]]
    window[:] = window * (1.0 - covered.reshape(shape).mean((1, 3))) + drawn.reshape(shape).mean((1, 3))
    return picture


def find(picture: NDArray[np.uint8], marker: Marker, camera: Intrinsics) -> Sighting | None:
    """The marker in a grey picture [H, W]; None if it is not seen.

    The pose comes from OpenCV's IPPE_SQUARE (Collins and Bartoli, "Infinitesimal plane-based pose estimation", 2014),
    which knows both poses that a square has when it is seen from afar, and gives the better one.

    Raises:
        UserError: OpenCV has no such marker.
    """
    import cv2

    settings = cv2.aruco.DetectorParameters()
    settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    found, ids, _ = cv2.aruco.ArucoDetector(_dictionary(marker), settings).detectMarkers(picture)
    places = [] if ids is None else np.flatnonzero(np.ravel(ids) == marker.id)
    if len(places) != 1:  # of two markers of one name none is known to be on the flange
        return None
    pixels = _refined(picture, found[places[0]].reshape(4, 2).astype(np.float64), _dictionary(marker).markerSize + 2)
    matrix = np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
    undistorted = cv2.undistortPoints(pixels[:, None], matrix, np.array(camera.distortion))
    rays = np.asarray(undistorted, dtype=np.float64).reshape(4, 2)
    ok, turn, shift = cv2.solvePnP(marker.corners, rays, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE_SQUARE)
    if not ok:
        return None
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(turn)[0], shift.ravel()
    return Sighting(pose, rays)


def _refined(picture: NDArray[np.uint8], corners: Array, cells: int) -> Array:
    """Corners [4, 2] (pixels) where straight lines along the four sides meet.

    OpenCV's refinement moves the corners of a small square inwards, by a fifth of a pixel or more, which puts the
    marker farther away than it is; lines through the places where grey levels rise most have no such bias.

    Args:
        picture: grey [H, W].
        corners: to start from, clockwise in the image.
        cells: of the marker along a side.
    """
    for _ in range(2):
        sides = np.roll(corners, -1, axis=0) - corners
        along = sides / np.linalg.norm(sides, axis=1, keepdims=True)
        outward = np.stack([along[:, 1], -along[:, 0]], axis=1)
        # Half a cell inwards everything is black, so far outwards everything white.
        reach = min(0.4 * float(np.linalg.norm(sides, axis=1).min()) / cells, 4.0)
        part, across = np.linspace(0.1, 0.9, 40), np.linspace(-reach, reach, 33)
        places = corners[:, None, None] + part[:, None, None] * sides[:, None, None]
        places = places + across[:, None] * outward[:, None, None]
        grey = map_coordinates(picture, np.moveaxis(places[..., ::-1], -1, 0), np.float64, order=1, mode="nearest")
        rise = np.gradient(grey, axis=2)
        rise = np.clip(rise - 0.25 * rise.max(2, keepdims=True), 1e-9, None)
        middle = (rise * across).sum(2) / rise.sum(2)
        slope, start = np.polyfit(part, middle.T, 1)
        first = corners + start[:, None] * outward
        second = corners + sides + (start + slope)[:, None] * outward
        one = np.ones((4, 1))
        lines = np.cross(np.hstack([first, one]), np.hstack([second, one]))
        meet = np.cross(np.roll(lines, 1, axis=0), lines)
        corners = meet[:, :2] / meet[:, 2:]
    return corners


def _dictionary(marker: Marker) -> Any:
    import cv2

    name = f"DICT_{marker.dictionary}"
    if not hasattr(cv2.aruco, name):
        known = sorted(name.removeprefix("DICT_") for name in dir(cv2.aruco) if name.startswith("DICT_"))
        raise UserError(f"OpenCV has no set of markers {marker.dictionary}; choose from {', '.join(known)}")
    family = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
    if not 0 <= marker.id < len(family.bytesList):
        raise UserError(f"marker {marker.id} is not in {marker.dictionary}, which has 0 to {len(family.bytesList) - 1}")
    return family
