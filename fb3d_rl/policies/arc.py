"""FlowBot++ (Zhang et al., CoRL 2023): where the part is held its joint's screw is estimated, and its arc executed.

A look is one call of the network. It takes place where a contact point is chosen, when the hand takes hold, and every
``policy.flow.arc.look_every`` control steps of a pull. In between the tip follows the arc of the last look; what the
camera sees is not used.
"""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn

from fb3d_rl.kinematics.joint_screw import JointScrew, flow_of_screw, projection_of_flow, screw_of_projection
from fb3d_rl.models.flowbotpp import FlowProjectionNet
from fb3d_rl.policies.flow_policy import FlowPolicy
from fb3d_rl.policies.flow_state import PULL, RELEASE, RETREAT, SELECT
from fb3d_rl.policies.hand import VelocityLimits
from fb3d_rl.policies.options import ArcOptions, FlowPolicyOptions
from fb3d_rl.policies.policy import Policy
from fb3d_rl.policies.touch import TouchPolicy

FLOW, PROJECTION, TWIST = ("prediction", "flow"), ("prediction", "projection"), ("prediction", "twist")

LOOKS = ("next", "arc", "looks")
"""How often a policy has looked in an episode, [E, 1]."""


class ArcFlow(Policy):
    """The flow of a look, or of the arc that the last look has found.

    An arc is followed if its screw explains the flow from which it comes; else there is a look in each step. While the
    hand hides all of the part there is none, and the arc goes on.

    Args:
        look: reads observations; writes ("prediction", "flow") and ("prediction", "projection") [E, N, 3].
        options: when it looks, and what it follows.

    Shapes: reads what ``look`` reads, points [E, N, 3], valid and part_mask [E, N], attached and the flow policy's
    phase [E, 1]. Writes ("prediction", "flow") [E, N, 3]: the arc's on the part where there is one, that of the look
    where there is one without an arc, else 0; ("prediction", "twist") [E, 6]: the arc as velocity of the world's
    origin and angular velocity, 0 without one; and under ("next", "arc") the arc's screw, "age" [E, 1] the steps since
    it was found and "looks" [E, 1] how often it has looked in the episode.
    """

    def __init__(self, look: TensorDictModuleBase, options: ArcOptions) -> None:
        super().__init__()
        self.look, self.options = look, options
        read = [("observation", key) for key in ("points", "valid", "part_mask", "attached")]
        state = [("arc", field) for field in ("revolute", "axis", "origin", "age", "looks")]
        self.in_keys = list(dict.fromkeys([*read, *look.in_keys, ("policy", "phase"), *state]))
        self.out_keys = [FLOW, TWIST, *(("next", *key) for key in state)]

    def initial_state(self, batch: torch.Size) -> TensorDict:
        """The state {"arc": ...} at the start of an episode: all zeros, no arc."""
        return TensorDict({"arc": _start(batch)}, batch_size=batch)

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Look where it is time to, and write the flow and the next state."""
        obs, state, phase = tensordict["observation"], tensordict["arc"], tensordict["policy", "phase"]
        held, part = obs["attached"], obs["part_mask"] & obs["valid"]
        pulls = held & ((phase == PULL) | (phase == RELEASE))
        age = torch.where(pulls, state["age"] + 1, 0)
        due = ~state["axis"].any(-1, keepdim=True)
        if self.options.look_every is not None:
            due = due | (age >= self.options.look_every)
        chooses = ~held & ((phase == SELECT) | (phase == RETREAT))
        looks = (chooses | (held & (~pulls | due))).squeeze(-1) & part.any(-1)
        screw = JointScrew(state["revolute"].squeeze(-1).clone(), held * state["axis"], state["origin"].clone())
        flow = flow_of_screw(screw, obs["points"], part)
        if bool(looks.any()):
            seen = self.look(tensordict.select(*self.look.in_keys)[looks])
            found, residual = screw_of_projection(obs["points"][looks], seen[FLOW], seen[PROJECTION], part[looks])
            arc = held[looks].squeeze(-1) & (residual <= self.options.residual)
            found = found._replace(axis=found.axis * arc[:, None])
            for old, new in zip(screw, found, strict=True):
                old[looks] = new
            arc_flow = flow_of_screw(found, obs["points"][looks], part[looks])
            flow[looks] = torch.where(arc[:, None, None], arc_flow, seen[FLOW])
            age = age.masked_fill(looks[:, None], 0)
        tensordict[FLOW], tensordict[TWIST] = flow, _twist(screw)
        after = {"revolute": screw.revolute[:, None], "axis": screw.axis, "origin": screw.origin}
        after |= {"age": age, "looks": state["looks"] + looks[:, None]}
        tensordict["next", "arc"] = TensorDict(after, batch_size=tensordict.batch_size, device=tensordict.device)
        return tensordict


def _start(batch: torch.Size) -> TensorDict:
    start = {key: torch.zeros(*batch, 1, dtype=torch.int64) for key in ("age", "looks")}
    start |= {key: torch.zeros(*batch, 3) for key in ("axis", "origin")}
    start["revolute"] = torch.zeros(*batch, 1, dtype=torch.bool)
    return TensorDict(start, batch_size=batch)


def _twist(screw: JointScrew) -> Tensor:
    """Velocity of the world's origin and angular velocity [E, 6] of a part."""
    turns = screw.revolute[:, None]
    velocity = torch.where(turns, torch.linalg.cross(screw.origin, screw.axis), screw.axis)
    return torch.cat([velocity, screw.axis * turns], -1)


def true_motions(points: Tensor, valid: Tensor, part_mask: Tensor, flow: Tensor) -> tuple[Tensor, Tensor]:
    """The true flow and the projection that follows from it, as FlowProjectionNet predicts them."""
    return flow, projection_of_flow(points, flow, part_mask & valid)[0]


def expert_arc_policy(limits: VelocityLimits, options: FlowPolicyOptions | None = None) -> TensorDictSequential:
    """The arcs of true flow and true projection: the upper bound of FlowBot++."""
    options = options or FlowPolicyOptions()
    options.require_mask("policy=expert_arc")
    keys = [*(("observation", key) for key in ("points", "valid", "part_mask")), ("privileged", "flow")]
    look = TensorDictModule(true_motions, in_keys=keys, out_keys=[FLOW, PROJECTION])
    return TensorDictSequential(ArcFlow(look, options.arc), FlowPolicy(FLOW, limits, options, twist_key=TWIST))


def flowbotpp_policy(
    net: nn.Module, limits: VelocityLimits, options: FlowPolicyOptions | None = None
) -> TensorDictSequential:
    """FlowBot++: the arcs of a FlowProjectionNet; with ``options.learn`` they are corrected by touch.

    Raises:
        UserError: the options keep the mask of the part from the policy.
    """
    assert isinstance(net, FlowProjectionNet)
    options = options or FlowPolicyOptions()
    options.require_mask("policy=flowbotpp")
    keys = [("observation", key) for key in ("points", "valid", "part_mask")]
    arcs = ArcFlow(TensorDictModule(_Motions(net), in_keys=keys, out_keys=[FLOW, PROJECTION]), options.arc)
    if options.learn:
        return TensorDictSequential(arcs, TouchPolicy(limits, options, proposals=False))
    return TensorDictSequential(arcs, FlowPolicy(FLOW, limits, options, twist_key=TWIST))


class _Motions(nn.Module):
    """A FlowProjectionNet that answers with flow and projection."""

    def __init__(self, net: FlowProjectionNet) -> None:
        super().__init__()
        self.net = net

    def forward(self, points: Tensor, valid: Tensor, part_mask: Tensor) -> tuple[Tensor, Tensor]:
        return self.net.motions(points, valid, part_mask)
