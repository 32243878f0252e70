"""Heads of a policy that imitates: from an encoder's vector to a plan, the actions of the next steps.

| head | loss | plan | where experts differ |
| --- | --- | --- | --- |
| deterministic | BCLoss: distance | the output | between their ways |
| gaussian | BCLoss: likelihood | the mean | between their ways |
| mixture | BCLoss: likelihood | the mean of the likeliest of K normals | on one of them |
| act | ACTLoss: distance, divergence of a latent (Zhao et al. 2023) | the decoder's at latent 0 | between their ways |
| diffusion | DiffusionBCLoss: noise (Chi et al. 2023) | noise, removed by DDIM (Song et al. 2021) | on one of them |
| flow_matching | FlowMatchingBCLoss: velocity (Lipman et al. 2023) | noise that follows it | on one of them |

All ways of a head that goes between them are averaged into one that no expert went; see tests/policies/test_heads.py.
The losses are TorchRL's, or written as those are (:mod:`fb3d_rl.models.bc_losses`). TorchRL's DiffusionActor is
trained; its own sampler, which draws from torch's global generator and calls the network once for each of the
training's steps, is not used.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from typing import Any, TypeAlias, cast

import torch
from tensordict import TensorDictBase
from tensordict.nn import (
    InteractionType,
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictModuleBase,
)
from torch import Tensor, nn
from torch.distributions import Categorical, Independent, MixtureSameFamily, Normal
from torchrl.modules import DiffusionActor, IndependentNormal
from torchrl.modules.models import ACTModel
from torchrl.objectives import BCLoss, DiffusionBCLoss

from fb3d_rl.models.bc_losses import FlowMatchingBCLoss, PaddedACTLoss, mean_of_kept
from fb3d_rl.models.encoders import mlp

# TorchRL 0.14.1 warns so about its own BCLoss, in which two annotations are missing.
warnings.filterwarnings("ignore", message="The name target_actor_network_params wasn't part")

Loss: TypeAlias = "Callable[[TensorDictBase], Tensor]"

LEAST_SCALE = 0.02
"""A lower bound of standard deviations keeps the likelihood of labels that repeat exactly finite."""


class Head:
    """What a head has to say; it is no module itself.

    Args:
        chunk: number of steps of a plan, T.
        size: numbers of an action, A.
        width: width of the network's layers.

    Attributes:
        inputs: numbers that it reads of the encoder.
        noise: standard normal numbers that a plan is made from; 0: none.
        network: its own network, to be registered with the encoder; None if the encoder's last layer is all.
    """

    noise = 0
    network: nn.Module | None = None

    def __init__(self, chunk: int, size: int, width: int) -> None:
        self.chunk, self.size = chunk, size
        self.inputs = 4 * width

    def plan(self, encoded: Tensor, noise: Tensor | None = None) -> Tensor:
        """The plan [B, T, A] for ``encoded`` [B, inputs], from ``noise`` [B, self.noise] if it asks for that."""
        raise NotImplementedError

    def loss(self, kind: str, kl_weight: float) -> Loss:
        """The loss of batches [B] of "encoded" [B, inputs], "twist" [B, T, A] and "is_pad" [B, T] bool.

        It shares the network's weights, and draws from torch's global generators, as TorchRL's losses do.

        Args:
            kind: the deterministic head's distance: "l1", "l2" or "smooth_l1".
            kl_weight: weight of ACT's divergence.
        """
        raise NotImplementedError

    def _chunks(self, numbers: Tensor) -> Tensor:
        return numbers.unflatten(-1, (self.chunk, self.size))


class Deterministic(Head):
    """The encoder's last layer is the plan."""

    def __init__(self, chunk: int, size: int, width: int) -> None:
        super().__init__(chunk, size, width)
        self.inputs = chunk * size

    def plan(self, encoded: Tensor, noise: Tensor | None = None) -> Tensor:
        """See :class:`Head`."""
        return self._chunks(encoded)

    def loss(self, kind: str, kl_weight: float) -> Loss:
        """See :class:`Head`."""
        split = TensorDictModule(self.plan, in_keys=["encoded"], out_keys=["twist"])
        return _bc_loss(split, kind, "is_pad")


class Gaussian(Head):
    """The encoder's last layer is mean and standard deviation of each number of the plan."""

    def __init__(self, chunk: int, size: int, width: int) -> None:
        super().__init__(chunk, size, width)
        self.inputs = 2 * chunk * size

    def parameters(self, encoded: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation, each [B, T, A]."""
        loc, raw = encoded.chunk(2, dim=-1)
        return self._chunks(loc), self._chunks(nn.functional.softplus(raw)) + LEAST_SCALE

    def plan(self, encoded: Tensor, noise: Tensor | None = None) -> Tensor:
        """See :class:`Head`; the mean."""
        return self.parameters(encoded)[0]

    def loss(self, kind: str, kl_weight: float) -> Loss:
        """See :class:`Head`."""
        split = TensorDictModule(self.parameters, in_keys=["encoded"], out_keys=["loc", "scale"])
        draw = ProbabilisticTensorDictModule(
            in_keys=["loc", "scale"],
            out_keys=["twist"],
            distribution_class=_StepNormal,
            default_interaction_type=InteractionType.DETERMINISTIC,
        )
        return _bc_loss(ProbabilisticTensorDictSequential(split, draw), None, "is_pad")


class _StepNormal(IndependentNormal):
    """Normal over the numbers of each step of a plan [..., T, A], so that padding can be left out."""

    def __init__(self, loc: Tensor, scale: Tensor) -> None:
        super().__init__(loc, scale, event_dim=1)


class ChunkMixture(MixtureSameFamily):
    """Mixture of K normals over plans: one of them is drawn for all steps of a plan.

    Args:
        logits: of the components [B, K].
        loc: mean [B, K, T, A].
        scale: standard deviation, likewise.
        pad: steps [B, T] bool that do not count.
    """

    def __init__(self, logits: Tensor, loc: Tensor, scale: Tensor, pad: Tensor) -> None:
        # Without PyTorch's check of values: those of padding do not count.
        super().__init__(Categorical(logits=logits), Independent(Normal(loc, scale), 2), validate_args=False)
        self._means, self._deviations, self._padding = loc, scale, pad

    def log_prob(self, value: Tensor) -> Tensor:
        """Logarithm [B] of the density of the steps of ``value`` [B, T, A] that are no padding."""
        each = Normal(self._means, self._deviations).log_prob(value[:, None]).sum(-1)
        of_plan = each.masked_fill(self._padding[:, None], 0.0).sum(-1)
        return (self.mixture_distribution.logits + of_plan).logsumexp(-1)

    @property
    def deterministic_sample(self) -> Tensor:
        """The mean [B, T, A] of the likeliest component."""
        best = self.mixture_distribution.logits.argmax(-1)
        return self._means[torch.arange(len(best), device=best.device), best]


class Mixture(Head):
    """The encoder's last layer is K weights, means and standard deviations."""

    def __init__(self, chunk: int, size: int, width: int, components: int) -> None:
        super().__init__(chunk, size, width)
        self.components = components
        self.inputs = components * (1 + 2 * chunk * size)

    def parameters(self, encoded: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Logits [B, K], means and standard deviations [B, K, T, A]."""
        logits, rest = encoded.tensor_split([self.components], dim=-1)
        loc, raw = rest.unflatten(-1, (self.components, -1)).chunk(2, dim=-1)
        return logits, self._chunks(loc), self._chunks(nn.functional.softplus(raw)) + LEAST_SCALE

    def plan(self, encoded: Tensor, noise: Tensor | None = None) -> Tensor:
        """See :class:`Head`."""
        none = torch.zeros(len(encoded), self.chunk, dtype=torch.bool, device=encoded.device)
        return ChunkMixture(*self.parameters(encoded), none).deterministic_sample

    def loss(self, kind: str, kl_weight: float) -> Loss:
        """See :class:`Head`."""
        split = TensorDictModule(self.parameters, in_keys=["encoded"], out_keys=["logits", "loc", "scale"])
        draw = ProbabilisticTensorDictModule(
            in_keys={"logits": "logits", "loc": "loc", "scale": "scale", "pad": "is_pad"},
            out_keys=["twist"],
            distribution_class=ChunkMixture,
            default_interaction_type=InteractionType.DETERMINISTIC,
        )
        return _bc_loss(ProbabilisticTensorDictSequential(split, draw), None, None)


class ACT(Head):
    """Action chunking with transformers: an autoencoder of plans, given the encoder's vector."""

    def __init__(self, chunk: int, size: int, width: int) -> None:
        super().__init__(chunk, size, width)
        # Small: there is one token of the situation to attend to, not hundreds of image patches.
        self.network = ACTModel(
            self.inputs, size, chunk, hidden_dim=4 * width, nheads=4, num_encoder_layers=2, num_decoder_layers=2,
            latent_dim=16, dropout=0.0, dim_feedforward=8 * width,
        )  # fmt: skip

    def plan(self, encoded: Tensor, noise: Tensor | None = None) -> Tensor:
        """See :class:`Head`; the plan of the latent's mean."""
        assert self.network is not None
        found: Tensor = self.network(encoded)[0]
        return found

    def loss(self, kind: str, kl_weight: float) -> Loss:
        """See :class:`Head`."""
        keys: dict[str, Any] = dict(in_keys=["observation", "action_chunk"], out_keys=["action_pred", "mu", "log_var"])
        loss = PaddedACTLoss(TensorDictModule(self.network, **keys), kl_weight=kl_weight)
        loss.set_keys(observation="encoded", action_chunk="twist", pad_mask="is_pad")
        return lambda batch: cast(Tensor, loss(batch)["loss_act"])


class TimedNetwork(nn.Module):
    """(actions, observation, time) along the last dimension -> as many numbers as the actions have.

    Args:
        actions: numbers of the actions.
        observed: numbers of the observation.
        hidden: width of the layers.
        last: the time's largest value.
    """

    def __init__(self, actions: int, observed: int, hidden: int, last: float) -> None:
        super().__init__()
        self.last, self.waves = last, 8
        self.layers = mlp(actions + observed + 2 * self.waves, hidden, hidden, hidden, actions)

    def forward(self, given: Tensor) -> Tensor:
        """See the class."""
        rest, time = given[..., :-1], given[..., -1:] / self.last
        phases = time * math.pi * 2.0 ** torch.arange(self.waves, device=given.device) / 2
        found: Tensor = self.layers(torch.cat([rest, phases.sin(), phases.cos()], dim=-1))
        return found


class Denoising(Head):
    """A head that makes its plan from noise.

    Args:
        calls: calls of the network for a plan.
    """

    def __init__(self, chunk: int, size: int, width: int, calls: int) -> None:
        super().__init__(chunk, size, width)
        self.calls, self.noise = calls, chunk * size
        self._hidden = 8 * width


class Diffusion(Denoising):
    """Diffusion policy: TorchRL's DiffusionActor, sampled by DDIM."""

    STEPS = 50
    """Steps of the noise in training."""

    LAST_BETA = 0.22
    """The last step's share of noise: then 0.2 % of a plan's variance is left. DiffusionActor's default, 0.02, which is
    for 1000 steps, would leave 60 %."""

    def __init__(self, chunk: int, size: int, width: int, calls: int) -> None:
        super().__init__(chunk, size, width, min(calls, self.STEPS))
        network = TimedNetwork(self.noise, self.inputs, self._hidden, self.STEPS - 1)
        self.network = DiffusionActor(
            self.noise, score_network=network, num_steps=self.STEPS, beta_end=self.LAST_BETA, in_keys=["encoded"],
            out_keys=["twist"],
        )  # fmt: skip

    def plan(self, encoded: Tensor, noise: Tensor | None = None) -> Tensor:
        """See :class:`Head`."""
        assert noise is not None and self.network is not None
        process: Any = self.network.module
        times = torch.linspace(self.STEPS - 1, 0, self.calls).round().long().tolist()
        kept = [float(process.alphas_cumprod[time]) for time in times] + [1.0]
        plan = noise
        for time, now, after in zip(times, kept[:-1], kept[1:], strict=True):
            at = torch.full_like(encoded[:, :1], time)
            error = process.score_network(torch.cat([plan, encoded, at], dim=-1))
            clean = (plan - math.sqrt(1 - now) * error) / math.sqrt(now)
            plan = math.sqrt(after) * clean + math.sqrt(1 - after) * error
        return self._chunks(plan)

    def loss(self, kind: str, kl_weight: float) -> Loss:
        """See :class:`Head`."""
        loss = DiffusionBCLoss(self.network, reduction="none")
        loss.set_keys(observation="encoded", action="twist")

        def masked(batch: TensorDictBase) -> Tensor:
            flat = batch.select("encoded").set("twist", batch["twist"].flatten(1))
            return mean_of_kept(self._chunks(loss(flat)["loss_diffusion_bc"]), batch["is_pad"])

        return masked


class _Velocity(nn.Module):
    """What FlowMatchingBCLoss asks of an actor's module."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.velocity_network = network


class FlowMatching(Denoising):
    """Noise that follows a learned velocity, by Euler's method."""

    def __init__(self, chunk: int, size: int, width: int, calls: int) -> None:
        super().__init__(chunk, size, width, calls)
        self.network = _Velocity(TimedNetwork(self.noise, self.inputs, self._hidden, 1.0))

    def plan(self, encoded: Tensor, noise: Tensor | None = None) -> Tensor:
        """See :class:`Head`."""
        assert noise is not None and isinstance(self.network, _Velocity)
        plan = noise
        for call in range(self.calls):
            at = torch.full_like(encoded[:, :1], call / self.calls)
            plan = plan + self.network.velocity_network(torch.cat([plan, encoded, at], dim=-1)) / self.calls
        return self._chunks(plan)

    def loss(self, kind: str, kl_weight: float) -> Loss:
        """See :class:`Head`."""
        loss = FlowMatchingBCLoss(TensorDictModule(self.network, in_keys=["encoded"], out_keys=["twist"]))
        loss.set_keys(observation="encoded", action="twist", pad_mask="is_pad")
        return lambda batch: cast(Tensor, loss(batch)["loss_flow_matching"])


def _bc_loss(actor: TensorDictModuleBase, kind: str | None, pad_mask: str | None) -> Loss:
    """TorchRL's BCLoss of an actor that writes "twist"; a likelihood without ``kind``."""
    loss = BCLoss(actor, loss_function=kind)
    loss.set_keys(action="twist", pad_mask=pad_mask)
    return lambda batch: cast(Tensor, loss(batch)["loss_bc"])


HEADS: dict[str, type[Head]] = {
    "deterministic": Deterministic,
    "gaussian": Gaussian,
    "mixture": Mixture,
    "act": ACT,
    "diffusion": Diffusion,
    "flow_matching": FlowMatching,
}
"""The heads by name."""


def make_head(name: str, chunk: int, size: int, width: int, components: int, calls: int) -> Head:
    """The head of that name; see :class:`Head`, :class:`Mixture` and :class:`Denoising` for the arguments."""
    kind = HEADS[name]
    if issubclass(kind, Mixture):
        return kind(chunk, size, width, components)
    if issubclass(kind, Denoising):
        return kind(chunk, size, width, calls)
    return kind(chunk, size, width)
