"""algo.network: a network from outside the package, trained and measured as ArtFlowNet is."""

from __future__ import annotations

import inspect
from typing import Any

import torch
from torch import nn

from fb3d_rl.errors import UserError
from fb3d_rl.models.cloud_network import CloudNetwork
from fb3d_rl.plugins import plugin, said

KEY = "algo.network"
"""The key of the configuration that names it."""


def own_network(target: str, where: str = "") -> type[CloudNetwork]:
    """The class "package.module:Class" of the user's own.

    Args:
        target: its name.
        where: what names it, for messages: a file of weights; "" for the configuration.

    Raises:
        UserError: there is none, or it is no subclass of CloudNetwork with NAME and OUTPUTS.
    """
    try:
        kind = plugin(target, KEY)
    except UserError as error:
        raise UserError(
            f"{where} holds a network of a class that is not to be had: {error}" if where else str(error)
        ) from error
    if not isinstance(kind, type) or not issubclass(kind, CloudNetwork):
        raise UserError(f"{KEY}={target} is no class that derives from fb3d_rl.models.cloud_network.CloudNetwork")
    for name, of in (("NAME", str), ("OUTPUTS", int)):
        if not isinstance(getattr(kind, name, None), of):
            raise UserError(f"{KEY}={target} has no {name}: give the class a {of.__name__} of that name")
    return kind


def has_own_loss(net: nn.Module) -> bool:
    """Whether a network computes the loss that it is fitted by itself: its ``forward`` takes the true flow, ``target``
    [B, N, 3], and with it answers with a scalar.
    """
    return "target" in inspect.signature(net.forward).parameters


def require_flow(net: CloudNetwork, target: str) -> None:
    """Check that a new network answers with flows, learns, and can be made again of its ``arguments``.

    Raises:
        UserError: it does not.
    """
    generator = torch.Generator().manual_seed(0)
    points, valid = torch.randn(2, 256, 3, generator=generator).mul(0.3), torch.ones(2, 256, dtype=torch.bool)
    valid[:, 200:] = False
    training = net.training
    net.train()
    kept = {name: value.clone() for name, value in net.state_dict().items()}
    inputs = (points, valid, valid & (points[..., 0] > 0))
    try:
        flow = net(*inputs)
        shape = list(getattr(flow, "shape", ())) or type(flow).__name__
        if shape != [2, 256, 3]:
            raise UserError(f"{KEY}={target} answers with {shape}: the flow [B, N, 3] of points [B, N, 3] is needed")
        if not bool(flow.isfinite().all()):
            raise UserError(f"{KEY}={target} answers with a flow that is not finite")
        if has_own_loss(net):
            loss = net(*inputs, target=torch.randn(points.shape, generator=generator) * inputs[2][..., None])
            if getattr(loss, "shape", None) != ():
                raise UserError(f"{KEY}={target} takes a target, but does not answer with a loss, a scalar")
            if not bool(loss.isfinite()) or not loss.requires_grad:
                raise UserError(f"{KEY}={target} answers with a loss that is not finite or depends on no weight")
        elif not flow.requires_grad:
            raise UserError(f"{KEY}={target} answers with a flow that no weight has a part in: it cannot be trained")
        kind: Any = type(net)
        kind(**net.arguments).load_state_dict(net.state_dict())
    except UserError:
        raise
    except Exception as error:  # noqa: BLE001, it is code of others
        raise UserError(f"{KEY}={target} cannot be used: {said(error)}") from error
    net.load_state_dict(kept)  # running means
    net.train(training)
