"""Fit a network to stored rows: one readable loop, for ArtFlowNet as for the policies that imitate.

A run is a pure function of (model's first weights, rows, options): step k draws its rows and its rotations from the
seed and k alone. So the state to resume from is the model, the optimizer and a counter, and a resumed run equals a
straight one bit for bit on a CPU.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, cast

import torch
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from tensordict import TensorDictBase
from torch import distributed, nn
from torch.nn.parallel import DistributedDataParallel

from fb3d_rl.errors import Interrupted, UserError
from fb3d_rl.training.device import Rows, resident, tune_cpu
from fb3d_rl.training.draws import batch_rows
from fb3d_rl.training.interrupt import deferred_interrupt
from fb3d_rl.training.objective import Objective, flow_objective
from fb3d_rl.training.options import FitOptions, learning_rate
from fb3d_rl.training.processes import rank_and_count
from fb3d_rl.training.state import FitState


def fit(
    model: nn.Module,
    buffer: Rows,
    options: FitOptions,
    *,
    objective: Objective | None = None,
    device: torch.device | str = "cpu",
    evaluate: Callable[[nn.Module], dict[str, float]] | None = None,
    log: Callable[[dict[str, Any]], None] | None = None,
    on_checkpoint: Callable[[dict[str, Any]], None] | None = None,
    resume: dict[str, Any] | None = None,
    progress: bool = True,
    title: str = "training",
) -> dict[str, Any]:
    """Train a network, beside the other processes if torchrun started several (:mod:`fb3d_rl.training.processes`).

    These compute equal shares of every batch, normalize each by its own statistics, and average their gradients. Only
    the first is to evaluate, log and write checkpoints.

    Args:
        model: trained in place. A flow network is called as model(points [B, N, 3], valid [B, N], part_mask [B, N])
            -> flow [B, N, 3].
        buffer: rows that ``objective`` understands; of a flow network, rows with ("observation", "points" | "valid" |
            "part_mask") and ("privileged", "flow").
        options: see FitOptions.
        objective: what is minimized; :func:`~fb3d_rl.training.objective.flow_objective` unless given.
        device: where to train; the model is moved there.
        evaluate: measures the model, or the average of its weights, which is in evaluation mode meanwhile; its numbers
            go to the log.
        log: receives rows {"step": ..., "train/loss": ..., ...}; keys that start with "time/" differ between runs.
        on_checkpoint: receives the state to resume from; also called at the end and on Ctrl-C.
        resume: such a state.
        progress: show a progress bar.
        title: of the progress bar.

    Returns:
        The last state: {"step", "model", "average", "optimizer", "loss_sum", "loss_count", "options"}. With ``ema`` the
        model ends with the averaged weights, "average"; the last ones are "model", to go on from.

    Raises:
        UserError: there are no rows, the state belongs to other options, or the loss is not finite.
        Interrupted: Ctrl-C was pressed (after the checkpoint).
    """
    if len(buffer) == 0:
        raise UserError("There are no clouds to train on: generate flow samples first.")
    state, objective, draw = _prepare(model, buffer, options, objective, device, resume)
    hooks = _Hooks(evaluate, log, on_checkpoint)
    with _progress_bar(title, options.steps, state.step, shown=progress) as show, deferred_interrupt() as interrupt:
        _loop(state, objective, draw, hooks, show, interrupt, device)
    return state.finish()


@dataclass(frozen=True)
class _Hooks:
    """What :func:`fit` calls between its steps."""

    evaluate: Callable[[nn.Module], dict[str, float]] | None
    log: Callable[[dict[str, Any]], None] | None
    on_checkpoint: Callable[[dict[str, Any]], None] | None


def _prepare(
    model: nn.Module,
    buffer: Rows,
    options: FitOptions,
    objective: Objective | None,
    device: torch.device | str,
    resume: dict[str, Any] | None,
) -> tuple[FitState, Objective, Callable[[int], TensorDictBase]]:
    """The state before the first step, the objective, and a function that draws this process's share of a step."""
    tune_cpu()
    rows, (rank, processes) = len(buffer), rank_and_count()
    share = slice(rank, None, processes)
    model.to(device).train()
    if torch.device(device).type == "cuda":
        buffer = resident(buffer, device, torch.cuda.mem_get_info(device)[0] // 2)
    if options.compile:
        cast(nn.Module, model.network).compile(dynamic=True)
    state = FitState(model, options, averages=processes > 1 and objective is not None)
    objective = objective or flow_objective(model if processes == 1 else DistributedDataParallel(model), options, share)
    if resume is not None:
        state.load_state_dict(resume)

    # Where rows lie on the card, their numbers go there once, and not for each of a row's tensors.
    place = (buffer.device or "cpu") if isinstance(buffer, TensorDictBase) else "cpu"

    def draw(step: int) -> TensorDictBase:
        return buffer[batch_rows(step, rows, options)[share].to(place)].to(device)

    return state, objective, draw


def _loop(
    state: FitState,
    objective: Objective,
    draw: Callable[[int], TensorDictBase],
    hooks: _Hooks,
    show: Callable[[int, float, float], None],
    interrupt: threading.Event,
    device: torch.device | str,
) -> None:
    """The steps that are left, with what happens between them."""
    options: FitOptions = state.options
    processes = rank_and_count()[1]
    started, first = time.perf_counter(), state.step
    while state.step < options.steps:
        loss = _summed(device, state.update(objective, draw(state.step)))[0] / processes
        if not math.isfinite(loss):
            raise UserError(f"The loss is {loss} after step {state.step + 1}: lower lr or set clip_norm.")
        state.count(loss)  # counters move after the work that they count
        seconds = time.perf_counter() - started
        rate = (state.step - first) * options.batch_size / seconds
        show(state.step, loss, rate)
        if state.due(options.log_every):
            if hooks.log is not None:
                lr, mean = learning_rate(state.step - 1, options), state.loss_sum / state.loss_count
                hooks.log({"step": state.step, "train/loss": mean, "train/lr": lr, "time/seconds": seconds,
                           "time/rows_per_s": rate})  # fmt: skip
            state.loss_sum, state.loss_count = 0.0, 0
        if state.due(options.evaluate_every) and hooks.evaluate is not None:
            numbers = _evaluated(state.measured(), hooks.evaluate)
            if hooks.log is not None:
                hooks.log({"step": state.step, **numbers, "time/seconds": time.perf_counter() - started})
        # Processes stop together, or the others would wait for this one for ever.
        overdue = options.max_minutes is not None and seconds > 60 * options.max_minutes
        late, stopped = (count > 0 for count in _summed(device, overdue, interrupt.is_set()))
        if (state.due(options.checkpoint_every) or late or stopped) and hooks.on_checkpoint is not None:
            hooks.on_checkpoint(state.state_dict())
        if stopped:
            saved = "a checkpoint was saved, resume from it to go on" if hooks.on_checkpoint else "nothing was saved"
            raise Interrupted(f"Stopped by Ctrl-C after step {state.step} of {options.steps}: {saved}.")
        if late:
            break


def _evaluated(model: nn.Module, evaluate: Callable[[nn.Module], dict[str, float]]) -> dict[str, float]:
    """Numbers of a model that is in evaluation mode meanwhile."""
    model.eval()
    numbers = evaluate(model)
    model.train()
    return numbers


def _summed(device: torch.device | str, *numbers: float) -> list[float]:
    """Each number's sum over all processes, which all of them must ask for."""
    if rank_and_count()[1] == 1:
        return list(numbers)
    values = torch.tensor(numbers, device=device)
    distributed.all_reduce(values)
    return values.tolist()


@contextmanager
def _progress_bar(title: str, steps: int, first: int, shown: bool) -> Iterator[Callable[[int, float, float], None]]:
    """A progress bar, from step ``first`` on; yields a function that takes the step, its loss and rows per second."""
    columns = (
        TextColumn(title),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("loss {task.fields[loss]:.4f}  {task.fields[rate]:.0f} rows/s  left"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, disable=not shown) as bar:
        task = bar.add_task("", total=steps, completed=first, loss=math.nan, rate=0.0)
        yield lambda step, loss, rate: bar.update(task, completed=step, loss=loss, rate=rate)
