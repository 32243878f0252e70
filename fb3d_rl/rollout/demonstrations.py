"""Record the expert's episodes, and run recorded actions again: an episode repeats bit for bit."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.assets.catalog import procedural_catalog
from fb3d_rl.contract import Key, spec
from fb3d_rl.data.demonstrations import DemonstrationBuffer, EpisodeInfo
from fb3d_rl.data.samples import SampleOptions
from fb3d_rl.env.options import EnvOptions, Trial
from fb3d_rl.errors import UserError
from fb3d_rl.importer.catalog import path_catalog
from fb3d_rl.policies.flow_policy import expert_policy
from fb3d_rl.policies.interaction import BetaGate, InteractivePolicy
from fb3d_rl.rollout.collectors import CollectorOptions, Episode, Workers
from fb3d_rl.rollout.film import Film, record
from fb3d_rl.rollout.run import create_env, limits_of, state_of
from fb3d_rl.rollout.trials import Scheduled, schedule

KEYS: tuple[Key, ...] = (
    *spec("observation"), ("privileged", "flow"), "action", ("expert", "action"), ("expert", "acts"), "elapsed_steps",
)  # fmt: skip
"""What a row of a demonstration holds."""

OUTCOME: tuple[Key, ...] = (("next", "success"), ("next", "normalized_distance"))
"""Further entries of the frames, which :func:`episode_info` reads."""

COMMIT_EVERY = 10
"""Episodes are committed to disk in groups of this many; a killed process loses fewer than that."""


@dataclass(frozen=True)
class Assets:
    """Where the objects of demonstrations come from.

    Attributes:
        root: folder of PartNet-Mobility objects; procedural ones are made unless given.
        split: which of them, see :func:`fb3d_rl.assets.splits.select_ids`.
        categories: of procedural objects.
        count: procedural objects of each category; they are those of a training with the same seed.
        seed: of the procedural objects.
    """

    root: str | None = None
    split: str = "all"
    categories: tuple[str, ...] = ("StorageFurniture", "Microwave", "KitchenPot")
    count: int = 10
    seed: int = 0

    def load(self) -> list[tuple[ArticulatedObject, str]]:
        """The objects with their splits.

        Raises:
            UserError: there is none, or the split or a category is unknown.
        """
        if self.root is not None:
            return [(entry.load(), entry.split) for entry in path_catalog(self.root, self.split)]
        with tempfile.TemporaryDirectory() as folder:
            made = procedural_catalog(Path(folder), self.categories, self.count, 0, self.seed)
            return [(entry.load(), entry.split) for entry in made]


def plan(
    objects: Sequence[tuple[ArticulatedObject, str]], options: SampleOptions, seed: int, trials: int | None
) -> list[Scheduled]:
    """List the trials to record: one for every part that opens, or ``trials`` in all, from as many seeds as that needs.

    Raises:
        UserError: the objects have no part that opens and can be seen.
    """
    planned: list[Scheduled] = []
    while trials is None or len(planned) < trials:
        more, _ = schedule(objects, options, seed, None if trials is None else trials - len(planned))
        planned += more
        seed += 1
        if not more:
            raise UserError("the objects have no part that opens and can be seen; choose other objects")
        if trials is None:
            break
    return planned


def episode_info(trial: Trial, category: str, frames: TensorDictBase, round: int = 0) -> EpisodeInfo:
    """The entry of the buffer's table for an episode of frames [T], which hold :data:`OUTCOME`."""
    after = frames["next"][-1]
    return EpisodeInfo(
        trial.object, category, trial.link, trial.start, trial.view, trial.seed, round,
        bool(after["success"]), float(after["normalized_distance"]), len(frames),
    )  # fmt: skip


def trial_of(info: EpisodeInfo) -> Trial:
    """The trial of an episode.

    Raises:
        UserError: it is unknown, since the data are from another source.
    """
    if not info.start:
        raise UserError("the episode cannot be run again: the data are from another source and do not name its object")
    return Trial(info.object, info.link, info.start, info.view, info.seed)


def record_expert(
    buffer: DemonstrationBuffer,
    objects: Sequence[ArticulatedObject],
    scheduled: Sequence[Scheduled],
    options: EnvOptions,
    collector: CollectorOptions,
    successful: bool = False,
    progress: Callable[[Episode, bool], None] = lambda episode, kept: None,
) -> None:
    """Add the expert's episodes to ``buffer`` in the order of ``scheduled``, on any number of workers.

    Finished episodes are committed also when Ctrl-C ends the loop. A trial that crashes is left out.

    Args:
        buffer: has room for ``options.horizon`` rows of each trial.
        objects: the objects that the trials name.
        scheduled: the trials.
        options: the task's constants.
        collector: where the trials run.
        successful: leave out episodes without success.
        progress: called with each episode that was run and whether it is kept.
    """
    expert = expert_policy(limits_of(options))
    policy = InteractivePolicy(expert, None, BetaGate())
    create = partial(create_env, tuple(objects), options, state_of(policy))
    waiting: dict[int, Episode] = {}
    following = 0
    try:
        with Workers(create, policy, collector, options.horizon) as workers:
            for episode in workers.run([item.trial for item in scheduled], [*KEYS, *OUTCOME]):
                waiting[episode.index] = episode
                while following in waiting:
                    done, item = waiting.pop(following), scheduled[following]
                    kept = done.frames is not None and (not successful or bool(done.frames["next", "success"][-1]))
                    if kept and done.frames is not None:
                        buffer.extend(done.frames.select(*KEYS), episode_info(item.trial, item.category, done.frames))
                    following += 1
                    if following % COMMIT_EVERY == 0:
                        buffer.commit()
                    progress(done, kept)
    finally:
        buffer.commit()


def recipe(options: EnvOptions, assets: Assets) -> dict[str, Any]:
    """What a buffer stores in ``about`` so that its episodes can be run again, here and by ManiSkill's own tools."""
    from fb3d_rl.env.task import TASK

    env_info = {
        "env_id": TASK,
        "max_episode_steps": options.horizon,
        "env_kwargs": {"obs_mode": "pointcloud", "num_envs": 1},
    }
    return {"env": asdict(options), "assets": asdict(assets), "env_info": env_info, "control_mode": "velocity"}


def recorded_options(buffer: DemonstrationBuffer) -> EnvOptions:
    """The task's constants that a buffer was recorded with.

    Raises:
        UserError: they are unknown, or from another version.
    """
    try:
        return EnvOptions.of(buffer.about["env"])
    except (KeyError, TypeError, AttributeError, UserError) as error:
        raise UserError(f"{buffer.path} does not say how it was recorded, so it cannot be run again") from error


def recorded_object(buffer: DemonstrationBuffer, episode: int, root: str | None = None) -> ArticulatedObject:
    """The object of an episode: from below ``root`` if given, else from where it was recorded from.

    Raises:
        UserError: it is not there, or it is unknown where it was.
    """
    name = buffer.episodes[episode].object
    try:
        known: Mapping[str, Any] = buffer.about["assets"]
        assets = Assets(**{**known, "categories": tuple(known["categories"])})
    except (KeyError, TypeError) as error:
        if root is None:
            raise UserError(
                f"{buffer.path} does not say where its objects are; give their folder: --root DIR"
            ) from error
        assets = Assets()
    if root is not None or assets.root is not None:
        assets = replace(assets, root=root or assets.root, split=name)
    for obj, _ in assets.load():
        if obj.id == name:
            return obj
    raise UserError(f"object {name} is not among the objects that {buffer.path} was recorded with")


class Replay(TensorDictModuleBase):
    """The policy that takes given actions without regard to what it observes.

    Args:
        actions: [T, 8], one for each control step; the last one also for any further step.
    """

    def __init__(self, actions: Tensor) -> None:
        super().__init__()
        self.in_keys, self.out_keys = ["elapsed_steps"], ["action"]
        self.register_buffer("actions", actions)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write "action" [E, 8]."""
        step = tensordict["elapsed_steps"].squeeze(-1).long().clamp(max=len(self.actions) - 1)
        tensordict["action"] = self.actions[step]
        return tensordict


def replay(buffer: DemonstrationBuffer, episode: int, obj: ArticulatedObject) -> tuple[Film, bool]:
    """Run an episode's recorded actions again, from its start.

    Returns:
        The film, and whether the observed points and the tip's positions equal the recorded ones bit for bit.

    Raises:
        UserError: the trial or the task's constants are unknown, or steps are missing.
    """
    info, frames = buffer.episodes[episode], buffer.frames(episode)
    if not torch.equal(frames["elapsed_steps"].flatten().long(), torch.arange(len(frames))):
        raise UserError(
            f"episode {episode} cannot be run again: only steps in which suction held a part were kept of it"
        )
    options = replace(recorded_options(buffer), horizon=info.rows)
    film = record(f"episode {episode}", Replay(frames["action"]), obj, trial_of(info), options)
    acts = frames["expert", "acts"].flatten()
    if not bool(acts.all()):
        film = replace(film, expert_acts=acts.numpy())
    seen = torch.from_numpy(film.points[:-1]), torch.from_numpy(film.tips[:-1])
    kept = frames["observation", "points"], frames["observation", "tool_pose"][:, :3]
    return film, all(torch.equal(a, b) for a, b in zip(seen, kept, strict=True))
