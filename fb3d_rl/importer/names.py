"""What a part is, by its name."""

from __future__ import annotations

import re

from fb3d_rl.kinematics.opening import CONTROLS

NAMES = CONTROLS | frozenset("door drawer lid cover seat screen window sash flap leaf cap".split())
"""What a link can be called: the last of these words in its name is its semantic name."""


def part_name(name: str) -> str:
    """The last word in a link's name that is a known name of a part; "" if there is none."""
    return next((word for word in reversed(re.split(r"[\W_\d]+", name.lower())) if word in NAMES), "")
