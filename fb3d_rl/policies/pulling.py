"""Policies where a hand holds one point and is pulled in a direction: the flow that a policy would follow.

In UMPNet's world nobody drives a hand: a policy chooses a point to hold and then a direction for each pull. Any policy
that follows a flow does so here: what writes its flow is run, and what turns flows into velocities is left out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor

from fb3d_rl.errors import UserError
from fb3d_rl.policies.baselines import RandomPolicy
from fb3d_rl.policies.flow_policy import FlowPolicy
from fb3d_rl.policies.flow_state import PULL, SELECT
from fb3d_rl.policies.interaction import uniform
from fb3d_rl.policies.policy import initial_state

PREDICTED = ("prediction", "flow")
PHASE = ("policy", "phase")


@dataclass(frozen=True)
class FlowOf:
    """What gives the flow [E, N, 3] that a policy follows, from TensorDicts [E] of its observations.

    Attributes:
        answer: the function; what the policy remembers it writes below "next".
        state: what it remembers of an episode at its start, [].
    """

    answer: Callable[[TensorDictBase], Tensor]
    state: TensorDict = field(default_factory=lambda: TensorDict({}, batch_size=[]))

    def __call__(self, seen: TensorDictBase) -> Tensor:
        """See the class."""
        return self.answer(seen)


def flow_of(policy: TensorDictModuleBase, name: str) -> FlowOf:
    """The flow that a policy follows.

    Args:
        policy: one of the registry, or one from outside that writes ("prediction", "flow").
        name: of the policy, for the message.

    Raises:
        UserError: it follows no flow; at once, or where it is one from outside when it is asked.
    """
    if isinstance(policy, RandomPolicy):
        return FlowOf(_random_flow)
    if isinstance(policy, FlowPolicy):
        key = policy.flow_key
        return FlowOf(lambda seen: seen[key])
    if isinstance(policy, TensorDictSequential) and isinstance(policy.module[-1], FlowPolicy):
        key, before = policy.module[-1].flow_key, TensorDictSequential(*policy.module[:-1])

        def followed(seen: TensorDictBase) -> Tensor:
            if PHASE in before.in_keys:  # arcs are found while a part is pulled
                seen[PHASE] = torch.where(seen["observation", "attached"], PULL, SELECT)
            flow: Tensor = before(seen)[key]
            return flow

        return FlowOf(followed, initial_state(before, torch.Size([])))

    def written(seen: TensorDictBase) -> Tensor:
        flow = policy(seen).get(PREDICTED, None)
        if flow is None:
            raise UserError(
                f"{name} writes no flow under {PREDICTED}: only policies that follow a flow act in UMPNet's world"
            )
        return flow

    return FlowOf(written, initial_state(policy, torch.Size([])))


def _random_flow(seen: TensorDictBase) -> Tensor:
    """One random direction for each scene and step, with random sizes, so that any point is held as likely."""
    points = seen["observation", "points"]
    draws = uniform(seen, purpose=2, count=3 + points.shape[1]).to(points)
    way = torch.special.ndtri(draws[:, None, :3].clamp(1e-6, 1 - 1e-6))
    return draws[:, 3:, None] * way / way.norm(dim=-1, keepdim=True)
