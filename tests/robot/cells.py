"""Cells with known transforms for the tests of calibration."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fb3d_rl.camera.views import View, look_at
from fb3d_rl.robot.calibration_poses import choose_poses
from fb3d_rl.robot.calibration_session import LENS, REACH
from fb3d_rl.robot.marker import Marker

Array = NDArray[np.float64]
MARKER = Marker()


def small(rng: np.random.Generator, count: int, degrees: float, metres: float) -> Array:
    """Random transforms [count, 4, 4]; standard deviations along each axis."""
    transforms = np.tile(np.eye(4), (count, 1, 1))
    transforms[:, :3, :3] = Rotation.from_rotvec(np.radians(degrees) * rng.normal(size=(count, 3))).as_matrix()
    transforms[:, :3, 3] = metres * rng.normal(size=(count, 3))
    return transforms


def camera_and_mount(rng: np.random.Generator) -> tuple[Array, Array]:
    """T_base_camera and T_flange_marker: some metre before the robot, some centimetres on the flange, askew."""
    camera, mount = look_at(View(200.0, 35.0), np.array([0.5, 0.05, 0.3]), 1.1), np.eye(4)
    mount[:3, 3] = (0.01, -0.02, 0.04)
    return camera @ small(rng, 1, 5.0, 0.05)[0], mount @ small(rng, 1, 10.0, 0.01)[0]


def chosen(rng: np.random.Generator, count: int = 30) -> tuple[Array, Array, Array]:
    """T_base_camera, T_flange_marker, and chosen T_base_flange [count, 4, 4]."""
    camera, mount = camera_and_mount(rng)
    return camera, mount, choose_poses(count, camera, mount, MARKER, LENS, REACH, rng)


def turned_by(rng: np.random.Generator, degrees: float, count: int = 30, axes: float = 1.0) -> Array:
    """T_base_flange [count, 4, 4] turned by up to ``degrees`` about x, and ``axes`` times as far about y and z."""
    flange = np.tile(np.eye(4), (count, 1, 1))
    vectors = np.radians(degrees) * rng.uniform(-1.0, 1.0, (count, 3)) * (1.0, axes, axes)
    flange[:, :3, :3] = Rotation.from_rotvec(vectors).as_matrix()
    flange[:, :3, 3] = np.array([0.6, 0.0, 0.3]) + rng.uniform(-0.2, 0.2, (count, 3))
    return flange
