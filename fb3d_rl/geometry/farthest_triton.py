"""Farthest point sampling as one Triton kernel. Step by step in PyTorch it takes some ten launches for each of a
cloud's 240 centres, most of a training step on a GPU.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

LARGEST = 8192
"""Points of a cloud that the registers of one block hold."""


@triton.jit
def sample(points, valid, chosen, n, count: tl.constexpr, block: tl.constexpr):  # type: ignore[no-untyped-def]
    """One program for each cloud: points [B, n, 3] f32, valid [B, n] bool -> chosen [B, count] i64; ``block`` >= n."""
    cloud = tl.program_id(0).to(tl.int64)
    place = tl.arange(0, block)
    inside = place < n
    start = points + (cloud * n + place) * 3
    x = tl.load(start, mask=inside, other=0.0)
    y = tl.load(start + 1, mask=inside, other=0.0)
    z = tl.load(start + 2, mask=inside, other=0.0)
    real = tl.load(valid + cloud * n + place, mask=inside, other=0).to(tl.int32)
    distance = tl.where(real > 0, float("inf"), -1.0)
    current = tl.argmax(real, 0)  # the first valid one: of equal values, argmax takes the lower place
    for i in range(count):
        tl.store(chosen + cloud * count + i, current.to(tl.int64))
        here = place == current
        dx = x - tl.sum(tl.where(here, x, 0.0), 0)
        dy = y - tl.sum(tl.where(here, y, 0.0), 0)
        dz = z - tl.sum(tl.where(here, z, 0.0), 0)
        distance = tl.minimum(distance, dx * dx + dy * dy + dz * dz)
        current = tl.argmax(distance, 0)


def block_of(points: int) -> tuple[int, int]:
    """The block that holds so many points, a power of two, and the warps that work on it."""
    block = triton.next_power_of_2(points)
    return block, min(8, max(1, block // 256))


def farthest_point_sample(points: Tensor, count: int, valid: Tensor) -> Tensor:
    """As :func:`fb3d_rl.geometry.points.farthest_point_sample`, of clouds of at most :data:`LARGEST` points."""
    clouds, n = valid.shape
    chosen = torch.empty(clouds, count, dtype=torch.int64, device=points.device)
    block, warps = block_of(n)
    # Triton launches on the current device, which need not be the points'.
    with torch.cuda.device_of(points):
        sample[(clouds,)](points.float().contiguous(), valid.contiguous(), chosen, n, count, block, num_warps=warps)
    return chosen
