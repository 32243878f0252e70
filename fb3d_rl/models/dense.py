"""The layer that all of PointNet++ is made of."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from fb3d_rl.geometry.points import has_triton

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

    def activate(self, rows: Tensor, present: Tensor | None = None) -> Tensor:
        """The part after the linear map. If some rows are padding, ``present`` [B, 1, P / B] is 0 on them and 1 on the
        others, and they have no part in batch norm's statistics.
        """
        if present is None or not self.norm.training:
            normal: Tensor = self.norm(rows)
            return functional.relu(normal, inplace=True)
        norm = self.norm
        output, mean, variance, count = _PaddedNorm.apply(rows, present, norm.weight, norm.bias, norm.eps)
        self.track(mean, variance, count)
        return output

    def forward(self, rows: Tensor, present: Tensor | None = None) -> Tensor:
        """Rows [P, in] -> [P, out]; ``present`` as of :meth:`activate`."""
        return self.activate(self.linear(rows), present)

    def fixed_norm(self) -> tuple[Tensor, Tensor]:
        """Scale and shift [out] of batch norm in evaluation mode."""
        mean, variance = self._running()
        scale = self.norm.weight * (variance + self.norm.eps).rsqrt()
        return scale, self.norm.bias - mean * scale

    @torch.no_grad()
    def track(self, mean: Tensor, variance: Tensor, rows: int | Tensor) -> None:
        """Update batch norm's running statistics by mean and biased variance [out] of so many rows."""
        running_mean, running_variance = self._running()
        momentum = self.norm.momentum
        assert momentum is not None
        running_mean.lerp_(mean, momentum)
        others = (rows - 1).clamp(min=1) if isinstance(rows, Tensor) else max(1, rows - 1)
        running_variance.lerp_(variance * (rows / others), momentum)
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

    def forward(self, rows: Tensor, present: Tensor | None = None) -> Tensor:
        """Rows [P, in] -> [P, out]; ``present`` as of :meth:`DenseLayer.activate`."""
        for layer in self:
            rows = layer(rows, present)
        return rows


class _PaddedNorm(torch.autograd.Function):
    """Batch norm of the rows that are present, and ReLU. Sums over rows are products with their presence, cloud by
    cloud: one pass over memory each.
    """

    @staticmethod
    def forward(
        ctx: Any, rows: Tensor, present: Tensor, scale: Tensor, shift: Tensor, eps: float
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Rows [P, C] -> the same shape, and the statistics."""
        kind, rows = rows.dtype, rows.to(torch.promote_types(rows.dtype, torch.float32))
        if rows.is_cuda and has_triton():
            from fb3d_rl.models import norm_triton

            rows = rows.contiguous()
            output, mean, variance, count = norm_triton.normalized(rows, present.flatten(), scale, shift, eps)
        else:
            count = present.sum()
            mean = _sum(rows, present) / count
            centred = rows - mean
            variance = _sum(centred.square(), present) / count
            output = torch.addcmul(shift, centred, scale * (variance + eps).rsqrt()).relu_()
        ctx.save_for_backward(rows, output, present, scale, mean, (variance + eps).rsqrt(), count)
        ctx.kind = kind
        ctx.mark_non_differentiable(mean, variance, count)
        return output.to(kind), mean, variance, count

    @staticmethod
    def backward(ctx: Any, gradient: Tensor, *_: Tensor) -> tuple[Tensor | None, ...]:
        """The chain rule through ReLU and batch norm: scale * (dz - mean(dz) - xhat mean(dz xhat))."""
        rows, output, present, scale, mean, inverse, count = ctx.saved_tensors
        gradient = gradient.to(output.dtype)
        if rows.is_cuda and has_triton():
            from fb3d_rl.models import norm_triton

            gradient = gradient.contiguous()
            d_rows, d_scale, d_shift = norm_triton.gradients(
                gradient, rows, output, present.flatten(), mean, inverse, scale
            )
        else:
            gradient = torch.ops.aten.threshold_backward(gradient, output, 0)
            centred = rows - mean
            d_shift = _sum(gradient, present)
            d_scale = _sum(gradient * centred, present) * inverse
            d_rows = torch.addcmul(gradient - d_shift / count, centred, inverse * d_scale / -count)
            d_rows = d_rows.mul_(scale * inverse).mul_(present.view(-1, 1))
        return d_rows.to(ctx.kind), None, d_scale, d_shift, None


def _sum(rows: Tensor, present: Tensor) -> Tensor:
    """Sum [C] of the rows [P, C] that are present [B, 1, P / B]."""
    with torch.autocast(rows.device.type, enabled=False):
        return torch.bmm(present, rows.view(len(present), -1, rows.shape[1])).sum((0, 1))


def initialize(net: nn.Module, generator: torch.Generator) -> None:
    """Draw all weights anew from the distributions that PyTorch's modules use, with a generator handed in."""
    for module in net.modules():
        if isinstance(module, nn.Embedding):
            nn.init.normal_(module.weight, generator=generator)
        if isinstance(module, nn.MultiheadAttention):
            nn.init.xavier_uniform_(module.in_proj_weight, generator=generator)
        if isinstance(module, nn.Linear):
            nn.init.kaiming_uniform_(module.weight, a=math.sqrt(5), generator=generator)
            if module.bias is not None:
                bound = 1 / math.sqrt(module.in_features)
                nn.init.uniform_(module.bias, -bound, bound, generator=generator)
