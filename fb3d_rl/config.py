"""The configuration of each command, and its checks before any work. Only launch/ imports this.

The keys are described in the options classes of the groups; conf/*.yaml holds the values that differ from their
defaults. ``python -m fb3d_rl.config`` prints docs/configuration.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from fb3d_rl import registry
from fb3d_rl.algos.options import AlgoOptions, FlowNetworkOptions, ImitationOptions
from fb3d_rl.assets.options import AssetsOptions
from fb3d_rl.camera.options import DepthCameraOptions
from fb3d_rl.data.options import DataOptions
from fb3d_rl.env.options import EnvOptions
from fb3d_rl.env.umpnet.options import UmpnetOptions
from fb3d_rl.errors import UserError
from fb3d_rl.evaluation.options import EvaluationOptions
from fb3d_rl.options import built, group, keys, listing, option, schema
from fb3d_rl.policies.options import BUDGETED, COMPARING, PolicyOptions
from fb3d_rl.registry import REGISTRY
from fb3d_rl.robot.options import RobotOptions
from fb3d_rl.rollout.options import CollectorOptions
from fb3d_rl.training.options import LoggerOptions


@dataclass(frozen=True)
class CommandConfig:
    """What all commands share."""

    assets: AssetsOptions = group(AssetsOptions)
    data: DataOptions = group(DataOptions)
    camera: DepthCameraOptions = group(DepthCameraOptions)
    env: EnvOptions = group(EnvOptions)
    policy: PolicyOptions = group(PolicyOptions)
    collector: CollectorOptions = group(CollectorOptions)
    evaluation: EvaluationOptions = group(EvaluationOptions)
    seed: int = option(0, "seed of all random draws", within="[0, inf)")
    device: Literal["auto", "cpu", "cuda"] = option(
        "auto", "device on which networks are trained and measured; policies run on the CPU, in the workers"
    )


@dataclass(frozen=True)
class ExpertOptions:
    """The expert of env.task."""

    target: str | None = option(
        None,
        "package.module:make, where make(env) gives a function from ManiSkill's observation to the expert's action",
    )


@dataclass(frozen=True)
class TrainConfig(CommandConfig):
    """Everything that launch/train.py needs."""

    expert: ExpertOptions = group(ExpertOptions)
    algo: AlgoOptions = group(AlgoOptions)
    logger: LoggerOptions = group(LoggerOptions)
    resume: bool = option(False, "go on from the run folder's checkpoint; name the folder with hydra.run.dir=DIR")


@dataclass(frozen=True)
class EvaluateConfig(CommandConfig):
    """Everything that launch/evaluate.py needs."""

    checkpoint: str | None = option(None, "a run folder of launch/train.py, or a file of its weights")
    resume: bool = option(False, "go on from the rows in the run folder; name it with hydra.run.dir=DIR")
    robot: RobotOptions = group(RobotOptions)
    umpnet: UmpnetOptions = group(UmpnetOptions)


@dataclass(frozen=True)
class ViewConfig(CommandConfig):
    """Everything that launch/view.py needs."""

    checkpoint: str | None = option(
        None,
        "an ArtFlowNet: run folder, checkpoint.pt, .safetensors or pretrained; null shows only the true flow; with "
        "policy=bc or policy=dagger the learner's run folder or checkpoint.pt",
    )
    object: Any = option(
        None, "the folder of an object, an id, or a category, whose first object is shown; null: the first object"
    )
    port: int = option(
        8080, "port of the page, which only this machine reaches; the next free one if it is taken", within="[1, 65535]"
    )
    record: str | None = option(
        None,
        "with policy=bc or policy=dagger: folder of demonstrations to which each trial is added as an episode, new or "
        "from before; null: nothing is kept",
    )


@dataclass(frozen=True)
class ServeConfig(CommandConfig):
    """Everything that launch/serve.py needs."""

    checkpoint: str | None = option(
        "pretrained", "weights of the policy: a run folder, a file, or pretrained; not read by one that has none"
    )
    host: str = option("127.0.0.1", "address that is listened on; only this machine reaches the default")
    port: int = option(8000, "port; 0: any free one", within="[0, 65535]")
    token: str | None = option(
        None, "what clients have to give as api_key, '${oc.env:NAME}' for a variable of the environment; null: nothing"
    )
    megabytes: float = option(16.0, "size of the largest message that is read", "MiB", "(0, 2047]")
    clients: int = option(8, "clients that are served at once", within="[1, inf)")


COMMANDS: dict[str, type[CommandConfig]] = {
    "train": TrainConfig,
    "evaluate": EvaluateConfig,
    "view": ViewConfig,
    "serve": ServeConfig,
}


LEARNERS = tuple(name for name, entry in REGISTRY.items() if entry is registry.IMITATION)
"""The policies that imitate, from which a person can take over."""


def algorithms() -> dict[str, type[AlgoOptions]]:
    """The options of each algorithm by its name."""
    return {name: registry.behind(REGISTRY[name].options) for name in registry.trained()}


def schemas(command: str) -> dict[tuple[str | None, str], type]:
    """The typed schemas by the group and the name by which conf/<command>.yaml and conf/algo/ know them."""
    found: dict[tuple[str | None, str], type] = {(None, f"{command}_schema"): schema(COMMANDS[command])}
    if command == "train":
        found |= {("algo", kind.__name__): schema(kind) for kind in algorithms().values()}
    return found


def configured(values: Any) -> Any:
    """The checked configuration with the values of an instance of a command's schema.

    Raises:
        UserError: names the first wrong key and its allowed values.
    """
    cfg = built(values)
    validate(cfg)
    return cfg


def validate(cfg: CommandConfig) -> None:
    """Check combinations of keys; ranges are checked when a configuration is built (:func:`configured`).

    Raises:
        UserError: names the first wrong key and its allowed values.
    """
    one_of("policy.name", cfg.policy.name, tuple(REGISTRY))
    if cfg.policy.contact.reach <= cfg.policy.contact.clearance:
        raise UserError(
            f"policy.contact.reach={cfg.policy.contact.reach} is where the hand's cylinder ends; give more than "
            f"policy.contact.clearance={cfg.policy.contact.clearance}, where it starts"
        )
    acting = cfg.policy.name
    if isinstance(cfg, TrainConfig):
        one_of("policy.name", cfg.policy.name, ("artflownet",))  # the algorithm says what is evaluated
        acting = cfg.algo.name
        _validate_training(cfg)
    needs = isinstance(cfg, EvaluateConfig | ServeConfig) or (isinstance(cfg, ViewConfig) and acting in LEARNERS)
    if needs and REGISTRY[acting].trained and not getattr(cfg, "checkpoint", None):
        raise UserError(f"policy={acting} needs checkpoint=PATH, a run folder of launch/train.py or its checkpoint.pt")
    if cfg.evaluation.protocol != "task" and not isinstance(cfg, EvaluateConfig):
        raise UserError(
            f"protocol={cfg.evaluation.protocol} has trials of its own, which launch/evaluate.py runs alone"
        )
    if REGISTRY[cfg.policy.name].outside != bool(cfg.policy.target):
        raise UserError("policy=plugin and policy.target=package.module:make, a policy of your own, go together")
    if isinstance(cfg, ViewConfig):
        one_of("policy.name", cfg.policy.name, ("expert", "artflownet", *LEARNERS))
        if cfg.record is not None and cfg.policy.name not in LEARNERS:
            raise UserError(
                f"record={cfg.record} keeps what a person does who takes over from a learner: give policy=dagger or "
                "policy=bc, with its checkpoint=RUN"
            )
    _validate_task(cfg)
    if cfg.env.sim_freq % cfg.env.control_freq:
        raise UserError(f"env.sim_freq={cfg.env.sim_freq} is no multiple of env.control_freq={cfg.env.control_freq}")
    if isinstance(cfg, EvaluateConfig) and cfg.evaluation.protocol == "robot":
        cfg.robot.depth_noise()  # refuses unknown terms
        if cfg.collector.backend == "ray":
            raise UserError("protocol=robot runs in processes of this machine: give collector=process or direct")
    if cfg.policy.mask == "none" and not REGISTRY[acting].maskless:
        raise UserError(f"{acting} has to see which part to open: leave policy.mask=target")
    if cfg.evaluation.goal == "state" and REGISTRY[acting].opens_only:
        raise UserError(f"{acting} learns to open only; evaluation.goal=state is for policies of a flow")
    for key in ("azimuth", "elevation"):
        ends = getattr(cfg.camera, key)
        if len(ends) != 2 or ends[0] > ends[1]:
            raise UserError(
                f"camera.{key}={[*ends]} is no range; give two ascending angles in degrees, [lowest,highest]"
            )
    _validate_assets(cfg.assets)


def _validate_task(cfg: CommandConfig) -> None:
    if cfg.env.task is None and not (isinstance(cfg, TrainConfig) and cfg.expert.target):
        return
    if not isinstance(cfg, TrainConfig):
        raise UserError(f"env.task={cfg.env.task} is for launch/train.py with algo=bc or algo=dagger")
    if not (cfg.env.task and cfg.expert.target):
        raise UserError("env.task=TASK, a task of ManiSkill, and expert.target=package.module:make go together")
    algo = cfg.algo
    if not isinstance(algo, ImitationOptions):
        raise UserError(f"algo={algo.name} opens parts; on env.task={cfg.env.task} choose algo=bc or algo=dagger")
    if algo.learner.encoder == "artflownet":
        raise UserError(f"algo.learner.encoder=artflownet has seen objects that open, not env.task={cfg.env.task}")
    for key, value, wanted in (
        ("algo.gate.name", algo.gate.name, "beta"),
        ("algo.members", algo.members, 1),
        ("algo.oracle", algo.oracle, False),
        ("algo.learner.flow", algo.learner.flow, "none"),
        ("algo.learner.focus", algo.learner.focus, "none"),
        ("algo.learner.contact", algo.learner.contact, False),
        ("algo.learner.phase", algo.learner.phase, False),
        ("algo.demonstrations", algo.demonstrations, None),
        ("algo.overlap", algo.overlap, False),
        ("algo.validate_trials", algo.validate_trials, 0),
    ):
        if value != wanted:
            said = "null" if wanted is None else str(wanted).lower()
            raise UserError(f"{key}={value} is for opening parts; with env.task={cfg.env.task} leave {key}={said}")


def _validate_assets(assets: AssetsOptions) -> None:
    for key in ("split", "eval_split"):
        words = getattr(assets, key)
        if not (isinstance(words, (str, int)) or (isinstance(words, list) and words)):
            raise UserError(f"assets.{key}={words} is no split; give a name or a list of names: [train_test,test]")
    if assets.source == "procedural":
        _at_least("assets.eval_count", assets.eval_count, 1)
    elif assets.source == "files":
        if not assets.paths:
            raise UserError(
                "assets.root is not set; give a file, a folder of files or a list of paths: assets.root=PATH"
            )
        assets.metres  # noqa: B018 - refuses what is no scale
    elif len(assets.paths) != 1:
        raise UserError("assets.root is not set; give the folder that holds PartNet-Mobility objects: assets.root=DIR")


def _validate_training(cfg: TrainConfig) -> None:
    algo = cfg.algo
    one_of("algo.name", algo.name, registry.trained())
    if isinstance(algo, FlowNetworkOptions):
        if algo.network and algo.name != "artflownet":
            raise UserError(f"algo.network={algo.network} is for algo=artflownet")
        if not REGISTRY[algo.name].maskless and not algo.part_mask_input:
            raise UserError(f"algo={algo.name} is of one part, which the mask shows: leave algo.part_mask_input=true")
        needs_mask = algo.part_mask_input and not cfg.data.unmasked_share
        if cfg.policy.mask == "none" and REGISTRY[algo.name].maskless and needs_mask:
            raise UserError(
                "policy.mask=none keeps the mask from the network too: give algo.part_mask_input=false, or "
                "data.unmasked_share=0.2 for a network that does with and without"
            )
    elif isinstance(algo, ImitationOptions):
        _validate_imitation(algo, cfg.collector, cfg.data.labels)
    _at_least("data.train_samples", cfg.data.train_samples, 1)
    _at_least("data.met_samples", cfg.data.met_samples, 1)
    _at_least("assets.train_count", cfg.assets.train_count, 1)


def _validate_imitation(algo: ImitationOptions, collector: CollectorOptions, labels: int) -> None:
    gate, learner = algo.gate, algo.learner
    if labels < algo.rounds:
        raise UserError(f"data.labels={labels} is less than one for each of algo.rounds={algo.rounds}")
    if gate.budget is not None and gate.name not in BUDGETED:
        raise UserError(f"algo.gate.budget={gate.budget} sets nothing of algo.gate.name={gate.name}; leave it null")
    if gate.name in COMPARING and algo.members < 2:
        raise UserError(f"algo.gate.name={gate.name} compares learners; give algo.members=2 or more")
    if algo.members > 1 and (learner.execute > 1 or learner.ensemble is not None):
        raise UserError(
            f"algo.members={algo.members} learners would each go on with plans of their own; leave "
            "algo.learner.execute=1 and algo.learner.ensemble=null"
        )
    if (learner.flow == "artflownet") != bool(algo.flow_checkpoint):
        raise UserError(
            "algo.learner.flow=artflownet and algo.flow_checkpoint=PATH, a checkpoint of algo=artflownet, go together"
        )
    if learner.encoder != "artflownet" and not learner.frozen:
        raise UserError("algo.learner.frozen=false trains the weights of algo.learner.encoder=artflownet")
    if algo.overlap and collector.backend == "direct":
        raise UserError("algo.overlap=true collects beside the fit; choose collector=process or collector=ray")


def one_of(key: str, value: str, choices: tuple[str, ...]) -> None:
    """Check that a key has one of its values.

    Raises:
        UserError: it has not; names the values.
    """
    if value not in choices:
        raise UserError(f"{key}={value} is unknown; choose from {', '.join(choices)}")


def _at_least(key: str, value: float, least: float) -> None:
    if value < least:
        raise UserError(f"{key}={value} is out of range; give {least} or more")


def sections(command: str) -> dict[str, list[tuple[str, str, str, str]]]:
    """The keys of a command by group, as :func:`fb3d_rl.options.listing` gives them; those of ``algo`` by class."""
    found: dict[str, list[tuple[str, str, str, str]]] = {}
    for item, _, _ in keys(COMMANDS[command]):
        if item.name == "algo":
            for kind in dict.fromkeys(algorithms().values()):
                names = [name for name, other in algorithms().items() if other is kind]
                found[f"algo, of {', '.join(names)}"] = [*listing(kind, "algo.")]
    for row in listing(COMMANDS[command]):
        group_of = row[0].split(".")[0] if "." in row[0] else command
        if group_of != "algo":
            found.setdefault(group_of, []).append(row)
    return found


def help_of(command: str) -> str:
    """The text of ``--help`` on each key."""
    lines = []
    for title, rows in sections(command).items():
        lines.append(f"\n== {title} ==")
        lines += [f"{key}  {help}" + (f" [{allowed}]" if allowed else "") for key, _, allowed, help in rows]
    return "\n".join(lines)


def reference() -> str:
    """docs/configuration.md."""
    tables: dict[str, list[tuple[str, str, str, str]]] = {}
    for command in COMMANDS:
        tables |= {title: rows for title, rows in sections(command).items() if title not in tables}
    lines = [
        "# Configuration",
        "",
        "Every key of `launch/train.py`, `launch/evaluate.py`, `launch/view.py` and `launch/serve.py`, with its",
        "default before the files in `conf/` set what differs; `python launch/train.py --help` shows the values that",
        "result. Written by `python -m fb3d_rl.config`.",
    ]
    for title, rows in tables.items():
        lines += ["", f"## {title}", "", "| key | default | values | |", "| --- | --- | --- | --- |"]
        for key, default, allowed, help in rows:
            cells = (f"`{key}`", f"`{default}`", allowed, help)
            lines.append("| " + " | ".join(cell.replace("<", "&lt;") for cell in cells) + " |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    print(reference(), end="")
