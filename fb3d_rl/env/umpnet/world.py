"""What both simulations of UMPNet's world share: the constants of a pull, and what a world of scenes does."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pkgutil import resolve_name
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from fb3d_rl.env.umpnet.options import BACKENDS
from fb3d_rl.env.umpnet.scenes import Placed

STROKE = 0.18
"""How far (m, UMPNet's world) from the held point the target of a pull is."""

GAIN = 0.002
"""Share of the way to its target that the carriage is commanded in each step of the simulation."""

STEPS = 8 * 240
"""Most steps of a pull."""

STILL = 1e-4
"""A step in which the carriage moves less (m) is counted, and ..."""

STILLS = 3
"""... so many of them end the pull, whether or not they follow each other."""

Array = NDArray[np.float64]


class World(Protocol):
    """Several scenes, each with a hand that holds a point of a movable link for good once it has touched it.

    Lengths are in the object's own size, m (:mod:`fb3d_rl.camera.umpnet`).
    """

    placed: Sequence[Placed]
    states: list[Array]
    """Joint states [J] (rad or m) of the scenes."""

    def touch(self, index: int, link: int, point: Array) -> None:
        """In scene number ``index`` take hold of a movable ``link`` at a world point [3]."""

    def held(self, index: int) -> Array:
        """The held world point [3] of a scene."""

    def pull(self, directions: Array) -> None:
        """Pull every held point for one stroke along its unit direction [B, 3]; scenes with the direction 0 rest."""

    def close(self) -> None:
        """Give free what the simulation holds."""


def make_world(backend: str, placed: Sequence[Placed]) -> World:
    """The scenes at their starts, in the world of that name.

    Raises:
        UserError: PyBullet is missing or cannot read an object.
    """
    make: Callable[[Sequence[Placed]], World] = resolve_name(BACKENDS[backend])
    return make(placed)
