"""algo=bc and algo=dagger on any task of ManiSkill, with any expert: env.task and expert.target.

The same rounds, beta, labels, heads and fit as where parts are opened (:mod:`fb3d_rl.algos.dagger`); trials are seeds
of the task, and success is what the task says.
"""

from __future__ import annotations

import csv
import json
import shutil
import time
from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase

from fb3d_rl.algos import setup
from fb3d_rl.algos.collection import expert_share, kept_buffer
from fb3d_rl.algos.dagger import Progression
from fb3d_rl.algos.learners import NOISE, Labels, drawn_rows
from fb3d_rl.algos.rounds import BUFFER, fit_options, round_beta, share
from fb3d_rl.algos.weights import CHECKPOINT, state_before
from fb3d_rl.camera.views import View
from fb3d_rl.data.demonstrations import DemonstrationBuffer, EpisodeInfo, recorded
from fb3d_rl.env.any_task import make_task
from fb3d_rl.errors import UserError
from fb3d_rl.files import replacing, write_text
from fb3d_rl.options import content
from fb3d_rl.policies.interaction import BetaGate
from fb3d_rl.policies.learner import history_of
from fb3d_rl.policies.options import LearnerOptions
from fb3d_rl.policies.task_learner import POINTS, STATE, VALID, TaskExpert, TaskInteraction, TaskLearner
from fb3d_rl.rollout.collectors import Workers
from fb3d_rl.rollout.run import policy_env, state_of
from fb3d_rl.training.checkpoint import fitting, load_checkpoint, save_checkpoint
from fb3d_rl.training.draws import generator, global_draws
from fb3d_rl.training.fit import fit
from fb3d_rl.training.objective import Objective
from fb3d_rl.training.options import FitOptions
from fb3d_rl.training.run_log import RunLog, open_logger
from fb3d_rl.training.state import check_state

if TYPE_CHECKING:
    from fb3d_rl.algos.options import ImitationOptions
    from fb3d_rl.config import TrainConfig

EVALUATED = 50
"""Episodes of the evaluation where evaluation.trials is null."""

KEYS = (STATE, POINTS, VALID, "action", ("expert", "action"), ("expert", "acts"), "elapsed_steps", "seed",
        ("next", "success"))  # fmt: skip


def train_on_task(cfg: TrainConfig, out: Path) -> dict[str, Any]:
    """Train and evaluate; write buffer/, metrics.jsonl, the checkpoint, episodes.csv and summary.json.

    Returns:
        What is in summary.json.

    Raises:
        UserError: task or expert cannot be used.
    """
    setup.require_simulator(otherwise="train where it is installed")
    run = TaskRun(cfg, out)
    run.train()
    rows = [run.buffer.frames(i) for i in range(len(run.buffer.episodes))]
    known = setup.facts(cfg)
    del known["assets"]
    facts = known | {"task": cfg.env.task, "labels": len(run.buffer), "expert_share": expert_share(rows)}
    return _evaluate(cfg, out, run.make, {"expert": TaskExpert(), run.algo.name: run.learner}, facts)


class TaskRun:
    """A run on a task of ManiSkill; with ``resume`` it goes on from its checkpoint.

    Args:
        cfg: the configuration.
        out: the run folder.

    Raises:
        UserError: task or expert cannot be used, or checkpoint and buffer do not fit; raised before any work.
    """

    def __init__(self, cfg: TrainConfig, out: Path) -> None:
        self.cfg, self.out, self.algo = cfg, out, cast("ImitationOptions", cfg.algo)
        env = cfg.env
        assert env.task is not None and cfg.expert.target is not None
        self.task = env.task
        self.make = partial(
            make_task, env.task, cfg.expert.target, str(Path.cwd()), env.sees, cfg.data.points, dict(env.task_options)
        )
        first = self.make()  # what cannot be is said before any work
        self.sizes = (first.observation_spec[STATE].shape[-1], first.action_spec.shape[-1], env.sees == "points")
        first.close()
        self.learner = TaskLearner(self.algo.learner, *self.sizes, torch.Generator().manual_seed(cfg.seed)).eval()
        self.gate = BetaGate(per_step=self.algo.beta.mixing == "step")
        self.device = setup.choose_device(cfg.device)
        saved = state_before(cfg, out)
        self.resumed = saved is not None
        if saved is None:
            self.done = Progression()
            if cfg.resume:
                shutil.rmtree(out / BUFFER, ignore_errors=True)
            about = {"task": env.task, "control_mode": None}
            self.buffer = DemonstrationBuffer.create(out / BUFFER, cfg.data.labels, about)
            self.save()
            return
        with fitting(out / CHECKPOINT):
            self.done = Progression(**saved["state"]["run"])
            self.learner.network.load_state_dict(self.done.learner)
            if self.done.fit is not None:
                check_state(self.learner.network, self.options(self.done.round), self.done.fit)
        self.buffer = kept_buffer(out / BUFFER, self.done.rows)

    def options(self, number: int) -> FitOptions:
        """How the learner is fitted in a round."""
        return fit_options(self.algo, self.cfg.data.labels, self.cfg.seed, number)

    def save(self) -> None:
        """Write the checkpoint."""
        done, weights = self.done, self.learner.network.state_dict()
        if done.fit is None:
            done.learner = {key: value.clone() for key, value in weights.items()}
        save_checkpoint(
            self.out / CHECKPOINT, algo=self.algo.name, config=content(self.cfg), seed=self.cfg.seed,
            model_kwargs={"options": asdict(self.algo.learner), "sizes": list(self.sizes), "task": self.task},
            state={"model": weights, "step": done.round, "run": done.as_dict()},
        )  # fmt: skip

    def train(self) -> None:
        """Run the rounds that are left."""
        cfg, algo, done = self.cfg, self.algo, self.done
        both = TaskInteraction(cast(Any, TaskExpert()), self.learner, self.gate)
        create, options = partial(_env, self.make, state_of(both)), setup.collector_options(cfg)
        kept = done.log_rows if self.resumed else None
        with RunLog(
            self.out, resume_rows=kept, logger=open_logger(cfg.logger.name, cfg.logger.project, self.out)
        ) as log:
            with Workers(create, both, options, cfg.env.horizon) as workers:
                while done.round < algo.rounds:
                    number = done.round
                    if done.collected == number:
                        self.gate.beta.fill_(round_beta(algo, number))
                        workers.update_policy_weights_()
                        labels = share(cfg.data.labels, algo.rounds, number)
                        done.numbers = _collect(workers, self.buffer, self.learner, algo, labels, number, cfg.seed,
                                                self.task)  # fmt: skip
                        done.rows, done.collected = len(self.buffer), number + 1
                        self.save()
                    self.fit(number, log)
                    steps = sum(self.options(i).steps for i in range(number + 1))
                    log.write({"step": steps, "round": number, "labels": len(self.buffer),
                               "beta": round_beta(algo, number), **done.numbers})  # fmt: skip
                    done.round, done.fit, done.numbers, done.log_rows = number + 1, None, {}, log.rows
                    self.save()

    def fit(self, number: int, log: RunLog) -> None:
        """Fit the learner to the labels of the rounds so far; checkpoints are saved meanwhile."""
        algo, done, network, options = self.algo, self.done, self.learner.network, self.options(number)
        before = sum(self.options(i).steps for i in range(number))

        def checkpoint(state: dict[str, Any]) -> None:
            done.fit, done.log_rows = state, log.rows
            self.save()

        if number == 0:
            rows = [self.buffer.frames(i) for i in range(len(self.buffer.episodes))]
            network.measure(*(torch.cat([row[key] for row in rows]) for key in (STATE, ("expert", "twist"))))
        labels = Labels(self.buffer, algo.learner.chunk, drawn_rows(self.buffer, algo.sampling, number))
        fit(network.to(self.device), labels, options, objective=objective(self.learner, algo, options.seed),
            device=self.device, title=f"round {number + 1} of {algo.rounds}: fit", on_checkpoint=checkpoint,
            resume=done.fit, log=lambda row: log.write({**row, "step": before + row["step"], "round": number}),
            )  # fmt: skip
        network.to("cpu")


def load_learner(path: str | Path) -> TaskLearner:
    """The learner of a checkpoint that :func:`train_on_task` wrote.

    Raises:
        UserError: it is another file.
    """
    saved = load_checkpoint(path)
    with fitting(Path(path)):
        kwargs = saved["model_kwargs"]
        learner = TaskLearner(LearnerOptions(**kwargs["options"]), *kwargs["sizes"])
        learner.network.load_state_dict(saved["state"]["model"])
    return learner.eval()


def objective(learner: TaskLearner, algo: ImitationOptions, seed: int) -> Objective:
    """The loss of the learner's head on rows [B] of :class:`~fb3d_rl.algos.learners.Labels`."""
    loss = learner.network.loss(algo.loss, algo.kl_weight)

    def value(rows: TensorDictBase, step: int) -> Tensor:
        pad = rows["is_pad"]
        batch = {
            "encoded": learner.encoded(rows),
            "twist": rows["twist"].masked_fill(pad[..., None], 0.0),
            "is_pad": pad,
        }
        with global_draws(generator(seed, NOISE, step), pad.device):
            return loss(TensorDict(batch, batch_size=rows.batch_size))

    return value


def _env(make: partial[EnvBase], state: TensorDict) -> EnvBase:
    return policy_env(make(), state)


def _collect(
    workers: Workers,
    buffer: DemonstrationBuffer,
    learner: TaskLearner,
    algo: ImitationOptions,
    labels: int,
    number: int,
    seed: int,
    task: str,
) -> dict[str, float]:
    """Add ``labels`` labels of a round to the buffer; the last episode is cut to fit. Returns numbers for the log."""
    rng, started = np.random.default_rng([seed, 5, number]), time.perf_counter()
    missing, ended, kept = labels, [], []
    while missing:
        # As many episodes as long ones would need: the rows do not depend on the number of workers.
        seeds = rng.integers(2**31, size=max(1, missing // 50)).tolist()
        found = {episode.index: episode for episode in workers.run(seeds, KEYS)}
        if all(episode.frames is None for episode in found.values()):
            raise UserError(f"env.task={task}: every episode crashed, the last one with: {found[0].error}")
        for index, one in enumerate(seeds):
            frames = found[index].frames
            if frames is None or not missing:
                continue
            success = bool(frames["next", "success"].any())
            ended.append(success)
            info = EpisodeInfo(
                task, task, -1, (), View(0.0, 0.0), one, number, success, float(not success), len(frames)
            )
            rows = frames.exclude("next")
            rows["expert", "twist"] = rows["expert", "action"]
            if learner.options.history:
                rows["learner", "felt"] = history_of(rows[STATE], learner.options.history)
            rows = recorded(rows[:missing], info, round_beta(algo, number), number)
            buffer.extend(rows, info)
            kept.append(rows)
            missing -= len(rows)
    buffer.commit()
    return {
        "collect/success_rate": float(np.mean(ended)),
        "collect/expert_share": expert_share(kept),
        "collect/episodes": len(ended),
        "time/collect_seconds": time.perf_counter() - started,
    }


def _evaluate(
    cfg: TrainConfig,
    out: Path,
    make: partial[EnvBase],
    policies: dict[str, TensorDictModuleBase],
    facts: dict[str, Any],
) -> dict[str, Any]:
    """Run the same seeds with each policy; write episodes.csv and summary.json."""
    count = EVALUATED if cfg.evaluation.trials is None else cfg.evaluation.trials
    seeds: Sequence[int] = np.random.default_rng([cfg.seed, 10]).integers(2**31, size=count).tolist()
    rows: list[dict[str, Any]] = []
    for name, policy in policies.items():
        create = partial(_env, make, state_of(policy))
        with Workers(create, policy, setup.collector_options(cfg), cfg.env.horizon) as workers:
            for episode in sorted(workers.run(seeds, KEYS), key=lambda episode: episode.index):
                frames = episode.frames
                success = frames is not None and bool(frames["next", "success"].any())
                rows.append({"policy": name, "trial": episode.index, "seed": seeds[episode.index], "success": success,
                             "steps": 0 if frames is None else len(frames), "error": episode.error})  # fmt: skip
    with replacing(out / "episodes.csv") as part, part.open("w", newline="") as file:
        table = csv.DictWriter(file, ["policy", "trial", "seed", "success", "steps", "error"])
        table.writeheader()
        table.writerows(rows)
    for name in policies:
        won = [row["success"] for row in rows if row["policy"] == name]
        facts[f"{name}/success_rate"] = float(np.mean(won)) if won else None
        print(f"{name}: {sum(won)} of {len(won)} episodes of {cfg.env.task} end with success")
    write_text(out / "summary.json", json.dumps(facts, indent=1) + "\n")
    print(f"results: {out}")
    return facts
