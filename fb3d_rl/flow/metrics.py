"""How close a predicted flow is to the true one, cloud by cloud, over moving points only (FlowBot3D, section
V).
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

MOVING_NORM = 1e-6
"""A point moves if the norm of its true flow exceeds this; flow is scaled so that the largest norm is 1."""


def flow_metrics(predicted: Tensor, target: Tensor, valid: Tensor) -> dict[str, Tensor]:
    """Compare flows on the points that truly move.

    Args:
        predicted: [B, N, 3].
        target: [B, N, 3], same frame and scale.
        valid: [B, N] bool, False on padding.

    Returns:
        Three [B] tensors, nan for a cloud in which nothing moves (leave those out of a mean):
        "rmse", the mean L2 norm of the error (the reference's name for it); "cosine", the mean cosine, 0 where the
        prediction is zero; "magnitude_error", the mean absolute difference of the norms.
    """
    norm = target.norm(dim=2)
    moving = valid & (norm > MOVING_NORM)
    count = moving.sum(1)

    def mean(values: Tensor) -> Tensor:
        return values.masked_fill(~moving, 0.0).sum(1) / count

    return {
        "rmse": mean((predicted - target).norm(dim=2)),
        "cosine": mean((functional.normalize(predicted, dim=2) * functional.normalize(target, dim=2)).sum(2)),
        "magnitude_error": mean((predicted.norm(dim=2) - norm).abs()),
    }


def hypothesis_metrics(
    predicted: Tensor, flows: Tensor, probabilities: Tensor, target: Tensor, valid: Tensor
) -> dict[str, Tensor]:
    """What several proposed flows are worth, on the points that truly move.

    Args:
        predicted: [B, N, 3] the prediction; it may take each point's flow from another proposal.
        flows: [B, K, N, 3] the proposals.
        probabilities: [B, K] theirs.
        target: [B, N, 3] the true flow.
        valid: [B, N] bool, False on padding.

    Returns:
        Four [B] tensors, nan for a cloud in which nothing moves: "axis_cosine", the mean absolute cosine of the
        prediction, which does not ask for the sense of the motion; "best_cosine", the mean cosine of the proposal with
        the smallest "rmse" of all K; "probability" of the most probable; "hit", 1 where that is the best one, else 0.
        Probabilities are calibrated where the means of the last two agree.
    """
    each = [flow_metrics(flow, target, valid) for flow in flows.unbind(1)]
    rmse, cosine = (torch.stack([numbers[key] for numbers in each], 1) for key in ("rmse", "cosine"))
    best, chosen = rmse.argmin(1), probabilities.argmax(1)
    rows = torch.arange(len(flows))
    moving = valid & (target.norm(dim=2) > MOVING_NORM)
    along = (functional.normalize(predicted, dim=2) * functional.normalize(target, dim=2)).sum(2).abs()
    nothing = torch.where(moving.any(1), 0.0, torch.nan)
    return {
        "axis_cosine": along.masked_fill(~moving, 0.0).sum(1) / moving.sum(1),
        "best_cosine": cosine[rows, best],
        "probability": probabilities[rows, chosen] + nothing,
        "hit": (best == chosen).to(target.dtype) + nothing,
    }


def mean_metrics(metrics: dict[str, Tensor]) -> dict[str, float]:
    """Mean of each metric over the clouds in which something moves; nan if there is none."""
    return {name: float(torch.nanmean(values)) for name, values in metrics.items()}
