"""Expert and learner with one gripper: the expert labels every step, and a gate decides who acts."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from fb3d_rl.contract import Key
from fb3d_rl.errors import UserError
from fb3d_rl.policies.flow_policy import FlowPolicy
from fb3d_rl.policies.flow_state import APPROACH, RELEASE, RETREAT, SELECT, TRAVEL, FlowState
from fb3d_rl.policies.policy import Policy, initial_state


class Gate(nn.Module):
    """Decides in every step who acts: the expert or the learner.

    A gate reads the observation, ("expert", "action"), ("learner", "action") and what else the learner wrote below
    "learner". What changes from round to round (a share, a threshold) is a buffer, so that it reaches the workers with
    the weights. What changes within an episode is state: it travels in the TensorDict below "gate", as
    :meth:`initial_state` lays it out, and :meth:`forward` writes its next value below ("next", "gate").
    """

    in_keys: list[Key] = []
    """What the gate reads besides its own state."""

    def tune(self, frames: TensorDictBase, budget: float) -> None:
        """Set the thresholds from the last round's steps, if the gate has thresholds that a budget sets.

        Args:
            frames: the steps [T] in which the gate decided, with what it reads, its state and the two actions.
                Entries below "learner" should be those of the present learner.
            budget: share of the learner's steps in which the expert may take over, 0 to 1.
        """

    def initial_state(self, batch: torch.Size) -> TensorDict:
        """The gate's state {"gate": ...} at the start of an episode, all 0; empty unless a gate has one."""
        return TensorDict({}, batch_size=batch)

    def forward(self, tensordict: TensorDictBase) -> Tensor:
        """Whether the expert acts [E, 1] bool."""
        raise NotImplementedError


def uniform(tensordict: TensorDictBase, purpose: int, per_step: bool = True, count: int = 1) -> Tensor:
    """Random numbers [E, count] from 0 to below 1 for each environment, float64.

    They depend on the trial's seed, the purpose and, if ``per_step``, the step only, so that an episode does not depend
    on the worker that runs it.
    """
    seeds, steps = tensordict["seed"].flatten().tolist(), tensordict["elapsed_steps"].flatten().tolist()
    draws = [
        np.random.default_rng([seed, purpose, step if per_step else 0]).random(count)
        for seed, step in zip(seeds, steps, strict=True)
    ]
    return torch.from_numpy(np.stack(draws))


class BetaGate(Gate):
    """DAgger's mixture (Ross, Gordon, Bagnell 2011): the expert acts with probability beta.

    Args:
        beta: the expert's share; each round sets its own.
        per_step: whether to draw for every step, or once for an episode.

    Raises:
        UserError: beta is no share.
    """

    in_keys: list[Key] = ["seed", "elapsed_steps"]
    beta: Tensor

    def __init__(self, beta: float = 1.0, per_step: bool = True) -> None:
        super().__init__()
        if not 0.0 <= beta <= 1.0:
            raise UserError(f"beta={beta} is no share; give a number from 0 to 1")
        self.register_buffer("beta", torch.tensor(beta, dtype=torch.float64))
        self.per_step = per_step

    def forward(self, tensordict: TensorDictBase) -> Tensor:
        """See :class:`Gate`."""
        return uniform(tensordict, 1, self.per_step) < self.beta


class OracleGate(Gate):
    """The supplement's "Oracle" (III): the expert drives to the contact point, the learner acts once the part is held.

    Where suction is lost the expert drives back.
    """

    in_keys: list[Key] = [("observation", "attached")]

    def forward(self, tensordict: TensorDictBase) -> Tensor:
        """See :class:`Gate`."""
        attached: Tensor = tensordict["observation", "attached"]
        return ~attached


class EitherGate(Gate):
    """The expert acts where any of several gates says so."""

    def __init__(self, *gates: Gate) -> None:
        super().__init__()
        self.gates = nn.ModuleList(gates)
        self.in_keys = [key for gate in gates for key in gate.in_keys]

    def tune(self, frames: TensorDictBase, budget: float) -> None:
        """See :class:`Gate`; the budget is that of each gate by itself."""
        for gate in self._each():
            gate.tune(frames, budget)

    def initial_state(self, batch: torch.Size) -> TensorDict:
        """See :class:`Gate`."""
        state = TensorDict({}, batch_size=batch)
        for gate in self._each():
            state.update(gate.initial_state(batch))
        return state

    def forward(self, tensordict: TensorDictBase) -> Tensor:
        """See :class:`Gate`."""
        return torch.stack([gate(tensordict) for gate in self._each()]).any(0)  # no short cut: each may keep state

    def _each(self) -> Iterator[Gate]:
        return (gate for gate in self.gates if isinstance(gate, Gate))  # for the type checker: all are


class HumanGate(Gate):
    """HG-DAgger's gate (Kelly et al. 2019): any callable takes over and hands back, such as a person at a keyboard.

    Args:
        takes_over: called with the TensorDict of the step; returns [E, 1] bool, True where the expert acts. It has to
            be picklable if it is to run in worker processes.
    """

    def __init__(self, takes_over: Callable[[TensorDictBase], Tensor]) -> None:
        super().__init__()
        self._takes_over = takes_over

    def forward(self, tensordict: TensorDictBase) -> Tensor:
        """See :class:`Gate`."""
        return self._takes_over(tensordict)


class InteractivePolicy(Policy):
    """Expert and learner in one: ("expert", "action") is always the expert's label, "action" is executed.

    The expert keeps its own state while the learner acts, see :meth:`follow`.

    Args:
        expert: the flow policy with the true flow.
        learner: writes "action" and entries below "learner"; None if there is none yet, so that only the expert acts.
        gate: decides who acts.

    Raises:
        ValueError: the learner writes something else that the expert writes too, such as the flow policy's state.
    """

    def __init__(self, expert: FlowPolicy, learner: TensorDictModuleBase | None, gate: Gate) -> None:
        super().__init__()
        self.expert, self.learner, self.gate = expert, learner, gate
        keys = [*expert.in_keys, *(learner.in_keys if learner is not None else ()), *gate.in_keys]
        own = {"action", ("expert", "action"), ("learner", "action")}
        if learner is not None:
            both = set(learner.out_keys) & set(expert.out_keys) - {"action"}
            if both:
                raise ValueError(f"expert and learner both write {sorted(both, key=str)}")
            own.update(learner.out_keys)
        keys.append(("expert", "looks_on"))
        self.in_keys = [key for key in dict.fromkeys(keys) if key not in own]
        self.out_keys = ["action", ("expert", "action"), ("expert", "acts"), ("next", "expert", "looks_on")]

    def initial_state(self, batch: torch.Size) -> TensorDict:
        """The states of expert, learner and gate, and whether the learner acted in the last step."""
        state = TensorDict({"expert": {"looks_on": torch.zeros(*batch, 1, dtype=torch.bool)}}, batch_size=batch)
        state.update(self.expert.initial_state(batch))
        if self.learner is not None:
            state.update(initial_state(self.learner, batch))
        return state.update(self.gate.initial_state(batch))

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write "action", ("expert", "action") and who acted."""
        self.follow(tensordict)
        self.expert(tensordict)
        tensordict["expert", "action"] = tensordict["action"]
        if self.learner is None:
            acts = torch.ones_like(tensordict["expert", "looks_on"])
        else:
            self.learner(tensordict)
            tensordict["learner", "action"] = tensordict["action"]
            acts = self.gate(tensordict)
            tensordict["action"] = torch.where(acts, tensordict["expert", "action"], tensordict["action"])
        tensordict["expert", "acts"] = acts
        tensordict["next", "expert", "looks_on"] = ~acts
        return tensordict

    def follow(self, tensordict: TensorDictBase) -> None:
        """Adapt the expert's state, in environments where the learner made the last step, to the hand's present pose.

        A learner cannot see which contact point the expert chose in an earlier step, nor whether it had begun its
        approach. So that a label depends on the observation, the expert chooses the point, and whether to approach it,
        again at every step until it holds the part. The learner's steps do not count as the expert's lack of progress,
        and the learner's misses not as tries of the expert.
        """
        learner = tensordict["expert", "looks_on"]
        if not bool(learner.any()):
            return
        state = FlowState.from_tensordict(tensordict["policy"])
        phase = state.phase
        backs_off = learner & ((phase == RETREAT) | (phase == RELEASE))
        state = state.changed(learner, idle=0).changed(backs_off, phase=SELECT, leave=0.0)
        missed = learner & (state.phase == SELECT)
        tensordict["policy"] = state.changed(missed, chosen=(state.chosen - 1).clamp_min(0)).packed()
        on_its_way = learner & ((phase == TRAVEL) | (phase == APPROACH))
        if bool(on_its_way.any()):
            self.expert.choose_again(tensordict, on_its_way)
