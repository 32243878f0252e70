"""Fit a network to stored rows: one readable loop, for ArtFlowNet as for the policies that imitate.

A run is a pure function of (model's first weights, rows, options): step k draws its rows and its rotations
from the seed and k alone. So the state to resume from is the model, the optimizer and a counter, and a
resumed run equals a straight one bit for bit on a CPU.
"""

from __future__ import annotations

import copy
import ctypes
import math
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from functools import lru_cache
from typing import Any, Protocol, TypeAlias, cast

import torch
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, distributed, nn
from torch.nn.parallel import DistributedDataParallel
from torch.optim.swa_utils import AveragedModel
from torch.optim.swa_utils import get_ema_multi_avg_fn as ema_of

from fb3d_rl.errors import Interrupted, UserError
from fb3d_rl.training.options import FitOptions
from fb3d_rl.training.processes import rank_and_count

Objective: TypeAlias = "Callable[[TensorDictBase, int], Tensor]"
"""The loss of a batch of rows [B] in step number k, a scalar."""


class Rows(Protocol):
    """What is drawn from: a TensorDict [R], TorchRL's replay buffer, or what else gives rows by their number."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: Any, /) -> Any: ...


def flow_loss(predicted: Tensor, target: Tensor, valid: Tensor) -> Tensor:
    """L2 loss (supplement, II.A): squared norm of the error [B, N, 3], mean over all valid [B, N] points of
    the batch.

    Static points count too: the network must learn what does not move.
    """
    squared = (predicted - target).square().sum(2).masked_fill(~valid, 0.0)
    return squared.sum() / valid.sum().clamp(min=1)


def learning_rate(step: int, options: FitOptions) -> float:
    """The learning rate of step 0, 1, ... (one_cycle: after Smith and Topin 2018)."""
    if options.schedule == "constant":
        return options.lr
    done, warm = (step + 1) / options.steps, 0.1
    if done < warm:
        return options.lr * (1 / 25 + (1 - 1 / 25) * done / warm)
    return options.lr * 0.5 * (1 + math.cos(math.pi * (done - warm) / (1 - warm)))


def generator(seed: int, purpose: int, number: int) -> torch.Generator:
    """A generator that depends on its arguments only. A multiplicative hash keeps neighbouring arguments
    apart.
    """
    mixed = (seed * 0x9E3779B97F4A7C15 + purpose * 0xBF58476D1CE4E5B9 + number * 0x94D049BB133111EB) % 2**63
    return torch.Generator().manual_seed(mixed)


@lru_cache(maxsize=2)  # a batch is of one pass, or of the end of one and the start of the next
def _permutation(seed: int, number: int, rows: int) -> Tensor:
    return torch.randperm(rows, generator=generator(seed, 1, number))


def batch_rows(step: int, rows: int, options: FitOptions) -> Tensor:
    """Which rows step number ``step`` reads [batch_size]: every pass over the rows is a new permutation."""
    place = step * options.batch_size + torch.arange(options.batch_size)
    passes = place // rows
    chosen = torch.empty_like(place)
    for number in passes.unique().tolist():
        order = _permutation(options.seed, number, rows)
        here = passes == number
        chosen[here] = order[place[here] % rows]
    return chosen


def flow_objective(model: nn.Module, options: FitOptions, share: slice = slice(None)) -> Objective:
    """:func:`flow_loss` of a flow network on clouds that are augmented as the options say.

    ``share`` is the part of the whole batch that the objective is given.
    """

    def objective(batch: TensorDictBase, step: int) -> Tensor:
        batch = augment(batch, options, step, share)
        points, valid = batch["observation", "points"], batch["observation", "valid"]
        with products_of(options, points.device):
            predicted = model(points, valid, batch["observation", "part_mask"])
        return flow_loss(predicted.float(), batch["privileged", "flow"], valid)

    return objective


def require_compiler(device: torch.device) -> None:
    """Check that torch.compile can work.

    Raises:
        UserError: it cannot, for want of a compiler.
    """
    try:
        torch.compile(torch.neg)(torch.ones(2, device=device))
    except RuntimeError as error:
        reason = str(error).strip().splitlines()[0]
        raise UserError(
            f"torch.compile does not work here ({reason}): install a C++ compiler (on a GPU: Triton), or leave it off"
        ) from error


def emulates_bf16(device: torch.device) -> bool:
    """Whether ``device`` is an x86 processor without AVX-512, where bfloat16 products take several times fp32's."""
    return device.type == "cpu" and torch.backends.cpu.get_cpu_capability() == "AVX2"


def products_of(options: FitOptions, device: torch.device) -> torch.autocast:
    """The context in which a network's products are of the precision that the options say."""
    return torch.autocast(device.type, torch.bfloat16, enabled=options.precision == "bf16")


def augment(batch: TensorDictBase, options: FitOptions, step: int, share: slice = slice(None)) -> TensorDictBase:
    """The flow samples of a batch, turned, mirrored, scaled, jittered and thinned out as the options say.

    What is drawn depends on the seed and the step alone, for the whole batch, whose part ``share`` is given.
    """
    points, flow = batch["observation", "points"], batch["privileged", "flow"]
    valid, part_mask = batch["observation", "valid"], batch["observation", "part_mask"]
    size, device = options.batch_size, points.device

    def draw(purpose: int, *shape: int, normal: bool = False) -> Tensor:
        random = torch.randn if normal else torch.rand
        return random(size, *shape, generator=generator(options.seed, purpose, step))[share].to(device)

    if options.rotate:
        angle = draw(2) * (2 * math.pi)
        points, flow = rotate_about_z(points, angle), rotate_about_z(flow, angle)
    if options.mirror or options.scale:
        draws = torch.rand(2, size, 1, 1, generator=generator(options.seed, 3, step))[:, share].to(device)
        if options.mirror:
            reflect = torch.ones_like(points[:, :1])
            reflect[..., 1] = torch.where(draws[0, ..., 0] < 0.5, -1.0, 1.0)
            points, flow = points * reflect, flow * reflect
        points = points * (1 + options.scale * (2 * draws[1] - 1))
    if options.jitter:
        points = points + options.jitter * draw(4, points.shape[1], 3, normal=True)
    if options.dropout:
        valid = valid & (draw(5, points.shape[1]) >= options.dropout * draw(6, 1))
        part_mask, flow = part_mask & valid, flow * valid[..., None]
    observation = {"points": points, "valid": valid, "part_mask": part_mask}
    return TensorDict({"observation": observation, "privileged": {"flow": flow}}, batch_size=batch.batch_size)


def resident(rows: Rows, device: torch.device | str, room: int, chunk: int = 1024) -> Rows:
    """The rows in the memory of ``device``, where a step finds them without a copy from the host; as they are if they
    take more than ``room`` bytes.
    """
    one = rows[torch.arange(1)]
    if len(rows) * one.bytes() > room:
        return rows
    held = one.to(device).new_empty(len(rows))
    for numbers in torch.arange(len(rows)).split(chunk):
        held[numbers] = rows[numbers].to(device)
    return cast(Rows, held)


def rotate_about_z(vectors: Tensor, angle: Tensor) -> Tensor:
    """Turn vectors [B, N, 3] about z by angle [B] (radians, counter-clockwise seen from above)."""
    cos, sin = angle.cos()[:, None], angle.sin()[:, None]
    x, y, z = vectors.unbind(2)
    return torch.stack([cos * x - sin * y, sin * x + cos * y, z], 2)


def tune_cpu() -> None:
    """Two process-wide settings without which training on a CPU is up to three times slower.

    Gradients shrink into denormal floats as training converges, which CPUs handle in microcode: flush them to
    0. And glibc hands every large freed block back to the system, which then clears each page of the next
    one: keep them.
    """
    torch.set_flush_denormal(True)
    if sys.platform == "linux":
        mallopt = getattr(ctypes.CDLL(None), "mallopt", None)  # glibc only
        if mallopt is not None:
            m_trim_threshold, m_mmap_max = -1, -4  # malloc.h
            mallopt(m_mmap_max, 0)
            mallopt(m_trim_threshold, 2**31 - 1)


@contextmanager
def _deferred_interrupt() -> Iterator[threading.Event]:
    """Turn the first Ctrl-C into an event, so that a step is never cut in half; a second one interrupts at
    once.
    """
    asked = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield asked
        return
    previous = signal.getsignal(signal.SIGINT)

    def ask(*_: object) -> None:
        asked.set()
        signal.signal(signal.SIGINT, previous)

    signal.signal(signal.SIGINT, ask)
    try:
        yield asked
    finally:
        signal.signal(signal.SIGINT, previous)


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
        objective: what is minimized; :func:`flow_objective` unless given.
        device: where to train; the model is moved there.
        evaluate: measures the model, or the average of its weights, which is in evaluation mode meanwhile; its numbers
            go to the log.
        log: receives rows {"step": ..., "train/loss": ..., ...}; keys that start with "time/" differ between
            runs.
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
    tune_cpu()
    rows, (rank, processes) = len(buffer), rank_and_count()
    share = slice(rank, None, processes)
    if rows == 0:
        raise UserError("There are no clouds to train on: generate flow samples first.")
    model.to(device).train()
    if torch.device(device).type == "cuda":
        buffer = resident(buffer, device, torch.cuda.mem_get_info(device)[0] // 2)
    if options.compile:
        cast(nn.Module, model.network).compile(dynamic=True)
    objective = objective or flow_objective(model if processes == 1 else DistributedDataParallel(model), options, share)
    optimizer, average = _companions(model, options)
    step, loss_sum, loss_count = (0, 0.0, 0) if resume is None else _restore(model, options, optimizer, average, resume)

    def state() -> dict[str, Any]:
        return {
            "step": step,
            "model": model.state_dict(),
            "average": None if average is None else average.module.state_dict(),
            "optimizer": optimizer.state_dict(),
            "loss_sum": loss_sum,
            "loss_count": loss_count,
            "options": asdict(options),
        }

    def update() -> float:
        """One step: draw, predict, descend; returns the loss."""
        batch = buffer[batch_rows(step, rows, options)[share]].to(device)
        for group in optimizer.param_groups:
            group["lr"] = learning_rate(step, options)
        optimizer.zero_grad()
        value = objective(batch, step)
        value.backward()
        if options.clip_norm is not None:
            nn.utils.clip_grad_norm_(model.parameters(), options.clip_norm)
        optimizer.step()
        if average is not None:
            average.update_parameters(model)
        return value.item()

    def summed(*numbers: float) -> list[float]:
        """Each number's sum over all processes, which all of them must ask for."""
        if processes == 1:
            return list(numbers)
        values = torch.tensor(numbers, device=device)
        distributed.all_reduce(values)
        return values.tolist()

    def due(every: int | None) -> bool:
        return step == options.steps or (every is not None and step % every == 0)

    columns = (
        TextColumn(title),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("loss {task.fields[loss]:.4f}  {task.fields[rate]:.0f} rows/s  left"),
        TimeRemainingColumn(),
    )
    started, first = time.perf_counter(), step
    with Progress(*columns, disable=not progress) as bar, _deferred_interrupt() as interrupt:
        task = bar.add_task("", total=options.steps, completed=step, loss=math.nan, rate=0.0)
        while step < options.steps:
            loss = summed(update())[0] / processes
            if not math.isfinite(loss):
                raise UserError(f"The loss is {loss} after step {step + 1}: lower lr or set clip_norm.")
            # Counters move after the work that they count.
            step, loss_sum, loss_count = step + 1, loss_sum + loss, loss_count + 1
            seconds = time.perf_counter() - started
            rate = (step - first) * options.batch_size / seconds
            bar.update(task, completed=step, loss=loss, rate=rate)
            if due(options.log_every):
                if log is not None:
                    lr = learning_rate(step - 1, options)
                    mean = loss_sum / loss_count
                    log({"step": step, "train/loss": mean, "train/lr": lr, "time/seconds": seconds,
                         "time/rows_per_s": rate})  # fmt: skip
                loss_sum, loss_count = 0.0, 0
            if due(options.evaluate_every) and evaluate is not None:
                measured = model if average is None else average.module
                measured.eval()
                numbers = evaluate(measured)
                measured.train()
                if log is not None:
                    log({"step": step, **numbers, "time/seconds": time.perf_counter() - started})
            # Processes stop together, or the others would wait for this one for ever.
            overdue = options.max_minutes is not None and seconds > 60 * options.max_minutes
            late, stopped = (count > 0 for count in summed(overdue, interrupt.is_set()))
            if (due(options.checkpoint_every) or late or stopped) and on_checkpoint is not None:
                on_checkpoint(state())
            if stopped:
                saved = "a checkpoint was saved, resume from it to go on" if on_checkpoint else "nothing was saved"
                raise Interrupted(f"Stopped by Ctrl-C after step {step} of {options.steps}: {saved}.")
            if late:
                break
    last = state()
    if average is not None:
        last["model"] = {name: value.clone() for name, value in last["model"].items()}
        model.load_state_dict(average.module.state_dict())
    model.eval()
    return last


def check_state(model: nn.Module, options: FitOptions, state: dict[str, Any]) -> None:
    """Raise what :func:`fit` would raise of a ``state`` to resume from, before any work; leaves the model as it is.

    Raises:
        UserError: the state belongs to other options.
    """
    tried = copy.deepcopy(model)
    _restore(tried, options, *_companions(tried, options), state)


def _companions(model: nn.Module, options: FitOptions) -> tuple[torch.optim.Adam, AveragedModel | None]:
    """The optimizer, and the average of the weights if there is to be one."""
    optimizer = torch.optim.Adam(model.parameters(), lr=options.lr, fused=True)
    average = None if options.ema is None else AveragedModel(model, multi_avg_fn=ema_of(options.ema), use_buffers=True)
    return optimizer, average


def _restore(
    model: nn.Module,
    options: FitOptions,
    optimizer: torch.optim.Adam,
    average: AveragedModel | None,
    state: dict[str, Any],
) -> tuple[int, float, int]:
    """Load a state of :func:`fit`; returns the step, and the sum and the number of the losses to log."""
    _check_same_run(state["options"], options)
    model.load_state_dict(state["model"])
    optimizer.load_state_dict(state["optimizer"])
    for weights, moments in optimizer.state.items():
        if moments["exp_avg"].shape != weights.shape:  # which Adam would find out in its first step
            raise ValueError("the optimizer's state is of other weights")
    if average is not None:
        average.module.load_state_dict(state["average"])
        average.n_averaged.fill_(state["step"])
    return state["step"], state["loss_sum"], state["loss_count"]


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
