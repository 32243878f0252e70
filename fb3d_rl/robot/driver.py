"""What an attempt needs of a robot: five methods, which a simulated cell, a recording and a real robot have.

All vectors are in the frame of the robot's base, z up; numbers are in m, rad, s, N and Nm.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from fb3d_rl.perception.depth import Intrinsics

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class JointState:
    """The arm now.

    Attributes:
        position: [J] rad, in the order of the arm's joints.
        velocity: [J] rad/s.
        time: of the driver's own clock, s; it never goes back.
    """

    position: Array
    velocity: Array
    time: float


@dataclass(frozen=True, eq=False)
class Wrench:
    """What is felt at the tip: force and moment that the world exerts on the cup and all that it holds.

    As the sensor reports them, with its bias, which an attempt takes off itself.

    Attributes:
        force: [3] N, along the base's axes.
        moment: [3] Nm about the tip, likewise.
    """

    force: Array
    moment: Array


@dataclass(frozen=True, eq=False)
class Picture:
    """An RGB-D picture; depth and colour show the same through the same lens, without distortion.

    Attributes:
        depth: [H, W] m along the camera's axis, 0 where nothing was measured.
        colour: [H, W, 3] uint8, or None of a camera without.
        lens: the depth image's intrinsics.
        time: when it was taken, by the clock of :attr:`JointState.time`, s.
    """

    depth: NDArray[np.float32]
    colour: NDArray[np.uint8] | None
    lens: Intrinsics
    time: float


@runtime_checkable
class Driver(Protocol):
    """A robot arm with a suction cup before a fixed depth camera.

    A method that fails raises :class:`~fb3d_rl.errors.UserError` with one sentence; an attempt then stops the arm and
    ends. All of them answer at once but :meth:`move`, which sets the pace.
    """

    def joints(self) -> JointState:
        """The arm's joint state now."""
        ...

    def wrench(self) -> Wrench:
        """The latest force and moment at the tip."""
        ...

    def move(self, velocity: Array) -> None:
        """Command joint velocities [J] (rad/s) and return after one control period, 10 ms or less.

        The driver holds them until the next call and stops the arm by itself if none comes within a tenth of a second.
        It checks its own limits of velocity and force; a velocity that is beyond is an error and stops the arm.
        """
        ...

    def suction(self, on: bool) -> bool:
        """Switch the suction, which may be so already, and tell whether there is a vacuum in the cup now."""
        ...

    def picture(self) -> Picture:
        """A fresh picture, taken after the call."""
        ...
