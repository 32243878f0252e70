"""A film of an attempt in the simulated cell, with arm and cell, drawn on the CPU."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fb3d_rl.camera.views import View
from fb3d_rl.drawing.bodies import GRIPPER, STATIC, Body, Part, link_colors
from fb3d_rl.drawing.camera import Camera
from fb3d_rl.drawing.studio import Studio
from fb3d_rl.drawing.video import encode
from fb3d_rl.robot.driver import JointState, Picture, Wrench
from fb3d_rl.robot.sight import ArmSight, box_mesh
from fb3d_rl.robot.simulated import SimulatedCell
from fb3d_rl.robot.workspace import CENTRE, SIZE, TABLE, cell

Array = NDArray[np.float64]

RATE = 6
"""Pictures per second, of the cell's time."""

VIEW = View(-60.0, 28.0)
"""From behind the robot on its left, where its camera is: objects face that way."""

LIFT = np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0.05 - TABLE], [0, 0, 0, 1]])
"""The drawn ground is at 0, below the table."""


class Filmed:
    """The driver of a simulated cell that keeps what is to be drawn.

    Args:
        cell: the cell.
    """

    def __init__(self, cell: SimulatedCell) -> None:
        self.cell = cell
        self.moments = [cell.poses()]
        """T_base_body [B, 4, 4] at each picture."""

    def joints(self) -> JointState:
        """See :class:`~fb3d_rl.robot.driver.Driver`, as for the other four."""
        return self.cell.joints()

    def wrench(self) -> Wrench:
        return self.cell.wrench()

    def move(self, velocity: Array) -> None:
        self.cell.move(velocity)
        if self.cell.joints().time * RATE >= len(self.moments):
            self.moments.append(self.cell.poses())

    def suction(self, on: bool) -> bool:
        return self.cell.suction(on)

    def picture(self) -> Picture:
        return self.cell.picture()

    def write(self, path: Path, size: tuple[int, int] = (480, 360)) -> None:
        """Write the film, .mp4 or .gif."""
        encode(self._pictures(size), path, size, RATE, hold=1.0)

    def _pictures(self, size: tuple[int, int]) -> Iterator[NDArray[np.uint8]]:
        obj = self.cell.content.obj
        # The posts on the near side would hide what happens.
        boxes = [box_mesh(box) for box in cell() if box.size[2] < 0.5 or box.pose[1, 3] < 0.0]
        still = Body([Part(boxes, STATIC, LIFT)])
        links = [Body([Part(link.visuals, color)]) for link, color in zip(
            obj.links, link_colors(obj, self.cell.content.link), strict=True
        )]  # fmt: skip
        arm = [Body([Part(meshes, GRIPPER)]) for meshes in ArmSight(self.cell.arm).meshes]
        reach = np.array(SIZE) / 2
        corners = np.array([[*(CENTRE + reach * (a, b)), z] for a in (-1, 1) for b in (-1, 1) for z in (0.0, 0.5)])
        whole = np.concatenate([corners, [[-0.15, 0.0, 0.0], [0.0, 0.0, 0.85]]]) + LIFT[:3, 3]
        studio = Studio(Camera.fitting(VIEW, whole, size), still)
        for poses in self.moments:
            yield studio.picture([(body, LIFT @ pose) for body, pose in zip([*links, *arm], poses, strict=True)])
