"""algo=screwnet, FlowBot3D's baseline "Screw Parameters": what ScrewNet is fitted to."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

import torch
from torch import Tensor, nn
from torch.nn import functional

from fb3d_rl.algos.flow_network import FlowNetwork
from fb3d_rl.kinematics.joint_screw import UNEXPLAINED, JointScrew, screw_of_flow
from fb3d_rl.models.screwnet import ScrewNet
from fb3d_rl.training.device import products_of
from fb3d_rl.training.draws import augment
from fb3d_rl.training.objective import Objective
from fb3d_rl.training.options import FitOptions

if TYPE_CHECKING:
    from tensordict import TensorDictBase

NARROW = 0.05
"""Smallest size (m) of a part to which an error of the axis' position is relative."""


def screw_loss(votes: tuple[Tensor, Tensor, Tensor], target: JointScrew, points: Tensor, part: Tensor) -> Tensor:
    """How far the votes of a part's points are from a screw: mean over the points of

    binary cross-entropy of the type + |axis - true axis|^2 + (distance of the voted point from the true axis / largest
    distance of the part from it)^2, the last for revolute joints.

    FlowBot3D does not say which loss its baseline has. As in ScrewNet (Jain et al. 2021) an axis' direction and its
    distance from the true one count apart; here the distance is relative to the part's size, so that it is the error of
    the flow that it makes.

    Args:
        votes: of :meth:`ScrewNet.votes`, [B, N, ...].
        target: [B].
        points: [B, N, 3] m.
        part: [B, N] bool, the points of the part.
    """
    turns, axis, origin = votes
    revolute = target.revolute[:, None].expand_as(turns).to(turns.dtype)
    true_axis, true_origin = target.axis[:, None], target.origin[:, None]

    def squared_distance(places: Tensor) -> Tensor:  # from the true axis, [B, N]
        return torch.linalg.cross(places - true_origin, true_axis.expand_as(places)).square().sum(-1)

    reach = squared_distance(points).masked_fill(~part, 0.0).amax(1, keepdim=True).clamp_min(NARROW**2)
    error = functional.binary_cross_entropy_with_logits(turns, revolute, reduction="none")
    error = error + (axis - true_axis).square().sum(-1) + revolute * squared_distance(origin) / reach
    return error.masked_fill(~part, 0.0).sum() / part.sum().clamp_min(1)


def screw_objective(model: nn.Module, options: FitOptions) -> Objective:
    """:func:`screw_loss` of a ScrewNet on clouds that are augmented as the options say.

    The labels are the screws of the clouds' true flows, so the data set is ArtFlowNet's. Clouds whose mask marks parts
    that move by several joints have no one screw and do not count.
    """
    net = cast(ScrewNet, model)

    def objective(batch: TensorDictBase, step: int) -> Tensor:
        batch = augment(batch, options, step)
        points, valid, part = (batch["observation", key] for key in ("points", "valid", "part_mask"))
        part = part & valid
        target, unexplained = screw_of_flow(points, batch["privileged", "flow"], part)
        with products_of(options, points.device):
            votes = net.votes(points, valid, part)
        labelled = (unexplained < UNEXPLAINED) & target.axis.any(-1)
        return screw_loss(votes, target, points, part & labelled[:, None])

    return objective


ALGORITHM = FlowNetwork(ScrewNet, objective=screw_objective)
