"""algo=artflownet: draw flow samples, fit ArtFlowNet, then measure it and let it open things.

So do the other algorithms of :mod:`fb3d_rl.algos.kinds` with their networks.
"""

from __future__ import annotations

import math
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import torch
from safetensors import SafetensorError, safe_open
from tensordict import TensorDictBase
from torch import nn
from torchrl.data import TensorDictReplayBuffer, TensorStorage

from fb3d_rl.algos import setup
from fb3d_rl.algos.aggregation import meet_samples
from fb3d_rl.algos.kinds import KINDS
from fb3d_rl.assets.catalog import Entry
from fb3d_rl.data.generate import Joined, generate_samples, load_samples, recipe_of
from fb3d_rl.data.samples import SampleOptions
from fb3d_rl.errors import UserError
from fb3d_rl.evaluation.evaluate import evaluate, progress_bars
from fb3d_rl.evaluation.flow import held_out_samples
from fb3d_rl.flow.metrics import mean_metrics
from fb3d_rl.kinematics.opening import openable_links
from fb3d_rl.models.artflownet import ArtFlowNet
from fb3d_rl.models.cloud_network import CloudNetwork
from fb3d_rl.policies.baselines import RandomPolicy, normal_policy
from fb3d_rl.policies.flow_policy import artflownet_policy, expert_policy
from fb3d_rl.rollout.rows import TrialRow
from fb3d_rl.seeds import derived
from fb3d_rl.training.checkpoint import fitting, git_revision, load_checkpoint, save_checkpoint
from fb3d_rl.training.device import emulates_bf16, require_compiler
from fb3d_rl.training.fit import fit
from fb3d_rl.training.options import FitOptions
from fb3d_rl.training.processes import rank_and_count, wait_for_all
from fb3d_rl.training.run_log import RunLog, open_logger
from fb3d_rl.training.state import check_state

if TYPE_CHECKING:
    from fb3d_rl.config import ArtFlowNetConfig, EvaluateConfig, TrainConfig

CHECKPOINT = "checkpoint.pt"

SAMPLES = "samples"
"""The run's data set; data.dataset gives it to another run."""

VALIDATION_SAMPLES = 64

MET = "met"
"""The clouds that the policy of data.met_by met."""

BEST = "best.safetensors"
"""The weights of the run that did best in validation."""


def run(cfg: TrainConfig, out: Path) -> list[TrialRow]:
    """Train on the configured objects and evaluate on the held-out ones; everything is written below ``out``.

    Returns:
        One row for each scheduled trial and policy; none in the processes that only fit beside the first.
    """
    if rank_and_count()[0]:
        assist(cfg, out)
        return []
    # Whatever the configuration can get wrong shows here, before any work.
    protocol = setup.protocol(cfg, cfg.resume)
    device = protocol.device
    limits, speeds = setup.velocity_limits(cfg), setup.flow_policy_options(cfg)
    name, kind = cfg.algo.name, KINDS[cfg.algo.name]
    resume = state_before(cfg, out)
    logger = open_logger(cfg.logger.name, cfg.logger.project, out)
    options, net = fit_options(cfg), new_network(cfg)
    if resume is not None:
        with fitting(out / CHECKPOINT):
            check_state(net, options, resume["state"])
        best_cosine(out / BEST)
    met_by = load_network(cfg.data.met_by) if cfg.data.met_by else None
    if met_by is not None:
        setup.require_simulator()
    if options.compile:
        require_compiler(device)
    if options.precision == "bf16" and emulates_bf16(device):
        print(
            "note: this processor has no AVX-512, without which algo.precision=bf16 is several times slower than fp32"
        )
    samples = protocol.samples
    entries = setup.train_entries(cfg.assets, out, cfg.seed)
    train, objects = entries.train, setup.load(entries.held_out)
    if cfg.data.dataset:
        require_unseen(Path(cfg.data.dataset), [*entries.validation, *entries.held_out])
    else:
        draw_samples(cfg, [entry.folder for entry in train], samples, out / SAMPLES)
    if met_by is not None:
        loaded, count = [entry.load() for entry in train], cfg.data.met_samples
        own = setup.settled(replace(cfg, policy=replace(cfg.policy, mask=None)), met_by.part_mask_input)
        met_speeds, meeting = setup.flow_policy_options(own), replace(protocol, env=setup.env_options(own))
        acting = artflownet_policy(met_by, limits, met_speeds)
        made_by = {"weights": met_by.digest(), "policy": asdict(met_speeds)}
        with progress_bars() as bar:
            task = bar.add_task("clouds met", total=count)
            meet_samples(out / MET, loaded, acting, count, meeting, made_by, lambda n: bar.update(task, completed=n))
    wait_for_all()
    buffer = training_rows(cfg, out)
    validation = validation_samples(entries.validation, samples, cfg.seed)

    def validate(measured: nn.Module) -> dict[str, float]:
        """On the validation objects: nothing that is evaluated in the end is looked at before."""
        if validation is None:
            return {}
        metrics = kind.measure(cast(CloudNetwork, measured), validation, device)
        numbers = {f"val/{key}": value for key, value in mean_metrics(metrics).items()}
        if numbers["val/cosine"] > best_cosine(out / BEST):
            about = {"val/cosine": repr(numbers["val/cosine"]), "seed": str(cfg.seed), "git_revision": git_revision()}
            cast(CloudNetwork, measured).save_pretrained(out / BEST, about)
        return numbers

    def checkpoint(state: dict[str, Any]) -> None:
        path, config = out / CHECKPOINT, asdict(cfg)
        save_checkpoint(path, algo=name, config=config, model_kwargs=net.arguments, state=state, seed=cfg.seed)

    if resume is None:
        (out / BEST).unlink(missing_ok=True)
    with RunLog(out, resume_step=resume["step"] if resume else None, logger=logger) as run_log:
        fit(net, buffer, options, objective=kind.objective and kind.objective(net, options), device=device,
            evaluate=validate, log=run_log.write, on_checkpoint=checkpoint,
            resume=resume["state"] if resume else None)  # fmt: skip

    policies: dict[str, Any] = {"expert": expert_policy(limits, speeds)} if cfg.evaluation.expert else {}
    policies[name] = kind.policy(net.to("cpu"), limits, speeds)
    return evaluate(out, objects, policies, protocol, setup.facts(cfg, train), net if kind.flow else None)


def state_before(cfg: TrainConfig, out: Path) -> dict[str, Any] | None:
    """The checkpoint to go on from. A run that ended before its first one has lost nothing: it begins anew."""
    path = out / CHECKPOINT
    return load_checkpoint(path, algo=cfg.algo.name) if cfg.resume and path.exists() else None


def validation_samples(entries: list[Entry], options: SampleOptions, seed: int) -> TensorDictBase | None:
    """Samples of the validation objects, some ``VALIDATION_SAMPLES`` in all; None where there is no object."""
    objects = setup.load(entries)
    if not any(openable_links(obj) for obj, _ in objects):
        return None
    count = max(2, math.ceil(VALIDATION_SAMPLES / len(objects)))
    return held_out_samples(objects, options, count, derived(seed, "validation"), ("part",))["part"][0]


def require_unseen(dataset: Path, entries: list[Entry]) -> None:
    """Check that a whole data set of another run holds none of the objects that this one validates and evaluates on.

    Raises:
        UserError: it does.
    """
    # Earlier versions kept folders in place of ids with digests.
    drawn = {Path(item).name if isinstance(item, str) else item[0] for item in recipe_of(dataset)["objects"]}
    seen = sorted(entry.id for entry in entries if entry.id in drawn)
    if seen:
        raise UserError(
            f"data.dataset={dataset} holds clouds of {len(seen)} objects that are validated or evaluated on "
            f"({', '.join(seen[:3])} ...): give the assets and the seed of the run that drew it"
        )


def assist(cfg: TrainConfig, out: Path) -> None:
    """Fit beside the first of several processes, which does all the rest, once the samples are there."""
    device, options = setup.choose_device(cfg.device), fit_options(cfg)
    resume = state_before(cfg, out)
    net = new_network(cfg)
    wait_for_all()
    rows, state = training_rows(cfg, out), resume["state"] if resume else None
    fit(net, rows, options, device=device, resume=state, progress=False)


def draw_samples(cfg: TrainConfig, folders: list[Path], samples: SampleOptions, out: Path) -> None:
    """Draw the flow samples to train on, with a progress bar."""
    count, workers = cfg.data.train_samples, setup.workers(cfg.data.workers)
    with progress_bars() as bar:
        task = bar.add_task("flow samples", total=count)
        generate_samples(out, folders, count, cfg.seed, samples, workers, lambda n: bar.update(task, completed=n))


def training_rows(cfg: TrainConfig, out: Path) -> Joined:
    """What is trained on: flow samples, and behind them what a policy met."""
    folders = [Path(cfg.data.dataset or out / SAMPLES), *([out / MET] if cfg.data.met_by else [])]
    parts = [load_samples(folder) for folder in folders]
    return Joined(*(TensorDictReplayBuffer(storage=TensorStorage(part)) for part in parts))


def best_cosine(path: Path) -> float:
    """Validation cosine of the weights in the file; -inf if there is none.

    Raises:
        UserError: the file is damaged.
    """
    if not path.is_file():
        return -math.inf
    try:
        with safe_open(path, framework="pt") as content:
            return float(content.metadata()["val/cosine"])
    except (SafetensorError, ValueError, KeyError, TypeError) as error:
        raise UserError(f"{path} is damaged ({type(error).__name__}): copy it anew, or delete it") from error


def fit_options(cfg: TrainConfig) -> FitOptions:
    """How the network is fitted.

    Raises:
        UserError: the batch cannot be shared out to the processes that fit together.
    """
    algo, processes = cast("ArtFlowNetConfig", cfg.algo), rank_and_count()[1]
    if algo.batch_size % processes:
        raise UserError(f"algo.batch_size={algo.batch_size} cannot be shared out to {processes} processes equally")
    rows = len(load_samples(Path(cfg.data.dataset))) if cfg.data.dataset else cfg.data.train_samples
    rows += cfg.data.met_samples if cfg.data.met_by else 0
    return FitOptions(
        steps=math.ceil(algo.epochs * rows / algo.batch_size),
        batch_size=algo.batch_size,
        lr=algo.lr,
        schedule=algo.schedule,
        clip_norm=algo.clip_norm,
        ema=algo.ema,
        rotate=algo.rotate,
        mirror=algo.mirror,
        scale=algo.scale,
        jitter=algo.jitter,
        dropout=algo.dropout,
        precision=algo.precision,
        compile=algo.compile,
        seed=cfg.seed,
        log_every=algo.log_every,
        evaluate_every=algo.evaluate_every,
        checkpoint_every=algo.checkpoint_every,
    )


def new_network(cfg: TrainConfig) -> CloudNetwork:
    """The network to train: its weights depend on the seed alone, or are those of ``algo.start_from``.

    Raises:
        UserError: these are another network's.
    """
    algo = cast("ArtFlowNetConfig", cfg.algo)
    generator = torch.Generator().manual_seed(cfg.seed)
    net = KINDS[algo.name].network(algo.part_mask_input, algo.neighbors, algo.backbone, generator)
    if algo.start_from:
        begun = load_trained(algo.start_from, algo.name)
        if begun.arguments != net.arguments:
            different = [f"algo.{key}={value}" for key, value in begun.arguments.items() if net.arguments[key] != value]
            raise UserError(f"algo.start_from={algo.start_from} is another network; give {' '.join(different)}")
        net.load_state_dict(begun.state_dict())
    return net


def load_network(path: str | Path) -> ArtFlowNet:
    """The ArtFlowNet of a checkpoint that :func:`run` wrote, of a .safetensors file, or "pretrained".

    Raises:
        UserError: the file is missing or no such checkpoint.
    """
    return cast(ArtFlowNet, load_trained(path, ArtFlowNet.NAME))


def load_trained(path: str | Path, name: str) -> CloudNetwork:
    """As :func:`load_network`, for any of the kinds."""
    network = KINDS[name].network
    if Path(path).suffix == ".safetensors" or (str(path) == "pretrained" and network is ArtFlowNet):
        return network.from_pretrained(path)
    content = load_checkpoint(path, algo=name)
    with fitting(path):
        net = network(**content["model_kwargs"])
        net.load_state_dict(content["state"].get("average") or content["state"]["model"])
    return net.eval()


def run_evaluation(cfg: EvaluateConfig, out: Path) -> list[TrialRow]:
    """Evaluate the expert, a baseline that learns nothing, or what a trained network does, beside the expert."""
    setup.choose_device(cfg.device)  # one that is not there shows before anything is read
    name, kind = cfg.policy.name, KINDS.get(cfg.policy.name)
    net = load_trained(cfg.checkpoint, name) if kind and cfg.checkpoint else None
    cfg = setup.settled(cfg, net.part_mask_input if net else None)
    protocol = setup.protocol(cfg, cfg.resume)
    limits, speeds = setup.velocity_limits(cfg), setup.flow_policy_options(cfg)
    objects = setup.load(setup.eval_entries(cfg.assets, out, cfg.seed))
    policies: dict[str, Any] = {}
    if name == "expert" or cfg.evaluation.expert:
        policies["expert"] = expert_policy(limits, speeds)
    if name == "random":
        policies[name] = RandomPolicy()
    elif name == "normal":
        policies[name] = normal_policy(limits, speeds)
    elif kind and net:
        policies[name] = kind.policy(net, limits, speeds)
    return evaluate(out, objects, policies, protocol, setup.facts(cfg), net if kind and kind.flow else None)
