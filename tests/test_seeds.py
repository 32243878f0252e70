"""Streams of one seed are those of no other seed."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np

from fb3d_rl.algos.learners import new_learner
from fb3d_rl.algos.rounds import fit_options
from fb3d_rl.policies.hand import VelocityLimits
from fb3d_rl.policies.learner import LearnerOptions
from fb3d_rl.seeds import derived


def test_streams_follow_from_seed_and_names_and_never_meet() -> None:
    names = [(), ("validation",), ("member", 1), ("member", 2), ("round", 1), ("round", 2), ("round", 1000)]
    found = [derived(seed, *name) for seed, name in itertools.product([0, 1, 2, 1000, 1001, 2**40], names)]
    assert len({*found, *range(5000)}) == len(found) + 5000
    assert derived(1, "validation") == derived(1, "validation") == 5546392321549579070
    assert all(0 <= value < 2**63 for value in found)
    np.random.default_rng([derived(0, "validation"), 4])  # may be an entry of a list


def test_members_and_rounds_are_those_of_their_own_run_alone(config: Callable[[str, list[str]], Any]) -> None:
    limits, options = VelocityLimits(2.0, 3.0), LearnerOptions(points=16, width=8)
    weights = []
    for seed in (0, 1, 1000, 2000):
        for member in new_learner(options, limits, 3, seed).members:
            weights.append(next(member.parameters()).detach().numpy().tobytes())
    assert len(set(weights)) == len(weights)
    seeds = [
        fit_options(config("train", ["algo=dagger"]).algo, 100, seed, number).seed
        for seed in (0, 1, 1000)
        for number in (0, 1, 2)
    ]
    assert len(set(seeds)) == len(seeds) and seeds[0] == 0
