"""algo=bc and algo=dagger: in each round expert and learner act, the expert labels every step, the learner is fitted.

Behaviour cloning is the case of one round in which the expert always acts.
"""

from __future__ import annotations

import shutil
import time
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field, fields
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from fb3d_rl.algos import setup
from fb3d_rl.algos.algorithm import Acting
from fb3d_rl.algos.collection import (
    Round,
    RowsOptions,
    collect,
    copy_demonstrations,
    expert_share,
    kept_buffer,
    relabelled,
)
from fb3d_rl.algos.learners import (
    acting_policy,
    flow_network,
    learner_options,
    networks,
    new_gate,
    new_learner,
    policy_name,
)
from fb3d_rl.algos.rounds import (
    BUFFER,
    assist,
    first_learner,
    fit_options,
    fit_round,
    round_beta,
    round_steps,
    share,
)
from fb3d_rl.algos.weights import CHECKPOINT, state_before, weights_file
from fb3d_rl.contract import Key
from fb3d_rl.data.demonstrations import DemonstrationBuffer
from fb3d_rl.errors import UserError
from fb3d_rl.evaluation.evaluate import evaluate, progress_bars
from fb3d_rl.models.artflownet import ArtFlowNet
from fb3d_rl.options import content
from fb3d_rl.policies.flow_policy import expert_policy
from fb3d_rl.policies.hand import VelocityLimits
from fb3d_rl.policies.interaction import BetaGate, Gate, InteractivePolicy
from fb3d_rl.policies.learner import FLOW_KEYS
from fb3d_rl.policies.options import FlowPolicyOptions, LearnerOptions
from fb3d_rl.registry import REGISTRY
from fb3d_rl.rollout.collectors import Workers
from fb3d_rl.rollout.demonstrations import Assets, recipe
from fb3d_rl.rollout.rows import TrialRow
from fb3d_rl.rollout.run import create_env, run_trials, state_of
from fb3d_rl.rollout.trials import schedule
from fb3d_rl.scene.posed import Posed
from fb3d_rl.training.checkpoint import fitting, load_checkpoint, save_checkpoint
from fb3d_rl.training.processes import equal_share, rank_and_count, wait_for_all
from fb3d_rl.training.run_log import RunLog, open_logger
from fb3d_rl.training.state import check_state

if TYPE_CHECKING:
    from fb3d_rl.algos.options import ImitationOptions
    from fb3d_rl.config import TrainConfig


@dataclass
class Progression:
    """State of a run; with the rows on disk it is all that a resumed run needs.

    Attributes:
        round: the current round.
        collected: number of rounds whose rows are in the buffer.
        rows: number of rows of these rounds.
        log_rows: number of lines written to metrics.jsonl.
        numbers: the collection's numbers of this round.
        fit: state of this round's fit, once it has begun.
        learner: the weights; during a fit those from before it.
        gate: the gate's thresholds.
    """

    round: int = 0
    collected: int = 0
    rows: int = 0
    log_rows: int = 0
    numbers: dict[str, float] = field(default_factory=dict)
    fit: dict[str, Any] | None = None
    learner: dict[str, Tensor] = field(default_factory=dict)
    gate: dict[str, Tensor] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """The entries by name; tensors are not copied."""
        return {item.name: getattr(self, item.name) for item in fields(self)}


class Run:
    """A run of algo=bc or algo=dagger.

    Args:
        cfg: the configuration.
        out: the run folder.

    Raises:
        UserError: the configuration cannot be run; raised before any work.
    """

    def __init__(self, cfg: TrainConfig, out: Path) -> None:
        self.cfg, self.out, self.algo = cfg, out, cast("ImitationOptions", cfg.algo)
        algo = self.algo
        self.protocol = setup.protocol(cfg, cfg.resume)
        setup.require_simulator()
        self.limits = setup.velocity_limits(cfg)
        saved = state_before(cfg, out)
        self.resumed = saved is not None
        given = DemonstrationBuffer.open(algo.demonstrations) if algo.demonstrations else None
        self.given = len(given.episodes) if given else 0
        self.logger = open_logger(cfg.logger.name, cfg.logger.project, out)

        self.expert = expert_policy(self.limits, setup.flow_policy_options(cfg))
        equal_share(algo.batch_size)
        self.learner = first_learner(cfg)
        self.policy = InteractivePolicy(self.expert, self.learner, new_gate(algo))
        self.rows = rows_options(algo, self.limits, self.policy.gate)
        entries = setup.train_entries(cfg.assets, out, cfg.seed)
        self.entries = entries.train
        self.objects, self.tested = [entry.load() for entry in entries.train], setup.load(entries.held_out)
        self.views = [Posed(obj, self.protocol.samples.camera) for obj in self.objects]
        limit = algo.validate_trials
        self.validated = setup.load(entries.validation)
        if limit and not self.validated:
            raise UserError(
                f"algo.validate_trials={limit} needs validation objects; give a larger assets.validation_share"
            )
        self.validation = schedule(self.validated, self.protocol.samples, cfg.seed, limit)[0] if limit else []
        if saved is None:
            self.done = Progression()
            self.buffer = self.new_buffer(given)
            self.save()
        else:
            self.done = self.restored(saved["state"]["run"])
            self.buffer = kept_buffer(out / BUFFER, self.done.rows)

    def new_buffer(self, given: DemonstrationBuffer | None) -> DemonstrationBuffer:
        """A buffer for the run's labels that starts with the given demonstrations."""
        if self.cfg.resume:
            shutil.rmtree(self.out / BUFFER, ignore_errors=True)
        rows = self.cfg.data.labels + (len(given) if given else 0)
        root = self.cfg.assets.root if self.cfg.assets.source == "partnet_mobility" else str(self.out / "objects")
        about = recipe(self.protocol.env, Assets(root=root))
        buffer = DemonstrationBuffer.create(self.out / BUFFER, rows, about)
        if given is not None:
            copy_demonstrations(given, buffer, self.rows)
        buffer.commit()
        self.done.rows = len(buffer)
        return buffer

    def restored(self, state: dict[str, Any]) -> Progression:
        """The saved state; learner and gate get their saved weights."""
        with fitting(self.out / CHECKPOINT):
            done = Progression(**state)
            networks(self.learner).load_state_dict(done.learner)
            self.policy.gate.load_state_dict(done.gate)
            if done.fit is not None:
                options = fit_options(self.algo, self.cfg.data.labels, self.cfg.seed, done.round)
                check_state(networks(self.learner), options, done.fit)
        return done

    def save(self) -> None:
        """Write the checkpoint."""
        done, weights, flow_net = self.done, networks(self.learner).state_dict(), flow_network(self.learner)
        if done.fit is None:
            done.learner = {key: value.clone() for key, value in weights.items()}
        done.gate = self.policy.gate.state_dict()
        state = {
            "run": done.as_dict(),
            "model": weights,
            "flow_model": None if flow_net is None else flow_net.state_dict(),
            "step": done.round,
        }
        kwargs = {
            "options": asdict(learner_options(self.algo)),
            "members": self.algo.members,
            "limits": asdict(self.limits),
            "oracle": self.algo.oracle,
            "name": policy_name(self.algo),
            "flow_net": None if flow_net is None else flow_net.arguments,
        }
        save_checkpoint(self.out / CHECKPOINT, algo=self.algo.name, config=content(self.cfg), model_kwargs=kwargs,
                        state=state, seed=self.cfg.seed)  # fmt: skip

    def train(self) -> None:
        """Run the rounds that are left."""
        done, algo = self.done, self.algo
        create = partial(create_env, tuple(self.objects), self.protocol.env, state_of(self.policy))
        options = setup.collector_options(self.cfg, spare=int(algo.overlap))  # a core for the fit
        horizon = self.protocol.env.horizon
        with ExitStack() as stack:
            kept = done.log_rows if self.resumed else None
            log = stack.enter_context(RunLog(self.out, resume_rows=kept, logger=self.logger))
            bar = stack.enter_context(progress_bars())
            workers = stack.enter_context(Workers(create, self.policy, options, horizon))
            beside = stack.enter_context(ThreadPoolExecutor(1)) if algo.overlap else None
            pending: Future[Round] | None = None

            def begin(number: int) -> partial[Round]:
                """Prepare a round's collection, which may run in another thread."""
                self.set_gate(number)
                workers.update_policy_weights_()
                labels = share(self.cfg.data.labels, algo.rounds, number)
                task = bar.add_task(f"round {number + 1} of {algo.rounds}: labels", total=labels)
                rng = np.random.default_rng([self.cfg.seed, 5, number])
                advance = partial(bar.update, task)
                version = max(0, number - 1) if algo.overlap else number
                return partial(collect, workers, self.views, self.protocol.samples, self.rows, number,
                               round_beta(algo, number), version, labels, rng,
                               lambda count: advance(completed=count))  # fmt: skip

            while done.round < algo.rounds:
                number = done.round
                if done.collected == number:
                    started = time.perf_counter()
                    collected = pending.result() if pending else begin(number)()
                    waited = time.perf_counter() - started
                    pending = None
                    for frames, info in collected.episodes:
                        self.buffer.extend(frames, info)
                    self.buffer.commit()
                    done.rows, done.collected = len(self.buffer), number + 1
                    done.numbers = collected.numbers | {"time/waited_for_labels": waited}
                    if beside is not None and number + 1 < algo.rounds:  # how long no environment ran
                        done.numbers["time/waited_for_training"] = time.perf_counter() - collected.ended
                    self.save()
                if beside is not None and number + 1 < algo.rounds:
                    # The next round is collected while this one is fitted, with the weights from before the fit.
                    pending = beside.submit(begin(number + 1))
                self.fit(number, log)
                numbers = self.validate()
                log.write({"step": self.steps_before(number + 1), "round": number, "labels": self.labels,
                           "beta": round_beta(algo, number), **done.numbers, **numbers})  # fmt: skip
                done.round, done.fit, done.numbers, done.log_rows = number + 1, None, {}, log.rows
                self.save()

    def set_gate(self, number: int) -> None:
        """Set how the gate decides who acts in a round."""
        for gate in self.policy.gate.modules():
            if isinstance(gate, BetaGate):
                gate.beta.fill_(round_beta(self.algo, number))
        if self.algo.gate.budget is not None and number > 0:
            last = [i for i, info in enumerate(self.buffer.episodes) if info.round == number - 1]
            rows = torch.cat([self.buffer.frames(i) for i in last])
            self.policy.gate.tune(relabelled(rows, self.learner), self.algo.gate.budget)

    def fit(self, number: int, log: RunLog) -> None:
        """Fit the learner to all rows; checkpoints are saved meanwhile."""
        done, before = self.done, self.steps_before(number)

        def checkpoint(state: dict[str, Any]) -> None:
            done.fit, done.log_rows = state, log.rows
            self.save()

        wait_for_all()  # the others open the buffer now
        fit_round(self.learner, self.buffer, self.cfg, number, on_checkpoint=checkpoint, resume=done.fit,
                  log=lambda row: log.write({**row, "step": before + row["step"], "round": number}),
                  title=f"round {number + 1} of {self.algo.rounds}: fit")  # fmt: skip

    def validate(self) -> dict[str, float]:
        """The learner's success and contact rate on a few validation objects."""
        if not self.validation:
            return {}
        objects = [obj for obj, _ in self.validated]
        options = setup.collector_options(self.cfg)
        policy = acting_policy(self.expert, self.learner, self.algo.oracle)
        rows = run_trials("learner", policy, objects, self.validation, self.protocol.env, collector=options)
        return {
            "val/success_rate": float(np.mean([row.success for row in rows])),
            "val/contact_rate": float(np.mean([row.contact for row in rows])),
        }

    def steps_before(self, number: int) -> int:
        """Optimizer steps of the rounds before ``number``."""
        return sum(round_steps(self.algo, self.cfg.data.labels, i) for i in range(number))

    @property
    def labels(self) -> int:
        """Number of the expert's labels in the buffer, without the given demonstrations."""
        return sum(share(self.cfg.data.labels, self.algo.rounds, i) for i in range(self.done.collected))

    @property
    def expert_share(self) -> float:
        """See :func:`~fb3d_rl.algos.collection.expert_share`; without the given demonstrations."""
        return expert_share([self.buffer.frames(i) for i in range(self.given, len(self.buffer.episodes))])


class Imitation:
    """algo=bc and algo=dagger, see :class:`~fb3d_rl.algos.algorithm.Algorithm`."""

    def train(self, cfg: TrainConfig, out: Path) -> list[TrialRow]:
        """See :class:`~fb3d_rl.algos.algorithm.Algorithm`; only the first process returns rows."""
        if rank_and_count()[0]:
            assist(cfg, out)
            return []
        job = Run(cfg, out)
        job.train()
        policies: dict[str, Any] = {"expert": job.expert} if cfg.evaluation.expert else {}
        name = policy_name(job.algo)
        policies[name] = acting_policy(job.expert, job.learner, job.algo.oracle)
        facts = setup.facts(cfg, job.entries) | {"policy": name, "labels": job.labels}
        facts["expert_share"] = job.expert_share
        return evaluate(out, job.tested, policies, job.protocol, facts)

    def load(self, path: str | Path) -> Acting:
        """See :class:`~fb3d_rl.algos.algorithm.Algorithm`.

        The policy raises a UserError if its learner was trained with other limits or another control rate: its history
        and its plans are counted in control steps.
        """
        path = weights_file(path)
        saved = load_checkpoint(path)
        if REGISTRY.get(saved["algo"]) is not REGISTRY["dagger"]:  # bc has the same entry
            raise UserError(f"{path} is a checkpoint of {saved['algo']}, not of bc or dagger: choose another file.")
        with fitting(path):
            kwargs, state = saved["model_kwargs"], saved["state"]
            flow_net = None
            if kwargs["flow_net"] is not None:
                flow_net = ArtFlowNet(**kwargs["flow_net"])
                flow_net.load_state_dict(state["flow_model"])
            limits = VelocityLimits(**kwargs["limits"])
            learner = new_learner(LearnerOptions(**kwargs["options"]), limits, kwargs["members"], 0, flow_net)
            networks(learner).load_state_dict(state["model"])
            name, oracle = kwargs["name"], kwargs["oracle"]

        def policy(present: VelocityLimits, options: FlowPolicyOptions) -> TensorDictModuleBase:
            if limits != present:
                raise UserError(
                    f"{path} was trained with env.gripper.v_max={limits.linear:g} "
                    f"env.gripper.w_max={limits.angular:g} env.control_freq={1 / limits.period:g}; give the same"
                )
            return acting_policy(expert_policy(present, options), learner, oracle)

        return Acting(name, policy, fits=saved["step"])


ALGORITHM = Imitation()


def rows_options(algo: ImitationOptions, limits: VelocityLimits, gate: Gate) -> RowsOptions:
    """What a row of the buffer holds."""
    state = gate.initial_state(torch.Size([1])).keys(include_nested=True, leaves_only=True)
    compared = [key for key in gate.in_keys if key[0] == "learner"]
    draws: list[Key] = ["seed"] if algo.learner.draws and algo.gate.budget is not None else []
    further = tuple(dict.fromkeys([*state, *compared, *draws]))
    return RowsOptions(limits, algo.learner.history, FLOW_KEYS[algo.learner.flow], further, algo.oracle,
                       algo.learner.guided)  # fmt: skip
