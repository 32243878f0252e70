"""The simulated cell: an arm, an object on the table and a camera, as a :class:`~fb3d_rl.robot.driver.Driver`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.camera.noise import EXACT, DepthNoiseOptions
from fb3d_rl.options import check, option
from fb3d_rl.perception.suction import CupOptions
from fb3d_rl.robot.arm import Arm
from fb3d_rl.robot.driver import JointState, Picture, Wrench

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class TableObject:
    """An object of table size that stands on the table.

    Attributes:
        obj: the object, m.
        link: the part to open.
        start: joint state [J] at the start, rad or m.
        place: x, y of the object's origin (m) and its turn about z (rad) in the base's frame; at turn 0 its front faces
            the robot, -x.
        masses: of the links [L], kg; those of links that do not move do not matter.
        friction: of each joint, as a coefficient of PhysX (:attr:`fb3d_rl.env.options.EnvOptions.joint_friction`).
        damping: of each joint, Nm s/rad or N s/m.
    """

    obj: ArticulatedObject
    link: int
    start: Sequence[float]
    place: tuple[float, float, float]
    masses: Sequence[float]
    friction: float = 0.05
    damping: float = 0.05


@dataclass(frozen=True)
class CellOptions:
    """How real a simulated cell is."""

    noise: DepthNoiseOptions = field(default_factory=lambda: EXACT)
    suction: Literal["seal", "perfect"] = option(
        "seal", "seal: the surface decides whether the cup holds, and loads tear it; perfect: it always holds"
    )
    force_bias: float = option(2.0, "largest bias of the force at the tip along each axis", "N", "[0, inf)")
    force_noise: float = option(0.3, "standard deviation of the force along each axis", "N", "[0, inf)")
    rate: int = option(100, "control steps per second", "Hz", "[100, inf)")
    substeps: int = option(4, "physics steps in a control step", within="[1, inf)")
    cup: CupOptions = field(default_factory=CupOptions)

    def __post_init__(self) -> None:
        check(self)


class SimulatedCell:
    """A cell with one object; the methods of :class:`~fb3d_rl.robot.driver.Driver`, and the truth beside them.

    Args:
        arm: the arm; it starts at its home.
        content: the object on the table.
        options: errors and suction.
        session: seed of what stays the same in a session: the camera's bias and which bodies are dark.
        seed: of all else that is drawn in this trial.
        error: T_true_believed [4, 4] of the camera's calibration: what :attr:`believed` is off.

    Attributes:
        camera: the true T_base_camera [4, 4].
        believed: the calibrated one, ``camera @ error``.
    """

    camera: Array
    believed: Array

    def __init__(
        self,
        arm: Arm,
        content: TableObject,
        options: CellOptions | None = None,
        session: int = 0,
        seed: int = 0,
        error: Array | None = None,
    ) -> None:
        raise NotImplementedError

    # ------------------------------------------------------------------------------------------------- the driver

    def joints(self) -> JointState:
        """See :class:`~fb3d_rl.robot.driver.Driver`."""
        raise NotImplementedError

    def wrench(self) -> Wrench:
        """See :class:`~fb3d_rl.robot.driver.Driver`."""
        raise NotImplementedError

    def move(self, velocity: Array) -> None:
        """See :class:`~fb3d_rl.robot.driver.Driver`."""
        raise NotImplementedError

    def suction(self, on: bool) -> bool:
        """See :class:`~fb3d_rl.robot.driver.Driver`."""
        raise NotImplementedError

    def picture(self) -> Picture:
        """See :class:`~fb3d_rl.robot.driver.Driver`."""
        raise NotImplementedError

    # -------------------------------------------------------------------------------------------------- the truth

    def flow(self, points: NDArray[np.floating]) -> NDArray[np.float64]:
        """The true flow [N, 3] of points [N, 3] (m, base) near the object's surface; the largest norm is 1.

        ``lambda observation: cell.flow(observation.points)`` is the expert.
        """
        raise NotImplementedError

    def labels(self) -> NDArray[np.int64]:
        """What each pixel [H, W] of the last picture truly shows: a link's index, -1 nothing, -2 arm, -3 the cell."""
        raise NotImplementedError

    def position(self) -> float:
        """Of the joint to open, rad or m."""
        raise NotImplementedError

    def distance(self) -> float:
        """Normalised distance to fully open: 1 at the start, 0 open."""
        raise NotImplementedError

    @property
    def held(self) -> int | None:
        """The link that the cup holds now."""
        raise NotImplementedError
