"""Rounds of imitation: how each of them is fitted, by this process or by several that torchrun started."""

from __future__ import annotations

import math
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import torch

from fb3d_rl.algos import setup
from fb3d_rl.algos.learners import (
    Labels,
    drawn_rows,
    imitation_objective,
    learner_options,
    members,
    networks,
    new_learner,
    numbered_seed,
)
from fb3d_rl.algos.weights import CHECKPOINT, load_network, state_before
from fb3d_rl.data.demonstrations import DemonstrationBuffer
from fb3d_rl.options import taken
from fb3d_rl.policies.ensemble import Ensemble
from fb3d_rl.policies.learner import Learner
from fb3d_rl.rollout.worker import steady_floats
from fb3d_rl.training.checkpoint import fitting
from fb3d_rl.training.fit import fit
from fb3d_rl.training.options import FitOptions
from fb3d_rl.training.processes import wait_for_all
from fb3d_rl.training.schedules import beta

if TYPE_CHECKING:
    from fb3d_rl.algos.options import ImitationOptions
    from fb3d_rl.config import TrainConfig

BUFFER = "buffer"


def round_beta(algo: ImitationOptions, number: int) -> float:
    """The expert's share of a round's steps; 1 in the first round, since the learner is untrained."""
    if number == 0:
        return 1.0
    return beta(algo.beta.schedule, number, algo.beta.value, algo.beta.rounds, algo.beta.base)


def fit_options(algo: ImitationOptions, labels: int, seed: int, number: int) -> FitOptions:
    """How the learner is fitted in a round; each round has a warm-up and a decay of the learning rate."""
    return taken(FitOptions, algo, steps=round_steps(algo, labels, number), seed=numbered_seed(seed, "round", number))


def round_steps(algo: ImitationOptions, labels: int, number: int) -> int:
    """A round's share of the optimizer steps: ``algo.epochs`` draws of each label in all, and at least one a round."""
    total = max(algo.rounds, math.ceil(algo.epochs * labels / algo.batch_size))
    return share(total, algo.rounds, number)


def share(total: int, rounds: int, number: int) -> int:
    """The part of a total that round ``number`` of ``rounds`` has; the first rounds share the remainder."""
    return total // rounds + (number < total % rounds)


def first_learner(cfg: TrainConfig) -> Learner | Ensemble:
    """The learner before its first fit."""
    algo = cast("ImitationOptions", cfg.algo)
    flow_net = load_network(algo.flow_checkpoint) if algo.flow_checkpoint else None
    return new_learner(learner_options(algo), setup.velocity_limits(cfg), algo.members, cfg.seed, flow_net)


def fit_round(
    learner: Learner | Ensemble, buffer: DemonstrationBuffer, cfg: TrainConfig, number: int, **hooks: Any
) -> None:
    """Fit the learner to all rows, beside the other processes if torchrun started several.

    Args:
        learner: trained in place; it is on the CPU before and after.
        buffer: the rows of the rounds so far.
        cfg: the run's configuration.
        number: of the round.
        hooks: further arguments of :func:`fb3d_rl.training.fit.fit`.
    """
    algo = cast("ImitationOptions", cfg.algo)
    options = fit_options(algo, cfg.data.labels, cfg.seed, number)
    if number == 0:  # later on it would change what the weights mean
        twists = torch.cat([buffer.frames(i)["expert", "twist"] for i in range(len(buffer.episodes))])
        for member in members(learner):
            member.network.normalize(twists)
    device = setup.choose_device(cfg.device)
    nets = networks(learner).to(device)
    objective = imitation_objective(learner, algo, options.seed)
    labels = Labels(buffer, algo.learner.chunk, drawn_rows(buffer, algo.sampling, number))
    # One thread: several would wait for each other on cores that also collect, and slow both down many times.
    with steady_floats() if algo.overlap else nullcontext():
        fit(nets, labels, options, objective=objective, device=device, **hooks)
    nets.to("cpu")


def assist(cfg: TrainConfig, out: Path) -> None:
    """What the other of several processes do: wait until the first has collected a round, then fit with it.

    They read the labels from the first one's run folder.
    """
    saved, learner, first, begun = state_before(cfg, out), first_learner(cfg), 0, None
    if saved is not None:
        with fitting(out / CHECKPOINT):
            state = saved["state"]["run"]
            first, begun = state["round"], state["fit"]
            networks(learner).load_state_dict(state["learner"])
    for number in range(first, cast("ImitationOptions", cfg.algo).rounds):
        wait_for_all()
        fit_round(learner, DemonstrationBuffer.open(out / BUFFER), cfg, number, resume=begun, progress=False)
        begun = None
