"""What a fit minimizes."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from fb3d_rl.models.artflownet import Hypotheses, proposes_several
from fb3d_rl.models.cloud_network import CloudNetwork
from fb3d_rl.models.plugin import has_own_loss
from fb3d_rl.training.device import products_of
from fb3d_rl.training.draws import augment, generator, global_draws
from fb3d_rl.training.graph import GraphedLoss
from fb3d_rl.training.hypotheses import hypotheses_loss
from fb3d_rl.training.options import FitOptions

Objective: TypeAlias = "Callable[[TensorDictBase, int], Tensor]"
"""The loss of a batch of rows [B] in step number k, a scalar."""

OWN_LOSS = 8
"""Purpose of the random numbers of a network's own loss, see :func:`fb3d_rl.training.draws.generator`."""


def flow_loss(predicted: Tensor, target: Tensor, valid: Tensor) -> Tensor:
    """L2 loss (supplement, II.A): squared norm of the error [B, N, 3], mean over all valid [B, N] points of
    the batch.

    Static points count too: the network must learn what does not move.
    """
    squared = (predicted - target).square().sum(2).masked_fill(~valid, 0.0)
    return squared.sum() / valid.sum().clamp(min=1)


def flow_objective(model: nn.Module, options: FitOptions, share: slice = slice(None)) -> Objective:
    """The loss of a flow network (:func:`cloud_loss`) on clouds that are augmented according to the options.

    A network with a loss of its own may draw random numbers for it, which depend on the seed and the step alone.

    ``share`` is the part of the whole batch that the objective is called with. On a GPU with ``options.graph``, forward
    and backward are one launch (:class:`~fb3d_rl.training.graph.GraphedLoss`), if the network can do so.
    """
    loss, own = cloud_loss(model, options), has_own_loss(_network(model))
    if (
        options.graph
        and not own
        and not options.compile
        and isinstance(model, CloudNetwork)
        and getattr(getattr(model, "network", None), "FIXED_SHAPES", False)  # one of the user's own may have any layers
        and next(model.parameters()).is_cuda
    ):
        loss = GraphedLoss(model, loss)

    def objective(batch: TensorDictBase, step: int) -> Tensor:
        clouds = augment(batch, options, step, share)
        if not own:
            return loss(clouds)
        with global_draws(generator(options.seed, OWN_LOSS, step), clouds["observation", "points"].device):
            return loss(clouds)

    return objective


def cloud_loss(model: nn.Module, options: FitOptions) -> Callable[[TensorDictBase], Tensor]:
    """:func:`flow_loss` of a flow network on flow samples [B],
    :func:`~fb3d_rl.training.hypotheses.hypotheses_loss` of one that proposes several flows, or the network's own.
    """
    several, own = proposes_several(_network(model)), has_own_loss(_network(model))

    def loss(batch: TensorDictBase) -> Tensor:
        points, valid = batch["observation", "points"], batch["observation", "valid"]
        inputs, target = (points, valid, batch["observation", "part_mask"]), batch["privileged", "flow"]
        with products_of(options, points.device):
            if own:
                found: Tensor = model(*inputs, target=target)
                return found
            predicted = model(*inputs, propose=True) if several else model(*inputs)
        if not several:
            return flow_loss(predicted.float(), target, valid)
        proposed = Hypotheses(predicted.flows.float(), predicted.log_probabilities.float())
        return hypotheses_loss(proposed, target, valid, batch["privileged", "link"])

    return loss


def _network(model: nn.Module) -> nn.Module:
    """The network that processes share."""
    return model.module if isinstance(model, DistributedDataParallel) else model
