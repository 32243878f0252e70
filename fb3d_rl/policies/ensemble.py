"""Several learners as one policy, whose disagreement measures how far a state is from the training data."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import nn

from fb3d_rl.contract import Key
from fb3d_rl.policies.policy import Policy, initial_state


class Ensemble(Policy):
    """The mean action of M learners and their variance.

    "action" and what all members declare below "learner", such as a predicted discrepancy, are the members' means.
    ("learner", "variance") [E, 1] is the variance of each of the action's D entries across the members (divided by M,
    since they are the whole ensemble), averaged over the entries: 1/(D M) sum_d sum_m (a_md - mean_d)^2. That is the
    novelty of ThriftyDAgger and, since actions are normalised, EnsembleDAgger's variance in one number.

    Every member reads the input, never an output of another one. A state below ("next", ...) has to depend on the
    observation only, so that it is the same for all members: the first one writes it.

    Args:
        members: at least one learner; all of them declare the same keys.

    Raises:
        ValueError: there is no member, or they declare different keys.
    """

    def __init__(self, members: Sequence[TensorDictModuleBase]) -> None:
        super().__init__()
        if not members:
            raise ValueError("an ensemble needs at least one member")
        first = members[0]
        if any(set(m.in_keys) != set(first.in_keys) or set(m.out_keys) != set(first.out_keys) for m in members):
            raise ValueError("the members of an ensemble declare different keys")
        self.members = nn.ModuleList(members)
        self._means: list[Key] = [key for key in first.out_keys if key == "action" or key[0] == "learner"]
        self._state: list[Key] = [key for key in first.out_keys if key[0] == "next"]
        self.in_keys = list(first.in_keys)
        self.out_keys = [*self._means, ("learner", "variance"), *self._state]

    def initial_state(self, batch: torch.Size) -> TensorDict:
        """The state that the members share, at the start of an episode; empty if they have none."""
        return initial_state(self.members[0], batch)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the means, the variance and the next state."""
        outputs = [member(tensordict.select(*self.in_keys)) for member in self.members]
        for key in self._means:
            tensordict[key] = torch.stack([output[key] for output in outputs]).mean(0)
        actions = torch.stack([output["action"] for output in outputs])
        tensordict["learner", "variance"] = actions.var(0, correction=0).mean(-1, keepdim=True)
        for key in self._state:
            tensordict[key] = outputs[0][key]
        return tensordict
