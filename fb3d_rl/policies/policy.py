"""What every policy is: TensorDict in, TensorDict with "action" out, and the state that it carries between steps."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase, TensorDictSequential


class Policy(TensorDictModuleBase):
    """A policy whose state, if it has any, travels in the TensorDict.

    It reads its state under a key of its own, such as "policy" or "learner", and writes the next step's state under
    ("next", the same key), from where the environment carries it to the next step.
    """

    def initial_state(self, batch: torch.Size) -> TensorDict:
        """The state at the start of an episode, all zeros, with its keys; empty unless a policy has one."""
        return TensorDict({}, batch_size=batch)


def initial_state(policy: TensorDictModuleBase, batch: torch.Size) -> TensorDict:
    """The state of any policy at the start of an episode.

    Args:
        policy: a :class:`Policy`; a sequence of modules, whose state is that of its parts; or any other module, which
            has a state only if it has a method ``initial_state``.
        batch: the leading dimensions.
    """
    if isinstance(policy, TensorDictSequential):
        state = TensorDict({}, batch_size=batch)
        for part in policy.module:
            state.update(initial_state(part, batch))
        return state
    declared = getattr(policy, "initial_state", None)
    return TensorDict({}, batch_size=batch) if declared is None else declared(batch)
