"""algo=ump_di: the loss of DirectionNet, and the metric of its directions."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from fb3d_rl.algos.flow_network import FlowNetwork
from fb3d_rl.geometry.points import gather
from fb3d_rl.geometry.transforms import normalize
from fb3d_rl.models.cloud_network import CloudNetwork
from fb3d_rl.models.direction_net import DirectionNet, SearchOptions, directions_at
from fb3d_rl.policies.direction_policy import direction_policy
from fb3d_rl.training.device import products_of
from fb3d_rl.training.draws import augment, generator
from fb3d_rl.training.objective import Objective
from fb3d_rl.training.options import FitOptions

CONTACTS = 16
"""Contact points that are drawn on the part of each cloud."""

DIRECTIONS = 8
"""Directions that are drawn at each contact point."""


def direction_objective(model: nn.Module, options: FitOptions) -> Objective:
    """Mean squared error of the scores of random directions at random points of the part, on clouds that are augmented
    as the options say.

    The label is the true flow's projection on the direction: what a short pull along it gives if the joint guides
    the part without friction. (UMPNet regresses the distance that the simulated part really moved.)
    """

    def objective(batch: TensorDictBase, step: int) -> Tensor:
        batch = augment(batch, options, step)
        points, valid, part = (batch["observation", key] for key in ("points", "valid", "part_mask"))
        flow, part = batch["privileged", "flow"], part & valid
        draws = torch.rand(part.shape, generator=generator(options.seed, 7, step)).to(points.device)
        order, contact = draws.masked_fill(~part, -1.0).topk(CONTACTS, dim=-1)  # [B, CONTACTS]
        shape = (*contact.shape, DIRECTIONS, 3)
        directions = normalize(torch.randn(shape, generator=generator(options.seed, 8, step)).to(points))
        with products_of(options, points.device):
            scores = model(points, valid, part, contact, directions)
        label = (gather(flow, contact)[:, :, None] * directions).sum(-1)
        counts = (order >= 0)[..., None].expand_as(label)
        return (scores.float() - label).square().masked_fill(~counts, 0.0).sum() / counts.sum().clamp_min(1)

    return objective


def direction_cosine(net: CloudNetwork, samples: TensorDictBase, device: torch.device) -> dict[str, Tensor]:
    """Cosine between predicted direction and true flow at the point of largest true flow, of samples [S]."""
    assert isinstance(net, DirectionNet)
    cosines = []
    for batch in samples.split(32):
        points, valid, part = (batch["observation", key].to(device) for key in ("points", "valid", "part_mask"))
        flow = batch["privileged", "flow"].to(device)
        contact = flow.norm(dim=-1).argmax(-1)
        predicted = directions_at(net, points, valid, part, contact, SearchOptions())
        true = gather(flow, contact)
        # Where nothing can move there is no true direction.
        cosines.append(torch.where(true.any(-1), (predicted * normalize(true)).sum(-1), torch.nan).cpu())
    return {"cosine": torch.cat(cosines)}


ALGORITHM = FlowNetwork(DirectionNet, direction_policy, direction_objective, direction_cosine, flow=False)
