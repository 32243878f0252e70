"""One attempt to open a part, through a driver only (supplement, I.D to I.G)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from fb3d_rl.robot.arm import Arm
from fb3d_rl.robot.attempt import Attempt, AttemptOptions, Predictor, Puller
from fb3d_rl.robot.driver import Driver

Array = NDArray[np.float64]


def attempt(
    driver: Driver,
    arm: Arm,
    camera: Array,
    predictor: Predictor,
    options: AttemptOptions | None = None,
    seed: int = 0,
    puller: Puller | None = None,
    opened: Callable[[], bool] | None = None,
    say: Callable[[str], None] | None = None,
) -> Attempt:
    """See what opens, plan, approach, touch, hold and pull; the arm stands still afterwards, its suction off.

    Nothing raises but a fault of the program: whatever goes wrong is the attempt's reason and sentence.

    Args:
        driver: the robot, the simulated cell or a recording.
        arm: the arm that the driver moves.
        camera: T_base_camera [4, 4] of the calibration.
        predictor: the flow of what is seen, such as a network's; asked once before the contact and in a pull.
        options: speeds, forces and times.
        seed: of all that is drawn; the same driver answers and seed give the same commands.
        puller: asked in a pull in place of the predictor.
        opened: asked after each look whether the part is open, which ends the attempt.
        say: gets a line for each stage.
    """
    raise NotImplementedError
