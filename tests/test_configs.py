"""Every configuration composes, converts to its schema and is valid; every key is read; defaults are the library's."""

from __future__ import annotations

import argparse
import ast
import dataclasses
import importlib
import math
import os
import re
import runpy
import subprocess
import sys
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any, get_type_hints

import hydra
import pytest
import yaml
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException
from omegaconf import OmegaConf

from fb3d_rl import options
from fb3d_rl.camera.options import CameraOptions
from fb3d_rl.config import COMMANDS, algorithms, configured, reference, sections
from fb3d_rl.errors import UserError
from fb3d_rl.models.cloud_network import BACKBONES
from fb3d_rl.models.encoders import ENCODERS
from fb3d_rl.policies.gates import GATES
from fb3d_rl.policies.learner import FLOW_KEYS
from fb3d_rl.rollout.options import CollectorOptions
from fb3d_rl.settings import leaves
from fb3d_rl.training.options import FitOptions

ROOT = Path(__file__).resolve().parents[1]
CONF = ROOT / "conf"
SCHEMAS = COMMANDS
NEEDS: dict[tuple[str, str], list[str]] = {
    ("train", "assets/partnet_mobility"): ["assets.root=."],
    ("evaluate", "assets/partnet_mobility"): ["assets.root=."],
    ("view", "assets/partnet_mobility"): ["assets.root=."],
    ("train", "assets/files"): ["assets.root=[a.urdf,b]"],
    ("evaluate", "assets/files"): ["assets.root=a.urdf", "assets.scale=0.001", "assets.front=-y"],
    ("view", "assets/files"): ["assets.root=.", "assets.front=+x"],
    ("view", "assets/mixed"): ["assets.root=."],
    ("train", "assets/mixed"): ["assets.root=."],
    ("evaluate", "assets/mixed"): ["assets.root=."],
    ("train", "experiment/comparison_partnet"): ["assets.root=."],
    ("evaluate", "experiment/comparison_partnet"): ["assets.root=."],
    ("train", "experiment/partnet_long"): ["assets.root=."],
    ("train", "experiment/partnet_gpu"): ["assets.root=."],
    **{("serve", f"assets/{name}"): ["assets.root=."] for name in ("partnet_mobility", "files", "mixed")},
    **{(command, "policy/plugin"): ["policy.target=mine:make"] for command in ("evaluate", "serve")},
    ("evaluate", "policy/artflownet"): ["checkpoint=checkpoint.pt"],
    ("evaluate", "policy/flowbotpp"): ["checkpoint=checkpoint.pt"],
    ("evaluate", "policy/screwnet"): ["checkpoint=checkpoint.pt"],
    ("evaluate", "policy/ump_di"): ["checkpoint=checkpoint.pt"],
    ("evaluate", "policy/umpnet"): ["checkpoint=checkpoint.pt"],
    ("evaluate", "policy/bc"): ["checkpoint=checkpoint.pt"],
    ("evaluate", "policy/dagger"): ["checkpoint=checkpoint.pt"],
}
TRAINING_ONLY = {"experiment/partnet_long", "experiment/partnet_gpu", "experiment/partnet"}


@pytest.fixture(autouse=True)
def composer(schemas: None) -> Iterator[None]:
    with hydra.initialize_config_dir(version_base="1.3", config_dir=str(CONF)):
        yield
    GlobalHydra.instance().clear()


def compose(name: str, *overrides: str) -> Any:
    """The checked configuration, as the command of that name has it."""
    return configured(OmegaConf.to_object(hydra.compose(name, overrides=list(overrides))))


def groups_of(name: str) -> list[str]:
    """The group options that conf/<name>.yaml can be given, as group/option."""
    defaults = yaml.safe_load((CONF / f"{name}.yaml").read_text())["defaults"]
    groups = [key for entry in defaults if isinstance(entry, dict) for key in entry if not key.startswith("override")]
    found = [f"{group}/{path.stem}" for group in groups for path in sorted((CONF / group).glob("*.yaml"))]
    return found


def cases() -> list[tuple[str, str]]:
    further = ("random", "normal", "plugin", "expert_arc", "flowbotpp", "screwnet", "ump_di", "umpnet", "bc", "dagger")
    other = {("train", f"policy/{name}") for name in ("expert", *further)}
    other |= {("view", f"policy/{name}") for name in further}
    other |= {(name, f"protocol/{own}") for name in ("train", "view", "serve") for own in ("robot", "umpnet")}
    skipped = {*other, *(("evaluate", option) for option in TRAINING_ONLY)}
    return [(name, option) for name in SCHEMAS for option in groups_of(name) if (name, option) not in skipped]


@pytest.mark.parametrize(("name", "schema"), SCHEMAS.items())
def test_the_defaults_are_valid(name: str, schema: type) -> None:
    assert type(compose(name)) is schema


@pytest.mark.parametrize(("name", "option"), cases())
def test_every_option_of_every_group_is_valid(name: str, option: str) -> None:
    compose(name, option.replace("/", "="), *NEEDS.get((name, option), []))


def test_the_robots_trials_are_evaluations() -> None:
    cfg = compose("evaluate", "protocol=robot", "robot.without=[flying]", "robot.calibration_deg=null")
    assert cfg.evaluation.protocol == "robot" and cfg.evaluation.trials is None and not cfg.robot.depth_noise().flying
    assert compose("evaluate").evaluation.protocol == "task"
    for command, words, says in (
        ("train", [], "launch/evaluate.py"),
        ("evaluate", ["robot.without=[spots]"], "robot.without=spots"),
        ("evaluate", ["collector=ray"], "collector=process"),
        ("evaluate", ["robot.noise=none"], "robot.noise"),
    ):
        with pytest.raises(UserError, match=says):
            compose(command, "protocol=robot", *words)


def test_no_file_is_beside_the_groups() -> None:
    used = {path for name in SCHEMAS for path in groups_of(name)}
    files = {f"{path.parent.name}/{path.stem}" for path in CONF.glob("*/*.yaml")}
    assert used == files
    assert {path.stem for path in CONF.glob("*.yaml")} == set(SCHEMAS)


@pytest.mark.parametrize("experiment", sorted(path.stem for path in (CONF / "experiment").glob("*.yaml")))
def test_every_experiment_changes_something_and_is_valid(experiment: str) -> None:
    cfg = compose("train", f"experiment={experiment}", *NEEDS.get(("train", f"experiment/{experiment}"), []))
    assert (cfg == compose("train")) == (experiment == "none")


def test_the_comparison_sweeps_over_algorithms_that_there_are() -> None:
    raw = hydra.compose("train", ["experiment=comparison"], return_hydra_config=True)
    algos = raw.hydra.sweeper.params["algo"].split(",")
    assert len(set(algos)) == len(algos) == 7
    for algo in algos:
        compose("train", "experiment=comparison", f"algo={algo}")


def test_what_the_command_line_says_goes_before_an_experiment() -> None:
    assert compose("train", "experiment=smoke", "data.train_samples=7").data.train_samples == 7
    assert compose("evaluate", "experiment=smoke").collector.backend == "direct"
    assert compose("evaluate", "experiment=smoke", "collector=process").collector.backend == "process"


@pytest.mark.parametrize("algo", sorted(path.stem for path in (CONF / "algo").glob("*.yaml")))
def test_smoke_bounds_the_steps_of_every_algorithm(algo: str) -> None:
    from fb3d_rl.algos import flow_network, rounds

    cfg = compose("train", "experiment=smoke", f"algo={algo}")
    if hasattr(cfg.algo, "rounds"):
        fits = [rounds.fit_options(cfg.algo, cfg.data.labels, 0, number) for number in range(cfg.algo.rounds)]
        assert sum(fit.steps for fit in fits) <= 75
    else:
        fit = flow_network.fit_options(cfg)
        assert fit.steps <= 8 and fit.steps * fit.batch_size <= 128  # clouds
    long = compose("train", "experiment=smoke", "algo=artflownet_paper", "data.max_epochs=null")
    assert flow_network.fit_options(long).steps == long.algo.epochs == 320


def declared(kind: type) -> set[tuple[type, str]]:
    """The keys of options and of the groups in them, each with the class that declares it."""
    own = {(owner(kind, item.name), item.name) for item, _, _ in options.keys(kind)}
    groups = [hint for _, hint, _ in options.keys(kind) if dataclasses.is_dataclass(hint)]
    return own.union(*(declared(hint) for hint in groups))  # type: ignore[arg-type]


def owner(kind: type, key: str) -> type:
    return next(base for base in reversed(kind.__mro__) if key in getattr(base, "__annotations__", {}))


def all_kinds() -> Iterator[type]:
    """Every class of options: of the commands, and of what stands in their groups."""
    todo: list[Any] = [*SCHEMAS.values(), *algorithms().values(), FitOptions]  # made of those of algorithms
    while todo:
        kind = todo.pop()
        yield from (base for base in kind.__mro__ if dataclasses.is_dataclass(base))
        todo += [hint for _, hint, _ in options.keys(kind) if dataclasses.is_dataclass(hint)]


KIND_OF = {kind.__name__: kind for kind in all_kinds()}
SAME_KIND = ("settled", "setup.settled", "replace")
"""Functions that give options with other values back."""


class Reads(ast.NodeVisitor):
    """The keys that a module reads of values which its annotations, casts and assignments say to be options.

    Args:
        names: what the module's names stand for, among them classes that hold options.
        cfg: what a parameter ``cfg`` without an annotation of options is.
    """

    def __init__(self, tree: ast.Module, names: Mapping[str, Any], cfg: type | None = None) -> None:
        self.found: set[tuple[type, str]] = set()
        self.names, self.cfg = names, cfg
        self.known: dict[str, type] = {}
        self.attributes: dict[str, type] = {}  # of self
        self.visit(tree)

    def visit_ClassDef(self, node: ast.ClassDef) -> None:
        outside, self.known = self.known, {**self.known}
        self.bind(ast.Name("self"), KIND_OF.get(node.name))
        for statement in node.body:
            if isinstance(statement, ast.AnnAssign) and isinstance(statement.target, ast.Name):
                self.bind(ast.Attribute(ast.Name("self"), statement.target.id), self.named(statement.annotation))
        self.generic_visit(node)
        self.known = outside

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        outside, self.known = self.known, dict(self.known)
        for argument in node.args.args + node.args.kwonlyargs:
            if argument.arg == "self":
                continue
            kind = self.named(argument.annotation)
            if kind is None and argument.arg == "cfg":
                kind = self.cfg
            self.bind(ast.Name(argument.arg), kind)
        self.generic_visit(node)
        self.known = outside

    def named(self, annotation: ast.AST | None) -> type | None:
        if annotation is None:
            return None
        text = ast.unparse(annotation).strip("'\"").removesuffix(" | None")
        kind = KIND_OF.get(text, self.names.get(text))
        return kind if isinstance(kind, type) else None

    def bind(self, target: ast.AST, kind: type | None) -> None:
        place = self.known if isinstance(target, ast.Name) else self.attributes
        name = getattr(target, "id", getattr(target, "attr", ""))
        place.pop(name, None)
        if kind is not None:
            place[name] = kind

    def visit_Assign(self, node: ast.Assign) -> None:
        self.generic_visit(node)
        for target in node.targets:
            if isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple):
                for one, value in zip(target.elts, node.value.elts, strict=True):
                    self.bind(one, self.kind(value))
            else:
                self.bind(target, self.kind(node.value))

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        self.generic_visit(node)
        self.bind(node.target, self.named(node.annotation) or (self.kind(node.value) if node.value else None))

    def kind(self, node: ast.AST) -> type | None:
        """The class of an expression's value, if it is known."""
        if isinstance(node, ast.Name):
            return self.known.get(node.id)
        if isinstance(node, ast.BoolOp):
            return next((kind for kind in map(self.kind, node.values) if kind), None)
        if isinstance(node, ast.Call):
            function = ast.unparse(node.func)
            if function in ("cast", "taken"):
                return self.named(node.args[0])
            return self.kind(node.args[0]) if function in SAME_KIND and node.args else self.named(node.func)
        if isinstance(node, ast.Attribute):
            holder = self.kind(node.value)
            if holder is None:
                own = isinstance(node.value, ast.Name) and node.value.id == "self"
                return self.attributes.get(node.attr) if own else None
            kind = types_of(holder).get(node.attr)
            return kind if isinstance(kind, type) else None
        return None

    def visit_Attribute(self, node: ast.Attribute) -> None:
        self.generic_visit(node)
        kind = self.kind(node.value)
        if kind in KIND_OF.values() and isinstance(node.ctx, ast.Load):
            assert kind is not None and hasattr(kind(**needed(kind)), node.attr), f"{kind.__name__} has no {node.attr}"
            if node.attr in types_of(kind):
                self.found.add((owner(kind, node.attr), node.attr))


def types_of(kind: type) -> dict[str, Any]:
    """The types of a class's annotated attributes, where they are known at run time."""
    try:
        return get_type_hints(kind)
    except (NameError, TypeError):  # of a library that is compiled without what it names
        return {}


def needed(kind: type) -> dict[str, int]:
    """Values of the fields that have no default."""
    lacking = (dataclasses.MISSING, dataclasses.MISSING)
    return {field.name: 1 for field in dataclasses.fields(kind) if (field.default, field.default_factory) == lacking}  # type: ignore[arg-type]


def all_reads() -> set[tuple[type, str]]:
    found: set[tuple[type, str]] = set()
    checks = ("config.py", "options.py")  # they read values to check them, which is no use of them
    for path in sorted((ROOT / "fb3d_rl").rglob("*.py")):
        text = path.read_text()
        if path.name not in checks and any(name in text for name in (*KIND_OF, "Protocol", "Control")):
            module = importlib.import_module(".".join(path.relative_to(ROOT).with_suffix("").parts))
            found |= Reads(ast.parse(text), vars(module)).found
    for path in sorted((ROOT / "fb3d_rl").rglob("options.py")):  # their methods
        found |= Reads(ast.parse(path.read_text()), {}).found
    for name, schema in SCHEMAS.items():
        found |= Reads(ast.parse((ROOT / "launch" / f"{name}.py").read_text()), {}, schema).found
    return found


def test_every_key_is_read_by_code() -> None:
    declarations: set[tuple[type, str]] = set().union(*map(declared, (*SCHEMAS.values(), *algorithms().values())))
    assert len(declarations) > 150
    unread = sorted(f"{kind.__name__}.{key}" for kind, key in declarations - all_reads())
    assert not unread, f"no code reads {', '.join(unread)}"


def test_only_what_is_read_of_options_counts() -> None:
    source = """
def task(cfg: TrainConfig, other: object, loss: LossOptions, speeds: FlowPolicyOptions | None = None) -> None:
    env, algo = cfg.env, cast("ImitationOptions", cfg.algo)
    use(env.horizon, algo.gate.budget, other.epochs, loss.lr, "algo.turn")  # cfg.seed
    speeds = speeds or FlowPolicyOptions()
    cfg.device = "cpu"
    env = other
    env.success
    use(speeds.fade, asdict(cfg.logger))
"""
    found = {f"{kind.__name__}.{key}" for kind, key in Reads(ast.parse(source), {}).found}
    groups = {"CommandConfig.env", "TrainConfig.algo", "TrainConfig.logger", "ImitationOptions.gate"}
    assert found == {*groups, "EnvOptions.horizon", "GateOptions.budget", "FlowPolicyOptions.fade"}
    with pytest.raises(AssertionError, match="has no horizont"):
        Reads(ast.parse("def task(cfg: ViewConfig): return cfg.env.horizont"), {})


def test_the_run_follows_from_the_configuration() -> None:
    from fb3d_rl.algos import setup
    from fb3d_rl.algos.flow_network import fit_options

    cfg = compose("train", "data.points=321", "camera.fov=50", "env.gripper.v_max=0.7", "env.suction.max_stretch=0.2",
                  "policy.contact.min_distance=0.03", "policy.flow.pull_speed=0.6",
                  "algo.epochs=2", "algo.batch_size=8", "data.train_samples=21",
                  "seed=3", "collector.workers=3", "collector.restarts=4",
                  "evaluation.trials=null", "camera.azimuth=[1,2]", "env.gravity=true")  # fmt: skip
    samples, env, speeds, fit = (
        setup.sample_options(cfg), setup.env_options(cfg), setup.flow_policy_options(cfg), fit_options(cfg)
    )  # fmt: skip
    assert samples.points == env.points == 321 and samples.camera == env.camera and env.camera.fov == 50
    assert tuple(samples.views.azimuth) == (1.0, 2.0) and env.views == samples.views and env.gravity
    assert env.gripper.v_max == setup.velocity_limits(cfg).linear == 0.7 and env.suction.max_stretch == 0.2
    assert speeds.contact.min_distance == 0.03 and speeds.pull_speed == 0.6
    assert setup.protocol(cfg).collector == CollectorOptions("process", 3, 4)
    assert (fit.steps, fit.batch_size, fit.seed) == (6, 8, 3) and setup.protocol(cfg).trials is None


@pytest.mark.parametrize("name", SCHEMAS)
def test_no_file_repeats_a_default(name: str) -> None:
    defaults = {key: default for rows in sections(name).values() for key, default, _, _ in rows}
    for group, stem in (option.split("/") for option in groups_of(name)):
        content = yaml.safe_load((CONF / group / f"{stem}.yaml").read_text())
        if group in ("experiment", "protocol", "policy", "algo") or "defaults" in content:
            continue
        for key, value in leaves(content, f"{group}."):
            written = yaml.safe_load(defaults[key])
            assert value != written or key == "logger.name", f"conf/{group}/{stem}.yaml repeats {key}={value}"


@pytest.mark.parametrize("kind", KIND_OF.values())
def test_a_schema_stands_for_its_options(kind: type) -> None:
    """Defaults survive the way through Hydra's types, so that the library's and the commands' are the same."""
    own = kind(**needed(kind))
    if needed(kind):
        return  # set by code alone, so never a group of a configuration
    again = options.built(OmegaConf.to_object(OmegaConf.structured(options.schema(kind))))
    for item, _, about in options.keys(kind):
        assert getattr(again, item.name) == getattr(own, item.name)
        assert about.help


def test_a_configuration_is_checked_before_anything_slow_is_imported() -> None:
    code = "import sys, fb3d_rl.config as c; c.help_of('train'); print({'torch', 'sapien', 'hydra'} & {*sys.modules})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True)
    assert done.stdout == "set()\n"


def test_the_reference_is_current() -> None:
    path = ROOT / "docs" / "configuration.md"
    assert path.read_text() == reference(), f"{path.name} is old: python -m fb3d_rl.config > docs/configuration.md"


@pytest.mark.parametrize(
    ("key", "implemented"),
    [
        ("algo.backbone", BACKBONES),
        ("algo.learner.encoder", ENCODERS),
        ("algo.learner.flow", FLOW_KEYS),
        ("algo.gate.name", {*GATES} - {"human"}),  # a person is asked by a program, not by a configuration
    ],
)
def test_choices_are_those_that_are_implemented(key: str, implemented: Collection[str]) -> None:
    allowed = next(values for rows in sections("train").values() for name, _, values, _ in rows if name == key)
    assert set(allowed.split(", ")) == set(implemented)


def test_intervals_hold_what_they_say() -> None:
    @dataclasses.dataclass(frozen=True)
    class Some:
        value: float = options.option(0.5, "some number", within="(0, 1]")

    for good in (1e-9, 0.5, 1.0):
        options.check(Some(good))
    for bad in (0.0, 1.1, -math.inf, math.inf, math.nan):
        with pytest.raises(UserError, match=r"group\.value=.* is out of range; give a number above 0 to 1"):
            options.check(Some(bad), "group.")


@pytest.mark.parametrize(
    ("override", "word"),
    [
        ("device=gpu", "device"),
        ("seed=-1", "seed"),
        ("algo.schedule=cosine", "algo.schedule"),
        ("algo.epochs=0", "algo.epochs"),
        ("algo.lr=0", "algo.lr"),
        ("data.points=3", "data.points"),
        ("data.closed_share=1.5", "data.closed_share"),
        ("data.some_parts_share=-0.5", "data.some_parts_share"),
        ("data.workers=-1", "data.workers"),
        ("camera.azimuth=[10,-10]", "camera.azimuth"),
        ("camera.elevation=[10]", "camera.elevation"),
        ("camera.resolution=0", "camera.resolution"),
        ("camera.kind=lidar", "camera.kind"),
        ("camera.shader=rt", "camera.shader"),
        ("collector.backend=rpc", "collector.backend"),
        ("collector.workers=0", "collector.workers"),
        ("collector.restarts=-1", "collector.restarts"),
        ("evaluation.trials=-1", "evaluation.trials"),
        ("env.suction.hold=all", "env.suction.hold"),
        ("policy=expert", "policy.name"),
        ("policy.mask=some", "policy.mask"),
        ("policy.mask=none", "algo.part_mask_input=false"),
        ("policy.flow.retries=-1", "policy.flow.retries"),
        ("policy.flow.pull_speed=0", "policy.flow.pull_speed"),
        ("policy.flow.patience=-0.1", "policy.flow.patience"),
        ("policy.flow.fade=2", "policy.flow.fade"),
        ("policy.contact.min_flow=1.5", "policy.contact.min_flow"),
        ("policy.contact.neighbors=2", "policy.contact.neighbors"),
        ("policy.contact.facing=2", "policy.contact.facing"),
        ("policy.contact.reach=0.05", "policy.contact.clearance"),
        ("assets.source=shapenet", "assets.source"),
        ("assets=partnet_mobility", "assets.root"),
    ],
)
def test_values_out_of_range_are_named(defaults: Any, override: str, word: str) -> None:
    with pytest.raises(UserError, match=re.escape(word)):
        if override.split("=")[0] in os.listdir(CONF):
            compose("train", override)
        else:
            configured(OmegaConf.to_object(OmegaConf.merge(defaults, OmegaConf.from_dotlist([override]))))


@pytest.fixture(scope="module")
def defaults(schemas: None) -> Any:
    """conf/train.yaml, composed once, since that takes a while."""
    with hydra.initialize_config_dir(version_base="1.3", config_dir=str(CONF)):
        return hydra.compose("train")


def test_the_camera_of_the_task_can_be_another_than_that_of_the_samples() -> None:
    from fb3d_rl.algos import setup

    cfg = compose("train", "camera=sapien", "camera.shader=default", "camera.fov=50")
    assert setup.env_options(cfg).camera == CameraOptions(fov=50, kind="sapien", shader="default")
    assert setup.sample_options(cfg).camera == CameraOptions(fov=50)  # samples drawn before stay valid


def test_a_missing_checkpoint_is_named() -> None:
    with pytest.raises(UserError, match="checkpoint"):
        compose("evaluate", "policy=artflownet")


@pytest.mark.parametrize(
    ("override", "word"),
    [
        ("port=0", "port=0"),
        ("port=70000", "65535"),
        ("policy=random", "policy.name"),
        ("policy=bc", "checkpoint=PATH"),
        ("record=met", "record=met"),
    ],
)
def test_what_the_live_page_cannot_do_is_named(override: str, word: str) -> None:
    with pytest.raises(UserError, match=re.escape(word)):
        compose("view", override)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("train", ["algo=bc"]),
        ("train", ["algo=screwnet"]),
        ("train", ["algo=flowbotpp"]),
        ("evaluate", ["policy=expert_arc"]),
        ("evaluate", ["policy=normal"]),
        ("evaluate", ["policy=dagger", "checkpoint=x.pt"]),
        ("evaluate", ["policy=ump_di", "checkpoint=x.pt"]),
    ],
)
def test_what_needs_the_mask_is_not_run_without(name: str, words: list[str]) -> None:
    compose(name, *words)
    with pytest.raises(UserError, match=r"leave policy\.mask=target"):
        compose(name, *words, "policy.mask=none")


def test_what_learns_to_open_has_no_other_goal() -> None:
    compose("train", "algo=artflownet", "protocol=goal_state")
    for name, words in {"train": ["algo=bc"], "evaluate": ["policy=dagger", "checkpoint=x.pt"]}.items():
        with pytest.raises(UserError, match="learns to open only"):
            compose(name, *words, "protocol=goal_state")


def test_infinity_can_be_given() -> None:
    assert compose("train", "env.suction.breaking_force=inf").env.suction.breaking_force == math.inf


@pytest.mark.parametrize("split", ["test", "[train_test,test]", "[test,Laptop,10098]", "10098"])
def test_splits_can_be_given_as_a_name_an_id_or_a_list(split: str) -> None:
    compose("train", "assets=partnet_mobility", "assets.root=.", f"assets.split={split}")


TEXTS = (
    *sorted(ROOT.glob("*.md")),
    *sorted((ROOT / "docs").glob("*.md")),
    *sorted((ROOT / "results").glob("**/*.md")),
    *sorted((ROOT / "launch").glob("*.py")),
    *sorted(CONF.glob("**/*.yaml")),
)
START = r"(?:python|torchrun [^\s`]+) launch/"
PLACEHOLDERS = {"N": "1", "algo=NAME": "algo=dagger", "policy=NAME": "policy=expert", "SPLIT": "all"}


def documented_commands() -> list[str]:
    """Commands in backticks, which may be broken over lines, and lines that begin with one, without their comments."""
    found = set()
    pattern = rf"(?<!`)`{{1,2}}({START}[^`]+)`{{1,2}}(\s+with\s+the\s+(?:\S+\s+)?folder)?"
    for path in TEXTS:
        text = path.read_text()
        for quoted, folder in re.findall(pattern, text):
            found.add(" ".join(quoted.split()) + (" RUN" if folder else ""))
        for line in re.findall(rf"^[ #]*({START}.*)", text, re.MULTILINE):
            found.add(re.split(r"\s{3,}|\s+#", line)[0])
    return sorted(found)


def variants(command: str) -> list[list[str]]:
    """The command's words with every alternative that it leaves: with and without ``[word]``, ``A|B``, ``a,b`` of -m.

    Places for something else become something.
    """
    optional = re.compile(r"(?<=\s)\[([^\]]+)\]")
    made = set()
    for text in (optional.sub("", command), optional.sub(r"\1", command)):
        words = [word for word in text.split() if word != "..." and not word.endswith("=...")]
        words = [PLACEHOLDERS.get(word, word).replace(",...", "") for word in words]
        choices = [re.split(r"[|]", word.partition("=")[2] or word) for word in words]
        if "-m" in words:
            choices = [re.split(r",(?![^\[]*\])", one[0]) for one in choices]  # not within a list
        for i in range(max(map(len, choices))):
            names = [word.partition("=")[0] + "=" if "=" in word else "" for word in words]
            made.add(tuple(name + one[i % len(one)] for name, one in zip(names, choices, strict=True)))
    return [list(words) for words in sorted(made)]


class Parsed(Exception):
    """The parser has understood the command."""


def understand(words: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the command's own parser, or Hydra and the checks, read its words."""
    if words[0] == "torchrun":
        from torch.distributed.run import get_args_parser

        assert get_args_parser().parse_args([word.replace("=N", "=2") for word in words[1:]]).training_script
        words = words[1:]
    script, *words = words[1:]
    assert (ROOT / script).is_file()
    name = Path(script).stem
    if name in SCHEMAS:
        chosen = [word for word in words if not word.startswith(("hydra.", "-"))]
        assert not {*words} - {*chosen} - {"-m", "--help", "--cfg"} - {w for w in words if w.startswith("hydra.")}
        compose(name, *(word for word in chosen if word != "job"))
        return
    main, parse = runpy.run_path(str(ROOT / script))["main"], argparse.ArgumentParser.parse_args

    def parsed(*arguments: Any) -> None:
        parse(*arguments)
        raise Parsed

    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", parsed)
    with pytest.raises(Parsed):
        main(words)


@pytest.mark.parametrize("command", documented_commands())
def test_documented_commands_are_understood(command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if re.fullmatch(r"python launch/\w+\.py", command):  # named, not written out
        assert (ROOT / command.split()[1]).is_file()
        return
    for words in variants(command):
        if " [" in command:  # a synopsis: what one choice needs is among what it leaves open
            words += [need for word in words for need in NEEDS.get((Path(words[1]).stem, word.replace("=", "/")), [])]
        understand(words, monkeypatch)


def test_every_command_is_documented_and_a_wrong_one_not_understood(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    scripts = {path.name for path in (ROOT / "launch").glob("*.py")} - {"command.py", "run_folder.py"}
    assert {re.findall(r"launch/(\w+\.py)", command)[0] for command in documented_commands()} == scripts
    assert variants("python launch/x.py a=P|q [--b NAME,...] ...") == [
        ["python", "launch/x.py", "a=P"], ["python", "launch/x.py", "a=P", "--b", "NAME"],
        ["python", "launch/x.py", "a=q"], ["python", "launch/x.py", "a=q", "--b", "NAME"],
    ]  # fmt: skip
    for wrong in ("report.py --papper RUN", "demos.py lst DEMOS", "benchmark.py --rounds many", "export.py RUN"):
        with pytest.raises(SystemExit):
            understand(["python", *f"launch/{wrong}".split()], monkeypatch)
    with pytest.raises(HydraException):
        understand(["python", "launch/train.py", "algo.epcohs=1"], monkeypatch)


def test_documented_targets_of_make_are_there() -> None:
    targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    named = {word for path in TEXTS for word in re.findall(r"(?:^|`)make ([\w-]+)", path.read_text(), re.MULTILINE)}
    assert {"train", "test", "check", "install-training"} <= named <= {*targets}


def test_what_training_needs_is_all_but_the_simulator() -> None:
    lines = subprocess.run(["make", "-n", "install-training"], cwd=ROOT, check=True, capture_output=True, text=True)
    [program] = re.findall(r"-c '(.+?)' >", lines.stdout.replace("\\\n", ""))
    found = subprocess.run([sys.executable, "-c", program], cwd=ROOT, check=True, capture_output=True, text=True)
    names = {re.split(r"[=<>;]", line)[0] for line in found.stdout.split("\n") if line}
    assert {"torch", "torchrl", "trimesh", "hydra-core"} <= names and not names & {"sapien", "mani-skill"}
