"""How many pulls a trial took until the part moved the right way: what touch costs where sight cannot tell the way."""

from __future__ import annotations

import math

import torch
from torch import Tensor

MOVED = 0.05
"""Share of the way to the goal after which a part has moved the right way."""

SPACING = 0.005
"""The tip's way (m) over which the direction of a pull is measured."""

REVERSED = -0.5
"""Cosine to the direction before, below which the tip turned round: another pull."""


def pulls_until_moved(tips: Tensor, attached: Tensor, distances: Tensor) -> int:
    """Pulls that an episode began until the part had moved the right way; -1 if it never did.

    A pull begins when suction takes hold, and where the tip turns round without letting go.

    Args:
        tips: [T + 1, 3] the suction tip before the first step and after each, m.
        attached: [T] bool, whether suction holds after a step.
        distances: [T] normalized distance after each step.
    """
    moved = (distances <= 1.0 - MOVED).nonzero().flatten()
    if not len(moved):
        return -1
    pulls, held, place, before = 0, False, tips[0], None
    for tip, holds in zip(tips[1 : int(moved[0]) + 2].double(), attached.tolist(), strict=False):
        if holds and not held:
            pulls, place, before = pulls + 1, tip, None
        elif holds and math.dist(tip.tolist(), place.tolist()) >= SPACING:
            along = torch.nn.functional.normalize(tip - place, dim=0)
            if before is not None and float(along @ before) < REVERSED:
                pulls += 1
            place, before = tip, along
        held = holds
    return pulls
