"""Doors that look alike and open differently: what sight cannot tell, and touch can."""

from __future__ import annotations

import numpy as np

from fb3d_rl.procedural.frames import frame
from fb3d_rl.procedural.fronts import FrontStyle, HandleStyle, Side, hinged_door, swing_room
from fb3d_rl.procedural.spec import ObjectSpec

VARIANTS = 4
"""Doors of one group: hinged left or right, and each pulled or pushed."""


def ambiguous_door(rng: np.random.Generator, variant: int) -> ObjectSpec:
    """A door flush with both faces of its frame, whose hinges are not seen.

    Without a handle the four doors of a group are the same closed object; with one, its side tells that of the hinges,
    so there are two pairs, each the mirror image of the other, and only push and pull look alike.

    Args:
        rng: The same for all doors of a group.
        variant: 0 and 1 are hinged on the left, 2 and 3 on the right; the odd ones are pushed.
    """
    width, height = rng.uniform(0.55, 1.0), rng.uniform(1.2, 1.8)
    scale = 1.97 / float(np.hypot(width, height))
    x, y = (-width * scale / 2, width * scale / 2), (0.0, height * scale)
    thick, sill = rng.uniform(0.03, 0.08), bool(rng.random() < 0.4)
    bar = rng.uniform(0.04, 0.2) * (x[1] - x[0])
    head = bar * rng.uniform(0.6, 1.4)
    inner = x[1] - x[0] - 2 * bar
    gap = rng.uniform(0.0045, 0.007) + swing_room(inner, thick)
    leaf_x = (x[0] + bar + gap, x[1] - bar - gap)
    leaf_y = (y[0] + gap + (bar if sill else 0.0), y[1] - head - gap)
    kind = str(rng.choice(["none", "bar", "knob"], p=[0.5, 0.25, 0.25]))
    grip = HandleStyle(
        kind=kind,  # type: ignore[arg-type]
        reach=rng.uniform(0.035, 0.085),
        thickness=rng.uniform(0.014, 0.032),
        length=rng.uniform(0.15, 0.5),
        inset=rng.uniform(0.08, 0.14),  # what stands out in front of a pushed leaf swings beyond its free edge
        shift=rng.uniform(-0.4, 0.2),
        round=bool(rng.random() < 0.5),
    )
    rail = rng.uniform(0.06, 0.12) * rng.integers(0, 2)
    style = FrontStyle(grip, thick, rail, rng.uniform(0.2, 0.45))
    upper = rng.uniform(1.2, 1.55)
    side: Side = "left" if variant < VARIANTS // 2 else "right"
    part = hinged_door("rotation_door", style, side, leaf_x, leaf_y, (-thick, 0.0), upper, inward=variant % 2 == 1)
    body = frame("door_frame", x, y, (-thick, 0.0), bar, sill, head)
    return ObjectSpec("AmbiguousDoor", "static", "door_frame", tuple(body), (part,))
