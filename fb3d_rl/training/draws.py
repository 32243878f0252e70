"""What a step of a fit draws at random: its rows, and how their clouds are changed (augmentation).

All of it depends on the seed and the number of the step alone.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from fb3d_rl.training.options import FitOptions


def generator(seed: int, purpose: int, number: int) -> torch.Generator:
    """A generator that depends on its arguments only. A multiplicative hash keeps neighbouring arguments
    apart.
    """
    mixed = (seed * 0x9E3779B97F4A7C15 + purpose * 0xBF58476D1CE4E5B9 + number * 0x94D049BB133111EB) % 2**63
    return torch.Generator().manual_seed(mixed)


@contextmanager
def global_draws(source: torch.Generator, device: torch.device) -> Iterator[None]:
    """Let what draws from torch's global generators, as TorchRL's losses do, draw from ``source`` for a while."""
    with torch.random.fork_rng([device] if device.type == "cuda" else []):
        torch.set_rng_state(source.get_state())
        if device.type == "cuda":
            torch.cuda.manual_seed(source.initial_seed())
        yield


@lru_cache(maxsize=2)  # a batch is of one pass, or of the end of one and the start of the next
def _permutation(seed: int, number: int, rows: int) -> Tensor:
    return torch.randperm(rows, generator=generator(seed, 1, number))


def batch_rows(step: int, rows: int, options: FitOptions) -> Tensor:
    """Which rows step number ``step`` reads [batch_size]: every pass over the rows is a new permutation."""
    place = step * options.batch_size + torch.arange(options.batch_size)
    passes = place // rows
    chosen = torch.empty_like(place)
    for number in passes.unique().tolist():
        order = _permutation(options.seed, number, rows)
        here = passes == number
        chosen[here] = order[place[here] % rows]
    return chosen


def augment(batch: TensorDictBase, options: FitOptions, step: int, share: slice = slice(None)) -> TensorDictBase:
    """The flow samples of a batch, turned, mirrored, scaled, jittered and thinned out according to the options.

    Random numbers depend on the seed and the step alone: they are drawn for the whole batch, of which ``batch`` is the
    part ``share``.
    """
    points, flow = batch["observation", "points"], batch["privileged", "flow"]
    valid, part_mask = batch["observation", "valid"], batch["observation", "part_mask"]
    size, device = options.batch_size, points.device

    def draw(purpose: int, *shape: int, normal: bool = False) -> Tensor:
        random = torch.randn if normal else torch.rand
        return random(size, *shape, generator=generator(options.seed, purpose, step))[share].to(device)

    if options.rotate:
        angle = draw(2) * (2 * math.pi)
        points, flow = rotate_about_z(points, angle), rotate_about_z(flow, angle)
    if options.mirror or options.scale:
        draws = torch.rand(2, size, 1, 1, generator=generator(options.seed, 3, step))[:, share].to(device)
        if options.mirror:
            reflect = torch.ones_like(points[:, :1])
            reflect[..., 1] = torch.where(draws[0, ..., 0] < 0.5, -1.0, 1.0)
            points, flow = points * reflect, flow * reflect
        points = points * (1 + options.scale * (2 * draws[1] - 1))
    if options.jitter:
        points = points + options.jitter * draw(4, points.shape[1], 3, normal=True)
    if options.dropout:
        valid = valid & (draw(5, points.shape[1]) >= options.dropout * draw(6, 1))
        part_mask, flow = part_mask & valid, flow * valid[..., None]
    observation = {"points": points, "valid": valid, "part_mask": part_mask}
    privileged = batch["privileged"].to_dict() | {"flow": flow}
    return TensorDict({"observation": observation, "privileged": privileged}, batch_size=batch.batch_size)


def rotate_about_z(vectors: Tensor, angle: Tensor) -> Tensor:
    """Turn vectors [B, N, 3] about z by angle [B] (radians, counter-clockwise seen from above)."""
    cos, sin = angle.cos()[:, None], angle.sin()[:, None]
    x, y, z = vectors.unbind(2)
    return torch.stack([cos * x - sin * y, sin * x + cos * y, z], 2)
