"""DAgger's collection: rollouts of expert and learner in which the expert labels every step."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDictBase

from fb3d_rl.algos.weights import CHECKPOINT
from fb3d_rl.contract import Key
from fb3d_rl.data.demonstrations import RECORD, DemonstrationBuffer, EpisodeInfo, recorded
from fb3d_rl.data.samples import SampleOptions
from fb3d_rl.errors import UserError
from fb3d_rl.policies.hand import VelocityLimits
from fb3d_rl.policies.learner import INTENTION, OBSERVED, hand_features, history_of, twist_of
from fb3d_rl.rollout import demonstrations
from fb3d_rl.rollout.collectors import Workers
from fb3d_rl.rollout.demonstrations import episode_info
from fb3d_rl.rollout.trials import BARREN, draw_trials
from fb3d_rl.scene.posed import Posed

STEPS_OF_TRIAL = 60
"""Labels that a trial is expected to give."""

OUTCOME: tuple[Key, ...] = (*demonstrations.OUTCOME, ("next", "contact"))
"""The keys from which a round's numbers are computed."""

EXPERT: tuple[Key, ...] = ("action", ("expert", "action"), ("expert", "acts"), "elapsed_steps")
"""The keys of a row that the learner neither reads nor writes."""


@dataclass(frozen=True)
class Round:
    """The labelled episodes of one round.

    Attributes:
        episodes: frames [T] and facts of each episode; together exactly as many frames as labels were asked for.
        numbers: for the log; "collect/success_rate" and "collect/contact_rate" are of whole episodes,
            "collect/expert_share" is of the labels (see :func:`expert_share`).
        ended: the time of :func:`time.perf_counter` at the end.
    """

    episodes: list[tuple[TensorDictBase, EpisodeInfo]]
    numbers: dict[str, float]
    ended: float


def collect(
    workers: Workers,
    views: Sequence[Posed],
    samples: SampleOptions,
    rows: RowsOptions,
    number: int,
    beta: float,
    version: int,
    labels: int,
    rng: np.random.Generator,
    progress: Callable[[int], None] = lambda labels: None,
) -> Round:
    """Run trials until there are ``labels`` labels; the last episode is cut to fit.

    Args:
        workers: environments with an :class:`~fb3d_rl.policies.interaction.InteractivePolicy`.
        views: the objects to train on.
        samples: how clouds and views are drawn.
        rows: what a row holds.
        number: the number of the round.
        beta: see :func:`fb3d_rl.data.demonstrations.recorded`.
        version: likewise.
        labels: how many labels to collect.
        rng: the generator that draws the trials.
        progress: called with the number of labels so far.

    Raises:
        UserError: many trials in succession crashed or gave no label.
    """
    categories = {view.obj.id: view.obj.category for view in views}
    episodes: list[tuple[TensorDictBase, EpisodeInfo]] = []
    outcomes: list[tuple[bool, bool]] = []
    count, steps, crashed, barren, error, started = 0, 0, 0, 0, "", time.perf_counter()
    while count < labels:
        # The number of trials depends on the labels only, so that the rows do not depend on the number of workers.
        trials = draw_trials(views, samples, rng, min(48, math.ceil((labels - count) / STEPS_OF_TRIAL)))
        ended: dict[int, TensorDictBase] = {}
        for episode in workers.run(trials, rows.keys()):
            if episode.frames is None:
                crashed, error = crashed + 1, episode.error
                continue
            ended[episode.index] = episode.frames
            steps += len(episode.frames)
            progress(min(labels, count + sum(map(len, ended.values()))))
        for index, trial in enumerate(trials):
            barren += 1  # set to 0 below if the trial gives a label
            if index not in ended:
                continue
            frames = rows.of(ended[index])
            info = episode_info(trial, categories[trial.object], ended[index], number)
            outcomes.append((info.success, bool(ended[index]["next", "contact"].any())))
            if len(frames):
                barren = 0
            if count < labels and len(frames):
                kept = frames[: labels - count]
                episodes.append((recorded(kept, info, beta, version), info))
                count += len(kept)
        if barren >= BARREN:
            raise UserError(f"the last {barren} trials gave no label: {rows.why_none(len(outcomes), error)}")
    ended_at = time.perf_counter()
    return Round(episodes, _numbers(episodes, outcomes, crashed, steps, ended_at - started), ended_at)


def _numbers(
    episodes: Sequence[tuple[TensorDictBase, EpisodeInfo]],
    outcomes: Sequence[tuple[bool, bool]],
    crashed: int,
    steps: int,
    seconds: float,
) -> dict[str, float]:
    """A round's row of the log; ``outcomes`` are success and contact of each trial that did not crash."""
    success, contact = np.mean(outcomes, axis=0).tolist()
    return {
        "collect/success_rate": success,
        "collect/contact_rate": contact,
        "collect/expert_share": expert_share([frames for frames, _ in episodes]),
        "collect/episodes": len(outcomes),
        "collect/crashed": crashed,
        "time/collect_seconds": seconds,
        "time/labels_per_s": steps / seconds,
    }


def expert_share(rows: Sequence[TensorDictBase]) -> float:
    """Share of the labelled steps that the expert also made.

    Args:
        rows: the rows [T] of each episode in the buffer, all of which have a label.
    """
    return float(torch.cat([frames["expert", "acts"] for frames in rows]).double().mean())


@dataclass(frozen=True)
class RowsOptions:
    """Which frames and which of their entries become rows.

    Attributes:
        limits: the velocities of action 1.
        history: number of earlier steps in the learner's input.
        flow: the key of the flow in the learner's input, if there is one.
        further: what a gate compares and remembers, and keys from which its thresholds are set.
        attached_only: whether only steps in which suction holds a part become rows.
        guided: whether a row holds the expert's intention, which the learner learns to tell.
    """

    limits: VelocityLimits
    history: int = 0
    flow: Key | None = None
    further: tuple[Key, ...] = ()
    attached_only: bool = False
    guided: bool = False

    def keys(self) -> list[Key]:
        """The keys that the workers have to send."""
        told = [("next", "policy", key) for key in INTENTION] if self.guided else []
        return [*OBSERVED, *([self.flow] if self.flow else ()), *EXPERT, *self.further, *OUTCOME, *told]

    def kept(self) -> list[Key]:
        """The keys of a row in the buffer, as :meth:`of`, :func:`recorded` and the buffer make it."""
        flow: list[Key] = [self.flow] if self.flow else []
        told: list[Key] = [("expert", key) for key in INTENTION] if self.guided else []
        felt: list[Key] = [("learner", "felt")] if self.history else []
        return [*OBSERVED, *flow, *EXPERT, *self.further, *told, ("expert", "twist"), *felt, *RECORD, "episode"]

    def why_none(self, ended: int, error: str) -> str:
        """Why the trials of a round, of which ``ended`` did not crash, gave no rows, and what to change."""
        if not (ended and self.attached_only):
            return f"they crashed, the last one with: {error}"
        return (
            "with algo.oracle=true a step counts only while the hand holds a part, and it never did; give env.horizon "
            "more steps, choose other objects, or algo.oracle=false"
        )

    def of(self, frames: TensorDictBase) -> TensorDictBase:
        """The rows of an episode's frames [T], with the label as a twist and the hand's earlier steps."""
        rows = frames.select(*OBSERVED, *([self.flow] if self.flow else ()), *EXPERT, *self.further)
        for key in INTENTION if self.guided else ():
            kept = ("expert", key)  # of demonstrations that another run collected
            rows[kept] = frames[kept] if kept in frames.keys(True) else frames["next", "policy", key]
        rows["expert", "twist"] = twist_of(rows["observation"], rows["expert", "action"], self.limits)
        if self.history:
            rows["learner", "felt"] = history_of(hand_features(rows["observation"], self.limits), self.history)
        return rows[rows["observation", "attached"].squeeze(-1)] if self.attached_only else rows


def copy_demonstrations(source: DemonstrationBuffer, target: DemonstrationBuffer, rows: RowsOptions) -> None:
    """Add all rows of ``source`` in the layout that the learner reads.

    Raises:
        UserError: they lack a key that the learner reads.
    """
    lacking = [key for key in (*OBSERVED, *([rows.flow] if rows.flow else ()), *EXPERT) if key not in source.keys]
    if lacking:
        raise UserError(f"the demonstrations at {source.path} lack {', '.join(map(str, lacking))}; record them anew")
    if rows.guided and any(("expert", key) not in source.keys for key in INTENTION):
        raise UserError(
            f"the demonstrations at {source.path} do not say where the expert was going, as only the buffer of a run "
            "with algo.learner.contact or algo.learner.phase does: leave both false"
        )
    for episode, info in enumerate(source.episodes):
        frames = source.frames(episode)
        kept = rows.of(frames).update(frames.select("record", strict=False))
        target.extend(recorded(kept, info, beta=1.0, version=-1), info)


def kept_buffer(path: Path, rows: int) -> DemonstrationBuffer:
    """The buffer of a run that is resumed, cut to the rows that its checkpoint counts.

    Raises:
        UserError: it has fewer.
    """
    buffer = DemonstrationBuffer.open(path)
    if len(buffer) < rows:
        raise UserError(
            f"{path} holds {len(buffer)} of the {rows} rows that {CHECKPOINT} counts; copy the run folder anew, or "
            "start a new run"
        )
    buffer.truncate(rows)
    return buffer


def relabelled(rows: TensorDictBase, policy: Callable[[TensorDictBase], TensorDictBase]) -> TensorDictBase:
    """``rows`` [R] with the actions and predictions of the present learner."""
    parts = []
    for part in rows.split(256):
        decided = policy(part.clone())
        part["learner", "action"] = decided["action"]
        parts.append(part.update(decided.select("learner")))
    return torch.cat(parts)
