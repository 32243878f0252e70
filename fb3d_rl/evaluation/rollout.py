"""Run scheduled trials with a policy through a TorchRL collector; every trial ends in exactly one row."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import Collector
from torchrl.data.tensor_specs import Composite, Unbounded
from torchrl.envs import EnvBase, TensorDictPrimer, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.env.options import EnvOptions
from fb3d_rl.env.torchrl_env import ManiSkillEnv, make_env
from fb3d_rl.evaluation.rows import TrialRow
from fb3d_rl.evaluation.trials import Scheduled
from fb3d_rl.policies.flow_policy import FlowPolicy

log = logging.getLogger(__name__)


def policy_env(env: ManiSkillEnv) -> EnvBase:
    """``env`` with the flow policy's state in its TensorDicts, set to its start at every reset."""
    start = FlowPolicy.initial_state(env.batch_size)
    specs = {key: Unbounded(shape=value.shape, dtype=value.dtype) for key, value in start.items()}
    primer = Composite({"policy": Composite(specs, shape=env.batch_size)}, shape=env.batch_size)
    return TransformedEnv(env, TensorDictPrimer(primer, default_value=0.0))


@dataclass
class _Episode:
    """What is kept of the running trial."""

    steps: int = 0
    attach_step: int = -1
    held_at_end: bool = False
    force: float = 0.0

    def add(self, frame: TensorDictBase) -> None:
        after = frame["next"]
        if self.attach_step < 0 and bool(after["contact"]):
            self.attach_step = self.steps
        self.steps += 1
        self.held_at_end = bool(after["observation", "attached"])
        self.force = max(self.force, float(after["observation", "contact_force"]))

    def failure(self, distance: float) -> str:
        """Why the part is not open, in a few words."""
        opened = f"{100 * (1 - distance):.0f} % open"
        if self.attach_step < 0:
            return "touched, but never held the part" if self.force > 0 else "never touched the part"
        return f"held at the end, {opened}" if self.held_at_end else f"lost hold, {opened}"


def run_trials(
    name: str,
    policy: TensorDictModuleBase,
    objects: Sequence[ArticulatedObject],
    scheduled: Sequence[Scheduled],
    options: EnvOptions,
    progress: Callable[[TrialRow], None] = lambda row: None,
) -> list[TrialRow]:
    """Run every trial once.

    A trial that crashes becomes a row with status "error" and counts as a failure; the others are not touched by it.

    Args:
        name: the policy's name in the rows.
        policy: reads the contract's "observation" (and, for the expert, "privileged") keys and writes "action".
        objects: the objects that the trials name.
        scheduled: the trials.
        options: the task's constants.
        progress: called with each row.

    Returns:
        One row per trial, in the order of ``scheduled``.
    """
    rows: dict[int, TrialRow] = {}
    while pending := [i for i in range(len(scheduled)) if i not in rows]:
        env = make_env(objects, options, [scheduled[i].trial for i in pending])
        try:
            for place, outcome in _episodes(env, policy, len(pending), options.horizon):
                index = pending[place]
                rows[index] = _row(index, name, scheduled[index], **outcome)
                progress(rows[index])
        except Exception as error:  # whatever a trial dies of is that trial's row
            index = pending[max(env.running_trial, 0)]
            log.exception("trial %d crashed", index)
            rows[index] = _row(index, name, scheduled[index], status="error", error=f"{type(error).__name__}: {error}",
                               failure="crashed")  # fmt: skip
            progress(rows[index])
        finally:
            env.close(raise_if_closed=False)
    return [rows[i] for i in range(len(scheduled))]


def _episodes(
    env: ManiSkillEnv, policy: TensorDictModuleBase, count: int, horizon: int
) -> Iterator[tuple[int, dict[str, Any]]]:
    """Yield (place in the env's list of trials, what its row says) for each finished episode."""
    collector = Collector(
        policy_env(env),
        policy,
        frames_per_batch=horizon,
        total_frames=-1,
        trust_policy=True,
        use_buffers=False,
        auto_register_policy_transforms=False,
    )
    finished: set[int] = set()
    episode = _Episode()
    try:
        with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
            for batch in collector:
                for frame in batch.reshape(-1).unbind(0):
                    episode.add(frame)
                    if not bool(frame["next", "done"]):
                        continue
                    place, distance = int(frame["trial"]), float(frame["next", "normalized_distance"])
                    success = bool(frame["next", "success"])
                    if place not in finished:
                        finished.add(place)
                        yield (
                            place,
                            dict(
                                steps=episode.steps,
                                contact=bool(frame["next", "contact"]),
                                success=success,
                                normalized_distance=distance,
                                attach_step=episode.attach_step,
                                failure="" if success else episode.failure(distance),
                            ),
                        )
                    episode = _Episode()
                if len(finished) == count:
                    return
    finally:
        collector.shutdown(close_env=False)


def _row(index: int, name: str, item: Scheduled, **outcome: Any) -> TrialRow:
    trial = item.trial
    return TrialRow(
        trial=index, policy=name, object=trial.object, category=item.category, split=item.split, link=item.link,
        semantic=item.semantic, joint_type=item.joint_type, seed=trial.seed, **outcome,
    )  # fmt: skip
