"""Run scheduled trials with a policy through TorchRL collectors; every trial ends in exactly one row."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.data.tensor_specs import Composite, Unbounded
from torchrl.envs import EnvBase, TensorDictPrimer, TransformedEnv

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.contract import Key
from fb3d_rl.env.options import EnvOptions
from fb3d_rl.env.torchrl_env import make_env
from fb3d_rl.policies.arc import LOOKS
from fb3d_rl.policies.digest import policy_digest
from fb3d_rl.policies.flow_policy import MASK
from fb3d_rl.policies.hand import VelocityLimits
from fb3d_rl.policies.policy import initial_state
from fb3d_rl.rollout.collectors import CollectorOptions, Episode, Workers
from fb3d_rl.rollout.decisions import DECISION, TimedPolicy, TookTooLong
from fb3d_rl.rollout.pulls import pulls_until_moved
from fb3d_rl.rollout.rows import (
    CRASHED,
    LOST,
    NEVER_HELD,
    NEVER_TOUCHED,
    STUCK,
    TIMED_OUT,
    TOO_SLOW,
    WRONG_WAY,
    TrialRow,
)
from fb3d_rl.rollout.trials import Scheduled, trial_key

KEYS: tuple[Key, ...] = (
    ("observation", "tool_pose"),
    ("next", "observation", "tool_pose"),
    DECISION,
    ("next", "success"),
    ("next", "normalized_distance"),
    ("next", "contact"),
    ("next", "held_opened"),
    ("next", "observation", "attached"),
    ("next", "observation", "contact_force"),
    LOOKS,
)
"""The entries of the frames that a row is computed from; the last one is there for policies that follow arcs."""


def state_of(policy: TensorDictModuleBase) -> TensorDict:
    """The policy's state in the TensorDicts [1] of an episode at its start, all zeros."""
    return initial_state(policy, torch.Size([1]))


def limits_of(options: EnvOptions) -> VelocityLimits:
    """The velocities that an action of 1 stands for in a task."""
    return VelocityLimits(options.gripper.v_max, options.gripper.w_max, 1.0 / options.control_freq)


def policy_env(env: EnvBase, state: TensorDictBase) -> EnvBase:
    """``env`` with a policy's state, as :func:`state_of` gives it, in its TensorDicts, set to 0 at every reset."""
    start = _specs_of(state.expand(env.batch_size))
    return _PolicyEnv(env, TensorDictPrimer(start, default_value=0.0))


class _PolicyEnv(TransformedEnv):
    """Replaces groups of state as a whole by those that a policy wrote below "next".

    TorchRL would look up each of their keys among all keys of the environment twice in a step, which is slow.
    """

    def step(self, tensordict: TensorDictBase) -> TensorDictBase:
        """See :class:`TransformedEnv`."""
        written = tensordict.pop("next", None)
        tensordict = super().step(tensordict)
        after = tensordict["next"]
        for name, group in () if written is None else written.items():
            after[name] = group
        return tensordict


def _specs_of(start: TensorDictBase) -> Composite:
    specs = {
        key: _specs_of(value) if isinstance(value, TensorDictBase) else Unbounded(value.shape, dtype=value.dtype)
        for key, value in start.items()
    }
    return Composite(specs, shape=start.batch_size)


def run_trials(
    name: str,
    policy: TensorDictModuleBase,
    objects: Sequence[ArticulatedObject],
    scheduled: Sequence[Scheduled],
    options: EnvOptions,
    progress: Callable[[TrialRow], None] = lambda row: None,
    collector: CollectorOptions | None = None,
    limit: float | None = None,
    timing: Callable[[int, list[float]], None] = lambda trial, seconds: None,
) -> list[TrialRow]:
    """Run every trial once.

    A trial that crashes, or whose policy takes too long, becomes a row with status "error" and counts as a failure;
    it does not affect the others. The rows do not depend on the backend and the number of workers.

    Args:
        name: the policy's name in the rows.
        policy: reads the contract's "observation" (and, for the expert, "privileged") keys and writes "action".
        objects: the objects that the trials name.
        scheduled: the trials.
        options: the task's constants.
        progress: called with each row.
        collector: where the trials run; in this process unless given.
        limit: seconds that a decision may take (:class:`~fb3d_rl.rollout.decisions.TimedPolicy`); None for no limit.
        timing: called with the place of each trial that did not crash and the wall time of its decisions [T], s,
            before its row goes to ``progress``.

    Returns:
        One row per trial, in the order of ``scheduled``.
    """
    rows: dict[int, TrialRow] = {}
    create = partial(create_env, tuple(objects), options, state_of(policy))
    timed = TimedPolicy(policy, limit)
    named, acting = {obj.id: obj for obj in objects}, policy_digest(policy)
    with Workers(create, timed, collector or CollectorOptions(), options.horizon) as workers:
        for episode in workers.run([item.trial for item in scheduled], KEYS):
            item = scheduled[episode.index]
            row = replace(
                _row(episode, name, mask_of(policy), item, options),
                key=trial_key(named[item.trial.object], item.trial, options.suction.hold),
                policy_digest=acting,
            )
            if episode.frames is not None:
                timing(episode.index, episode.frames[DECISION].flatten().tolist())
            rows[episode.index] = row
            progress(row)
    return [rows[i] for i in range(len(scheduled))]


def create_env(objects: Sequence[ArticulatedObject], options: EnvOptions, state: TensorDictBase) -> EnvBase:
    """The task for ``objects`` with a policy's state; a function that can be pickled."""
    return policy_env(make_env(objects, options), state)


def mask_of(policy: TensorDictModuleBase) -> str:
    """Whether a policy sees which points are the part's: "target" or "none"; "" if it sees no points."""
    keys = set(policy.in_keys)
    return "target" if MASK in keys else "none" if ("observation", "points") in keys else ""


def _row(episode: Episode, name: str, mask: str, item: Scheduled, options: EnvOptions) -> TrialRow:
    trial = item.trial
    if episode.frames is None:
        failure = TOO_SLOW if episode.error.startswith(TookTooLong.__name__) else CRASHED
        outcome: dict[str, Any] = dict(status="error", error=episode.error, failure=failure)
    else:
        outcome = _outcome(episode.frames, options.control_freq)
    return TrialRow(
        trial=episode.index, policy=name, object=trial.object, category=item.category, split=item.split, link=item.link,
        semantic=item.semantic, joint_type=item.joint_type, seed=trial.seed, repeat=item.repeat, mask=mask,
        **outcome,
    )  # fmt: skip


def _outcome(frames: TensorDictBase, control_freq: int) -> dict[str, Any]:
    """The columns of a row that follow from the steps [T] of an episode."""
    after = frames["next"]
    attached = after["observation", "attached"].flatten()
    held = after["contact"].flatten().nonzero().flatten()
    success, distance = bool(after["success"][-1]), after["normalized_distance"].flatten()
    tips = torch.cat([frames["observation", "tool_pose"][:1], after["observation", "tool_pose"]])[..., :3].flatten(1)
    return dict(
        steps=len(after),
        contact=len(held) > 0,
        success=success,
        normalized_distance=float(distance[-1]),
        attach_step=int(held[0]) if len(held) else -1,
        failure="" if success else _failure(after, len(held) > 0, control_freq),
        seconds=len(after) / control_freq,
        path_length=float(tips.double().diff(dim=0).norm(dim=1).sum()),
        held_opened=bool(after["held_opened"].any()),
        lost=int((attached[:-1] & ~attached[1:]).sum()),
        pulls=pulls_until_moved(tips, attached, distance),
        network_calls=int(frames.get(LOOKS, torch.tensor([-1])).flatten()[-1]),
    )


def _failure(after: TensorDictBase, held: bool, control_freq: int) -> str:
    """Why the part was not opened in an episode; see :mod:`fb3d_rl.rollout.rows`."""
    if not held:
        touched = bool((after["observation", "contact_force"] > 0).any())
        return NEVER_HELD if touched else NEVER_TOUCHED
    if not bool(after["observation", "attached"][-1]):
        return LOST
    distance = after["normalized_distance"].flatten()
    if distance[-1] > 1.01:
        return WRONG_WAY
    still = len(distance) <= control_freq or distance[-1 - control_freq] - distance[-1] < 0.01
    return STUCK if still else TIMED_OUT
