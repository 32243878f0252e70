"""How to fit a network: the options of a fit, and the learning rate that follows from them."""

from __future__ import annotations

import math
from dataclasses import dataclass

from fb3d_rl.errors import UserError

SCHEDULES = ("constant", "one_cycle")

PRECISIONS = ("fp32", "bf16")


@dataclass(frozen=True)
class FitOptions:
    """How to fit.

    Attributes:
        steps: optimizer steps in all, those before a resumption included.
        batch_size: clouds in a step (paper: 64).
        lr: Adam's learning rate (paper: 1e-4); the peak if the schedule is not constant.
        schedule: "constant", or "one_cycle": up from lr / 25 in the first tenth, then down a cosine to 0.
        clip_norm: largest norm of the gradient; None leaves it alone.
        ema: decay of an exponential moving average of the weights, such as 0.999, which is measured and kept in place
            of the last weights; None for these.
        rotate: turn every drawn cloud and its flow by a random angle about z.
        mirror: reflect every other drawn cloud and its flow, at random, in the plane y = 0: a left-hinged door becomes
            a right-hinged one.
        scale: multiply every drawn cloud by a random factor from 1 - scale to 1 + scale.
        jitter: standard deviation of noise on every drawn point, m; the flow stays.
        dropout: take up to this share of its points, drawn for every cloud, out of it.
        precision: "fp32", or "bf16": a flow network's products in bfloat16 (autocast), its weights, places and the rest
            in float32.
        compile: run the layers of a network's PointNet++ through torch.compile, which takes a while before the first
            step and pays on GPUs at most: what costs time on a CPU, the balls, stays as it is.
        seed: of the rows drawn and of the rotations.
        log_every: steps from one log row to the next.
        evaluate_every: steps from one evaluation to the next; None only at the end.
        checkpoint_every: steps from one checkpoint to the next; None only at the end.
        max_minutes: stop after this time. None by default: with it, two runs of one seed may differ.
    """

    steps: int
    batch_size: int = 64
    lr: float = 1e-4
    schedule: str = "constant"
    clip_norm: float | None = None
    ema: float | None = None
    rotate: bool = True
    mirror: bool = False
    scale: float = 0.0
    jitter: float = 0.0
    dropout: float = 0.0
    precision: str = "fp32"
    compile: bool = False
    seed: int = 0
    log_every: int = 10
    evaluate_every: int | None = None
    checkpoint_every: int | None = None
    max_minutes: float | None = None

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            UserError: a value is out of range.
        """
        if self.schedule not in SCHEDULES:
            raise UserError(f"schedule={self.schedule} is unknown: choose one of {', '.join(SCHEDULES)}.")
        if self.precision not in PRECISIONS:
            raise UserError(f"precision={self.precision} is unknown: choose one of {', '.join(PRECISIONS)}.")
        for name in ("steps", "batch_size", "lr", "log_every", "evaluate_every", "checkpoint_every", "clip_norm"):
            value = getattr(self, name)
            if value is not None and value <= 0:
                raise UserError(f"{name}={value} must be greater than 0.")
        if self.ema is not None and not 0 < self.ema < 1:
            raise UserError(f"ema={self.ema} must lie between 0 and 1.")


def learning_rate(step: int, options: FitOptions) -> float:
    """The learning rate of step 0, 1, ... (one_cycle: after Smith and Topin 2018)."""
    if options.schedule == "constant":
        return options.lr
    done, warm = (step + 1) / options.steps, 0.1
    if done < warm:
        return options.lr * (1 / 25 + (1 - 1 / 25) * done / warm)
    return options.lr * 0.5 * (1 + math.cos(math.pi * (done - warm) / (1 - warm)))
