"""Options of how a network is fitted, and where the log goes."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal, get_args

from fb3d_rl.errors import UserError
from fb3d_rl.options import check, option

Precision = Literal["fp32", "bf16"]
PRECISIONS: tuple[str, ...] = get_args(Precision)


@dataclass(frozen=True)
class OptimizerOptions:
    """What every fit has."""

    batch_size: int = option(64, "rows in a step (paper: 64 clouds)", within="[1, inf)")
    lr: float = option(1e-4, "Adam's learning rate (paper: 1e-4); the peak of one_cycle", within="(0, inf)")
    schedule: Literal["constant", "one_cycle"] = option(
        "constant", "of the learning rate; one_cycle: up from lr / 25 in the first tenth, then down a cosine to 0"
    )
    clip_norm: float | None = option(None, "largest norm of the gradient; null: no limit", within="(0, inf)")
    log_every: int = option(10, "from one log row to the next", "steps", "[1, inf)")
    checkpoint_every: int | None = option(
        None, "from one checkpoint to the next; null: only at the end", "steps", "[1, inf)"
    )


@dataclass(frozen=True)
class FlowFitOptions(OptimizerOptions):
    """How a network is fitted to flow samples, which are augmented as they are drawn."""

    ema: float | None = option(
        None,
        "decay of an exponential moving average of the weights, such as 0.999, which is measured and kept in place of "
        "the last weights; null for these",
        within="(0, 1)",
    )
    rotate: bool = option(True, "turn every cloud and its flow by a random angle about z")
    # A left-hinged door becomes a right-hinged one.
    mirror: bool = option(False, "reflect every other cloud and its flow, at random, in the plane y = 0")
    scale: float = option(0.0, "multiply every cloud by a random factor from 1 - scale to 1 + scale", within="[0, 1)")
    jitter: float = option(0.0, "standard deviation of noise on every drawn point; the flow stays", "m", "[0, inf)")
    dropout: float = option(
        0.0, "take up to this share of its points, drawn for every cloud, out of it", within="[0, 1)"
    )
    precision: Precision = option(
        "fp32", "bf16: a network's products in bfloat16 (autocast), its weights, places and the rest in float32"
    )
    # What costs time on a CPU, the balls, stays as it is.
    compile: bool = option(
        False, "run the layers of a network's PointNet++ through torch.compile, which pays on GPUs at most"
    )
    graph: bool = option(
        True,
        "on a GPU, launch a step's loss and gradients as one CUDA graph, with backbone=delayed; the order of sums then "
        "varies",
    )
    evaluate_every: int | None = option(
        None, "from one validation to the next; null: only at the end", "steps", "[1, inf)"
    )


@dataclass(frozen=True)
class FitOptions(FlowFitOptions):
    """How to fit.

    Attributes:
        steps: optimizer steps in all, those before a resumption included.
        seed: of the rows drawn and of the rotations.
        max_minutes: stop after this time. None by default: with it, two runs of one seed may differ.
    """

    steps: int = field(kw_only=True)
    seed: int = 0
    max_minutes: float | None = None

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            UserError: a value is out of range.
        """
        check(self)
        if self.steps <= 0:
            raise UserError(f"steps={self.steps} must be greater than 0.")


@dataclass(frozen=True)
class LoggerOptions:
    """Where a run's numbers go besides metrics.jsonl."""

    name: Literal["none", "csv", "tensorboard", "wandb"] = option("none", "TorchRL's logger")
    project: str = option("fb3d_rl", "of Weights & Biases")


def learning_rate(step: int, options: FitOptions) -> float:
    """The learning rate of step 0, 1, ... (one_cycle: after Smith and Topin 2018)."""
    if options.schedule == "constant":
        return options.lr
    done, warm = (step + 1) / options.steps, 0.1
    if done < warm:
        return options.lr * (1 / 25 + (1 - 1 / 25) * done / warm)
    return options.lr * 0.5 * (1 + math.cos(math.pi * (done - warm) / (1 - warm)))
