"""How far the parts of the running trials are open, and which of them suction has held: the task's metrics."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from fb3d_rl.env.stage import Stage


class Progress:
    """What the metrics of E environments need besides their joint states [E, J], which are padded on the right.

    These are few numbers, so NumPy computes them: PyTorch takes several times as long for an array of one row.

    Args:
        envs: E.
        joints: J, of the object with the most joints.
        success: a part counts as open below this normalized distance.
        device: of the metrics.

    Attributes:
        held: [E, J] bool, the joints whose part suction has held in this trial.
        target: [E] int64, position of the joint to open in the joint state.
    """

    def __init__(self, envs: int, joints: int, success: float, device: torch.device) -> None:
        self.held = np.zeros((envs, joints), dtype=bool)
        self.target = np.zeros(envs, dtype=np.int64)
        self._start, self._goal = np.full((2, envs, joints), np.nan, dtype=np.float32)
        self._way = self._goal - self._start
        self._opens = np.ones((envs, joints), dtype=bool)
        self._success, self._device, self._envs = np.float32(success), device, np.arange(envs)

    def begin(self, e: int, stage: Stage) -> None:
        """Begin the trial of environment ``e``."""
        start = np.array(stage.trial.start, dtype=np.float32)
        self.target[e], self.held[e], self._opens[e] = stage.target, False, True
        self._opens[e, stage.target] = stage.trial.goal is None
        self._start[e, : len(start)] = start
        self._goal[e, : len(start)] = stage.goals()
        way = self._goal - self._start
        self._way = np.where(way == 0.0, np.float32(np.nan), way)

    def hold(self, e: int, stage: Stage) -> None:
        """Note what suction holds in environment ``e``."""
        if stage.suction.held is not None:
            carried = stage.tree.descendants[:, stage.suction.held].numpy()
            self.held[e, : len(carried)] |= carried

    def of_target(self, positions: NDArray[np.float32]) -> NDArray[np.float32]:
        """Position [E, 1] of the joint to open in a joint state [E, J] (rad or m)."""
        found: NDArray[np.float32] = positions[self._envs, self.target][:, None]
        return found

    def metrics(self, positions: NDArray[np.float32]) -> dict[str, Tensor]:
        """Metrics at a joint state [E, J] (rad or m).

        Returns:
            "normalized_distance" [E, 1], "contact" [E, 1] (suction has held the part), "held_opened" [E, 1] (a part
            that suction has held is open, the target or another) and "success" [E].
        """
        signed = (self._goal - positions) / self._way
        # A part past its limit (by the solver's slack) is open; one past a goal within its range has missed it.
        distances = np.where(self._opens, np.maximum(signed, np.float32(0.0)), np.abs(signed))
        opened = distances < self._success  # NaN, so False, where nothing opens
        ours = (self._envs, self.target)
        found = {
            "normalized_distance": distances[ours][:, None],
            "contact": self.held[ours][:, None],
            "held_opened": (opened & self.held).any(1, keepdims=True),
            "success": opened[ours],
        }
        return {name: torch.from_numpy(values).to(self._device) for name, values in found.items()}
