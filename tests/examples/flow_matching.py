"""Flow matching (Lipman et al. 2023) on ArtFlowNet's encoder: a network of one's own with a loss of its own.

It draws several flows for a cloud, as FlowBotHD's diffusion does, but reads the cloud once: a small network follows the
velocity field from noise to a flow in ten steps.

python launch/train.py algo=artflownet algo.network=tests.examples.flow_matching:FlowMatching algo.hypotheses=8
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn

from fb3d_rl.models.artflownet import ArtFlowNet, Hypotheses

FEATURES = 64
"""Numbers that the encoder says about each point."""

WIDTH = 128

STEPS = 10
"""From noise to a flow."""

WAVES = 8
"""Sines and as many cosines that tell the time."""

ALIKE = 0.7
"""Cosine above which two draws count as one answer, as FlowBotHD's evaluation has it."""


class Velocity(nn.Module):
    """The velocity of each point's flow on its way, from the encoder's features, the flow so far and the time.

    Points of a cloud hear of each other by a mean over the cloud, so that a part moves one way.
    """

    def __init__(self) -> None:
        super().__init__()
        self.first = nn.Sequential(nn.Linear(FEATURES + 3 + 2 * WAVES, WIDTH), nn.ReLU(), nn.Linear(WIDTH, WIDTH))
        self.second = nn.Sequential(nn.Linear(2 * WIDTH, WIDTH), nn.ReLU(), nn.Linear(WIDTH, WIDTH))
        self.last = nn.Sequential(nn.Linear(2 * WIDTH, WIDTH), nn.ReLU(), nn.Linear(WIDTH, 3))

    def forward(self, features: Tensor, so_far: Tensor, time: Tensor, valid: Tensor) -> Tensor:
        """Features [B, N, F], flow so far [B, N, 3], time [B] and valid [B, N] -> [B, N, 3]."""
        angles = time[:, None] * torch.arange(1, WAVES + 1, device=time.device) * math.pi
        waves = torch.cat([angles.sin(), angles.cos()], 1)[:, None].expand(-1, features.shape[1], -1)
        hidden = self.first(torch.cat([features, so_far, waves], 2))
        for layers in (self.second, self.last):
            weight = valid[..., None].to(hidden.dtype)
            mean = (hidden * weight).sum(1, keepdim=True) / weight.sum(1, keepdim=True).clamp(min=1.0)
            hidden = layers(torch.cat([hidden, mean.expand_as(hidden)], 2))
        return hidden


class FlowMatching(ArtFlowNet):
    """ArtFlowNet whose ``hypotheses`` are draws: as probable as there are draws that are like it."""

    NAME = "flow_matching"

    def outputs(self) -> int:
        """Features of a point, not flows."""
        return FEATURES

    def add_layers(self) -> None:
        """The velocity network."""
        self.velocity = Velocity()

    def forward(
        self,
        points: Tensor,
        valid: Tensor,
        part_mask: Tensor | None = None,
        propose: bool = False,
        target: Tensor | None = None,
    ) -> Any:
        """See :class:`ArtFlowNet`; with the true flow ``target`` [B, N, 3] the loss."""
        if target is None:
            return super().forward(points, valid, part_mask, propose)
        features = self.per_point(points, valid, part_mask).float()
        noise = torch.randn_like(target)
        time = torch.rand(len(target), device=target.device)
        so_far = torch.lerp(noise, target, time[:, None, None])
        error = self.velocity(features, so_far, time, valid) - (target - noise)
        return error.square().sum(2).masked_fill(~valid, 0.0).sum() / valid.sum().clamp(min=1)

    def propose(self, points: Tensor, valid: Tensor, part_mask: Tensor | None = None) -> Hypotheses:
        """Draws for each cloud, always from the same noise."""
        features = self.per_point(points, valid, part_mask)
        clouds, count = len(points), self.hypotheses
        generator = torch.Generator().manual_seed(0)
        noise = torch.randn((count, *points.shape[1:]), generator=generator).to(points)
        flows = noise.repeat(clouds, 1, 1)  # [B K, N, 3]
        features, real = (x.repeat_interleave(count, 0) for x in (features, valid))
        for step in range(STEPS):
            time = features.new_full((len(flows),), step / STEPS)
            flows = flows + self.velocity(features, flows, time, real) / STEPS
        flows = flows.masked_fill(~real[..., None], 0.0).unflatten(0, (clouds, count))
        directions = torch.nn.functional.normalize(flows.flatten(2), dim=2)
        alike = (directions @ directions.transpose(1, 2) > ALIKE).sum(2).to(flows.dtype)  # [B, K]
        return Hypotheses(flows, alike.log().log_softmax(1)[..., None].expand(-1, -1, points.shape[1]))
