"""When a learner that plans several steps looks, plans and executes.

chunk=4, execute=2: it looks and plans in every second step, and executes half of each plan, in between blindly::

    step        0    1    2    3    4    5
    observed    o         o         o
    planned     [0    1    2    3]
                          [2    3    4    5]
                                    [4    5    6    7]
    executed    0    1  | 2    3  | 4    5        of the newest plan

chunk=4, ensemble=0.01 (temporal ensembling, Zhao et al. 2023): it plans in every step, and executes the weighted mean
of all plans that reach this step::

    step        0    1    2    3    4    5
    observed    o    o    o    o    o    o
    planned     [0    1    2    3]
                     [1    2    3    4]
                          [2    3    4    5]
    executed    mean over each column, the i-th oldest plan with weight exp(-0.01 i)

With execute=1 and no ensemble it executes the first step of each plan. Where the expert acts in between, plans grow
old as if the learner had acted. The network is called in every step in any case: gates may ask for the discrepancy.
"""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from fb3d_rl.models.heads import Loss, make_head
from fb3d_rl.policies.interaction import uniform
from fb3d_rl.policies.options import LearnerOptions

NOISE = 8
"""Purpose of random draws; see :func:`fb3d_rl.policies.interaction.uniform`."""

LEAST_SIZE = 0.02
"""Labels are divided by no less than this share of the largest action."""


class PlanNetwork(nn.Module):
    """The head of a policy that imitates, with the size of its labels; a subclass adds what sees and calls the head.

    Args:
        options: which head.
        size: numbers of an action, A.
        alike: so many successive numbers of an action have one size, such as the 3 of a velocity.
    """

    size: Tensor

    def __init__(self, options: LearnerOptions, size: int, alike: int = 1) -> None:
        super().__init__()
        self.options = options
        self._alike = alike
        self._head = make_head(options.head, options.chunk, size, options.width, options.components, options.calls)
        if self._head.network is not None:
            self.head = self._head.network
        if options.normalized:
            self.register_buffer("size", torch.ones(size))

    @property
    def noise(self) -> int:
        """Standard normal numbers that a plan is made from; 0: none."""
        return self._head.noise

    def plan(self, encoded: Tensor, noise: Tensor | None = None) -> Tensor:
        """The plan [B, chunk, A]; see :meth:`fb3d_rl.models.heads.Head.plan`."""
        plan = self._head.plan(encoded, noise)
        return plan * self.size if self.options.normalized else plan

    def loss(self, kind: str, kl_weight: float) -> Loss:
        """The loss of :meth:`fb3d_rl.models.heads.Head.loss`, for plans as :meth:`plan` gives them."""
        loss = self._head.loss(kind, kl_weight)
        if not self.options.normalized:
            return loss
        return lambda batch: loss(batch.copy().set("twist", batch["twist"] / self.size))

    @torch.no_grad()
    def normalize(self, labels: Tensor) -> None:
        """Measure the size of labels [R, A], their root mean square."""
        if self.options.normalized:
            size = labels.unflatten(-1, (-1, self._alike)).square().mean((0, 2)).sqrt().clamp_min(LEAST_SIZE)
            self.size.copy_(size.repeat_interleave(self._alike))


def trial_noise(tensordict: TensorDictBase, count: int) -> Tensor | None:
    """Standard normal numbers [E, count] that depend on the trial's seed and the step only; None for no numbers."""
    return torch.special.ndtri(uniform(tensordict, NOISE, count=count).clamp_min(1e-12)).float() if count else None


State = dict[str, tuple[tuple[int, ...], torch.dtype]]
"""Trailing shape and dtype of each entry."""


def plan_state(options: LearnerOptions, size: int) -> State:
    """What has to be remembered of plans with ``size`` numbers a step.

    "plan" [P, size] are the next P steps; "planned" [1] is how many of them are left to execute, or with an ensemble
    [P] how many plans each of them is the mean of.
    """
    kept = options.chunk - 1 if options.ensemble is not None else options.execute - 1
    if kept == 0:
        return {}
    counts = kept if options.ensemble is not None else 1
    return {"plan": ((kept, size), torch.float32), "planned": ((counts,), torch.int64)}


def executed(plan: Tensor, state: TensorDictBase | None, options: LearnerOptions) -> tuple[Tensor, dict[str, Tensor]]:
    """The action [E, A] of this step, and the next step's state.

    Args:
        plan: the plan [E, chunk, A] made now.
        state: as :func:`plan_state` lays it out, zeros at the start of an episode.
        options: how plans are executed.
    """
    if options.ensemble is not None:
        assert state is not None
        return _ensembled(plan, state["plan"], state["planned"], options.ensemble)
    if options.execute == 1:
        return plan[:, 0], {}
    assert state is not None
    before, planned = state["plan"], state["planned"]
    whole = torch.cat([before, torch.zeros_like(before[:, :1])], dim=1)
    whole = torch.where((planned > 0)[..., None], whole, plan[:, : options.execute])
    left = torch.where(planned > 0, planned - 1, options.execute - 1)
    return whole[:, 0], {"plan": whole[:, 1:], "planned": left}


def _ensembled(plan: Tensor, before: Tensor, counts: Tensor, rate: float) -> tuple[Tensor, dict[str, Tensor]]:
    """The mean of the plan and of those before it, of which each step of ``before`` has ``counts`` [E, chunk - 1]."""
    old = torch.cat([before, torch.zeros_like(plan[:, :1])], dim=1)
    counts = torch.cat([counts, torch.zeros_like(counts[:, :1])], dim=1)
    # Of the oldest plan, of the oldest two, ...
    weights = torch.exp(-rate * torch.arange(plan.shape[1], device=plan.device)).cumsum(0)
    so_far = torch.where(counts > 0, weights[(counts - 1).clamp_min(0)], 0.0)
    new = torch.exp(-rate * counts)
    mean = (old * so_far[..., None] + plan * new[..., None]) / (so_far + new)[..., None]
    return mean[:, 0], {"plan": mean[:, 1:], "planned": counts[:, 1:] + 1}
