"""algo=bc and algo=dagger: in rounds, let expert and learner act, have the expert label every step, fit the learner.

Behaviour cloning is the case of one round in which the expert always acts.
"""

from __future__ import annotations

import math
import shutil
import time
import warnings
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, nullcontext
from dataclasses import asdict, dataclass, field, fields
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.objectives import BCLoss

from fb3d_rl.algos import setup
from fb3d_rl.algos.artflownet import CHECKPOINT, load_network, state_before
from fb3d_rl.algos.collection import Round, RowsOptions, collect, copy_demonstrations, expert_share, relabelled
from fb3d_rl.contract import Key
from fb3d_rl.data.demonstrations import DemonstrationBuffer
from fb3d_rl.data.picking import Index, pick
from fb3d_rl.errors import UserError
from fb3d_rl.evaluation.evaluate import evaluate, progress_bars
from fb3d_rl.models.artflownet import ArtFlowNet
from fb3d_rl.policies.ensemble import Ensemble
from fb3d_rl.policies.flow_policy import FlowPolicy, expert_policy
from fb3d_rl.policies.gates import PREDICTED, make_gate
from fb3d_rl.policies.hand import VelocityLimits
from fb3d_rl.policies.interaction import BetaGate, EitherGate, Gate, InteractivePolicy, OracleGate
from fb3d_rl.policies.learner import FLOW_KEYS, INPUTS, Learner, LearnerOptions, rotated
from fb3d_rl.rollout.collectors import Workers
from fb3d_rl.rollout.rows import TrialRow
from fb3d_rl.rollout.run import create_env, run_trials, state_of
from fb3d_rl.rollout.trials import schedule
from fb3d_rl.rollout.worker import steady_floats
from fb3d_rl.scene.posed import Posed
from fb3d_rl.seeds import derived
from fb3d_rl.training.checkpoint import fitting, load_checkpoint, save_checkpoint
from fb3d_rl.training.draws import generator
from fb3d_rl.training.fit import fit
from fb3d_rl.training.objective import Objective
from fb3d_rl.training.options import FitOptions
from fb3d_rl.training.run_log import RunLog, open_logger
from fb3d_rl.training.schedules import beta
from fb3d_rl.training.state import check_state

if TYPE_CHECKING:
    from fb3d_rl.config import EvaluateConfig, ImitationConfig, TrainConfig

BUFFER = "buffer"
ALGOS = ("bc", "dagger")
# TorchRL 0.14.1 says so of its own BCLoss, in which it left out two annotations.
warnings.filterwarnings("ignore", message="The name target_actor_network_params wasn't part")
TURN = 4
"""Purpose of random draws; see :func:`fb3d_rl.training.draws.generator`."""


class Labels:
    """The buffer's rows as the loss takes them: with the expert's twists of ``chunk`` steps as "twist" and "is_pad".

    A plan that outlasts its episode is padded; the padding is no part of the loss.
    """

    def __init__(self, buffer: DemonstrationBuffer, chunk: int) -> None:
        self._buffer, self._chunk = buffer, chunk

    def __len__(self) -> int:
        return len(self._buffer)

    def __getitem__(self, index: Index) -> TensorDictBase:
        return pick(index, len(self), self._take)

    def _take(self, index: Tensor) -> TensorDictBase:
        rows = self._buffer[index]
        steps = torch.arange(self._chunk)
        ahead = (index[:, None] + steps).clamp(max=len(self) - 1)
        later = rows[:, None] if self._chunk == 1 else self._buffer[ahead.flatten()].view(len(index), self._chunk)
        rows["twist"] = later["expert", "twist"]
        follows = later["elapsed_steps"].squeeze(-1) == rows["elapsed_steps"] + steps
        rows["is_pad"] = ~(follows & (later["episode"].squeeze(-1) == rows["episode"]))
        return rows


@dataclass
class Progression:
    """How far a run is: with the rows on disk, all that a resumed run needs.

    Attributes:
        round: the round in work.
        collected: rounds whose rows are in the buffer.
        rows: rows of these rounds.
        log_rows: lines written to metrics.jsonl.
        numbers: what the collection of this round showed.
        fit: state of this round's fit, once it has begun.
        learner: the weights; while a fit runs, those from before it.
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


class Run:
    """A run of algo=bc or algo=dagger: what it is made of, and how far it is.

    Args:
        cfg: the configuration.
        out: the run folder.

    Raises:
        UserError: whatever the configuration can get wrong, before any work.
    """

    def __init__(self, cfg: TrainConfig, out: Path) -> None:
        self.cfg, self.out, self.algo = cfg, out, cast("ImitationConfig", cfg.algo)
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
        flow_net = load_network(algo.flow_checkpoint) if algo.flow_checkpoint else None
        self.learner = new_learner(learner_options(algo), self.limits, algo.members, cfg.seed, flow_net)
        self.policy = InteractivePolicy(self.expert, self.learner, new_gate(algo))
        self.rows = rows_options(algo, self.limits, self.policy.gate)
        entries = setup.train_entries(cfg.assets, out, cfg.seed)
        self.entries = entries.train
        self.objects, self.tested = [entry.load() for entry in entries.train], setup.load(entries.held_out)
        self.views = [Posed(obj, self.protocol.samples.camera) for obj in self.objects]
        limit = algo.validate_trials
        self.validated = setup.load(entries.validation)
        if limit and not self.validated:
            raise UserError(f"algo.validate_trials={limit} needs validation objects: more assets.validation_share")
        self.validation = schedule(self.validated, self.protocol.samples, cfg.seed, limit)[0] if limit else []

        if saved is None:
            self.done = Progression()
            if cfg.resume:
                shutil.rmtree(out / BUFFER, ignore_errors=True)
            self.buffer = DemonstrationBuffer.create(out / BUFFER, cfg.data.labels + (len(given) if given else 0))
            if given is not None:
                copy_demonstrations(given, self.buffer, self.rows)
            self.buffer.commit()
            self.done.rows = len(self.buffer)
            self.save()
        else:
            with fitting(out / CHECKPOINT):
                self.done = Progression(**saved["state"]["run"])
                networks(self.learner).load_state_dict(self.done.learner)
                self.policy.gate.load_state_dict(self.done.gate)
                if self.done.fit is not None:
                    options = fit_options(algo, cfg.data.labels, cfg.seed, self.done.round)
                    check_state(networks(self.learner), options, self.done.fit)
            self.buffer = DemonstrationBuffer.open(out / BUFFER)
            if len(self.buffer) < self.done.rows:
                raise UserError(
                    f"{out / BUFFER} holds {len(self.buffer)} of the {self.done.rows} rows that {CHECKPOINT} knows of; "
                    "copy the run folder anew, or start a new run"
                )
            self.buffer.truncate(self.done.rows)

    def save(self) -> None:
        """Write the checkpoint."""
        done, weights, flow_net = self.done, networks(self.learner).state_dict(), flow_network(self.learner)
        if done.fit is None:
            done.learner = {key: value.clone() for key, value in weights.items()}
        done.gate = self.policy.gate.state_dict()
        state = {
            "run": {item.name: getattr(done, item.name) for item in fields(done)},
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
        save_checkpoint(self.out / CHECKPOINT, algo=self.algo.name, config=asdict(self.cfg), model_kwargs=kwargs,
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
                """The collection of a round, ready to run beside anything else."""
                self.set_gate(number)
                workers.update_policy_weights_()
                labels = share(self.cfg.data.labels, algo.rounds, number)
                task = bar.add_task(f"round {number + 1} of {algo.rounds}: labels", total=labels)
                rng = np.random.default_rng([self.cfg.seed, 5, number])
                advance = partial(bar.update, task)
                return partial(collect, workers, self.views, self.protocol.samples, self.rows, number, labels, rng,
                               lambda count: advance(completed=count))  # fmt: skip

            while done.round < algo.rounds:
                number = done.round
                if done.collected == number:
                    started = time.perf_counter()
                    found = pending.result() if pending else begin(number)()
                    waited = time.perf_counter() - started
                    pending = None
                    for frames, info in found.episodes:
                        self.buffer.extend(frames, info)
                    self.buffer.commit()
                    done.rows, done.collected = len(self.buffer), number + 1
                    done.numbers = found.numbers | {"time/waited_for_labels": waited}
                    if beside is not None and number + 1 < algo.rounds:  # how long the environments stood still
                        done.numbers["time/waited_for_training"] = time.perf_counter() - found.ended
                    self.save()
                if beside is not None and number + 1 < algo.rounds:
                    # The next round runs while this one is fitted, with the weights from before.
                    pending = beside.submit(begin(number + 1))
                self.fit(number, log)
                numbers = self.validate()
                log.write({"step": self.steps_before(number + 1), "round": number, "labels": self.labels,
                           "beta": round_beta(algo, number), **done.numbers, **numbers})  # fmt: skip
                done.round, done.fit, done.numbers, done.log_rows = number + 1, None, {}, log.rows
                self.save()

    def set_gate(self, number: int) -> None:
        """Set who acts in a round."""
        for gate in self.policy.gate.modules():
            if isinstance(gate, BetaGate):
                gate.beta.fill_(round_beta(self.algo, number))
        if self.algo.gate.budget is not None and number > 0:
            last = [i for i, info in enumerate(self.buffer.episodes) if info.round == number - 1]
            rows = torch.cat([self.buffer.frames(i) for i in last])
            self.policy.gate.tune(relabelled(rows, self.learner), self.algo.gate.budget)

    def fit(self, number: int, log: RunLog) -> None:
        """Fit the learner to all rows; saves the run now and then."""
        done, before = self.done, self.steps_before(number)
        options = fit_options(self.algo, self.cfg.data.labels, self.cfg.seed, number)

        def checkpoint(state: dict[str, Any]) -> None:
            done.fit, done.log_rows = state, log.rows
            self.save()

        nets = networks(self.learner).to(self.protocol.device)
        objective = imitation_objective(self.learner, self.algo, options.seed)
        labels = Labels(self.buffer, self.algo.learner.chunk)
        # Threads that wait for each other on cores that collect would slow both down many times.
        with steady_floats() if self.algo.overlap else nullcontext():
            fit(nets, labels, options, objective=objective, device=self.protocol.device, on_checkpoint=checkpoint,
                resume=done.fit, log=lambda row: log.write({**row, "step": before + row["step"], "round": number}),
                title=f"round {number + 1} of {self.algo.rounds}: fit")  # fmt: skip
        nets.to("cpu")

    def validate(self) -> dict[str, float]:
        """What the learner opens of a few validation objects."""
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
        """The expert's labels in the buffer; demonstrations that were given are not counted."""
        return sum(share(self.cfg.data.labels, self.algo.rounds, i) for i in range(self.done.collected))

    @property
    def expert_share(self) -> float:
        """See :func:`~fb3d_rl.algos.collection.expert_share`; demonstrations that were given are not counted."""
        return expert_share([self.buffer.frames(i) for i in range(self.given, len(self.buffer.episodes))])


def run(cfg: TrainConfig, out: Path) -> list[TrialRow]:
    """Train on the configured objects and evaluate on the held-out ones; everything is written below ``out``.

    Returns:
        One row for each scheduled trial and policy.
    """
    job = Run(cfg, out)
    job.train()
    policies: dict[str, Any] = {"expert": job.expert} if cfg.evaluation.expert else {}
    policies[policy_name(job.algo)] = acting_policy(job.expert, job.learner, job.algo.oracle)
    facts = setup.facts(cfg, job.entries) | {"policy": policy_name(job.algo), "labels": job.labels}
    facts["expert_share"] = job.expert_share
    return evaluate(out, job.tested, policies, job.protocol, facts)


def run_evaluation(cfg: EvaluateConfig, out: Path) -> list[TrialRow]:
    """Evaluate a trained learner beside the expert."""
    protocol = setup.protocol(cfg, cfg.resume)
    expert = expert_policy(setup.velocity_limits(cfg), setup.flow_policy_options(cfg))
    assert cfg.checkpoint is not None  # config.validate has seen to it
    name, policy = load_policy(cfg.checkpoint, expert)
    objects = setup.load(setup.eval_entries(cfg.assets, out, cfg.seed))
    policies: dict[str, Any] = {"expert": expert} if cfg.evaluation.expert else {}
    return evaluate(out, objects, {**policies, name: policy}, protocol, setup.facts(cfg))


def load_policy(path: str | Path, expert: FlowPolicy) -> tuple[str, TensorDictModuleBase]:
    """Name and policy of a checkpoint of algo=bc or algo=dagger.

    Args:
        path: the file.
        expert: the oracle that drives to the contact point, if the learner was trained beside one.

    Raises:
        UserError: the file is missing or no such checkpoint, or its learner was trained on a gripper to which an action
            means something else: what it remembers and plans is counted in control steps.
    """
    content = load_checkpoint(path)
    if content["algo"] not in ALGOS:
        raise UserError(f"{path} is a checkpoint of {content['algo']}, not of bc or dagger: choose another file.")
    with fitting(path):
        kwargs, state = content["model_kwargs"], content["state"]
        flow_net = None
        if kwargs["flow_net"] is not None:
            flow_net = ArtFlowNet(**kwargs["flow_net"])
            flow_net.load_state_dict(state["flow_model"])
        limits = VelocityLimits(**kwargs["limits"])
        learner = new_learner(LearnerOptions(**kwargs["options"]), limits, kwargs["members"], 0, flow_net)
        networks(learner).load_state_dict(state["model"])
        name, oracle = kwargs["name"], kwargs["oracle"]
    if limits != expert.limits:
        raise UserError(
            f"{path} was trained with env.gripper.v_max={limits.linear:g} env.gripper.w_max={limits.angular:g} "
            f"env.control_freq={1 / limits.period:g}; give the same"
        )
    return name, acting_policy(expert, learner, oracle)


def new_learner(
    options: LearnerOptions, limits: VelocityLimits, members: int, seed: int, flow_net: ArtFlowNet | None = None
) -> Learner | Ensemble:
    """A learner, or an ensemble of several, with first weights that depend on the seed alone."""
    each = [
        Learner(options, limits, torch.Generator().manual_seed(_nth(seed, "member", k)), flow_net).eval()
        for k in range(members)
    ]
    return each[0] if members == 1 else Ensemble(each)


def _nth(seed: int, what: str, number: int) -> int:
    """The seed of member or round ``number``: the run's own for the first, else one that no other run has."""
    return derived(seed, what, number) if number else seed


def members(learner: Learner | Ensemble) -> list[Learner]:
    """The learners of an ensemble, or the learner."""
    return [learner] if isinstance(learner, Learner) else [cast(Learner, member) for member in learner.members]


def networks(learner: Learner | Ensemble) -> nn.ModuleList:
    """What is trained of the learner."""
    return nn.ModuleList(member.network for member in members(learner))


def flow_network(learner: Learner | Ensemble) -> ArtFlowNet | None:
    """The network that predicts the flow for the learner, if it has one."""
    return members(learner)[0].flow_network


def acting_policy(expert: FlowPolicy, learner: Learner | Ensemble, oracle: bool) -> TensorDictModuleBase:
    """The policy that is evaluated: the learner alone, or with an oracle that drives to the contact point."""
    learner.eval()
    return InteractivePolicy(expert, learner, OracleGate()) if oracle else learner


def policy_name(algo: ImitationConfig) -> str:
    """The policy's name in tables, such as "dagger_oracle_flow"."""
    flow = {"none": "", "ground_truth": "_flow", "artflownet": "_artflow"}[algo.learner.flow]
    gate = "" if algo.gate.name == "beta" else f"_{algo.gate.name}"
    return algo.name + gate + ("_oracle" if algo.oracle else "") + flow


def new_gate(algo: ImitationConfig) -> Gate:
    """Who acts while labels are collected: the gate, beside it the schedule's share of the expert, and the oracle."""
    mixture = BetaGate(per_step=algo.beta.mixing == "step")
    gates: list[Gate] = [mixture]
    if algo.gate.name != "beta":
        gates.append(make_gate(algo.gate.name, **cast("dict[str, Any]", algo.gate.options)))
    if algo.oracle:
        gates.append(OracleGate())
    return gates[0] if len(gates) == 1 else EitherGate(*gates)


def round_beta(algo: ImitationConfig, number: int) -> float:
    """The expert's share in a round; all of it in the first one, before the learner has learned anything."""
    if number == 0:
        return 1.0
    return beta(algo.beta.schedule, number, algo.beta.value, algo.beta.rounds, algo.beta.base)


def learner_options(algo: ImitationConfig) -> LearnerOptions:
    """The learner's network; it predicts its distance from the expert if the gate asks for that."""
    return LearnerOptions(**asdict(algo.learner), discrepancy=PREDICTED in new_gate(algo).in_keys)


def rows_options(algo: ImitationConfig, limits: VelocityLimits, gate: Gate) -> RowsOptions:
    """What a row of the buffer holds."""
    state = gate.initial_state(torch.Size([1])).keys(include_nested=True, leaves_only=True)
    further: list[Key] = list(state) if algo.gate.budget is not None else []
    return RowsOptions(limits, algo.learner.history, FLOW_KEYS[algo.learner.flow], tuple(further), algo.oracle)


def fit_options(algo: ImitationConfig, labels: int, seed: int, number: int) -> FitOptions:
    """How the learner is fitted in a round: its share of the steps, with a learning rate that rises and falls."""
    return FitOptions(
        steps=round_steps(algo, labels, number),
        batch_size=algo.batch_size,
        lr=algo.lr,
        schedule=algo.schedule,
        clip_norm=algo.clip_norm,
        seed=_nth(seed, "round", number),
        log_every=algo.log_every,
        checkpoint_every=algo.checkpoint_every,
    )


def round_steps(algo: ImitationConfig, labels: int, number: int) -> int:
    """A round's share of the optimizer steps: ``algo.epochs`` draws of each label in all, and at least one a round."""
    total = max(algo.rounds, math.ceil(algo.epochs * labels / algo.batch_size))
    return share(total, algo.rounds, number)


def share(total: int, rounds: int, number: int) -> int:
    """What round ``number`` of ``rounds`` has of a total; the first ones have the remainder."""
    return total // rounds + (number < total % rounds)


def imitation_objective(learner: Learner | Ensemble, algo: ImitationConfig, seed: int) -> Objective:
    """TorchRL's BCLoss of every member on situations that are turned and mirrored at random.

    A member that predicts its distance from the expert learns that too; it is taken between twists, which are
    normalised as actions are.
    """
    losses = []
    for member in members(learner):
        loss = BCLoss(member.actor(), loss_function=None if algo.learner.head == "gaussian" else algo.loss)
        loss.set_keys(action="twist", pad_mask=None if algo.learner.head == "gaussian" else "is_pad")
        losses.append(loss)
    most = math.radians(algo.turn)

    def objective(rows: TensorDictBase, step: int) -> Tensor:
        values = []
        for k, (member, loss) in enumerate(zip(members(learner), losses, strict=True)):
            draws = torch.rand(2, len(rows), generator=generator(_nth(seed, "member", k), TURN, step)).to(rows.device)
            mirrored = (draws[1] < 0.5) & algo.mirror
            inputs, twist = rotated(member.network_inputs(rows), rows["twist"], (2 * draws[0] - 1) * most, mirrored)
            inputs["twist"], inputs["is_pad"] = twist, rows["is_pad"]
            values.append(loss(inputs)["loss_bc"])
            if member.options.discrepancy:
                said, *_, distance = member.network(*(inputs[key] for key in INPUTS))
                true = (said[:, 0] - twist[:, 0]).norm(dim=-1, keepdim=True).detach()
                values.append(nn.functional.smooth_l1_loss(distance, true, beta=0.1))
        return torch.stack(values).mean()

    return objective
