"""What algo=artflownet, algo=screwnet and algo=ump_di do not share; all else is :mod:`fb3d_rl.algos.artflownet`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from fb3d_rl.algos.screwnet import screw_objective
from fb3d_rl.algos.ump_di import direction_cosine, direction_objective
from fb3d_rl.evaluation.flow import predict
from fb3d_rl.flow.metrics import flow_metrics
from fb3d_rl.models.artflownet import ArtFlowNet
from fb3d_rl.models.cloud_network import CloudNetwork
from fb3d_rl.models.direction_net import DirectionNet
from fb3d_rl.models.screwnet import ScrewNet
from fb3d_rl.policies.direction_policy import direction_policy
from fb3d_rl.policies.flow_policy import FlowPolicyOptions, artflownet_policy
from fb3d_rl.policies.hand import VelocityLimits
from fb3d_rl.training.objective import Objective
from fb3d_rl.training.options import FitOptions

Measure: TypeAlias = "Callable[[CloudNetwork, TensorDictBase, torch.device], dict[str, Tensor]]"
"""Numbers of samples [S], each [S], "cosine" among them: in validation the network with the largest is the best."""


def flow_numbers(net: CloudNetwork, samples: TensorDictBase, device: torch.device) -> dict[str, Tensor]:
    """The flow's errors on samples [S], see :func:`flow_metrics`."""
    flow, valid = samples["privileged", "flow"], samples["observation", "valid"]
    return flow_metrics(predict(net, samples, device), flow, valid)


@dataclass(frozen=True)
class Kind:
    """A network that is trained on flow samples, and the policy that it makes.

    Attributes:
        network: the class.
        policy: of a network on the CPU.
        objective: what is minimized; None for the loss of the flow.
        measure: in validation.
        flow: whether the network answers the flow of a whole cloud.
    """

    network: type[CloudNetwork]
    policy: Callable[[CloudNetwork, VelocityLimits, FlowPolicyOptions], TensorDictModuleBase] = artflownet_policy
    objective: Callable[[nn.Module, FitOptions], Objective] | None = None
    measure: Measure = flow_numbers
    flow: bool = True


KINDS = {
    ArtFlowNet.NAME: Kind(ArtFlowNet),
    ScrewNet.NAME: Kind(ScrewNet, objective=screw_objective),
    DirectionNet.NAME: Kind(DirectionNet, direction_policy, direction_objective, direction_cosine, flow=False),
}
"""The kinds by the name of their algorithm, checkpoints and policy."""
