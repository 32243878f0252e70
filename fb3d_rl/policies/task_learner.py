"""What imitation trains on any task of ManiSkill: from the state, or a cloud and what the robot feels, to actions."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from fb3d_rl.contract import Key
from fb3d_rl.models.dense import initialize
from fb3d_rl.models.encoders import ENCODERS, mlp
from fb3d_rl.policies.interaction import InteractivePolicy
from fb3d_rl.policies.options import LearnerOptions
from fb3d_rl.policies.plans import PlanNetwork, State, executed, plan_state, trial_noise
from fb3d_rl.policies.policy import Policy

STATE, POINTS, VALID, LABEL = (
    ("observation", "state"), ("observation", "points"), ("observation", "valid"), ("label", "action"),
)  # fmt: skip


class TaskNetwork(PlanNetwork):
    """An encoder and its head; states are normalized by those of the first round.

    Shapes: state [B, 1 + history, S], and with points [B, N, 3] (m) and valid [B, N] -> what the head reads [B, ...].
    """

    mean: Tensor
    deviation: Tensor

    def __init__(self, options: LearnerOptions, states: int, actions: int, points: bool) -> None:
        super().__init__(options, actions)
        context, wide = states * (1 + options.history), 4 * options.width
        self.encoder = (
            ENCODERS[options.encoder](0, context, self._head.inputs, options.width)
            if points
            else mlp(context, wide, wide, self._head.inputs)
        )
        self.register_buffer("mean", torch.zeros(states))
        self.register_buffer("deviation", torch.ones(states))

    def forward(self, state: Tensor, points: Tensor | None = None, valid: Tensor | None = None) -> Tensor:
        """See the class."""
        felt = ((state - self.mean) / self.deviation).flatten(1)
        found: Tensor = (
            self.encoder(felt)
            if points is None or valid is None
            else self.encoder(points.masked_fill(~valid[..., None], 0.0), points[..., :0], valid, felt)
        )
        return found

    @torch.no_grad()
    def measure(self, states: Tensor, labels: Tensor) -> None:
        """Take mean and deviation of states [R, S], and the size of labels [R, A]."""
        self.mean.copy_(states.mean(0))
        self.deviation.copy_(states.std(0).clamp_min(1e-2))
        self.normalize(labels)


class TaskLearner(Policy):
    """Reads "state" (and the cloud), writes "action" [E, A] in [-1, 1]; history and plan travel below "learner".

    Args:
        options: the network.
        states: numbers of a state, S.
        actions: numbers of an action, A.
        points: whether it sees a cloud.
        generator: draws the first weights.
    """

    def __init__(
        self, options: LearnerOptions, states: int, actions: int, points: bool, generator: torch.Generator | None = None
    ) -> None:
        super().__init__()
        self.options, self.states, self.actions, self.points = options, states, actions, points
        self.network = TaskNetwork(options, states, actions, points)
        if generator is not None:
            initialize(self.network, generator)
        episode: list[Key] = ["seed", "elapsed_steps"] if self.network.noise else []
        cloud: list[Key] = [POINTS, VALID] if points else []
        self.in_keys = [STATE, *cloud, *episode, *(("learner", key) for key in self._state())]
        self.out_keys = ["action", *(("next", "learner", key) for key in self._state())]

    def _state(self) -> State:
        felt: State = {"felt": ((self.options.history, self.states), torch.float32)} if self.options.history else {}
        return felt | plan_state(self.options, self.actions)

    def initial_state(self, batch: torch.Size) -> TensorDict:
        """History and plan {"learner": ...}, all zeros at the start of an episode."""
        state = {key: torch.zeros(*batch, *shape, dtype=dtype) for key, (shape, dtype) in self._state().items()}
        return TensorDict({"learner": state} if state else {}, batch_size=batch)

    def encoded(self, rows: TensorDictBase) -> Tensor:
        """What the head reads [B, ...] of rows [B]."""
        state = rows[STATE][:, None]
        if self.options.history:
            state = torch.cat([state, rows["learner", "felt"]], dim=1)
        cloud = [rows[key][:, : self.options.points] for key in (POINTS, VALID)] if self.points else []
        found: Tensor = self.network(state, *cloud)
        return found

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action, the history and the plan."""
        noise = trial_noise(tensordict, self.network.noise)
        plan = self.network.plan(self.encoded(tensordict), noise)
        action, state = executed(plan, tensordict.get("learner", None), self.options)
        for key, value in state.items():
            tensordict["next", "learner", key] = value
        if self.options.history:
            felt = torch.cat([tensordict[STATE][:, None], tensordict["learner", "felt"]], dim=1)
            tensordict["next", "learner", "felt"] = felt[:, :-1]
        tensordict["action"] = action.clamp(-1.0, 1.0)
        return tensordict


class TaskExpert(Policy):
    """Takes the action that the environment's expert says."""

    def __init__(self) -> None:
        super().__init__()
        self.in_keys, self.out_keys = [LABEL], ["action"]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write "action"."""
        tensordict["action"] = tensordict[LABEL]
        return tensordict


class TaskInteraction(InteractivePolicy):
    """Expert and learner in one, on a task whose expert has no state of its own."""

    def follow(self, tensordict: TensorDictBase) -> None:
        """Nothing to follow: the expert sees each state anew."""
