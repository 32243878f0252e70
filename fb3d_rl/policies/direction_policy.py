"""UMP-DI (FlowBot3D, section V): where to touch is given, in which direction to pull is inferred."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn

from fb3d_rl.models.direction_net import DirectionNet, SearchOptions, directions_at
from fb3d_rl.policies.flow_policy import FlowPolicy, FlowPolicyOptions
from fb3d_rl.policies.hand import VelocityLimits


class DirectionFlow(TensorDictModuleBase):
    """In place of a flow one direction for the whole part, anew in each step.

    The contact is ground truth, as in the paper: until the hand holds the part the direction is that at the point of
    largest true flow, and its size at each point is that of the true flow there, so that the flow policy chooses among
    the same points as the expert. The true flow's *direction* is never read. Once the part is held the direction is
    that at the visible point nearest the suction tip, of the same size everywhere, and nothing true is read at all.

    Args:
        net: scores directions.
        options: how the best one is searched.

    Shapes: reads the observation's points [E, N, 3], valid, part_mask [E, N], tool_pose, attached and, before the part
    is held, ("privileged", "flow") [E, N, 3]; writes ("prediction", "flow") [E, N, 3].
    """

    def __init__(self, net: DirectionNet, options: SearchOptions | None = None) -> None:
        super().__init__()
        self.net, self.options = net, options or SearchOptions()
        observed = ("points", "valid", "part_mask", "tool_pose", "attached")
        self.in_keys = [*(("observation", key) for key in observed), ("privileged", "flow")]
        self.out_keys = [("prediction", "flow")]

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the directions."""
        points, valid, part, tool_pose, held, flow = (tensordict[key] for key in self.in_keys)
        part = part & valid
        size = torch.where(held, 1.0, flow.norm(dim=-1)).masked_fill(~part, 0.0)
        contact = pulled_point(size, points, part, tool_pose, held.squeeze(-1))
        direction = directions_at(self.net, points, valid, part, contact, self.options)
        tensordict["prediction", "flow"] = size[..., None] * direction[:, None]
        return tensordict


def pulled_point(size: Tensor, points: Tensor, part: Tensor, tool_pose: Tensor, held: Tensor) -> Tensor:
    """Number [E] of the point at which a pull is asked for.

    If the part is ``held`` [E] it is the part's nearest to the tip, else the one of the largest ``size`` [E, N].
    """
    distance = (points - tool_pose[:, None, :3]).norm(dim=-1).masked_fill(~part, torch.inf)
    return torch.where(held, distance.argmin(-1), size.argmax(-1))


def direction_policy(
    net: nn.Module, limits: VelocityLimits, options: FlowPolicyOptions | None = None
) -> TensorDictSequential:
    """The flow policy fed with the direction that a DirectionNet scores best."""
    assert isinstance(net, DirectionNet)
    if options is not None:
        options.require_mask("policy=ump_di")
    return TensorDictSequential(DirectionFlow(net), FlowPolicy(("prediction", "flow"), limits, options))
