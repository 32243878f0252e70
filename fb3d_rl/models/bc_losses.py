"""Losses of behaviour cloning that TorchRL 0.14 lacks, written as its own are.

Its ACTLoss and DiffusionBCLoss know no padding of chunks, and there is none for flow matching.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.objectives import ACTLoss
from torchrl.objectives.common import LossModule


class PaddedACTLoss(ACTLoss):
    """TorchRL's ACTLoss (Zhao et al. 2023) that leaves out the padding of a chunk, as BCLoss does.

    Args:
        actor_network: as of ACTLoss.
        kl_weight: weight of the divergence of the latent from a standard normal.

    Shapes: the entry ``pad_mask`` [..., T] bool is True where the expert's chunk [..., T, A] is padding, which the
    reconstruction leaves out; the actor sees what stands there. The losses are means.
    """

    @dataclass
    class _AcceptedKeys(ACTLoss._AcceptedKeys):
        pad_mask: NestedKey | None = None

    default_keys = _AcceptedKeys()

    def __init__(self, actor_network: TensorDictModule, *, kl_weight: float = 10.0) -> None:
        super().__init__(actor_network, kl_weight=kl_weight, reduction="mean")

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """The losses "loss_act", and its parts "loss_reconstruction" and "loss_kl" without gradients."""
        keys, chunk = self.tensor_keys, tensordict.get(self.tensor_keys.action_chunk)
        seen = TensorDict(
            {"observation": tensordict.get(keys.observation), "action_chunk": chunk}, batch_size=tensordict.batch_size
        )
        with self.actor_network_params.to_module(self.actor_network, preserve_module_state=False):
            found = self.actor_network(seen)
        mean, log_variance = found.get(keys.mu), found.get(keys.log_var)
        error = (found.get(keys.action_pred) - chunk).abs()
        reconstruction = mean_of_kept(error, None if keys.pad_mask is None else tensordict.get(keys.pad_mask))
        divergence = -0.5 * (1.0 + log_variance - mean.square() - log_variance.exp()).sum(-1).mean()
        losses = {
            "loss_act": reconstruction + self.kl_weight * divergence,
            "loss_reconstruction": reconstruction.detach(),
            "loss_kl": divergence.detach(),
        }
        return TensorDict(losses, batch_size=[])


class FlowMatchingBCLoss(LossModule):
    """Behaviour cloning by flow matching (Lipman et al. 2023; Black et al. 2024 for actions).

    On the straight way x_t = (1 - t) noise + t action, t uniform in [0, 1], the network learns the velocity
    action - noise; following it from noise, t from 0 to 1, draws an action.

    Args:
        actor_network: its ``module`` has the attribute ``velocity_network``, which gets (x_t, observation, t)
            concatenated along the last dimension, as the score network of DiffusionBCLoss does.

    Shapes: entries ``action`` [..., T, A], ``observation`` [..., O] and, if there is one, ``pad_mask`` [..., T] bool,
    True where the chunk is padding, which the loss leaves out. The network sees chunks as T * A numbers.
    """

    @dataclass
    class _AcceptedKeys:
        action: NestedKey = "action"
        observation: NestedKey = "observation"
        pad_mask: NestedKey | None = None

    default_keys = _AcceptedKeys()
    out_keys = ["loss_flow_matching"]
    actor_network: TensorDictModule
    actor_network_params: TensorDictParams | None
    target_actor_network_params: TensorDictParams | None

    def __init__(self, actor_network: TensorDictModule) -> None:
        super().__init__()
        self.convert_to_functional(actor_network, "actor_network")

    @property
    def in_keys(self) -> list[NestedKey]:
        """What the loss reads."""
        keys = self.tensor_keys
        return [keys.observation, keys.action, *([] if keys.pad_mask is None else [keys.pad_mask])]

    def _forward_value_estimator_keys(self, **kwargs: NestedKey) -> None:
        pass

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """The loss "loss_flow_matching", a mean."""
        keys = self.tensor_keys
        action, observation = tensordict.get(keys.action), tensordict.get(keys.observation)
        clean = action.flatten(-2)
        noise, time = torch.randn_like(clean), torch.rand_like(clean[..., :1])
        assert self.actor_network_params is not None
        with self.actor_network_params.to_module(self.actor_network, preserve_module_state=False):
            network = self.actor_network.module.velocity_network
            velocity = network(torch.cat([noise.lerp(clean, time), observation, time], dim=-1))
        error = (velocity - (clean - noise)).square().unflatten(-1, action.shape[-2:])
        pad = None if keys.pad_mask is None else tensordict.get(keys.pad_mask)
        return TensorDict({"loss_flow_matching": mean_of_kept(error, pad)}, batch_size=[])


def mean_of_kept(error: Tensor, pad: Tensor | None) -> Tensor:
    """Mean of ``error`` [..., T, A] over the steps that ``pad`` [..., T] bool does not mark; 0 if there are none."""
    if pad is None:
        return error.mean()
    kept = error.masked_fill(pad[..., None], 0.0)
    return kept.sum() / ((~pad).sum() * error.shape[-1]).clamp_min(1)
