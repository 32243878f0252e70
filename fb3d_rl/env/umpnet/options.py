"""Options of trials in UMPNet's world."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from fb3d_rl.options import option

BACKENDS: dict[str, str] = {
    "quasistatic": "fb3d_rl.env.umpnet.quasistatic:Quasistatic",
    "pybullet": "fb3d_rl.env.umpnet.bullet:Bullet",
}
"""The worlds by name, as "module:class"."""


@dataclass(frozen=True)
class UmpnetOptions:
    """Trials in UMPNet's world, of protocol=umpnet."""

    task: Literal["manipulation", "exploration"] = option(
        "manipulation", "manipulation: bring a joint to the state of a goal image; exploration: see many of its states"
    )
    backend: str = option(
        "quasistatic",
        "what moves the parts: pybullet, as in UMPNet (extra umpnet), or a quasi-static rule for the same pulls",
        among=BACKENDS,
    )
    mask: Literal["goal", "target"] = option(
        "goal",
        "the points that a policy is told are the part's: goal, those that differ from the goal image, as UMPNet has "
        "it; target, the truth, which in exploration it is in any case",
    )
    batch: int = option(16, "scenes that are run side by side, their pulls together", within="[1, inf)")
