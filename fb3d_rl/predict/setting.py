"""A cloud of the user's own placed upright in a world, and what of it is the object."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from fb3d_rl.errors import UserError
from fb3d_rl.perception.foreground import above, outliers, support_plane, turned_up, viewpoint

Array = NDArray[np.float64]

AZIMUTH = 60.0
"""Degrees beside -x from which a cloud may be seen before it is turned about the vertical: the network was trained on
objects that face -x, seen from up to 45 degrees beside it."""

SKEW = 1.1
"""The bounding rectangle on the ground is this many times the smallest one where an object stands skew."""

AXES = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1), "-x": (-1, 0, 0), "-y": (0, -1, 0), "-z": (0, 0, -1)}
"""Directions that may be up, by name."""


@dataclass(frozen=True, eq=False)
class Setting:
    """A cloud in the world frame: upright, with its support at z = 0.

    Attributes:
        points: [n, 3] m, (cloud - base) @ turn.T.
        inside: [n] bool, on the object.
        turn: [3, 3] R_world_cloud.
        base: [3] the world's origin, in the cloud's frame.
        camera: [3] where the camera stood, in the world frame.
        remarks: what was guessed.
    """

    points: Array
    inside: NDArray[np.bool_]
    turn: Array
    base: Array
    camera: Array
    remarks: tuple[str, ...]

    @classmethod
    def of(
        cls,
        cloud: Array,
        camera: Array | None,
        up: str | ArrayLike,
        front: str | ArrayLike,
        tilt: float,
        ground: float | None,
        foreground: bool,
        far: float,
    ) -> Setting:
        """Place a cloud [n, 3]; see :func:`fb3d_rl.predict.plan.plan`."""
        remarks = []
        upwards = direction(up, "up")
        close = np.ones(len(cloud), dtype=bool)
        if camera is not None and math.isfinite(far):
            close = np.linalg.norm(cloud - camera, axis=1) <= far
        if close.sum() < 3:
            raise UserError(f"far={far:g}: {close.sum()} points are nearer to the camera.")
        plane = None
        if foreground and ground is None:
            plane = support_plane(cloud[close], upwards, math.radians(tilt), np.random.default_rng(0))
        if plane is not None:
            off = math.degrees(math.acos(min(1.0, float(plane.normal @ upwards))))
            upwards = plane.normal
            remarks.append(f"the support plane was found, {off:.0f} degrees off the given up")
        turn = turned_up(upwards)
        lowest = float((cloud[close] @ upwards).min())
        height = plane.height if plane is not None else lowest if ground is None else ground
        base = upwards * height
        points = (cloud - base) @ turn.T
        inside = close
        if foreground and (plane is not None or ground is not None):
            inside = close & above(points)
            inside[inside] = ~outliers(points[inside])
        if inside.sum() < 3:
            raise UserError("Nothing of the cloud is above its support: check up and ground, or give foreground=false.")
        if camera is None:
            place = viewpoint(points[inside])
            remarks.append("nobody says where the camera stood: it was guessed from what hides what")
        else:
            place = turn @ (camera - base)
        faces = None if isinstance(front, str) and front == "auto" else turn @ direction(front, "front")
        if faces is not None and np.linalg.norm(faces[:2]) < 0.1:
            raise UserError(f"front={front!r} is up or down: give a level direction.")
        yaw = _yaw(place, points[inside], faces)
        if yaw is not None:
            points, place, turn = points @ yaw.T, yaw @ place, yaw @ turn
            remarks.append("the network saw the object turned about the vertical, with its front to -x")
        return cls(points, inside, turn, base, place, tuple(remarks))


def _yaw(camera: Array, points: Array, front: Array | None) -> Array | None:
    """The turn [3, 3] about z after which the front of the object is -x; None if it is already, as far as can be seen.

    The network knows objects whose sides are parallel to the axes. So do most bodies stand whose bounding rectangle
    on the ground is the smallest one; of its four sides the front is the one that the camera sees best.
    """
    if front is not None:
        angle = math.atan2(-front[1], -front[0])
        return None if abs(angle) < 1e-6 else _about_z(-angle)
    some = points[:: max(1, len(points) // 2000)]
    areas = [float(np.prod(np.ptp(some @ _about_z(-math.radians(k)).T, axis=0)[:2])) for k in range(90)]
    skew = int(np.argmin(areas))
    skew = 0 if areas[0] <= SKEW * areas[skew] else skew
    x, y, _ = 0.5 * (points.min(0) + points.max(0)) - camera
    seen = math.degrees(math.atan2(y, x))
    if skew == 0 and abs(seen) <= AZIMUTH:
        return None
    turns = [(skew + quarter) for quarter in (0, 90, 180, 270)]
    best = min(turns, key=lambda turn: abs((seen - turn + 180) % 360 - 180))
    return _about_z(-math.radians(best))


def _about_z(angle: float) -> Array:
    cosine, sine = round(math.cos(angle), 15), round(math.sin(angle), 15)  # exact for quarters
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


def moved(points: NDArray[Any], pose: Array) -> Array:
    """Points [N, 3] of a frame b in a frame a, by T_ab [4, 4].

    Raises:
        UserError: the pose is no rigid one.
    """
    turn = pose[:3, :3]
    if not (np.isfinite(pose).all() and np.allclose(turn @ turn.T, np.eye(3), atol=1e-3) and np.linalg.det(turn) > 0):
        raise UserError("The camera's pose is no rotation with a position: give T_world_camera, 4 x 4.")
    return np.asarray(points @ turn.T + pose[:3, 3])


def position(camera: ArrayLike) -> Array:
    """Where a camera stands, of its position [3] or its pose [4, 4]."""
    try:
        values = np.asarray(camera.cpu() if isinstance(camera, Tensor) else camera, dtype=np.float64)
    except (ValueError, TypeError) as error:
        raise UserError("camera is no list of numbers: give its position [3] or its pose [4, 4].") from error
    if values.shape not in ((3,), (4, 4)) or not np.isfinite(values).all():
        raise UserError(f"camera is {list(values.shape)}: give its position [3] or its pose T_cloud_camera [4, 4].")
    return values if values.shape == (3,) else values[:3, 3]


def direction(way: str | ArrayLike, name: str) -> Array:
    """The unit vector [3] of an axis by name or of any vector.

    Raises:
        UserError: it is none.
    """
    if isinstance(way, str):
        if way not in AXES:
            raise UserError(f"{name}={way} is unknown; choose from {', '.join(AXES)}, or give a direction [3].")
        way = AXES[way]
    vector = numbers(way, (3,), name).numpy()
    if not vector.any():
        raise UserError(f"{name} is 0: give a direction [3].")
    return np.asarray(vector / np.linalg.norm(vector))


def numbers(values: ArrayLike, shape: Sequence[int], name: str) -> Tensor:
    """Finite numbers of this shape, float64.

    Raises:
        UserError: they are none; ``name`` is what they are called.
    """
    try:
        numbers = torch.as_tensor(np.asarray(values, dtype=np.float64))
    except (ValueError, TypeError) as error:
        raise UserError(f"{name} is no list of {shape[0]} numbers.") from error
    if tuple(numbers.shape) != tuple(shape) or not bool(numbers.isfinite().all()):
        raise UserError(f"{name} is {list(numbers.shape)}: give {shape[0]} numbers.")
    return numbers
