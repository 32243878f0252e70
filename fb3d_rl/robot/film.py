"""A film of an attempt in the simulated cell, with arm and cell, drawn on the CPU."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fb3d_rl.camera.views import View
from fb3d_rl.drawing.bodies import GRIPPER, STATIC, Body, Part, link_colors
from fb3d_rl.drawing.camera import Camera
from fb3d_rl.drawing.caption import CAPTION, Still, captioned, filmstrip, still_width
from fb3d_rl.drawing.signs import FREE, HOLDING
from fb3d_rl.drawing.studio import Studio
from fb3d_rl.drawing.video import encode
from fb3d_rl.files import replacing
from fb3d_rl.robot.attempt import OPEN
from fb3d_rl.robot.driver import JointState, Picture, Wrench
from fb3d_rl.robot.sight import ArmSight, box_mesh
from fb3d_rl.robot.simulated import SimulatedCell
from fb3d_rl.robot.workspace import CENTRE, SIZE, TABLE, cell
from fb3d_rl.rollout.shot import moments
from fb3d_rl.rollout.videos import SIZE as SHAPE
from fb3d_rl.rollout.videos import STRIP_WIDTH

Array = NDArray[np.float64]

RATE = 6
"""Pictures per second, of the cell's time."""

HOLD = 1.5
"""How long (s) the last picture is shown."""

VIEW = View(-60.0, 28.0)
"""From behind the robot on its left, where its camera is: objects face that way."""

LIFT = np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0.05 - TABLE], [0, 0, 0, 1]])
"""The drawn ground is at 0, below the table."""


class Filmed:
    """The driver of a simulated cell that keeps what is to be drawn.

    Args:
        cell: the cell.
        title: of the film.
    """

    def __init__(self, cell: SimulatedCell, title: str) -> None:
        self.cell, self.title = cell, title
        self.said = "looks at the object"
        """What the attempt said last: give :meth:`say` to it."""
        self._poses: list[Array] = []
        self._told: list[tuple[float, bool, float, str]] = []
        self._keep(0.0)

    def joints(self) -> JointState:
        """See :class:`~fb3d_rl.robot.driver.Driver`, as for the other four."""
        return self.cell.joints()

    def wrench(self) -> Wrench:
        return self.cell.wrench()

    def move(self, velocity: Array) -> None:
        self.cell.move(velocity)
        now = self.cell.joints().time
        if now * RATE >= len(self._poses):
            self._keep(now)

    def suction(self, on: bool) -> bool:
        return self.cell.suction(on)

    def picture(self) -> Picture:
        return self.cell.picture()

    def say(self, line: str) -> None:
        """Show the beginning of that line from now on."""
        self.said = re.split("[;:]", line)[0]

    def __len__(self) -> int:
        return len(self._poses)

    @property
    def aim(self) -> tuple[str, str]:
        """As of :class:`~fb3d_rl.rollout.film.Film`."""
        return "opened", "opened"

    def moment(self, t: int) -> str:
        """What moment ``t`` is called."""
        return f"after {self._told[t][0]:.0f} s"

    @property
    def attached(self) -> NDArray[np.bool_]:
        """Whether the cup holds something [T]."""
        return np.array([held for _, held, _, _ in self._told])

    @property
    def opened(self) -> Array:
        """How far the part is open [T], 0 to 1."""
        return np.array([opened for _, _, opened, _ in self._told])

    @property
    def tips(self) -> Array:
        """Where the cup is [T, 3], m, in the base's frame."""
        return np.array([poses[-1, :3, 3] for poses in self._poses])

    @property
    def success(self) -> bool:
        """Whether the part is open at the end."""
        return bool(self.opened[-1] > 1.0 - OPEN)

    def write(self, path: Path) -> None:
        """Write the film, .mp4 or .gif."""
        encode(self._frames(), path, (SHAPE[0], SHAPE[1] + CAPTION), RATE, HOLD)

    def write_filmstrip(self, path: Path) -> None:
        """Write a PNG of its important moments, side by side."""
        shown = moments(self)
        width = 2 * still_width(len(shown), STRIP_WIDTH)
        picture = self._drawing((width, 3 * width // 4))
        stills = [Still(name, self._state(t), picture(t)) for name, t in shown]
        with replacing(path) as part:
            filmstrip(stills, self.title, STRIP_WIDTH).save(part)

    def _keep(self, now: float) -> None:
        self._poses.append(self.cell.poses())
        opened = float(np.clip(1.0 - self.cell.distance(), 0.0, 1.0))
        self._told.append((now, self.cell.held is not None, opened, self.said))

    def _state(self, t: int) -> str:
        return f"{self._told[t][0]:.1f} s · {100 * self._told[t][2]:.0f} % opened"

    def _frames(self) -> Iterator[NDArray[np.uint8]]:
        picture = self._drawing(SHAPE)
        for t, (_, held, opened, said) in enumerate(self._told):
            yield np.asarray(captioned(picture(t), f"{self.title} · {said}", self._state(t), opened, held))

    def _drawing(self, size: tuple[int, int]) -> Callable[[int], NDArray[np.uint8]]:
        """What draws a moment, in pictures of that size."""
        obj = self.cell.content.obj
        # The posts on the near side would hide what happens.
        boxes = [box_mesh(box) for box in cell() if box.size[2] < 0.5 or box.pose[1, 3] < 0.0]
        still = Body([Part(boxes, STATIC, LIFT)])
        colors = link_colors(obj, self.cell.content.link)
        links = [Body([Part(link.visuals, color)]) for link, color in zip(obj.links, colors, strict=True)]
        *arm, tip = ArmSight(self.cell.arm).meshes
        bodies = [*links, *(Body([Part(meshes, GRIPPER)]) for meshes in arm)]
        free, holding = (Body([Part(tip, color)]) for color in (FREE, HOLDING))
        reach = np.array(SIZE) / 2
        corners = np.array([[*(CENTRE + reach * (a, b)), z] for a in (-1, 1) for b in (-1, 1) for z in (0.0, 0.5)])
        whole = np.concatenate([corners, [[-0.15, 0.0, 0.0], [0.0, 0.0, 0.85]]]) + LIFT[:3, 3]
        studio = Studio(Camera.fitting(VIEW, whole, size), still)

        def picture(t: int) -> NDArray[np.uint8]:
            shown = [*bodies, holding if self._told[t][1] else free]
            return studio.picture([(body, LIFT @ pose) for body, pose in zip(shown, self._poses[t], strict=True)])

        return picture
