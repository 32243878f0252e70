"""The interface of the registry's algorithms, and the policy that one loads."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from tensordict.nn import TensorDictModuleBase
from torch import nn

from fb3d_rl.policies.hand import VelocityLimits
from fb3d_rl.policies.options import FlowPolicyOptions
from fb3d_rl.rollout.rows import TrialRow

if TYPE_CHECKING:
    from fb3d_rl.config import TrainConfig


@dataclass(frozen=True)
class Acting:
    """A policy that still needs the gripper's limits and the flow policy's options.

    Attributes:
        name: the policy's name in tables.
        policy: makes the policy, on the CPU.
        part_mask_input: whether its network was trained with the mask of the part to open.
        network: the flow network whose predictions are measured as well, if it has one.
        fits: number of fits that the weights of a learner had behind them; -1 for other policies.
    """

    name: str
    policy: Callable[[VelocityLimits, FlowPolicyOptions], TensorDictModuleBase]
    part_mask_input: bool = True
    network: nn.Module | None = None
    fits: int = -1


class Algorithm(Protocol):
    """An algorithm of :mod:`fb3d_rl.registry`."""

    def train(self, cfg: TrainConfig, out: Path) -> list[TrialRow]:
        """Train on the configured objects and evaluate on the held-out ones; everything is written below ``out``.

        Returns:
            One row for each scheduled trial and policy.
        """
        ...

    def load(self, path: str | Path) -> Acting:
        """Load the policy of a checkpoint.

        Raises:
            UserError: the file is missing or no checkpoint of this algorithm.
        """
        ...
