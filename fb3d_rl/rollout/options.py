"""Options of which trials are run, and where."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from fb3d_rl.env.options import Start, drawn_fraction
from fb3d_rl.options import option

if TYPE_CHECKING:
    import numpy as np


@dataclass(frozen=True)
class CollectorOptions:
    """Where environments and policy run."""

    backend: Literal["direct", "process", "ray"] = option(
        "direct",
        "this process, worker processes, or Ray actors, on the cluster that RAY_ADDRESS names or else on this machine",
    )
    workers: int = option(
        1, "workers; direct has one in any case", within="[1, inf)", null="one per core of this machine"
    )
    restarts: int = option(
        20, "how many workers that died are started again, in total, for each policy", within="[0, inf)"
    )


@dataclass(frozen=True)
class ScheduleOptions:
    """How trials start, what their goal is, and how often each is repeated."""

    start: Start = option(
        "reference",
        "how far the part is open at the start: reference (20 % in some categories, else closed), closed, or random "
        "(uniform, up to 90 %)",
    )
    goal: Literal["open", "state"] = option(
        "open",
        "open, fully (UMPNet's exploration), or a joint state that is drawn at least 30 % of the range away from the "
        "start, which is random then, towards opening or closing (UMPNet's manipulation)",
    )
    repeats: int = option(1, "trials of each part, each with a view and a seed of its own", within="[1, inf)")

    def draw(self, rng: np.random.Generator) -> dict[str, float | None]:
        """Start and goal of a trial, for :func:`~fb3d_rl.env.options.default_trial`."""
        if self.goal == "state":
            start, goal = rng.random(2)
            while abs(goal - start) < 0.3:
                start, goal = rng.random(2)
            return {"fraction": float(start), "goal": float(goal)}
        return {"fraction": drawn_fraction(self.start, rng)}
