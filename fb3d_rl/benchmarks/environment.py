"""Speed of the environment, as ratios measured in one run on the same work: they vary less between machines."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import cycle
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

import psutil
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.assets.partnet_mobility import load_objects
from fb3d_rl.camera.raycast import CameraOptions
from fb3d_rl.camera.views import View
from fb3d_rl.contract import Key
from fb3d_rl.env.options import EnvOptions, Trial, default_trial
from fb3d_rl.env.torchrl_env import make_env
from fb3d_rl.policies.flow_policy import FlowPolicy, expert_policy
from fb3d_rl.policies.interaction import BetaGate, InteractivePolicy
from fb3d_rl.rollout.collectors import CollectorOptions, Workers
from fb3d_rl.rollout.rows import TrialRow
from fb3d_rl.rollout.run import create_env, limits_of, policy_env, run_trials, state_of
from fb3d_rl.rollout.trials import Scheduled
from fb3d_rl.scene.posed import Posed

Progress = Callable[[str], None]


@dataclass(frozen=True)
class Episode:
    """A trial and the actions [T, 8] that the expert took in it: work that is the same for all that are compared."""

    trial: Trial
    actions: Tensor


@contextmanager
def one_core() -> Iterator[None]:
    """Keep this process on one core, with one thread for PyTorch."""
    threads, cores = torch.get_num_threads(), os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else None
    torch.set_num_threads(1)
    if cores:
        os.sched_setaffinity(0, {min(cores)})
    try:
        yield
    finally:
        torch.set_num_threads(threads)
        if cores:
            os.sched_setaffinity(0, cores)


def expert_episodes(objects: Sequence[ArticulatedObject], options: EnvOptions) -> list[Episode]:
    """One episode of the expert with each object; the seeds of their trials are 0, 1, ..."""
    expert = _expert(options)
    episodes = []
    for seed, obj in enumerate(objects):
        trial = default_trial(obj, seed=seed)
        env = policy_env(make_env([obj], options, [trial]), state_of(expert))
        with torch.no_grad():
            frames = env.rollout(options.horizon, expert)
        episodes.append(Episode(trial, frames["action"].reshape(-1, frames["action"].shape[-1])))
        env.close()
    return episodes


def step_rates(
    objects: Sequence[ArticulatedObject], options: EnvOptions, rounds: int, progress: Progress
) -> dict[str, Any]:
    """Control steps per second with the expert's actions: no observation, our clouds, ManiSkill's own clouds.

    Ours run on one core through TorchRL; ManiSkill's renderer may use all cores, and is driven without TorchRL. The
    kinds take turns in each round, and ratios are medians over rounds.
    """
    episodes = expert_episodes(objects, options)
    steps = sum(len(episode.actions) for episode in episodes)
    trials = [episode.trial for episode in episodes]
    ours = {mode: make_env(objects, options, cycle(trials), obs_mode=mode) for mode in ("none", "pointcloud")}
    stock, reason = _stock_env(objects, options)

    def through_torchrl(mode: str) -> float:
        env, spent = ours[mode], 0.0
        for episode in episodes:
            td = env.reset()
            start = time.perf_counter()
            for action in episode.actions:
                td["action"] = action[None]
                td = env.step(td)["next"]
            spent += time.perf_counter() - start
        return spent

    def through_maniskill() -> float:
        spent = 0.0
        for episode in episodes:
            stock.reset(options={"trials": [episode.trial]})
            start = time.perf_counter()
            for action in episode.actions:
                stock.step(action[None])
            spent += time.perf_counter() - start
        return spent

    seconds: dict[str, list[float]] = {"none": [], "pointcloud": [], "maniskill": []}
    for i in range(rounds):
        progress(f"control steps, round {i + 1} of {rounds}")
        with one_core():
            for mode in ours:
                seconds[mode].append(through_torchrl(mode))
        if stock is not None:
            seconds["maniskill"].append(through_maniskill())
    for env in ours.values():
        env.close()
    result: dict[str, Any] = {
        "objects": [obj.id for obj in objects],
        "steps": steps,
        "rounds": rounds,
        "no observation, steps/s": steps / min(seconds["none"]),
        "point cloud, steps/s": steps / min(seconds["pointcloud"]),
        "point cloud / no observation": median(_ratios(seconds["none"], seconds["pointcloud"])),
    }
    if stock is None:
        return result | {"ManiSkill's point cloud": f"not measured: {reason}"}
    stock.close()
    return result | {
        "ManiSkill's point cloud, steps/s": steps / min(seconds["maniskill"]),
        "point cloud / ManiSkill's": median(_ratios(seconds["maniskill"], seconds["pointcloud"])),
    }


def _ratios(over: Sequence[float], under: Sequence[float]) -> list[float]:
    """Round by round."""
    return [a / b for a, b in zip(over, under, strict=True)]


def _expert(options: EnvOptions) -> FlowPolicy:
    return expert_policy(limits_of(options))


def _stock_env(objects: Sequence[ArticulatedObject], options: EnvOptions) -> tuple[Any, str]:
    """The same task observed by ManiSkill's point cloud, or None and why it cannot run here."""
    from fb3d_rl.env.stock import StockCloudEnv
    from fb3d_rl.errors import UserError

    try:
        return StockCloudEnv(objects, options), ""
    except UserError as error:
        return None, str(error)


class Replay(TensorDictModuleBase):
    """Repeats recorded actions: a learner without cost that follows the recording.

    Args:
        actions: those of the trial with seed i [T, 8], for every i.
    """

    def __init__(self, actions: Sequence[Tensor]) -> None:
        super().__init__()
        self.actions = actions
        self.in_keys: list[Key] = ["seed", "elapsed_steps"]
        self.out_keys: list[Key] = ["action"]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action [E, 8]."""
        seeds, steps = tensordict["seed"].flatten().tolist(), tensordict["elapsed_steps"].flatten().tolist()
        tensordict["action"] = torch.stack([self.actions[i][t] for i, t in zip(seeds, steps, strict=True)])
        return tensordict


def labelling(
    objects: Sequence[ArticulatedObject], options: EnvOptions, rounds: int, progress: Progress
) -> dict[str, Any]:
    """Rows per second that a learner collects by itself, and where the expert labels each of them as DAgger does.

    The learner replays the expert's actions, so that both visit the same states. It takes no time of its own: with a
    real one the ratio is closer to 1. One core, through TorchRL's collector; the two take turns in each round, and
    the ratio is a median over rounds. Objects are loaded before.
    """
    episodes = expert_episodes(objects, options)
    steps = sum(len(episode.actions) for episode in episodes)
    trials = [episode.trial for episode in episodes]
    learner = Replay([episode.actions for episode in episodes])
    policies = {"alone": learner, "labelled": InteractivePolicy(_expert(options), learner, BetaGate(0.0))}
    keys: dict[str, list[Key]] = {"alone": ["observation"], "labelled": ["observation", ("expert", "action")]}
    seconds: dict[str, list[float]] = {name: [] for name in policies}
    with one_core(), ExitStack() as stack:
        workers = {
            name: stack.enter_context(
                Workers(
                    partial(create_env, objects, options, state_of(policy)), policy, CollectorOptions(), options.horizon
                )
            )
            for name, policy in policies.items()
        }
        for i in range(rounds + 1):
            progress(f"labelling, round {i} of {rounds}")
            for name in policies:
                start = time.perf_counter()
                found = list(workers[name].run(trials, keys[name]))
                seconds[name].append(time.perf_counter() - start)
                if [len(e.frames if e.frames is not None else ()) for e in found] != [len(e.actions) for e in episodes]:
                    raise RuntimeError("the episodes are not those that were recorded")
    alone, labelled = (spent[1:] for spent in seconds.values())  # without the round that loads the objects
    return {
        "objects": [obj.id for obj in objects],
        "rows": steps,
        "rounds": rounds,
        "learner alone, rows/s": steps / min(alone),
        "labelled by the expert, rows/s": steps / min(labelled),
        "labelled / alone": median(_ratios(alone, labelled)),
    }


def worker_scaling(
    objects: Sequence[ArticulatedObject],
    scheduled: Sequence[Scheduled],
    options: EnvOptions,
    rounds: int,
    progress: Progress,
) -> dict[str, Any]:
    """Trials of the expert per second with one worker process and with two, start-up left out."""
    expert = _expert(options)
    rates: dict[int, list[float]] = {1: [], 2: []}
    for i in range(rounds):
        for workers, found in rates.items():
            progress(f"{workers} worker{'s' * (workers > 1)}, round {i + 1} of {rounds}")
            found.append(_trials_per_second(expert, objects, scheduled, options, workers))
    return {
        "trials": len(scheduled),
        "one worker, trials/s": max(rates[1]),
        "two workers, trials/s": max(rates[2]),
        "two workers / one": median(_ratios(rates[2], rates[1])),
    }


def _trials_per_second(
    policy: TensorDictModuleBase,
    objects: Sequence[ArticulatedObject],
    scheduled: Sequence[Scheduled],
    options: EnvOptions,
    workers: int,
) -> float:
    ends: list[float] = []

    def finished(row: TrialRow) -> None:
        ends.append(time.perf_counter())

    collector = CollectorOptions(backend="process", workers=workers)
    run_trials("policy", policy, objects, scheduled, options, finished, collector)
    # From the first row on: what comes before is the start of the workers.
    return (len(ends) - 1) / (ends[-1] - ends[0])


def reading(folders: Sequence[Path], progress: Progress) -> dict[str, Any]:
    """Seconds to read objects' folders, without a cache and with one, and for the first cloud of each of them.

    The trees that rays are cast in are built then: Embree offers no way to keep them on disk.
    """
    seconds = []
    with TemporaryDirectory() as empty:
        usual, os.environ["FB3D_CACHE"] = os.environ.get("FB3D_CACHE", ""), empty
        try:
            for turn in ("first", "second", "third"):
                progress(f"{turn} read of {len(folders)} objects")
                start = time.perf_counter()
                objects, _ = load_objects(folders)
                seconds.append(time.perf_counter() - start)
        finally:
            os.environ["FB3D_CACHE"] = usual
    progress(f"first look at {len(objects)} objects")
    start = time.perf_counter()
    for obj in objects:
        posed = Posed(obj, CameraOptions(resolution=8))
        posed.camera.capture(posed.poses(posed.closed), View(azimuth=30.0, elevation=30.0))
    return {
        "objects": len(objects),
        "first read, s": seconds[0],
        "read again, s": min(seconds[1:]),
        "first look, trees for rays included, s": time.perf_counter() - start,
        "read again / first": min(seconds[1:]) / seconds[0],
    }


def loading(objects: Sequence[ArticulatedObject], options: EnvOptions, progress: Progress) -> dict[str, Any]:
    """Time that a reset to an object takes, the first time and again, with all the others in between."""
    env = make_env(objects, options, cycle([default_trial(obj) for obj in objects]))
    times: list[list[float]] = []
    with one_core():
        for turn in ("first", "second", "third"):
            progress(f"{turn} load of {len(objects)} objects")
            times.append([])
            for _ in objects:
                start = time.perf_counter()
                env.reset()
                times[-1].append(1e3 * (time.perf_counter() - start))
    env.close()
    again = [min(pair) for pair in zip(*times[1:], strict=True)]
    return {
        "objects": len(objects),
        "first load, ms": sum(times[0]) / len(objects),
        "load again, ms": sum(again) / len(objects),
        "load again, slowest object, ms": max(again),
        "load again / first": sum(again) / sum(times[0]),
    }


def soak(
    objects: Sequence[ArticulatedObject], options: EnvOptions, steps: int, seed: int, progress: Progress
) -> dict[str, Any]:
    """Random actions over many objects, each visited twice: crashes, NaNs, growth of memory.

    Memory is compared between the ends of the two visits: in the first one every object is prepared and kept.
    """
    env = make_env(objects, options, cycle([default_trial(obj) for obj in objects]))
    generator = torch.Generator().manual_seed(seed)
    process, resident = psutil.Process(), []
    per_visit, done, broken = max(1, steps // (2 * len(objects))), 0, 0
    for visit in (1, 2):
        for i in range(len(objects)):
            progress(f"random actions, visit {visit} of object {i + 1} of {len(objects)}")
            td = env.reset()
            for _ in range(per_visit):
                td["action"] = 2 * torch.rand(1, 8, generator=generator) - 1
                td = env.step(td)["next"]
                broken += sum(not bool(v.isfinite().all()) for v in td.flatten_keys().values() if v.is_floating_point())
                done += 1
        resident.append(process.memory_info().rss)
    env.close()
    return {
        "objects": len(objects),
        "steps": done,
        "entries that are not finite": broken,
        "memory, MB": resident[1] / 1e6,
        "memory after / before": resident[1] / resident[0],
    }
