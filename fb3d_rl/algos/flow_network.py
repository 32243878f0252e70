"""Draw flow samples, fit a network to them, measure it, and evaluate its policy: algo=artflownet, screwnet, ump_di.

Each algorithm is a :class:`FlowNetwork` in the module of its name, which holds what they do not share.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.data import TensorDictReplayBuffer, TensorStorage

from fb3d_rl.algos import setup
from fb3d_rl.algos.aggregation import rollout_samples
from fb3d_rl.algos.algorithm import Acting
from fb3d_rl.algos.weights import BEST, CHECKPOINT, NETWORK, best_cosine, load_network, load_trained, state_before
from fb3d_rl.assets.catalog import Entry
from fb3d_rl.data.generate import Joined, generate_samples, load_samples, recipe_of
from fb3d_rl.data.options import SampleOptions
from fb3d_rl.data.samples import FLOWS, SampleKind
from fb3d_rl.errors import UserError
from fb3d_rl.evaluation.evaluate import Protocol, evaluate, progress_bars
from fb3d_rl.evaluation.flow import held_out_samples, predict
from fb3d_rl.flow.metrics import flow_metrics, mean_metrics
from fb3d_rl.kinematics.opening import openable_links
from fb3d_rl.models.artflownet import ArtFlowNet
from fb3d_rl.models.cloud_network import CloudNetwork
from fb3d_rl.models.plugin import own_network, require_flow
from fb3d_rl.options import content, taken
from fb3d_rl.plugins import said
from fb3d_rl.policies.flow_policy import artflownet_policy, expert_policy
from fb3d_rl.policies.hand import VelocityLimits
from fb3d_rl.policies.options import FlowPolicyOptions
from fb3d_rl.rollout.rows import TrialRow
from fb3d_rl.seeds import derived
from fb3d_rl.training.checkpoint import fitting, git_revision, save_checkpoint
from fb3d_rl.training.device import emulates_bf16, require_compiler
from fb3d_rl.training.fit import fit
from fb3d_rl.training.objective import Objective
from fb3d_rl.training.options import FitOptions
from fb3d_rl.training.processes import equal_share, rank_and_count, wait_for_all
from fb3d_rl.training.run_log import RunLog, open_logger
from fb3d_rl.training.state import check_state

if TYPE_CHECKING:
    from fb3d_rl.algos.options import FlowNetworkOptions
    from fb3d_rl.config import TrainConfig

SAMPLES = "samples"
"""The run's data set; data.dataset gives it to another run."""

VALIDATION_SAMPLES = 64

MET = "met"
"""The clouds of the rollouts of data.met_by."""

Measure: TypeAlias = "Callable[[CloudNetwork, TensorDictBase, torch.device], dict[str, Tensor]]"
"""Metrics of samples [S], each [S]; validation keeps the weights with the largest "cosine"."""


def flow_numbers(net: CloudNetwork, samples: TensorDictBase, device: torch.device) -> dict[str, Tensor]:
    """The flow's errors on samples [S], see :func:`flow_metrics`."""
    flow, valid = samples["privileged", "flow"], samples["observation", "valid"]
    return flow_metrics(predict(net, samples, device), flow, valid)


@dataclass(frozen=True)
class FlowNetwork:
    """The algorithm (:class:`~fb3d_rl.algos.algorithm.Algorithm`) of a network that is trained on flow samples.

    Attributes:
        network: the network's class.
        policy: makes the policy of a network on the CPU.
        objective: the loss to minimize; None for that of the flow.
        measure: computes the metrics of validation.
        flow: whether the network predicts the flow of a whole cloud.
        samples: what it is fitted to.
        target: name of the user's own class that stands in for ``network`` (algo.network).
    """

    network: type[CloudNetwork]
    policy: Callable[[CloudNetwork, VelocityLimits, FlowPolicyOptions], TensorDictModuleBase] = artflownet_policy
    objective: Callable[[nn.Module, FitOptions], Objective] | None = None
    measure: Measure = flow_numbers
    flow: bool = True
    samples: SampleKind = FLOWS
    target: str | None = None

    def train(self, cfg: TrainConfig, out: Path) -> list[TrialRow]:
        """See :class:`~fb3d_rl.algos.algorithm.Algorithm`; only the first process returns rows."""
        target = cast("FlowNetworkOptions", cfg.algo).network
        kind = self if target is None else replace(self, network=own_network(target), target=target)
        if rank_and_count()[0]:
            assist(kind, cfg, out)
            return []
        return run(kind, cfg, out)

    def load(self, path: str | Path) -> Acting:
        """See :class:`~fb3d_rl.algos.algorithm.Algorithm`."""
        return self.acting(load_trained(path, self.network))

    def acting(self, net: CloudNetwork) -> Acting:
        """The policy of a network."""
        policy = partial(self.policy, net)
        return Acting(net.NAME, policy, net.part_mask_input, net if self.flow else None)


def run(kind: FlowNetwork, cfg: TrainConfig, out: Path) -> list[TrialRow]:
    """Train on the configured objects and evaluate on the held-out ones."""
    # All errors of the configuration are raised here, before any work.
    protocol = setup.protocol(cfg, cfg.resume)
    device = protocol.device
    limits, speeds = setup.velocity_limits(cfg), setup.flow_policy_options(cfg)
    resume = state_before(cfg, out)
    logger = open_logger(cfg.logger.name, cfg.logger.project, out)
    options, net = fit_options(cfg), new_network(kind, cfg)
    if resume is not None:
        with fitting(out / CHECKPOINT):
            check_state(net, options, resume["state"])
        best_cosine(out / BEST)
    if cfg.data.met_by and kind.samples != FLOWS:
        raise UserError(
            f"algo={cfg.algo.name} learns from {kind.samples.name}, not from rollouts: leave data.met_by out"
        )
    met_by = load_network(cfg.data.met_by) if cfg.data.met_by else None
    if met_by is not None:
        setup.require_simulator()
    require_products(options, device)
    entries = setup.train_entries(cfg.assets, out, cfg.seed)
    objects = setup.load(entries.held_out)

    if cfg.data.dataset:
        require_unseen(Path(cfg.data.dataset), [*entries.validation, *entries.held_out])
    else:
        drawn = [entry.folder for entry in entries.drawn(cfg.data.given_share)]
        draw_samples(kind, cfg, drawn, protocol.samples, out / SAMPLES)
    if met_by is not None:
        draw_rollout_samples(cfg, out, met_by, entries.train, protocol)
    wait_for_all()
    buffer = training_rows(cfg, out, kind.samples)
    validation = validation_samples(kind, entries.validation, protocol.samples, cfg.seed)

    def checkpoint(state: dict[str, Any]) -> None:
        save_checkpoint(out / CHECKPOINT, algo=cfg.algo.name, config=content(cfg), model_kwargs=net.arguments,
                        state=state, seed=fit_seed(cfg))  # fmt: skip

    if resume is None:
        (out / BEST).unlink(missing_ok=True)
    about = {} if kind.target is None else {NETWORK: kind.target}
    with RunLog(out, resume_step=resume["step"] if resume else None, logger=logger) as run_log:
        fit(net, buffer, options, objective=kind.objective and kind.objective(net, options), device=device,
            evaluate=partial(validate, kind, validation, device, out / BEST, fit_seed(cfg), about), log=run_log.write,
            on_checkpoint=checkpoint, resume=resume["state"] if resume else None)  # fmt: skip

    policies: dict[str, Any] = {"expert": expert_policy(limits, speeds)} if cfg.evaluation.expert else {}
    fitted = kind.acting(net.to("cpu"))
    policies[fitted.name] = fitted.policy(limits, speeds)
    return evaluate(out, objects, policies, protocol, setup.facts(cfg, entries.train), fitted.network)


def validate(
    kind: FlowNetwork,
    samples: TensorDictBase | None,
    device: torch.device,
    best: Path,
    seed: int,
    about: Mapping[str, str],
    measured: nn.Module,
) -> dict[str, float]:
    """Metrics of a network on the validation objects; the file ``best`` keeps the weights with the largest cosine.

    The file also holds ``about``. The objects of the final evaluation are not used here.
    """
    if samples is None:
        return {}
    net = cast(CloudNetwork, measured)
    numbers = {f"val/{key}": value for key, value in mean_metrics(kind.measure(net, samples, device)).items()}
    if numbers["val/cosine"] > best_cosine(best):
        facts = {"val/cosine": repr(numbers["val/cosine"]), "seed": str(seed), "git_revision": git_revision()}
        net.save_pretrained(best, facts | dict(about))
    return numbers


def require_products(options: FitOptions, device: torch.device) -> None:
    """Check that the device can compute as the options say, and print a note where it is slow.

    Raises:
        UserError: there is no compiler.
    """
    if options.compile:
        require_compiler(device)
    if options.precision == "bf16" and emulates_bf16(device):
        print(
            "note: this processor has no AVX-512, without which algo.precision=bf16 is several times slower than fp32"
        )


def draw_rollout_samples(
    cfg: TrainConfig, out: Path, met_by: ArtFlowNet, train: list[Entry], protocol: Protocol
) -> None:
    """Draw clouds from rollouts of an ArtFlowNet's policy with the training objects, with a progress bar."""
    loaded, count = [entry.load() for entry in train], cfg.data.met_samples
    own = setup.settled(replace(cfg, policy=replace(cfg.policy, mask=None)), met_by.part_mask_input)
    speeds, meeting = setup.flow_policy_options(own), replace(protocol, env=setup.env_options(own))
    acting = artflownet_policy(met_by, setup.velocity_limits(cfg), speeds)
    made_by = {"weights": met_by.digest(), "policy": asdict(speeds)}
    with progress_bars() as bar:
        task = bar.add_task("rollout clouds", total=count)
        rollout_samples(out / MET, loaded, acting, count, meeting, made_by, lambda n: bar.update(task, completed=n))


def validation_samples(
    kind: FlowNetwork, entries: list[Entry], options: SampleOptions, seed: int
) -> TensorDictBase | None:
    """About ``VALIDATION_SAMPLES`` samples of the validation objects; None if none of them can be opened."""
    objects = setup.load(entries)
    if not any(openable_links(obj) for obj, _ in objects):
        return None
    count = max(2, math.ceil(VALIDATION_SAMPLES / len(objects)))
    drawn = held_out_samples(objects, options, count, derived(seed, "validation"), ("part",), kind.samples)
    return drawn["part"][0]


def require_unseen(dataset: Path, entries: list[Entry]) -> None:
    """Check that another run's data set has none of the objects that this run validates or evaluates on.

    Raises:
        UserError: it does.
    """
    # Recipes of version 1 list folders, later ones ids with digests.
    drawn = {Path(item).name if isinstance(item, str) else item[0] for item in recipe_of(dataset)["objects"]}
    seen = sorted(entry.id for entry in entries if entry.id in drawn)
    if seen:
        raise UserError(
            f"data.dataset={dataset} holds clouds of {len(seen)} objects that are validated or evaluated on "
            f"({', '.join(seen[:3])} ...): give the assets and the seed of the run that drew it"
        )


def assist(kind: FlowNetwork, cfg: TrainConfig, out: Path) -> None:
    """What the other of several processes do: wait until the first has drawn the samples, then fit with it."""
    device, options = setup.choose_device(cfg.device), fit_options(cfg)
    resume = state_before(cfg, out)
    net = new_network(kind, cfg)
    wait_for_all()
    rows, state = training_rows(cfg, out, kind.samples), resume["state"] if resume else None
    fit(net, rows, options, device=device, resume=state, progress=False)


def draw_samples(kind: FlowNetwork, cfg: TrainConfig, folders: list[Path], samples: SampleOptions, out: Path) -> None:
    """Draw the flow samples to train on, with a progress bar."""
    count, workers = cfg.data.train_samples, setup.workers(cfg.data.workers)
    with progress_bars() as bar:
        task = bar.add_task("flow samples", total=count)
        generate_samples(
            out, folders, count, cfg.seed, samples, workers, lambda n: bar.update(task, completed=n), kind.samples
        )


def training_rows(cfg: TrainConfig, out: Path, kind: SampleKind = FLOWS) -> Joined:
    """The training samples: drawn ones, then those of rollouts."""
    folders = [Path(cfg.data.dataset or out / SAMPLES), *([out / MET] if cfg.data.met_by else [])]
    parts = [load_samples(folder, kind) for folder in folders]
    return Joined(*(TensorDictReplayBuffer(storage=TensorStorage(part)) for part in parts))


def fit_options(cfg: TrainConfig) -> FitOptions:
    """How the network is fitted.

    Raises:
        UserError: the batch size is no multiple of the number of processes that fit together.
    """
    algo = cast("FlowNetworkOptions", cfg.algo)
    equal_share(algo.batch_size)
    rows = len(load_samples(Path(cfg.data.dataset))) if cfg.data.dataset else cfg.data.train_samples
    rows += cfg.data.met_samples if cfg.data.met_by else 0
    epochs = min(algo.epochs, cfg.data.max_epochs or algo.epochs)
    return taken(FitOptions, algo, steps=math.ceil(epochs * rows / algo.batch_size), seed=fit_seed(cfg))


def fit_seed(cfg: TrainConfig) -> int:
    """The seed of the fit, which may differ from that of the objects and samples."""
    seed = cast("FlowNetworkOptions", cfg.algo).seed
    return cfg.seed if seed is None else seed


def new_network(kind: FlowNetwork, cfg: TrainConfig) -> CloudNetwork:
    """The network to train: its first weights are drawn from the seed or read from ``algo.start_from``.

    Raises:
        UserError: the file holds another kind of network, or one that cannot propose several flows.
    """
    algo = cast("FlowNetworkOptions", cfg.algo)
    generator = torch.Generator().manual_seed(fit_seed(cfg))
    of_its_kind = issubclass(kind.network, ArtFlowNet)
    if algo.hypotheses > 1 and not of_its_kind:
        raise UserError(f"algo={algo.name} proposes one answer: leave algo.hypotheses=1")
    further: dict[str, Any] = {}
    if of_its_kind:
        further = {"hypotheses": algo.hypotheses, "mask_optional": cfg.data.unmasked_share > 0}
    try:
        net = kind.network(algo.part_mask_input, algo.neighbors, algo.backbone, generator, **further)
    except Exception as error:
        if kind.target is None:
            raise
        raise UserError(f"algo.network={kind.target} cannot be made: {said(error)}") from error
    if kind.target is not None:
        require_flow(net, kind.target)
    if algo.start_from:
        begun = load_trained(algo.start_from, kind.network if kind.target is None else ArtFlowNet)
        if type(begun) is not kind.network:
            raise UserError(f"algo.start_from={algo.start_from} is a {type(begun).__name__}: leave it out")
        different = [
            f"algo.{key}={value}"
            for key, value in begun.arguments.items()
            if key != "mask_optional" and net.arguments.get(key) != value
        ]
        if different:
            raise UserError(f"algo.start_from={algo.start_from} is another network; give {' '.join(different)}")
        net.load_state_dict(begun.state_dict())
    return net
