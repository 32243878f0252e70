"""Batch norm of the rows that are present, and ReLU, as Triton kernels: a pass reads and writes memory once, which is
what takes time.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

VALUES = 8192
"""Numbers that one program reads at once."""


@triton.jit
def moments(rows, present, partial, count, channels, size: tl.constexpr, block: tl.constexpr):  # type: ignore[no-untyped-def]
    """One program for ``size`` rows [count, channels]: sums of values and squares of those present -> partial [G, 2,
    channels].
    """
    row = tl.program_id(0).to(tl.int64) * size + tl.arange(0, size)
    channel = tl.arange(0, block)
    inside = (row < count)[:, None] & (channel < channels)[None, :]
    value = tl.load(rows + row[:, None] * channels + channel[None, :], mask=inside, other=0.0)
    share = tl.load(present + row, mask=row < count, other=0.0)[:, None]
    start = partial + tl.program_id(0).to(tl.int64) * 2 * channels + channel
    tl.store(start, tl.sum(value * share, 0), mask=channel < channels)
    tl.store(start + channels, tl.sum(value * value * share, 0), mask=channel < channels)


@triton.jit
def apply(rows, scale, shift, output, count, channels, size: tl.constexpr, block: tl.constexpr):  # type: ignore[no-untyped-def]
    """Write relu(rows * scale + shift)."""
    row = tl.program_id(0).to(tl.int64) * size + tl.arange(0, size)
    channel = tl.arange(0, block)
    inside = (row < count)[:, None] & (channel < channels)[None, :]
    place = row[:, None] * channels + channel[None, :]
    value = tl.load(rows + place, mask=inside, other=0.0)
    by = tl.load(scale + channel, mask=channel < channels, other=0.0)[None, :]
    to = tl.load(shift + channel, mask=channel < channels, other=0.0)[None, :]
    tl.store(output + place, tl.maximum(value * by + to, 0.0), mask=inside)


@triton.jit
def slopes(  # type: ignore[no-untyped-def]
    gradient, rows, output, present, mean, partial, count, channels, size: tl.constexpr, block: tl.constexpr
):
    """Sums of dz and of dz (rows - mean), dz the gradient behind ReLU, of those present -> partial [G, 2, channels]."""
    row = tl.program_id(0).to(tl.int64) * size + tl.arange(0, size)
    channel = tl.arange(0, block)
    inside = (row < count)[:, None] & (channel < channels)[None, :]
    place = row[:, None] * channels + channel[None, :]
    dz = tl.load(gradient + place, mask=inside, other=0.0)
    share = tl.load(present + row, mask=row < count, other=0.0)[:, None]
    dz = tl.where(tl.load(output + place, mask=inside, other=0.0) > 0, dz * share, 0.0)
    centre = tl.load(mean + channel, mask=channel < channels, other=0.0)[None, :]
    value = tl.load(rows + place, mask=inside, other=0.0) - centre
    start = partial + tl.program_id(0).to(tl.int64) * 2 * channels + channel
    tl.store(start, tl.sum(dz, 0), mask=channel < channels)
    tl.store(start + channels, tl.sum(dz * value, 0), mask=channel < channels)


@triton.jit
def spread(  # type: ignore[no-untyped-def]
    gradient, rows, output, present, mean, scale, level, slope, result, count, channels,
    size: tl.constexpr, block: tl.constexpr,
):  # fmt: skip
    """Write scale * (dz - level - (rows - mean) * slope) of the rows present; 0 on padding."""
    row = tl.program_id(0).to(tl.int64) * size + tl.arange(0, size)
    channel = tl.arange(0, block)
    real = channel < channels
    inside = (row < count)[:, None] & real[None, :]
    place = row[:, None] * channels + channel[None, :]
    dz = tl.load(gradient + place, mask=inside, other=0.0)
    dz = tl.where(tl.load(output + place, mask=inside, other=0.0) > 0, dz, 0.0)
    share = tl.load(present + row, mask=row < count, other=0.0)[:, None]
    value = tl.load(rows + place, mask=inside, other=0.0) - tl.load(mean + channel, mask=real, other=0.0)[None, :]
    dz -= tl.load(level + channel, mask=real, other=0.0)[None, :]
    dz -= value * tl.load(slope + channel, mask=real, other=0.0)[None, :]
    dz *= tl.load(scale + channel, mask=real, other=0.0)[None, :] * share
    tl.store(result + place, dz, mask=inside)


def normalized(rows: Tensor, present: Tensor, scale: Tensor, shift: Tensor, eps: float) -> tuple[Tensor, ...]:
    """Rows [P, C] f32 after batch norm with scale and shift [C] and ReLU, and mean and variance [C] of those that are
    present [P] (1 or 0), and how many they are.
    """
    count = present.sum()
    sums = _sums(moments, rows, rows, present) / count.double()
    mean, variance = sums[0], (sums[1] - sums[0].square()).clamp_(min=0)
    factor = scale * (variance + eps).rsqrt().float()
    mean, variance = mean.float(), variance.float()
    output = torch.empty_like(rows)
    _launch(apply, rows, rows, factor, shift - mean * factor, output)
    return output, mean, variance, count


def gradients(
    gradient: Tensor, rows: Tensor, output: Tensor, present: Tensor, mean: Tensor, inverse: Tensor, scale: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Gradients of rows [P, C], scale and shift [C] from the output's [P, C]; ``inverse`` is 1 / deviation [C]."""
    d_shift, product = _sums(slopes, rows, gradient, rows, output, present, mean).float()
    count = present.sum()
    d_rows = torch.empty_like(rows)
    level, slope = d_shift / count, product * inverse.square() / count
    _launch(spread, rows, gradient, rows, output, present, mean, scale * inverse, level, slope, d_rows)
    return d_rows, product * inverse, d_shift


def _launch(kernel: triton.JITFunction, rows: Tensor, *given: Tensor) -> None:
    count, channels = rows.shape
    block = triton.next_power_of_2(channels)
    size = max(1, VALUES // block)
    with torch.cuda.device_of(rows):
        kernel[(triton.cdiv(count, size),)](*given, count, channels, size, block, num_warps=8)


def _sums(kernel: triton.JITFunction, rows: Tensor, *given: Tensor) -> Tensor:
    """The two sums [2, C] of a kernel, f64."""
    count, channels = rows.shape
    size = max(1, VALUES // triton.next_power_of_2(channels))
    partial = torch.empty(triton.cdiv(count, size), 2, channels, device=rows.device)
    _launch(kernel, rows, *given, partial)
    return partial.sum(0, dtype=torch.float64)
