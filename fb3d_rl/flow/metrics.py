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


def mean_metrics(metrics: dict[str, Tensor]) -> dict[str, float]:
    """Mean of each metric over the clouds in which something moves; nan if there is none."""
    return {name: float(torch.nanmean(values)) for name, values in metrics.items()}
