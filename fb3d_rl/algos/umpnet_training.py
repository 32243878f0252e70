"""algo=umpnet: what UMPNet's networks are fitted to, pulls in UMPNet's world at points of two clouds of an object."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.nn import functional

from fb3d_rl.algos.flow_network import FlowNetwork
from fb3d_rl.camera.umpnet import SCALE
from fb3d_rl.contract import GOAL_POINTS
from fb3d_rl.data.pairs import PAIRS
from fb3d_rl.env.umpnet.quasistatic import Paths, stroke
from fb3d_rl.env.umpnet.world import STROKE
from fb3d_rl.geometry.points import gather
from fb3d_rl.geometry.transforms import dot, normalize
from fb3d_rl.kinematics.joint_screw import UNEXPLAINED, screw_of_flow
from fb3d_rl.models.cloud_network import CloudNetwork
from fb3d_rl.models.direction_net import SearchOptions
from fb3d_rl.models.umpnet import AWAY, STILL, TOWARDS, UmpNet
from fb3d_rl.policies.umpnet_policy import best_pull, umpnet_policy
from fb3d_rl.training.device import products_of
from fb3d_rl.training.draws import augment, generator
from fb3d_rl.training.objective import Objective
from fb3d_rl.training.options import FitOptions

CONTACTS = 16
"""Points that are pulled on the part of each cloud, and as many that are not on any part."""

DIRECTIONS = 8
"""Pulls at each of them."""

COARSE = 10
"""Steps of the simulation that are made at once for a label."""

FAR = (0.1, 0.05)
"""What UMPNet calls moved: rad of a joint that turns, m (UMPNet's world) of one that slides, ..."""

SHARE = 1 / 3.5
"""... or this share of its range, where that is less."""

DISTANCE = 10.0
"""Weight of the distance's squared error, in strokes, beside the two cross-entropies."""


@dataclass(frozen=True)
class Pulled:
    """What pulls in UMPNet's world do.

    Attributes:
        distance: [B, K, S] how far the held point came, in strokes.
        moved: [B, K, S] whether UMPNet calls that moved.
        arrow: [B, K, S] int64, TOWARDS, STILL or AWAY from the other image's state.
    """

    distance: Tensor
    moved: Tensor
    arrow: Tensor


def pulled(batch: TensorDictBase, contact: Tensor, directions: Tensor) -> Pulled:
    """Simulate pulls on the target part of pairs of clouds [B].

    Args:
        batch: pairs (:mod:`fb3d_rl.data.pairs`), their travel among the "privileged" entries.
        contact: [B, K] numbers of points of the part.
        directions: [B, K, S, 3], unit, world axes.
    """
    points, flow = batch["observation", "points"].double(), batch["privileged", "flow"].double()
    screw, _ = screw_of_flow(points, flow, flow.any(-1))
    turns = screw.revolute[:, None, None]
    unit = torch.where(screw.revolute, 1.0, SCALE)[:, None]
    closed, opened, other = (batch["privileged", "travel"].double() * unit).unbind(-1)
    held, axis = SCALE * gather(points, contact), screw.axis[:, None].expand(*contact.shape, 3)
    arm = held - SCALE * screw.origin[:, None]
    along = (arm - dot(arm, axis) * axis) * turns
    path = [held - along, along, torch.linalg.cross(axis, along), axis * ~turns]
    ends = torch.stack([closed, opened], dim=-1)[:, None].expand(*contact.shape, 2)
    rows = torch.cat([*path, ends], dim=-1)[:, :, None].expand(*directions.shape[:3], 14).reshape(-1, 14)
    paths, ways = Paths(list(rows.cpu().numpy())), directions.double().reshape(-1, 3).cpu()
    start = torch.zeros(len(ways), dtype=torch.float64)
    ended = stroke(paths, start, ways, COARSE)
    came = (paths.at(ended)[0] - paths.at(start)[0]).norm(dim=-1) / STROKE
    joint, came = (x.view(directions.shape[:3]).to(points.device) for x in (ended, came))
    least = torch.minimum(torch.where(screw.revolute, *FAR), SHARE * (opened - closed))
    moved = joint.abs() > least[:, None, None]
    further = (joint - other[:, None, None]).abs() > other.abs()[:, None, None]
    arrow = torch.where(moved, torch.where(further, AWAY, TOWARDS), STILL)
    return Pulled(came.float(), moved, arrow)


def balanced(values: Tensor, counts: Tensor) -> Tensor:
    """Mean of values [...] over those that count, each group [G, ...] (bool) of ``counts`` weighing the same."""
    means = [values[group].mean() for group in counts if bool(group.any())]
    return torch.stack(means).mean() if means else values.sum() * 0.0


def pulls_objective(model: nn.Module, options: FitOptions) -> Objective:
    """Cross-entropy of the position and of the arrow of time, and squared error of the distance, for random pulls at
    random points of clouds that are augmented as the options say.

    As UMPNet draws as many examples of each outcome, each weighs the same. A point counts as movable if one of the
    pulls at it moved it; points of other parts that move say nothing.
    """
    net = cast(UmpNet, model)

    def objective(batch: TensorDictBase, step: int) -> Tensor:
        batch = augment(batch, options, step)
        points, valid, other = (batch["observation", key] for key in ("points", "valid", "part_mask"))
        flow, movable = batch["privileged", "flow"], batch["privileged", "movable"]
        part = flow.any(-1) & valid & ~other
        part = part & (screw_of_flow(points, flow, part)[1] < UNEXPLAINED)[:, None]  # parts that follow others
        draws = torch.rand(part.shape, generator=generator(options.seed, 7, step)).to(points.device)
        groups = part, valid & ~other & ~movable
        (on_part, contact), (off, beside) = (
            draws.masked_fill(~group, -1.0)[:, :-GOAL_POINTS].topk(CONTACTS, dim=-1) for group in groups
        )
        shape = (*contact.shape, DIRECTIONS, 3)
        directions = normalize(torch.randn(shape, generator=generator(options.seed, 8, step)).to(points))
        true = pulled(batch, contact, directions)
        with products_of(options, points.device):
            seen = net.see(points, valid, other)
            distance, arrow = net.judge(seen.at(contact), directions)
        held = (on_part >= 0)[..., None].expand_as(distance)
        odds = torch.cat([seen.movable.float().gather(1, contact), seen.movable.float().gather(1, beside)], dim=1)
        moves = torch.cat([true.moved.any(-1), torch.zeros_like(off, dtype=torch.bool)], dim=1)
        known = torch.cat([on_part >= 0, off >= 0], dim=1)
        position = functional.binary_cross_entropy_with_logits(odds, moves.float(), reduction="none")
        arrows = functional.cross_entropy(arrow.float().flatten(0, 2), true.arrow.flatten(), reduction="none")
        outcomes = torch.stack([held & (true.arrow == outcome) for outcome in (TOWARDS, STILL, AWAY)])
        squared = (distance.float() - true.distance).square().masked_fill(~held, 0.0)
        return (
            balanced(position, torch.stack([known & moves, known & ~moves]))
            + balanced(arrows.view_as(distance), outcomes)
            + DISTANCE * squared.sum() / held.sum().clamp_min(1)
        )

    return objective


def pull_cosine(net: CloudNetwork, samples: TensorDictBase, device: torch.device) -> dict[str, Tensor]:
    """Of pairs [S], at the point of largest true flow: the cosine between the pull that is to bring the part to the
    other image's state and the true way there (NaN where it is there), and how likely that point is called movable.
    """
    assert isinstance(net, UmpNet)
    cosines, likely = [], []
    for batch in samples.split(32):
        points, valid, other = (batch["observation", key].to(device) for key in ("points", "valid", "part_mask"))
        flow = batch["privileged", "flow"].to(device)
        contact = flow.norm(dim=-1).argmax(-1)
        way = gather(flow, contact) * batch["privileged", "travel"][:, 2:].sign().to(device)
        with torch.no_grad():
            seen = net.see(points, valid, other)
            found = best_pull(net, seen, contact, -1.0, flow.new_zeros(len(flow), 0, 3), SearchOptions())
        cosines.append(torch.where(way.any(-1), (found * normalize(way)).sum(-1), torch.nan).cpu())
        likely.append(seen.movable.gather(1, contact[:, None])[:, 0].sigmoid().cpu())
    return {"cosine": torch.cat(cosines), "movable": torch.cat(likely)}


ALGORITHM = FlowNetwork(UmpNet, umpnet_policy, pulls_objective, pull_cosine, flow=False, samples=PAIRS)
