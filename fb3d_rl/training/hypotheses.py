"""The loss of a flow network that proposes several flows: winner takes all, with probabilities.

Each moving part of a cloud has one true motion. The hypothesis that is closest to it over all of the part's points, the
winner, learns from it (multiple choice learning, Guzman-Rivera et al., NeurIPS 2012). The others learn a little, too,
so that none is left behind by a bad start (relaxed winner takes all, Rupprecht et al., ICCV 2017). The scores learn
which one wins.
"""

from __future__ import annotations

import torch
from torch import Tensor

from fb3d_rl.flow.metrics import MOVING_NORM
from fb3d_rl.models.artflownet import Hypotheses

RELAXATION = 0.05
"""Share of the loss that the hypotheses which do not win have together."""

SCORE_WEIGHT = 0.02
"""Weight of the scores' cross-entropy beside the squared error of the flow."""

LINKS = 256
"""Links of an object that are told apart; those behind count as one."""


def hypotheses_loss(found: Hypotheses, target: Tensor, valid: Tensor, link: Tensor) -> Tensor:
    """Relaxed winner-takes-all loss of K hypotheses, with the cross-entropy of their scores.

    Args:
        found: flows [B, K, N, 3] and log-probabilities [B, K, N].
        target: true flow [B, N, 3].
        valid: [B, N] bool, False on padding.
        link: [B, N] int, the link that a point lies on: those of a link have one motion.

    Returns:
        A scalar; for one hypothesis it is :func:`fb3d_rl.training.objective.flow_loss`.
    """
    flows, log_probabilities = found
    count = flows.shape[1]
    squared = (flows - target[:, None]).square().sum(3)  # [B, K, N]
    moving = valid & (target.norm(dim=2) > MOVING_NORM)
    still = squared.mean(1).masked_fill(~valid | moving, 0.0).sum()
    # One row for each link of each cloud, which holds zeros if the link does not move.
    cloud = torch.arange(len(link), device=link.device)[:, None]
    part = (cloud * LINKS + link.long().clamp(0, LINKS - 1)).flatten()
    of_points = squared.masked_fill(~moving[:, None], 0.0).transpose(1, 2).flatten(0, 1)  # [B N, K]
    errors = of_points.new_zeros(len(link) * LINKS, count).index_add_(0, part, of_points)
    points = valid.sum().clamp(min=1)
    if count == 1:
        return (still + errors.sum()) / points
    winner = errors.argmin(1)
    weights = torch.full_like(errors, RELAXATION / (count - 1)).scatter_(1, winner[:, None], 1.0 - RELAXATION)
    flow_error = (still + (weights * errors).sum()) / points
    scores = log_probabilities.gather(1, winner[part].view(len(link), 1, -1)).squeeze(1).masked_fill(~moving, 0.0)
    return flow_error - SCORE_WEIGHT * scores.sum() / moving.sum().clamp(min=1)
