"""The state of a fit: what changes from step to step, and how it is saved and restored."""

from __future__ import annotations

import copy
from dataclasses import asdict
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import nn
from torch.optim.swa_utils import AveragedModel
from torch.optim.swa_utils import get_ema_multi_avg_fn as ema_of

from fb3d_rl.errors import UserError
from fb3d_rl.training.objective import Objective
from fb3d_rl.training.options import FitOptions, learning_rate
from fb3d_rl.training.processes import average_gradients


class FitState:
    """A fit in progress: the model, its optimizer, the average of its weights, and counters.

    Args:
        model: trained in place.
        options: how.
        averages: whether it averages the gradients of several processes; else the objective does so, if need be.

    Attributes:
        average: moving average of the weights; None without ``options.ema``.
        step: how many steps are done.
        loss_sum, loss_count: sum and number of the losses since the last log row.
    """

    def __init__(self, model: nn.Module, options: FitOptions, averages: bool = False) -> None:
        self.model, self.options, self.averages = model, options, averages
        self.optimizer = torch.optim.Adam(model.parameters(), lr=options.lr, fused=True)
        self.average = (
            None if options.ema is None else AveragedModel(model, multi_avg_fn=ema_of(options.ema), use_buffers=True)
        )
        self.step, self.loss_sum, self.loss_count = 0, 0.0, 0

    def update(self, objective: Objective, batch: TensorDictBase) -> float:
        """One step of the optimizer on a batch of rows [B]; returns the loss. :meth:`count` then counts it."""
        for group in self.optimizer.param_groups:
            group["lr"] = learning_rate(self.step, self.options)
        self.optimizer.zero_grad()
        value = objective(batch, self.step)
        if value.requires_grad:  # else the objective has left the gradients in place
            value.backward()
        if self.averages:
            average_gradients(self.model)
        if self.options.clip_norm is not None:
            nn.utils.clip_grad_norm_(self.model.parameters(), self.options.clip_norm)
        self.optimizer.step()
        if self.average is not None:
            self.average.update_parameters(self.model)
        return value.item()

    def count(self, loss: float) -> None:
        """Count a step that is done."""
        self.step, self.loss_sum, self.loss_count = self.step + 1, self.loss_sum + loss, self.loss_count + 1

    def due(self, every: int | None) -> bool:
        """Whether it is time for what happens after each ``every`` steps, and after the last one."""
        return self.step == self.options.steps or (every is not None and self.step % every == 0)

    def measured(self) -> nn.Module:
        """The network to evaluate: the average of the weights if there is one, else the model."""
        return self.model if self.average is None else self.average.module

    def state_dict(self) -> dict[str, Any]:
        """The state to resume from; its tensors are those of the fit, not copies."""
        return {
            "step": self.step,
            "model": self.model.state_dict(),
            "average": None if self.average is None else self.average.module.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "loss_sum": self.loss_sum,
            "loss_count": self.loss_count,
            "options": asdict(self.options),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from what :meth:`state_dict` returned.

        Raises:
            UserError: the state belongs to other options.
            RuntimeError, LookupError, TypeError, ValueError: it belongs to another model.
        """
        _check_same_run(state["options"], self.options)
        self.model.load_state_dict(state["model"])
        self.optimizer.load_state_dict(state["optimizer"])
        for weights, moments in self.optimizer.state.items():
            if moments["exp_avg"].shape != weights.shape:  # Adam would fail in its first step
                raise ValueError("the optimizer's state is of other weights")
        if self.average is not None:
            self.average.module.load_state_dict(state["average"])
            self.average.n_averaged.fill_(state["step"])
        self.step, self.loss_sum, self.loss_count = state["step"], state["loss_sum"], state["loss_count"]

    def finish(self) -> dict[str, Any]:
        """The last state. The model is left in evaluation mode, with the averaged weights if there are any."""
        last = self.state_dict()
        if self.average is not None:
            last["model"] = {name: value.clone() for name, value in last["model"].items()}
            self.model.load_state_dict(self.average.module.state_dict())
        self.model.eval()
        return last


def check_state(model: nn.Module, options: FitOptions, state: dict[str, Any]) -> None:
    """Raise before any work what :func:`fb3d_rl.training.fit.fit` would raise for a ``state`` to resume from.

    Leaves the model as it is.

    Raises:
        UserError: the state belongs to other options.
    """
    FitState(copy.deepcopy(model), options).load_state_dict(state)


def _check_same_run(before: dict[str, Any], options: FitOptions) -> None:
    """Refuse to continue a run under options that would have led elsewhere."""
    decisive = ["batch_size", "lr", "schedule", "clip_norm", "ema", "rotate", "mirror", "scale", "jitter", "dropout"]
    decisive += ["precision", "compile", "seed"]
    if options.schedule != "constant":
        decisive.append("steps")
    for name in decisive:
        trained_with = before.get(name, getattr(FitOptions, name, None))  # older checkpoints lack what came later
        if trained_with != getattr(options, name):
            raise UserError(
                f"The checkpoint was trained with {name}={trained_with}, not {getattr(options, name)}: "
                f"resume with the same value or start a new run."
            )
