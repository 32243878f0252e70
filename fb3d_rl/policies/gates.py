"""The gates of interactive imitation: when the expert takes over from the learner and when it hands back.

Distances between actions are ||a_learner - a_expert|| over the D entries of normalised actions (the papers partly write
its square). Where a number that a gate compares is not finite, the expert acts.
"""

from __future__ import annotations

import inspect
import math
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from fb3d_rl.contract import Key
from fb3d_rl.errors import UserError
from fb3d_rl.policies.interaction import BetaGate, Gate, HumanGate

EXPERT: Key = ("expert", "action")
LEARNER: Key = ("learner", "action")
PREDICTED: Key = ("learner", "discrepancy")
VARIANCE: Key = ("learner", "variance")


def discrepancy(tensordict: TensorDictBase) -> Tensor:
    """||a_learner - a_expert|| [..., 1], what ("learner", "discrepancy") predicts."""
    difference: Tensor = tensordict[LEARNER] - tensordict[EXPERT]
    return difference.norm(dim=-1, keepdim=True)


def budget_threshold(values: Tensor, budget: float) -> float:
    """The smallest of ``values`` [T] that at most the share ``budget`` of them exceeds: their (1 - budget) quantile.

    It is -inf where all of them may be exceeded.

    Raises:
        UserError: the budget is no share.
        ValueError: there are no values.
    """
    if not 0.0 <= budget <= 1.0:
        raise UserError(f"budget={budget} is no share; give a number from 0 to 1")
    if not values.numel():
        raise ValueError("there are no steps from which to set a threshold")
    above = math.floor(budget * values.numel() + 1e-9)  # 0.29 * 100 is below 29
    if above == values.numel():
        return -math.inf
    return float(values.flatten().kthvalue(values.numel() - above).values)


class SafeGate(Gate):
    """SafeDAgger (Zhang, Cho 2017, "Safety Policy" and "Safe Strategy"): the expert acts where the learner may deviate.

    The paper's safety policy is a classifier of "the learner is further than tau from the expert". Here the learner
    predicts how far it is, and the prediction is compared with tau, so that tau can change without training anew.

    Args:
        tau: the largest predicted distance at which the learner acts.

    Raises:
        UserError: tau is negative.
    """

    in_keys: list[Key] = [PREDICTED]
    tau: Tensor

    def __init__(self, tau: float = 0.5) -> None:
        super().__init__()
        self.register_buffer("tau", _threshold("tau", tau))

    def tune(self, frames: TensorDictBase, budget: float) -> None:
        """Set tau to the quantile of the predictions that leaves the expert ``budget`` of the steps."""
        self.tau.fill_(budget_threshold(frames[PREDICTED], budget))

    def forward(self, tensordict: TensorDictBase) -> Tensor:
        """See :class:`~fb3d_rl.policies.interaction.Gate`."""
        return _exceeds(tensordict[PREDICTED], self.tau)


class EnsembleGate(Gate):
    """EnsembleDAgger (Menda, Driggs-Campbell, Kochenderfer 2019, section III): the learner acts where two rules agree.

    The discrepancy rule asks that its mean action is within tau of the expert's, the variance rule ("doubt") that the
    ensemble's variance is at most chi.

    Args:
        chi: the largest variance, see :class:`~fb3d_rl.policies.ensemble.Ensemble`.
        tau: the largest distance.

    Raises:
        UserError: a threshold is negative.
    """

    in_keys: list[Key] = [VARIANCE, LEARNER, EXPERT]
    chi: Tensor
    tau: Tensor

    def __init__(self, chi: float = 0.01, tau: float = 0.5) -> None:
        super().__init__()
        self.register_buffer("chi", _threshold("chi", chi))
        self.register_buffer("tau", _threshold("tau", tau))

    def forward(self, tensordict: TensorDictBase) -> Tensor:
        """See :class:`~fb3d_rl.policies.interaction.Gate`."""
        return _exceeds(tensordict[VARIANCE], self.chi) | _exceeds(discrepancy(tensordict), self.tau)


class _HandoverGate(Gate):
    """The expert takes over on one condition and keeps acting until another one holds.

    The state ("gate", name) [E, 1] bool says that the expert has taken over and not handed back. The step in which the
    condition to hand back holds is still the expert's, as in the authors' code.
    """

    name: str

    def initial_state(self, batch: torch.Size) -> TensorDict:
        """See :class:`~fb3d_rl.policies.interaction.Gate`."""
        return TensorDict({"gate": {self.name: torch.zeros(*batch, 1, dtype=torch.bool)}}, batch_size=batch)

    def forward(self, tensordict: TensorDictBase) -> Tensor:
        """See :class:`~fb3d_rl.policies.interaction.Gate`."""
        acts: Tensor = tensordict["gate", self.name] | self.takes_over(tensordict)
        tensordict["next", "gate", self.name] = acts & ~self.hands_back(tensordict)
        return acts

    def takes_over(self, tensordict: TensorDictBase) -> Tensor:
        """Whether a learner that acts has to stop [E, 1] bool."""
        raise NotImplementedError

    def hands_back(self, tensordict: TensorDictBase) -> Tensor:
        """Whether this is an expert's last step for now [E, 1] bool."""
        raise NotImplementedError

    def decided(self, frames: TensorDictBase) -> TensorDictBase:
        """The steps in which the condition to take over was evaluated; the budget is a share of these.

        Steps in which the expert then took over are among them: else thresholds would sink from round to round.
        """
        return frames[~frames["gate", self.name].squeeze(-1)]


class LazyGate(_HandoverGate):
    """LazyDAgger (Hoque et al., CASE 2021, Algorithm 1): SafeDAgger with hysteresis, for fewer changes of who acts.

    The expert takes over where the predicted distance exceeds beta_h, and hands back once the true one, which it sees
    while it acts, is below beta_r. The noise that the paper adds to the expert's actions is left out.

    Args:
        beta_h: distance beyond which the expert takes over.
        beta_r: distance below which it hands back, less than ``beta_h``.

    Raises:
        UserError: a threshold is negative, or ``beta_r`` is not less than ``beta_h``.
    """

    name = "lazy"
    in_keys: list[Key] = [PREDICTED, LEARNER, EXPERT]
    beta_h: Tensor
    beta_r: Tensor

    def __init__(self, beta_h: float = 0.5, beta_r: float = 0.25) -> None:
        super().__init__()
        self.register_buffer("beta_h", _threshold("beta_h", beta_h))
        self.register_buffer("beta_r", _threshold("beta_r", beta_r))
        if beta_r >= beta_h:
            raise UserError(f"beta_r={beta_r} has to be less than beta_h={beta_h}, else the expert never keeps acting")
        self._ratio = beta_r / beta_h

    def tune(self, frames: TensorDictBase, budget: float) -> None:
        """Set beta_h to the quantile of the predictions, and beta_r so that their ratio stays as given.

        The expert's share of the steps is then more than ``budget`` by those that it keeps acting.
        """
        self.beta_h.fill_(budget_threshold(self.decided(frames)[PREDICTED], budget))
        self.beta_r.copy_(self._ratio * self.beta_h)

    def takes_over(self, tensordict: TensorDictBase) -> Tensor:
        """See :class:`_HandoverGate`."""
        return _exceeds(tensordict[PREDICTED], self.beta_h)

    def hands_back(self, tensordict: TensorDictBase) -> Tensor:
        """See :class:`_HandoverGate`."""
        return discrepancy(tensordict) < self.beta_r


class ThriftyGate(_HandoverGate):
    """ThriftyDAgger (Hoque et al., CoRL 2021): the expert takes over in novel or risky states, within a budget.

    A state is novel if the ensemble's variance is above delta_h. The paper calls it risky if the probability of success
    is low, which it learns as a Q function from sparse rewards. There is no Q function here: a state is risky if the
    predicted distance from the expert is above beta_h. The expert hands back once the true distance is below delta_r;
    the paper also asks for a low risk, which would here be the same condition twice.

    Args:
        delta_h: the largest variance at which the learner acts.
        beta_h: the largest predicted distance at which the learner acts.
        delta_r: distance below which the expert hands back.

    Raises:
        UserError: a threshold is negative.
    """

    name = "thrifty"
    in_keys: list[Key] = [VARIANCE, PREDICTED, LEARNER, EXPERT]
    delta_h: Tensor
    beta_h: Tensor
    delta_r: Tensor

    def __init__(self, delta_h: float = 0.01, beta_h: float = 0.5, delta_r: float = 0.25) -> None:
        super().__init__()
        self.register_buffer("delta_h", _threshold("delta_h", delta_h))
        self.register_buffer("beta_h", _threshold("beta_h", beta_h))
        self.register_buffer("delta_r", _threshold("delta_r", delta_r))

    def tune(self, frames: TensorDictBase, budget: float) -> None:
        """Set all thresholds as the paper does.

        delta_h and beta_h are the (1 - budget) quantiles over the learner's steps, so that the expert takes
        over in ``budget`` to twice as many of them, as novelty and risk coincide or not. delta_r is the mean distance
        over the labelled steps, which here are all.
        """
        decided = self.decided(frames)
        self.delta_h.fill_(budget_threshold(decided[VARIANCE], budget))
        self.beta_h.fill_(budget_threshold(decided[PREDICTED], budget))
        self.delta_r.copy_(discrepancy(frames).mean())

    def takes_over(self, tensordict: TensorDictBase) -> Tensor:
        """See :class:`_HandoverGate`."""
        return _exceeds(tensordict[VARIANCE], self.delta_h) | _exceeds(tensordict[PREDICTED], self.beta_h)

    def hands_back(self, tensordict: TensorDictBase) -> Tensor:
        """See :class:`_HandoverGate`."""
        return discrepancy(tensordict) < self.delta_r


GATES: dict[str, type[Gate]] = {
    "beta": BetaGate,
    "safe": SafeGate,
    "ensemble": EnsembleGate,
    "lazy": LazyGate,
    "thrifty": ThriftyGate,
    "human": HumanGate,
}
"""The gates by name."""


def make_gate(name: str, **options: Any) -> Gate:
    """The gate of that name.

    Args:
        name: one of :data:`GATES`.
        options: options of this gate.

    Raises:
        UserError: there is no such gate, it has no such option or lacks one, or the option is out of range.
    """
    if name not in GATES:
        raise UserError(f"the gate {name} is unknown; choose from {', '.join(GATES)}")
    signature = inspect.signature(GATES[name].__init__)
    try:
        signature.bind(None, **options)
    except TypeError as error:
        has = ", ".join(list(signature.parameters)[1:])
        raise UserError(f"the gate {name} does not take these options ({error}); it has {has}") from error
    return GATES[name](**options)


def _threshold(name: str, value: float) -> Tensor:
    if not value >= 0.0:
        raise UserError(f"{name}={value} is no threshold; give a number of 0 or more")
    return torch.tensor(value, dtype=torch.float32)


def _exceeds(value: Tensor, threshold: Tensor) -> Tensor:
    return ~(value <= threshold)  # True for NaN
