"""When to be where on a path: the fastest motion within joint velocities and accelerations, by TOPP-RA.

TOPP-RA (Pham and Pham, IEEE T-RO 2018) is the library toppra, which mani-skill brings along on Linux.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline

from fb3d_rl.errors import UserError
from fb3d_rl.robot.arm import ACCELERATION, SPEED, Arm
from fb3d_rl.robot.collision import Checker

Array = NDArray[np.float64]

CORNER = 0.3
"""Up to so far (rad) from a corner of its path the motion cuts it; halved until it touches nothing."""

HALVINGS = 8
"""After the last one the curve is within 1 mm or so of the path, which is less than the margin of a path."""

FINE = 0.004
"""Between the states of the rounded path that are checked, rad (Euclidean norm): the tip moves less than 1 cm."""

GRID = 0.02
"""Between the points of the path at which the limits are kept exactly, rad."""


@dataclass(frozen=True)
class Motion:
    """A path in time.

    Attributes:
        times: [K], s, from 0 on.
        positions: joint states [K, J] then, rad.
        velocities: [K, J], rad/s; 0 at both ends.
    """

    times: Array
    positions: Array
    velocities: Array

    @property
    def duration(self) -> float:
        return float(self.times[-1])


def timed(
    arm: Arm,
    path: Array,
    checker: Checker | None = None,
    speed: float = SPEED,
    acceleration: float = ACCELERATION,
    rate: float = 100.0,
) -> Motion:
    """The fastest motion along a path that stands still at both ends.

    The path's corners are rounded, since a motion could pass them only at rest.

    Args:
        arm: its joints' velocities are limits, too.
        path: joint states [K, J] with straight pieces between them, rad.
        checker: what the rounded path must not touch; unless given, it is not looked at.
        speed: limit for all joints, rad/s.
        acceleration: likewise, rad/s^2.
        rate: how often the motion is given, 1/s.

    Raises:
        UserError: toppra is not installed.
    """
    if len(path) < 2 or not np.abs(np.diff(path, axis=0)).any():
        return Motion(np.zeros(1), path[:1].copy(), np.zeros_like(path[:1]))
    try:
        import toppra
        from toppra.algorithm import TOPPRA
        from toppra.constraint import JointAccelerationConstraint, JointVelocityConstraint
    except ImportError as error:
        raise UserError("motions are timed by toppra, which is not installed: pip install toppra") from error
    toppra.setup_logging("ERROR")
    curve = _Curve(rounded(path, checker))
    velocity = np.minimum(arm.velocity.numpy(), speed)
    limits = [
        JointVelocityConstraint(np.stack([-velocity, velocity], axis=1)),
        JointAccelerationConstraint(np.full((path.shape[1], 2), [-acceleration, acceleration])),
    ]
    points = np.linspace(0.0, curve.length, 2 + int(curve.length / GRID))
    trajectory = TOPPRA(limits, curve, gridpoints=points, parametrizer="ParametrizeConstAccel").compute_trajectory(0, 0)
    if trajectory is None:
        raise RuntimeError("TOPP-RA found no motion along the path, although it may rest at its ends")
    times = np.linspace(0.0, trajectory.duration, 2 + int(trajectory.duration * rate))
    return Motion(times, trajectory(times), trajectory(times, 1))


def rounded(path: Array, checker: Checker | None = None) -> BSpline:
    """The path [K, J] as a smooth curve over [0, 1]: straight pieces stay straight, corners are cut.

    It is the clamped cubic B-spline whose control points lie on the path, CORNER apart, or less where it would touch
    something. As CORNER goes to 0 it becomes the path.
    """
    for halving in range(HALVINGS):
        curve = _spline(path, CORNER / 2**halving)
        if checker is None or bool(checker.free(curve(np.linspace(0.0, 1.0, 2 + int(_length(path) / FINE)))).all()):
            break
    return curve


def _length(path: Array) -> float:
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())


def _spline(path: Array, spacing: float) -> BSpline:
    control = [path[:1]]
    for a, b in zip(path[:-1], path[1:], strict=True):
        pieces = max(1, int(np.ceil(np.linalg.norm(b - a) / spacing)))
        control.append(a + np.arange(1, pieces + 1)[:, None] / pieces * (b - a))
    points = np.concatenate(control)
    if len(points) < 4:  # as many as a cubic needs
        return _spline(path, spacing / 2)
    knots = np.concatenate([np.zeros(3), np.linspace(0.0, 1.0, len(points) - 2), np.ones(3)])
    return BSpline(knots, points, 3)


class _Curve:
    """A curve as toppra takes it: over [0, length], with its derivatives."""

    def __init__(self, curve: BSpline) -> None:
        samples = curve(np.linspace(0.0, 1.0, 500))
        self.length = _length(samples)
        self.dof = samples.shape[1]
        self.path_interval = np.array([0.0, self.length])
        self._orders = [curve, curve.derivative(1), curve.derivative(2)]

    def __call__(self, position: Array, order: int = 0) -> Array:
        return np.asarray(self._orders[order](np.asarray(position) / self.length) / self.length**order)
