"""Clouds from rollouts of a network's own policy, labelled with the true flow: DAgger for the flow network.

Unlike samples of an object alone they show the hand in front of it, and parts as far open as the policy left them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.assets.cache import content_digest
from fb3d_rl.contract import Key
from fb3d_rl.data.generate import empty_rows, finish, finished_rows
from fb3d_rl.errors import UserError
from fb3d_rl.evaluation.evaluate import Protocol
from fb3d_rl.rollout.collectors import Workers
from fb3d_rl.rollout.run import create_env, state_of
from fb3d_rl.rollout.trials import BARREN, draw_trials
from fb3d_rl.scene.posed import Posed

EVERY = 0.2
"""Time (s) between frames that are kept; closer ones are nearly alike."""

KEYS: tuple[Key, ...] = (
    *(("observation", key) for key in ("points", "valid", "part_mask")),
    ("privileged", "flow"),
    ("privileged", "link"),
)


def rollout_samples(
    out: Path,
    objects: Sequence[ArticulatedObject],
    policy: TensorDictModuleBase,
    count: int,
    protocol: Protocol,
    made_by: dict[str, Any],
    progress: Callable[[int], None] = lambda done: None,
) -> TensorDictBase:
    """Run trials with a policy until ``count`` samples are kept: every few frames in which a visible part can move.

    Args:
        out: folder of the memory map; a finished one that was made from the same arguments is reused.
        objects: the objects to train on; a trial's category, object and part are drawn with equal odds.
        policy: the policy that acts.
        count: number of samples S.
        protocol: clouds, task, workers and seed.
        made_by: what else the samples depend on, such as the policy's weights; part of the recipe.
        progress: called with the number of samples so far.

    Returns:
        TensorDict [S] as :func:`fb3d_rl.data.generate.generate_samples` gives it.

    Raises:
        UserError: many trials in succession crashed or showed no part that can move.
    """
    recipe = {"objects": [[obj.id, content_digest(obj)] for obj in objects], "count": count, "seed": protocol.seed,
              "made_by": made_by, "samples": asdict(protocol.samples), "env": asdict(protocol.env)}  # fmt: skip
    done = finished_rows(out, recipe)
    if done is not None:
        progress(count)
        return done
    rows = empty_rows(out, count, protocol.samples.points)
    views = [Posed(obj, protocol.samples.camera) for obj in objects]
    number = {obj.id: index for index, obj in enumerate(objects)}
    rng = np.random.default_rng([protocol.seed, 6])
    create = partial(create_env, tuple(objects), protocol.env, state_of(policy))
    every = max(1, round(EVERY * protocol.env.control_freq))
    filled, barren = 0, 0
    with Workers(create, policy, protocol.collector, protocol.env.horizon) as workers:
        while filled < count:
            trials = draw_trials(views, protocol.samples, rng, min(24, 1 + (count - filled) // 10))
            frames = {episode.index: episode.frames for episode in workers.run(trials, KEYS)}
            for index, trial in enumerate(trials):  # in the order of the trials, not in that of their ends
                episode = frames[index]
                barren += 1  # set to 0 below if the trial gives samples
                if episode is None:
                    continue
                seen = _labelled(episode[::every], trial.link, number[trial.object])[: count - filled]
                barren = barren if len(seen) else 0
                rows[filled : filled + len(seen)] = seen
                filled += len(seen)
            if barren >= BARREN and filled < count:
                raise UserError(
                    f"none of the last {barren} trials of the policy data.met_by showed a part that can move; choose "
                    "other objects, or set data.met_by=null"
                )
            progress(filled)
    finish(out, recipe)
    return rows


def _labelled(frames: TensorDictBase, target: int, owner: int) -> TensorDictBase:
    """The samples among frames [T] of a trial: those that show a part that can move."""
    seen = frames[frames["privileged", "flow"].norm(dim=-1).amax(-1) > 0.5].select(*KEYS)
    seen["privileged", "link"] = seen["privileged", "link"].to(torch.int16)
    seen["target"] = torch.full([len(seen)], target)
    seen["object"] = torch.full([len(seen)], owner)
    return seen
