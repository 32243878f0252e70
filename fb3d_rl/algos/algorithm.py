"""What an algorithm of the registry is, and what acts in the end."""

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
    """A policy that is ready but for the gripper and how it moves.

    Attributes:
        name: in tables.
        policy: makes it, on the CPU.
        part_mask_input: whether its network was trained with the mask of the part to open.
        network: the flow network that is measured besides; None if there is none.
    """

    name: str
    policy: Callable[[VelocityLimits, FlowPolicyOptions], TensorDictModuleBase]
    part_mask_input: bool = True
    network: nn.Module | None = None


class Algorithm(Protocol):
    """What :mod:`fb3d_rl.registry` names as an algorithm."""

    def train(self, cfg: TrainConfig, out: Path) -> list[TrialRow]:
        """Train on the configured objects and evaluate on the held-out ones; everything is written below ``out``.

        Returns:
            One row for each scheduled trial and policy.
        """
        ...

    def load(self, path: str | Path) -> Acting:
        """What a checkpoint holds.

        Raises:
            UserError: the file is missing or no checkpoint of this algorithm.
        """
        ...
