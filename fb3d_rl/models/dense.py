"""The layer that all of PointNet++ is made of."""

from __future__ import annotations

import math
from collections.abc import Iterator

import torch
from torch import Tensor, nn
from torch.nn import functional

eager = torch.compiler.disable
"""Keeps a function out of a compiled network: its loops are long, or the shapes of its results follow from values."""


class DenseLayer(nn.Module):
    """Linear, batch norm, ReLU on rows [P, in] -> [P, out]. Batch norm's shift makes a bias redundant."""

    linear: nn.Linear
    norm: nn.BatchNorm1d

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.linear = nn.Linear(inputs, outputs, bias=False)
        self.norm = nn.BatchNorm1d(outputs)

    def activate(self, rows: Tensor) -> Tensor:
        """The part after the linear map."""
        normal: Tensor = self.norm(rows)
        return functional.relu(normal, inplace=True)

    def forward(self, rows: Tensor) -> Tensor:
        """Rows [P, in] -> [P, out]."""
        return self.activate(self.linear(rows))

    def fixed_norm(self) -> tuple[Tensor, Tensor]:
        """Scale and shift [out] of batch norm in evaluation mode."""
        mean, variance = self._running()
        scale = self.norm.weight * (variance + self.norm.eps).rsqrt()
        return scale, self.norm.bias - mean * scale

    @torch.no_grad()
    def track(self, mean: Tensor, variance: Tensor, rows: int) -> None:
        """Update batch norm's running statistics by mean and biased variance [out] of the rows."""
        running_mean, running_variance = self._running()
        momentum = self.norm.momentum
        assert momentum is not None
        running_mean.lerp_(mean, momentum)
        running_variance.lerp_(variance * (rows / max(1, rows - 1)), momentum)
        assert self.norm.num_batches_tracked is not None
        self.norm.num_batches_tracked.add_(1)

    def _running(self) -> tuple[Tensor, Tensor]:
        mean, variance = self.norm.running_mean, self.norm.running_var
        assert mean is not None and variance is not None
        return mean, variance


class DenseMLP(nn.Sequential):
    """Dense layers between the given widths."""

    def __init__(self, *widths: int) -> None:
        super().__init__(*(DenseLayer(a, b) for a, b in zip(widths[:-1], widths[1:], strict=True)))

    def __iter__(self) -> Iterator[DenseLayer]:
        """The layers, first to last."""
        return iter(self._modules.values())  # type: ignore[arg-type]


def initialize(net: nn.Module, generator: torch.Generator) -> None:
    """Draw every linear map anew from the distribution that ``nn.Linear`` uses, with a generator handed in."""
    for module in net.modules():
        if isinstance(module, nn.Linear):
            nn.init.kaiming_uniform_(module.weight, a=math.sqrt(5), generator=generator)
            if module.bias is not None:
                bound = 1 / math.sqrt(module.in_features)
                nn.init.uniform_(module.bias, -bound, bound, generator=generator)
