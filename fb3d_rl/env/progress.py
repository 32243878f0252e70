"""How far the parts of the running trials are open, and which of them suction has held: the task's metrics."""

from __future__ import annotations

import torch
from torch import Tensor

from fb3d_rl.env.stage import Stage


class Progress:
    """What the metrics of E environments need besides their joint states [E, J], which are padded on the right.

    Args:
        envs: E.
        joints: J, of the object with the most joints.
        success: a part counts as open below this normalized distance.
        device: of all tensors.

    Attributes:
        held: [E, J] bool, the joints whose part suction has held in this trial.
        target: [E, 1] int64, position of the joint to open in the joint state.
    """

    def __init__(self, envs: int, joints: int, success: float, device: torch.device) -> None:
        self.held = torch.zeros(envs, joints, dtype=torch.bool, device=device)
        self.target = torch.zeros(envs, 1, dtype=torch.int64, device=device)
        self._start, self._goal = torch.full((2, envs, joints), torch.nan, device=device)
        self._opens = torch.ones(envs, joints, dtype=torch.bool, device=device)
        self._success = success

    def begin(self, e: int, stage: Stage) -> None:
        """Begin the trial of environment ``e``."""
        start = torch.tensor(stage.trial.start, dtype=torch.float32)
        self.target[e], self.held[e], self._opens[e] = stage.target, False, True
        self._opens[e, stage.target] = stage.trial.goal is None
        self._start[e, : len(start)] = start
        self._goal[e, : len(start)] = torch.from_numpy(stage.goals())

    def hold(self, e: int, stage: Stage) -> None:
        """Note what suction holds in environment ``e``."""
        if stage.suction.held is not None:
            carried = stage.tree.descendants[:, stage.suction.held]
            self.held[e, : len(carried)] |= carried.to(self.held.device)

    def metrics(self, positions: Tensor) -> dict[str, Tensor]:
        """Metrics at a joint state [E, J] (rad or m).

        Returns:
            "normalized_distance" [E, 1], "contact" [E, 1] (suction has held the part), "held_opened" [E, 1] (a part
            that suction has held is open, the target or another) and "success" [E].
        """
        signed = (self._goal - positions) / (self._goal - self._start)
        # A part past its limit (by the solver's slack) is open; one past a goal within its range has missed it.
        distances = torch.where(self._opens, signed.clamp_min(0.0), signed.abs())
        opened = distances < self._success  # NaN, so False, where nothing opens
        return {
            "normalized_distance": distances.gather(1, self.target),
            "contact": self.held.gather(1, self.target),
            "held_opened": (opened & self.held).any(-1, keepdim=True),
            "success": opened.gather(1, self.target)[:, 0],
        }
