"""Typed schemas of the configuration in conf/, and the checks that come before any work. Only launch/ imports this.

The values stand in conf/*.yaml, the meaning of each key in the docstring of the option class that it feeds.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from fb3d_rl.errors import UserError
from fb3d_rl.settings import UNTRAINED


@dataclass
class AssetsConfig:
    """Which objects.

    Attributes:
        source: "procedural" (made on the fly) or "partnet_mobility" (read below ``root``).
        root: folder that holds ``<id>/mobility.urdf`` or ``<Category>/<id>/mobility.urdf``, or "maniskill" for
            ManiSkill's asset folder.
        split: what to train on (train.py) or evaluate on (evaluate.py): "all", a split, a category, an object id, a
            file of such words (.txt, .json), or a list of them.
        eval_split: what train.py evaluates on, likewise.
        split_file: split file in UMPNet's format; if null, root/split-full.json, else UMPNet's own lists.
        categories: families of procedural objects; "all", "train" or "test" for UMPNet's, "mechanisms"; with
            "partnet_mobility", those that are trained on besides.
        unseen_categories: families of procedural objects that are only evaluated on, as the split "test".
        train_count: procedural training objects of each category.
        eval_count: procedural held-out objects of each category; with "partnet_mobility" 0, or the splits
            "procedural_train_test" and "procedural_test" besides the real ones.
        validation_share: share of the training objects of each category that is not trained on, but validated on while
            training: what is chosen then, such as best.safetensors, is chosen by these.
    """

    source: str
    root: str | None
    split: Any
    eval_split: Any
    split_file: str | None
    categories: list[str]
    unseen_categories: list[str]
    train_count: int
    eval_count: int
    validation_share: float


@dataclass
class DataConfig:
    """Flow samples: fb3d_rl.data.samples.SampleOptions, their numbers and the worker processes that draw them.

    Attributes:
        train_samples: samples to train ArtFlowNet on.
        dataset: the folder samples/ of another run, to train on what it drew; null draws anew.
        met_by: an ArtFlowNet whose policy runs trials with the training objects; what it sees there is trained on, too.
        met_samples: how many such clouds.
        labels: control steps that the expert labels for imitation, in all rounds.
        eval_samples: samples per held-out object on which the flow is measured.
        workers: worker processes; null for one per core.
    """

    points: int
    train_samples: int
    dataset: str | None
    met_by: str | None
    met_samples: int
    labels: int
    eval_samples: int
    workers: int | None
    closed_share: float
    others_closed: float
    all_parts_share: float
    some_parts_share: float


@dataclass
class CameraConfig:
    """fb3d_rl.camera.raycast.CameraOptions and fb3d_rl.camera.views.ViewRange."""

    kind: str
    shader: str
    resolution: int
    fov: float
    margin: float
    azimuth: list[float]
    elevation: list[float]


@dataclass
class AlgoConfig:
    """What is trained; ``name`` chooses the kind."""

    name: str


@dataclass
class ArtFlowNetConfig(AlgoConfig):
    """fb3d_rl.training.options.FitOptions and the network's arguments, for every network that flow samples train.

    Attributes:
        epochs: how often each training sample is drawn; with the batch size it gives the number of steps.
        start_from: the weights to start from, a checkpoint.pt or .safetensors; null draws them.
    """

    epochs: float
    batch_size: int
    lr: float
    schedule: str
    clip_norm: float | None
    ema: float | None
    rotate: bool
    mirror: bool
    scale: float
    jitter: float
    dropout: float
    precision: str
    compile: bool
    log_every: int
    evaluate_every: int | None
    checkpoint_every: int | None
    start_from: str | None
    backbone: str
    neighbors: int
    part_mask_input: bool


@dataclass
class BetaConfig:
    """The share of steps that the expert makes in a round (fb3d_rl.training.schedules.beta); in the first it is 1.

    Attributes:
        mixing: "step" draws who acts for every step, "episode" once for an episode.
    """

    schedule: str
    value: float
    rounds: int
    base: float
    mixing: str


@dataclass
class GateConfig:
    """fb3d_rl.policies.gates.make_gate: when the expert takes over from the learner.

    Attributes:
        options: the gate's thresholds; its own defaults unless given.
        budget: share of steps in which it may; sets the thresholds anew before every round.
    """

    name: str
    options: dict[str, float]
    budget: float | None


@dataclass
class LearnerConfig:
    """fb3d_rl.policies.learner.LearnerOptions."""

    encoder: str
    head: str
    flow: str
    points: int
    width: int
    history: int
    chunk: int
    execute: int


@dataclass
class ImitationConfig(AlgoConfig):
    """Behaviour cloning and DAgger.

    Attributes:
        rounds: how often is collected and fitted.
        labels: steps that the expert labels, in all rounds.
        steps: optimizer steps in all rounds; each fit has its share of them.
        oracle: whether the expert drives to the contact point and the learner acts on held parts alone.
        members: learners of an ensemble.
        flow_checkpoint: an ArtFlowNet's checkpoint.pt, for ``learner.flow=artflownet``.
        demonstrations: a buffer that launch/demos.py recorded, imported or filtered, to start from.
        overlap: collect each next round while the last one is fitted, with the weights from before.
        validate_trials: trials with validation objects after each round, for the learning curve.
        loss: of a deterministic head: "l1", "l2" or "smooth_l1"; the Gaussian's is its likelihood.
        turn: situations are turned about z by up to so many degrees.
        mirror: every other situation is mirrored, at random.
    """

    rounds: int
    epochs: float
    beta: BetaConfig
    gate: GateConfig
    oracle: bool
    members: int
    learner: LearnerConfig
    flow_checkpoint: str | None
    demonstrations: str | None
    overlap: bool
    validate_trials: int
    batch_size: int
    lr: float
    schedule: str
    clip_norm: float | None
    loss: str
    turn: float
    mirror: bool
    log_every: int
    checkpoint_every: int | None


@dataclass
class GripperConfig:
    """fb3d_rl.env.options.GripperOptions."""

    v_max: float
    w_max: float
    f_max: float
    force_limit: float
    torque_limit: float
    finger_force_limit: float
    damping: float
    angular_damping: float
    distance: float


@dataclass
class SuctionConfig:
    """fb3d_rl.env.options.SuctionOptions.

    Attributes:
        hold: null for "target", or "any" where policy.mask is "none".
    """

    hold: str | None
    stiffness: float
    damping: float
    angular_damping: float
    breaking_force: float
    max_stretch: float
    touch: float
    reach: float


@dataclass
class EnvConfig:
    """fb3d_rl.env.options.EnvOptions."""

    horizon: int
    success: float
    sim_freq: int
    control_freq: int
    gravity: bool
    joint_friction: float
    joint_damping: float
    density: float
    gripper: GripperConfig
    suction: SuctionConfig


@dataclass
class FlowConfig:
    """fb3d_rl.policies.flow_policy.FlowPolicyOptions."""

    travel_speed: float
    approach_speed: float
    touch_speed: float
    pull_speed: float
    angular_gain: float
    precontact: float
    line: float
    overshoot: float
    force: float
    patience: float
    stuck_speed: float
    stuck_time: float
    release_time: float
    fade: float
    retries: int | None
    retry_distance: float
    nearby: float
    lead: float
    clearance: float
    funnel: float
    free: float
    margin: float


@dataclass
class ContactConfig:
    """fb3d_rl.policies.contact.ContactOptions."""

    neighbors: int
    curvature: float
    rim: float
    min_distance: float
    min_flow: float
    near: float
    turning: float
    facing: float
    collisions: bool
    hand_radius: float
    clearance: float
    reach: float
    run_up: float
    weak_flow: float
    candidates: int
    sweep: float
    sweep_angle: float
    sweep_steps: int


@dataclass
class PolicyConfig:
    """The flow policy; ``name`` chooses where the flow comes from.

    Attributes:
        mask: which points it is told to act on: "target", those of the part to open, or "none", whatever has a flow
            (the paper's "without mask"); null for "none" with a network that was trained so, else "target".
    """

    name: str
    mask: str | None
    flow: FlowConfig
    contact: ContactConfig


@dataclass
class CollectorConfig:
    """fb3d_rl.rollout.collectors.CollectorOptions.

    Attributes:
        workers: null for one per core.
    """

    backend: str
    workers: int | None
    restarts: int


@dataclass
class EvaluationConfig:
    """Which trials.

    Attributes:
        trials: at most this many, spread over the categories; null for all visible openable parts; 0 for none, which
            needs no simulator.
        start: as goal and repeats of fb3d_rl.rollout.trials.ScheduleOptions; conf/protocol/ sets the three.
        decision_seconds: a trial whose policy takes longer for one decision ends there; null for no limit.
        expert: also run the expert on the same trials.
        clouds: clouds shown in the report.
        videos: trials filmed with every policy, spread over the categories, half of them failures if there are any.
    """

    trials: int | None
    expert: bool
    clouds: int
    videos: int
    decision_seconds: float | None
    start: str
    goal: str
    repeats: int


@dataclass
class LoggerConfig:
    """fb3d_rl.training.run_log.open_logger: where a run's numbers go besides metrics.jsonl.

    Attributes:
        name: "none", "csv", "tensorboard" or "wandb".
        project: of Weights & Biases.
    """

    name: str
    project: str


@dataclass
class CommandConfig:
    """What launch/train.py and launch/evaluate.py share."""

    assets: AssetsConfig
    data: DataConfig
    camera: CameraConfig
    env: EnvConfig
    policy: PolicyConfig
    collector: CollectorConfig
    evaluation: EvaluationConfig
    seed: int
    device: str


@dataclass
class TrainConfig(CommandConfig):
    """Everything that launch/train.py needs; ``resume`` goes on from the run folder's checkpoint."""

    algo: AlgoConfig
    logger: LoggerConfig
    resume: bool


@dataclass
class EvaluateConfig(CommandConfig):
    """Everything that launch/evaluate.py needs.

    Attributes:
        checkpoint: a file that launch/train.py wrote.
        resume: go on from the rows in the run folder.
    """

    checkpoint: str | None
    resume: bool


RUN_FILES = frozenset(
    {
        "config.yaml", "metrics.jsonl", "checkpoint.pt", "best.safetensors", "rows.csv", "decision_times.jsonl",
        "flow_rows.csv", "flow_rows_all_parts.csv", "summary.json", "report.html", "clouds.npz", "flow.png", "videos",
        "samples", "met", "buffer", "objects",
    }
)  # fmt: skip
"""What a run leaves in its folder; a new run wants a folder without any of it."""


def changes_no_number(key: str) -> bool:
    """Whether a run may go on with another value of this dotted key: where it computes, and where its log goes."""
    return key in ("device", "data.workers") or key.startswith(("collector.", "logger."))


TRAINED = ("artflownet", "screwnet", "ump_di", "bc", "dagger")
"""What launch/train.py trains, and launch/evaluate.py evaluates from a checkpoint."""


MASKLESS = ("expert", "random", "artflownet")
"""Policies that can do without the mask of the part to open."""


@dataclass
class ViewConfig(CommandConfig):
    """Everything that launch/view.py needs.

    Attributes:
        checkpoint: an ArtFlowNet, as checkpoint.pt, .safetensors or "pretrained"; null shows the true flow alone.
        object: the folder of an object, its id, or a category, of which it is the first; null for the first of all.
        port: where the page is served, on this machine alone; the next free one if it is taken.
    """

    checkpoint: str | None
    object: Any
    port: int


def validate(cfg: CommandConfig) -> None:
    """Check values that types cannot; the one place for it.

    Raises:
        UserError: names the first key that is wrong and what it may be.
    """
    _one_of("assets.source", cfg.assets.source, ("procedural", "partnet_mobility"))
    _one_of("policy.name", cfg.policy.name, UNTRAINED + TRAINED)
    _validate_policy(cfg.policy)
    _one_of("collector.backend", cfg.collector.backend, ("direct", "process", "ray"))
    _at_least("collector.workers", 1 if cfg.collector.workers is None else cfg.collector.workers, 1)
    _at_least("collector.restarts", cfg.collector.restarts, 0)
    if cfg.env.suction.hold is not None:
        _one_of("env.suction.hold", cfg.env.suction.hold, ("target", "any"))
    _one_of("camera.kind", cfg.camera.kind, ("raycast", "sapien"))
    _one_of("camera.shader", cfg.camera.shader, ("minimal", "default"))
    _one_of("device", cfg.device, ("auto", "cpu", "cuda"))
    if isinstance(cfg, TrainConfig):
        _one_of("algo.name", cfg.algo.name, TRAINED)
        _one_of("logger.name", cfg.logger.name, ("none", "csv", "tensorboard", "wandb"))
        _one_of("policy.name", cfg.policy.name, ("artflownet",))  # the algorithm says what is evaluated
        if isinstance(cfg.algo, ArtFlowNetConfig):
            _validate_artflownet(cfg.algo)
            if cfg.policy.mask == "none" and cfg.algo.name in MASKLESS and cfg.algo.part_mask_input:
                raise UserError("policy.mask=none keeps the mask from the network too: give algo.part_mask_input=false")
        elif isinstance(cfg.algo, ImitationConfig):
            _validate_imitation(cfg.algo, cfg.collector, cfg.data.labels)
        _at_least("data.train_samples", cfg.data.train_samples, 1)
        _at_least("data.met_samples", cfg.data.met_samples, 1)
        _at_least("assets.train_count", cfg.assets.train_count, 1)
    if isinstance(cfg, EvaluateConfig) and cfg.policy.name in TRAINED and not cfg.checkpoint:
        raise UserError(f"policy={cfg.policy.name} needs checkpoint=PATH, a checkpoint.pt that launch/train.py wrote")
    if isinstance(cfg, ViewConfig):
        _one_of("policy.name", cfg.policy.name, ("expert", "artflownet"))
        if not 1 <= cfg.port <= 65535:
            raise UserError(f"port={cfg.port} is no port; give a number from 1 to 65535")
    _at_least("seed", cfg.seed, 0)
    _at_least("data.points", cfg.data.points, 64)
    _at_least("data.eval_samples", cfg.data.eval_samples, 1)
    _at_least("data.workers", 0 if cfg.data.workers is None else cfg.data.workers, 0)
    _at_least("assets.eval_count", cfg.assets.eval_count, 1 if cfg.assets.source == "procedural" else 0)
    if not 0 <= cfg.assets.validation_share < 1:
        raise UserError(f"assets.validation_share={cfg.assets.validation_share} is no share; give a number from 0 to 1")
    _at_least("camera.resolution", cfg.camera.resolution, 8)
    if not 0 < cfg.camera.fov < 180:
        raise UserError(f"camera.fov={cfg.camera.fov} is no field of view; give degrees between 0 and 180")
    _at_least("env.horizon", cfg.env.horizon, 1)
    _at_least("env.control_freq", cfg.env.control_freq, 1)
    if cfg.env.sim_freq % cfg.env.control_freq:
        raise UserError(f"env.sim_freq={cfg.env.sim_freq} is no multiple of env.control_freq={cfg.env.control_freq}")
    _at_least("evaluation.trials", 0 if cfg.evaluation.trials is None else cfg.evaluation.trials, 0)
    _at_least("evaluation.clouds", cfg.evaluation.clouds, 0)
    _at_least("evaluation.videos", cfg.evaluation.videos, 0)
    _at_least("evaluation.repeats", cfg.evaluation.repeats, 1)
    _one_of("evaluation.start", cfg.evaluation.start, ("reference", "closed", "random"))
    _one_of("evaluation.goal", cfg.evaluation.goal, ("open", "state"))
    if cfg.evaluation.decision_seconds is not None:
        _positive("evaluation.decision_seconds", cfg.evaluation.decision_seconds)
    acting = cfg.algo.name if isinstance(cfg, TrainConfig) else cfg.policy.name
    if cfg.policy.mask == "none" and acting not in MASKLESS:
        raise UserError(f"{acting} has to see which part to open: leave policy.mask=target")
    if cfg.evaluation.goal == "state" and acting in ("bc", "dagger"):
        raise UserError(f"{acting} learns to open only; evaluation.goal=state is for policies of a flow")
    for key in ("closed_share", "others_closed", "all_parts_share", "some_parts_share"):
        if not 0 <= getattr(cfg.data, key) <= 1:
            raise UserError(f"data.{key}={getattr(cfg.data, key)} is no share; give a number from 0 to 1")
    for key in ("azimuth", "elevation"):
        ends = getattr(cfg.camera, key)
        if len(ends) != 2 or ends[0] > ends[1]:
            raise UserError(f"camera.{key}={ends} is no range; give two ascending angles in degrees, [lowest,highest]")
    for key in ("split", "eval_split"):
        words = getattr(cfg.assets, key)
        if not (isinstance(words, (str, int)) or (isinstance(words, list) and words)):
            raise UserError(f"assets.{key}={words} is no split; give a name or a list of names: [train_test,test]")
    if cfg.assets.source == "partnet_mobility":
        if not cfg.assets.root:
            raise UserError(
                "assets.root is not set; give the folder that holds PartNet-Mobility objects: assets.root=DIR"
            )


def _validate_policy(policy: PolicyConfig) -> None:
    flow, contact = policy.flow, policy.contact
    if policy.mask is not None:
        _one_of("policy.mask", policy.mask, ("target", "none"))
    for key in ("travel_speed", "approach_speed", "touch_speed", "pull_speed", "angular_gain", "precontact", "line",
                "overshoot", "nearby"):  # fmt: skip
        _positive(f"policy.flow.{key}", getattr(flow, key))
    for key in ("force", "patience", "stuck_speed", "stuck_time", "release_time", "retry_distance", "lead", "clearance",
                "funnel", "free", "margin"):  # fmt: skip
        _at_least(f"policy.flow.{key}", getattr(flow, key), 0)
    if flow.retries is not None:
        _at_least("policy.flow.retries", flow.retries, 0)
    for key in ("curvature", "rim", "min_distance", "near", "turning", "hand_radius", "clearance", "run_up"):
        _at_least(f"policy.contact.{key}", getattr(contact, key), 0)
    for key in ("reach", "sweep", "sweep_angle"):
        _positive(f"policy.contact.{key}", getattr(contact, key))
    for key, least in (("neighbors", 3), ("candidates", 1), ("sweep_steps", 1)):
        _at_least(f"policy.contact.{key}", getattr(contact, key), least)
    if contact.reach <= contact.clearance:
        raise UserError(
            f"policy.contact.reach={contact.reach} is where the hand's cylinder ends; give more than "
            f"policy.contact.clearance={contact.clearance}, where it starts"
        )
    shares = {"flow.fade": flow.fade, "contact.min_flow": contact.min_flow, "contact.weak_flow": contact.weak_flow}
    for key, value in shares.items():
        if not 0 <= value <= 1:
            raise UserError(f"policy.{key}={value} is no share; give a number from 0 to 1")
    if not -1 <= contact.facing <= 1:
        raise UserError(f"policy.contact.facing={contact.facing} is no cosine; give a number from -1 to 1")


def _validate_artflownet(algo: ArtFlowNetConfig) -> None:
    _one_of("algo.schedule", algo.schedule, ("constant", "one_cycle"))
    _one_of("algo.backbone", algo.backbone, ("pointnet2", "delayed"))
    if algo.name != "artflownet" and not algo.part_mask_input:
        raise UserError(f"algo={algo.name} is of one part, which the mask shows: leave algo.part_mask_input=true")
    for key in ("batch_size", "log_every", "neighbors"):
        _at_least(f"algo.{key}", getattr(algo, key), 1)
    if algo.ema is not None and not 0 < algo.ema < 1:
        raise UserError(f"algo.ema={algo.ema} is out of range; give a number between 0 and 1, or null")
    _one_of("algo.precision", algo.precision, ("fp32", "bf16"))
    for key in ("scale", "dropout"):
        if not 0 <= getattr(algo, key) < 1:
            raise UserError(f"algo.{key}={getattr(algo, key)} is out of range; give a number from 0 to below 1")
    _at_least("algo.jitter", algo.jitter, 0)
    for key in ("epochs", "lr"):
        _positive(f"algo.{key}", getattr(algo, key))


def _validate_imitation(algo: ImitationConfig, collector: CollectorConfig, labels: int) -> None:
    _one_of("algo.schedule", algo.schedule, ("constant", "one_cycle"))
    _one_of("algo.loss", algo.loss, ("l1", "l2", "smooth_l1"))
    _one_of("algo.beta.schedule", algo.beta.schedule, ("constant", "linear", "exponential", "first"))
    _one_of("algo.beta.mixing", algo.beta.mixing, ("step", "episode"))
    _one_of("algo.gate.name", algo.gate.name, ("beta", "safe", "ensemble", "lazy", "thrifty"))
    for key in ("rounds", "members", "batch_size", "log_every"):
        _at_least(f"algo.{key}", getattr(algo, key), 1)
    _positive("algo.epochs", algo.epochs)
    if labels < algo.rounds:
        raise UserError(f"data.labels={labels} is less than one for each of algo.rounds={algo.rounds}")
    _at_least("algo.validate_trials", algo.validate_trials, 0)
    _at_least("algo.turn", algo.turn, 0)
    _positive("algo.lr", algo.lr)
    for key in ("value", "base"):
        if not 0 <= getattr(algo.beta, key) <= 1:
            raise UserError(f"algo.beta.{key}={getattr(algo.beta, key)} is no share; give a number from 0 to 1")
    budget = algo.gate.budget
    if budget is not None and algo.gate.name not in ("safe", "lazy", "thrifty"):
        raise UserError(f"algo.gate.budget={budget} sets nothing of algo.gate.name={algo.gate.name}; leave it null")
    if budget is not None and not 0 <= budget <= 1:
        raise UserError(f"algo.gate.budget={budget} is no share; give a number from 0 to 1")
    if algo.gate.name in ("ensemble", "thrifty") and algo.members < 2:
        raise UserError(f"algo.gate.name={algo.gate.name} compares learners; give algo.members=2 or more")
    if algo.learner.head == "gaussian" and algo.learner.chunk > 1:
        raise UserError("algo.learner.head=gaussian has a likelihood for algo.learner.chunk=1 only")
    if (algo.learner.flow == "artflownet") != bool(algo.flow_checkpoint):
        raise UserError(
            "algo.learner.flow=artflownet and algo.flow_checkpoint=PATH, a checkpoint of algo=artflownet, go together"
        )
    if algo.overlap and collector.backend == "direct":
        raise UserError("algo.overlap=true collects beside the fit; choose collector=process or collector=ray")


def _positive(key: str, value: float) -> None:
    if value <= 0:
        raise UserError(f"{key}={value} must be greater than 0")


def _one_of(key: str, value: str, choices: tuple[str, ...]) -> None:
    if value not in choices:
        raise UserError(f"{key}={value} is unknown; choose from {', '.join(choices)}")


def _at_least(key: str, value: float, least: float) -> None:
    if value < least:
        raise UserError(f"{key}={value} is too small; give {least} or more")
