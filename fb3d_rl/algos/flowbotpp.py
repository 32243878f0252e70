"""algo=flowbotpp: the loss of FlowProjectionNet, and the metrics of what it predicts."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

import torch
from torch import Tensor, nn

from fb3d_rl.algos.flow_network import FlowNetwork
from fb3d_rl.flow.metrics import flow_metrics
from fb3d_rl.kinematics.joint_screw import projection_of_flow
from fb3d_rl.models.cloud_network import CloudNetwork
from fb3d_rl.models.flowbotpp import FlowProjectionNet
from fb3d_rl.policies.arc import flowbotpp_policy
from fb3d_rl.training.device import products_of
from fb3d_rl.training.draws import augment
from fb3d_rl.training.objective import Objective, flow_loss
from fb3d_rl.training.options import FitOptions

if TYPE_CHECKING:
    from tensordict import TensorDictBase


def flowbotpp_objective(model: nn.Module, options: FitOptions) -> Objective:
    """The flow's loss, and that of the projection, on clouds that are augmented as the options say.

    FlowBot++ adds the squared error of flow and projection, as a mean over the cloud, to that of the points in which
    the projections end, as a mean over the part; the latter differ by the projection alone. As labels are the
    projections of the true flow, the data set is ArtFlowNet's. A projection counts on parts that turn; in clouds whose
    mask marks parts that move by several joints it does not.
    """
    net = cast(FlowProjectionNet, model)

    def objective(batch: TensorDictBase, step: int) -> Tensor:
        batch = augment(batch, options, step)
        points, valid, part = (batch["observation", key] for key in ("points", "valid", "part_mask"))
        part = part & valid
        flow = batch["privileged", "flow"]
        projection, turns = projection_of_flow(points, flow, part)
        with products_of(options, points.device):
            predicted = net.motions(points, valid, part)
        labelled = part & turns[:, None]
        error = flow_loss(predicted[1], projection, labelled)
        share = labelled.sum() / valid.sum().clamp(min=1)
        return flow_loss(predicted[0], flow, valid) + (1.0 + share) * error

    return objective


@torch.no_grad()
def flowbotpp_numbers(net: CloudNetwork, samples: TensorDictBase, device: torch.device) -> dict[str, Tensor]:
    """The flow's errors on samples [S], and "projection_error", the mean distance (m) between the points on the axis in
    which predicted and true projections end; nan for parts that do not turn.
    """
    assert isinstance(net, FlowProjectionNet)
    training = net.training
    net.eval()
    flows, errors = [], []
    for batch in samples.split(32):
        points, valid, part = (batch["observation", key].to(device) for key in ("points", "valid", "part_mask"))
        part = part & valid
        true, turns = projection_of_flow(points, batch["privileged", "flow"].to(device), part)
        flow, projection = net.motions(points, valid, part)
        error = (projection - true).norm(dim=-1).masked_fill(~part, 0.0).sum(1) / part.sum(1)
        flows.append(flow.cpu())
        errors.append(torch.where(turns, error, torch.nan).cpu())
    net.train(training)
    numbers = flow_metrics(torch.cat(flows), samples["privileged", "flow"], samples["observation", "valid"])
    return numbers | {"projection_error": torch.cat(errors)}


ALGORITHM = FlowNetwork(FlowProjectionNet, flowbotpp_policy, flowbotpp_objective, flowbotpp_numbers)
