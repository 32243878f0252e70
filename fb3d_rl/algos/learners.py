"""What imitation trains: the learners, the training rows and the loss."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any, cast

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from fb3d_rl.data.demonstrations import DemonstrationBuffer
from fb3d_rl.data.picking import Index, pick
from fb3d_rl.errors import UserError
from fb3d_rl.models.artflownet import ArtFlowNet
from fb3d_rl.models.guide import Intention
from fb3d_rl.policies.ensemble import Ensemble
from fb3d_rl.policies.flow_policy import FlowPolicy
from fb3d_rl.policies.gates import PREDICTED, make_gate
from fb3d_rl.policies.hand import VelocityLimits
from fb3d_rl.policies.interaction import BetaGate, EitherGate, Gate, InteractivePolicy, OracleGate
from fb3d_rl.policies.learner import INPUTS, Learner, hand_in, intention_of, rotated, turning
from fb3d_rl.policies.options import LearnerOptions
from fb3d_rl.seeds import derived
from fb3d_rl.training.draws import generator, global_draws
from fb3d_rl.training.objective import Objective
from fb3d_rl.training.processes import rank_and_count

if TYPE_CHECKING:
    from fb3d_rl.algos.options import ImitationOptions, SamplingOptions

TURN, NOISE = 4, 9
"""Purposes of random draws; see :func:`fb3d_rl.training.draws.generator`."""


class Labels:
    """The buffer's rows for the loss: with "twist", the expert's twists of the next ``chunk`` steps, and "is_pad".

    Where the episode ends earlier, the twists are padded; the loss leaves the padding out.

    Args:
        buffer: the rows.
        chunk: see above.
        drawn: numbers of the rows to learn from, as :func:`drawn_rows` gives them; None for each of them once.
    """

    def __init__(self, buffer: DemonstrationBuffer, chunk: int, drawn: Tensor | None = None) -> None:
        self._buffer, self._chunk, self._drawn = buffer, chunk, drawn

    def __len__(self) -> int:
        return len(self._buffer) if self._drawn is None else len(self._drawn)

    def __getitem__(self, index: Index) -> TensorDictBase:
        return pick(index, len(self), self._take)

    def _take(self, index: Tensor) -> TensorDictBase:
        index = index if self._drawn is None else self._drawn[index]
        rows = self._buffer[index]
        steps = torch.arange(self._chunk)
        ahead = (index[:, None] + steps).clamp(max=len(self._buffer) - 1)
        later = rows[:, None] if self._chunk == 1 else self._buffer[ahead.flatten()].view(len(index), self._chunk)
        rows["twist"] = later["expert", "twist"]
        follows = later["elapsed_steps"].squeeze(-1) == rows["elapsed_steps"] + steps
        rows["is_pad"] = ~(follows & (later["episode"].squeeze(-1) == rows["episode"]))
        return rows


def drawn_rows(buffer: DemonstrationBuffer, options: SamplingOptions, number: int) -> Tensor | None:
    """Numbers of the rows that round ``number`` learns from, those of larger weight more often; None for all rows.

    There are as many numbers as rows that count; how often each of them comes is its share, rounded up or down.

    Raises:
        UserError: no row counts.
    """
    if options.rows == "all" and options.expert == options.learner:
        return None
    weights = []
    for episode, info in enumerate(buffer.episodes):
        counts = {
            "all": True,
            "recent": info.round > number - options.rounds,
            "successes": info.success,
        }[options.rows]
        acts = buffer.frames(episode)["expert", "acts"].flatten()
        weights.append(torch.where(acts, options.expert, options.learner).double() * counts)
    weight = torch.cat(weights)
    total, count = weight.sum(), int((weight > 0).sum())
    if not count:
        raise UserError(
            f"algo.sampling.rows={options.rows} leaves no label to learn from in round {number + 1}; choose another, "
            "or give algo.sampling.expert and algo.sampling.learner more than 0"
        )
    return torch.searchsorted(weight.cumsum(0) / total, (torch.arange(count) + 0.5) / count)


def new_learner(
    options: LearnerOptions, limits: VelocityLimits, members: int, seed: int, flow_net: ArtFlowNet | None = None
) -> Learner | Ensemble:
    """A learner, or an ensemble of several, with first weights that depend on the seed only."""
    each = [
        Learner(options, limits, torch.Generator().manual_seed(numbered_seed(seed, "member", k)), flow_net).eval()
        for k in range(members)
    ]
    return each[0] if members == 1 else Ensemble(each)


def numbered_seed(seed: int, what: str, number: int) -> int:
    """The seed of member or round ``number``: the run's own for number 0, else one derived from it."""
    return derived(seed, what, number) if number else seed


def members(learner: Learner | Ensemble) -> list[Learner]:
    """The learners of an ensemble, or the learner."""
    return [learner] if isinstance(learner, Learner) else [cast(Learner, member) for member in learner.members]


def networks(learner: Learner | Ensemble) -> nn.ModuleList:
    """The trainable networks of the learner."""
    return nn.ModuleList(member.network for member in members(learner))


def flow_network(learner: Learner | Ensemble) -> ArtFlowNet | None:
    """The network that predicts the flow for the learner, if it has one."""
    return members(learner)[0].flow_network


def acting_policy(expert: FlowPolicy, learner: Learner | Ensemble, oracle: bool) -> TensorDictModuleBase:
    """The policy that is evaluated: the learner, or learner and oracle, which drives to the contact point."""
    learner.eval()
    return InteractivePolicy(expert, learner, OracleGate()) if oracle else learner


def policy_name(algo: ImitationOptions) -> str:
    """The policy's name in tables, such as "dagger_oracle_flow"."""
    flow = {"none": "", "ground_truth": "_flow", "artflownet": "_artflow"}[algo.learner.flow]
    gate = "" if algo.gate.name == "beta" else f"_{algo.gate.name}"
    return algo.name + gate + ("_oracle" if algo.oracle else "") + flow


def new_gate(algo: ImitationOptions) -> Gate:
    """The gate of the collection: the expert acts if beta's schedule, ``algo.gate`` or the oracle wants it."""
    mixture = BetaGate(per_step=algo.beta.mixing == "step")
    gates: list[Gate] = [mixture]
    if algo.gate.name != "beta":
        gates.append(make_gate(algo.gate.name, **cast("dict[str, Any]", algo.gate.options)))
    if algo.oracle:
        gates.append(OracleGate())
    return gates[0] if len(gates) == 1 else EitherGate(*gates)


def learner_options(algo: ImitationOptions) -> LearnerOptions:
    """The learner's options; it predicts its distance from the expert if the gate reads that."""
    return replace(algo.learner, discrepancy=PREDICTED in new_gate(algo).in_keys)


def _guided(member: Learner, inputs: TensorDictBase, rows: TensorDictBase, matrix: Tensor) -> tuple[Intention, Tensor]:
    """The intention for which the head learns to plan, and the loss of what the guide tells.

    The head is given the expert's own intention, of which it learns how to follow it; where the expert goes to no
    contact point, what the guide tells.

    Args:
        member: the learner.
        inputs: its network's inputs in a scene that was turned by ``matrix`` [B, 3, 3].
        rows: the rows [B].
        matrix: see above.
    """
    network, options, felt = member.network, member.options, inputs["felt"]
    told, (true, goes) = network.told(*(inputs[key] for key in INPUTS)), intention_of(rows)
    contact, standoff = (torch.einsum("bij,bj->bi", matrix, vector) for vector in (true.contact, true.standoff))
    loss = told.scores.new_zeros(())
    if options.contact:
        loss = loss + told.loss(contact, standoff).masked_fill(~goes, 0.0).mean()
        with torch.no_grad():
            own = told.likeliest()
        contact, standoff = (torch.where(goes[:, None], *pair) for pair in zip((contact, standoff), own, strict=True))
    if options.phase:
        logits = network.guide.phase_logits(told, contact, standoff, felt.flatten(1), hand_in(felt))
        loss = loss + nn.functional.cross_entropy(logits, true.phase)
    return Intention(contact, standoff, true.phase), loss


def imitation_objective(learner: Learner | Ensemble, algo: ImitationOptions, seed: int) -> Objective:
    """The loss of every member's head on inputs that are rotated and mirrored at random.

    One of several processes is given its share of the rows, and draws as if it had all of them.

    A member that predicts its distance from the expert is also fitted to that: the norm of the difference between the
    normalised twists of the first step.
    """
    losses = [member.network.loss(algo.loss, algo.kl_weight) for member in members(learner)]
    largest, (rank, processes) = math.radians(algo.turn), rank_and_count()

    def objective(rows: TensorDictBase, step: int) -> Tensor:
        values = []
        for k, (member, loss) in enumerate(zip(members(learner), losses, strict=True)):
            own = numbered_seed(seed, "member", k)
            whole = processes * len(rows)
            draws = torch.rand(2, whole, generator=generator(own, TURN, step))[:, rank::processes].to(rows.device)
            mirrored = (draws[1] < 0.5) & algo.mirror
            inputs, twist = rotated(member.network_inputs(rows), rows["twist"], (2 * draws[0] - 1) * largest, mirrored)
            intention = None
            if member.options.guided:
                intention, value = _guided(member, inputs, rows, turning((2 * draws[0] - 1) * largest, mirrored))
                values.append(algo.auxiliary * value)
            encoded, _ = member.network(*(inputs[key] for key in INPUTS), intention)
            twist = twist.masked_fill(rows["is_pad"][..., None], 0.0)
            batch = {"encoded": encoded, "twist": twist, "is_pad": rows["is_pad"]}
            with global_draws(generator(numbered_seed(own, "process", rank), NOISE, step), twist.device):
                values.append(loss(TensorDict(batch, batch_size=rows.batch_size)))
            if member.options.discrepancy:
                noise = torch.randn(whole, member.network.noise, generator=generator(own, NOISE, step))
                plan, distance = member.planned(inputs, noise[rank::processes].to(twist.device))
                assert distance is not None
                true = (plan[:, 0] - twist[:, 0]).norm(dim=-1, keepdim=True).detach()
                values.append(nn.functional.smooth_l1_loss(distance, true, beta=0.1))
        return torch.stack(values).mean()

    return objective
