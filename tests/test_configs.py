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
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, get_type_hints

import hydra
import pytest
import yaml
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException
from omegaconf import OmegaConf

from fb3d_rl import config
from fb3d_rl.camera.raycast import CameraOptions
from fb3d_rl.camera.views import ViewRange
from fb3d_rl.config import (
    ArtFlowNetConfig,
    EvaluateConfig,
    ImitationConfig,
    TrainConfig,
    ViewConfig,
    validate,
)  # fmt: skip
from fb3d_rl.data.samples import SampleOptions
from fb3d_rl.env.options import EnvOptions, GripperOptions, SuctionOptions
from fb3d_rl.errors import UserError
from fb3d_rl.policies.contact import ContactOptions
from fb3d_rl.policies.flow_policy import FlowPolicyOptions
from fb3d_rl.rollout.collectors import CollectorOptions

ROOT = Path(__file__).resolve().parents[1]
CONF = ROOT / "conf"
SCHEMAS = {"train": TrainConfig, "evaluate": EvaluateConfig, "view": ViewConfig}
ABSTRACT = {"policy/flow"}  # what the options of a group share
NEEDS: dict[tuple[str, str], list[str]] = {
    ("train", "assets/partnet_mobility"): ["assets.root=."],
    ("evaluate", "assets/partnet_mobility"): ["assets.root=."],
    ("view", "assets/partnet_mobility"): ["assets.root=."],
    ("view", "assets/mixed"): ["assets.root=."],
    ("train", "assets/mixed"): ["assets.root=."],
    ("evaluate", "assets/mixed"): ["assets.root=."],
    ("train", "experiment/comparison_partnet"): ["assets.root=."],
    ("evaluate", "experiment/comparison_partnet"): ["assets.root=."],
    ("evaluate", "policy/artflownet"): ["checkpoint=checkpoint.pt"],
    ("evaluate", "policy/screwnet"): ["checkpoint=checkpoint.pt"],
    ("evaluate", "policy/ump_di"): ["checkpoint=checkpoint.pt"],
    ("evaluate", "policy/bc"): ["checkpoint=checkpoint.pt"],
    ("evaluate", "policy/dagger"): ["checkpoint=checkpoint.pt"],
}
TRAINING_ONLY = {"experiment/partnet"}


@pytest.fixture(autouse=True)
def composer(schemas: None) -> Iterator[None]:
    with hydra.initialize_config_dir(version_base="1.3", config_dir=str(CONF)):
        yield
    GlobalHydra.instance().clear()


def compose(name: str, *overrides: str) -> Any:
    return OmegaConf.to_object(hydra.compose(name, overrides=list(overrides)))


def options(name: str) -> list[str]:
    """The group options that conf/<name>.yaml can be given, as group/option."""
    defaults = yaml.safe_load((CONF / f"{name}.yaml").read_text())["defaults"]
    groups = [key for entry in defaults if isinstance(entry, dict) for key in entry if not key.startswith("override")]
    found = [f"{group}/{path.stem}" for group in groups for path in sorted((CONF / group).glob("*.yaml"))]
    return [option for option in found if option not in ABSTRACT]


def cases() -> list[tuple[str, str]]:
    further = ("random", "normal", "screwnet", "ump_di", "bc", "dagger")
    other = {("train", f"policy/{name}") for name in ("expert", *further)}
    other |= {("view", f"policy/{name}") for name in further}
    skipped = {*other, *(("evaluate", option) for option in TRAINING_ONLY)}
    return [(name, option) for name in SCHEMAS for option in options(name) if (name, option) not in skipped]


@pytest.mark.parametrize(("name", "schema"), SCHEMAS.items())
def test_the_defaults_are_valid(name: str, schema: type) -> None:
    cfg = compose(name)
    assert isinstance(cfg, schema)
    validate(cfg)


@pytest.mark.parametrize(("name", "option"), cases())
def test_every_option_of_every_group_is_valid(name: str, option: str) -> None:
    validate(compose(name, option.replace("/", "="), *NEEDS.get((name, option), [])))


def test_no_file_is_beside_the_groups() -> None:
    used = {path for name in SCHEMAS for path in options(name)} | ABSTRACT
    files = {f"{path.parent.name}/{path.stem}" for path in CONF.glob("*/*.yaml")}
    assert used == files
    assert {path.stem for path in CONF.glob("*.yaml")} == set(SCHEMAS)


@pytest.mark.parametrize("experiment", sorted(path.stem for path in (CONF / "experiment").glob("*.yaml")))
def test_every_experiment_changes_something_and_is_valid(experiment: str) -> None:
    cfg = compose("train", f"experiment={experiment}", *NEEDS.get(("train", f"experiment/{experiment}"), []))
    validate(cfg)
    assert (cfg == compose("train")) == (experiment == "none")


def test_the_comparison_sweeps_over_algorithms_that_there_are() -> None:
    raw = hydra.compose("train", ["experiment=comparison"], return_hydra_config=True)
    algos = raw.hydra.sweeper.params["algo"].split(",")
    assert len(set(algos)) == len(algos) == 7
    for algo in algos:
        validate(compose("train", "experiment=comparison", f"algo={algo}"))


def test_what_the_command_line_says_goes_before_an_experiment() -> None:
    assert compose("train", "experiment=smoke", "data.train_samples=7").data.train_samples == 7
    assert compose("evaluate", "experiment=smoke").collector.backend == "direct"
    assert compose("evaluate", "experiment=smoke", "collector=process").collector.backend == "process"


def declared(schema: type) -> set[tuple[type, str]]:
    """The keys of a schema and of the groups in it, each with the class that declares it."""
    keys = {(owner(schema, field.name), field.name) for field in dataclasses.fields(schema)}
    return keys.union(*(declared(kind) for kind in get_type_hints(schema).values() if dataclasses.is_dataclass(kind)))


def owner(schema: type, key: str) -> type:
    return next(kind for kind in reversed(schema.__mro__) if key in getattr(kind, "__annotations__", {}))


SCHEMA_OF = {
    name: kind for name, kind in vars(config).items() if isinstance(kind, type) and dataclasses.is_dataclass(kind)
}


SAME_KIND = ("settled", "setup.settled", "replace")
"""Functions that give a configuration with other values back."""


class Reads(ast.NodeVisitor):
    """The keys that a module reads of values which its annotations, casts and assignments say to be configurations.

    A group that is handed on whole, as ``Options(**asdict(group))``, is read if the options have just its keys.

    Args:
        names: what the module's names stand for, in which the options are looked up.
        cfg: what a parameter ``cfg`` without an annotation of a schema is.
    """

    def __init__(self, tree: ast.Module, names: Mapping[str, Any], cfg: type | None = None) -> None:
        self.found: set[tuple[type, str]] = set()
        self.names, self.cfg = names, cfg
        self.known: dict[str, type] = {}
        self.attributes: dict[str, type] = {}  # of self
        self.visit(tree)

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        outside, self.known = self.known, dict(self.known)
        for argument in node.args.args + node.args.kwonlyargs:
            kind = self.named(argument.annotation)
            if kind is None and argument.arg == "cfg":
                kind = self.cfg
            self.bind(ast.Name(argument.arg), kind)
        self.generic_visit(node)
        self.known = outside

    def named(self, annotation: ast.AST | None) -> type | None:
        return SCHEMA_OF.get(ast.unparse(annotation).strip("'\"")) if annotation is not None else None

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
        """The schema of an expression's value, if it has one."""
        if isinstance(node, ast.Name):
            return self.known.get(node.id)
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "cast":
            return self.named(node.args[0])
        if isinstance(node, ast.Call) and ast.unparse(node.func) in SAME_KIND and node.args:
            return self.kind(node.args[0])
        if isinstance(node, ast.Attribute):
            if isinstance(node.value, ast.Name) and node.value.id == "self":
                return self.attributes.get(node.attr)
            group = self.kind(node.value)
            kind = get_type_hints(group).get(node.attr) if group else None
            return kind if isinstance(kind, type) and dataclasses.is_dataclass(kind) else None
        return None

    def visit_Attribute(self, node: ast.Attribute) -> None:
        self.generic_visit(node)
        group = self.kind(node.value)
        if group is not None and isinstance(node.ctx, ast.Load):
            assert node.attr in get_type_hints(group), f"{group.__name__} has no key {node.attr}"
            self.found.add((owner(group, node.attr), node.attr))

    def visit_Call(self, node: ast.Call) -> None:
        self.generic_visit(node)
        for keyword in node.keywords:
            value = keyword.value
            if keyword.arg is None and isinstance(value, ast.Call) and ast.unparse(value.func) == "asdict":
                group, options = self.kind(value.args[0]), self.names.get(ast.unparse(node.func))
                if group is not None and dataclasses.is_dataclass(options):
                    keys = {field.name for field in dataclasses.fields(group)}
                    more = keys - {field.name for field in dataclasses.fields(options)}
                    assert not more, f"{options.__name__} has no {', '.join(more)}"
                    self.found |= {(owner(group, key), key) for key in keys}


def all_reads() -> set[tuple[type, str]]:
    found: set[tuple[type, str]] = set()
    for path in sorted((ROOT / "fb3d_rl").rglob("*.py")):
        text = path.read_text()
        if "Config" in text and path.name != "config.py":  # the others know of none: an import rule
            module = importlib.import_module(".".join(path.relative_to(ROOT).with_suffix("").parts))
            found |= Reads(ast.parse(text), vars(module)).found
    for name, schema in SCHEMAS.items():
        found |= Reads(ast.parse((ROOT / "launch" / f"{name}.py").read_text()), {}, schema).found
    return found


def test_every_key_is_read_by_code() -> None:
    keys = set().union(*(declared(schema) for schema in (*SCHEMAS.values(), ArtFlowNetConfig, ImitationConfig)))
    assert len(keys) > 120
    unread = sorted(f"{kind.__name__}.{key}" for kind, key in keys - all_reads())
    assert not unread, f"no code reads {', '.join(unread)}"


def test_only_what_is_read_of_a_configuration_counts() -> None:
    source = """
def task(cfg: TrainConfig, other: object, loss: LossOptions) -> None:
    env, algo = cfg.env, cast("ImitationConfig", cfg.algo)
    use(env.horizon, algo.gate.budget, other.epochs, loss.lr, "algo.turn")  # cfg.seed
    cfg.device = "cpu"
    env = other
    env.success
    GripperOptions(**asdict(cfg.env.gripper))
    save(**asdict(cfg.env.suction), config=asdict(cfg))
"""
    found = {f"{kind.__name__}.{key}" for kind, key in Reads(ast.parse(source), globals()).found}
    gripper = {f"GripperConfig.{field.name}" for field in dataclasses.fields(config.GripperConfig)}
    groups = {"CommandConfig.env", "TrainConfig.algo", "ImitationConfig.gate", "EnvConfig.gripper", "EnvConfig.suction"}
    assert found == {*groups, *gripper, "EnvConfig.horizon", "GateConfig.budget"}
    with pytest.raises(AssertionError, match="has no key horizont"):
        Reads(ast.parse("def task(cfg: ViewConfig): return cfg.env.horizont"), {})


def test_the_run_follows_from_the_configuration() -> None:
    from fb3d_rl.algos import setup
    from fb3d_rl.algos.artflownet import fit_options

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


PAIRS: dict[str, tuple[tuple[Any, ...], tuple[str, ...]]] = {
    "env/default": ((EnvOptions(),), ()),
    "env/default:gripper": ((GripperOptions(),), ("gripper",)),
    "env/default:suction": ((SuctionOptions(),), ("suction",)),
    "policy/flow:flow": ((FlowPolicyOptions(),), ("flow",)),
    "policy/flow:contact": ((ContactOptions(),), ("contact",)),
    "camera/raycast": ((CameraOptions(), ViewRange()), ()),
    "data/default": ((SampleOptions(),), ()),
    "collector/direct": ((CollectorOptions(),), ()),
}
ONLY_CONFIGURED = {
    "data/default": {"train_samples", "dataset", "met_by", "met_samples", "labels", "eval_samples", "workers"}
}

SETTLED = {"env/default:suction": {"hold"}}
"""Keys whose null stands for a value that another key decides (setup.settled)."""


@pytest.mark.parametrize("name", PAIRS)
def test_defaults_are_the_librarys(name: str) -> None:
    defaults, path = PAIRS[name]
    content = OmegaConf.to_container(OmegaConf.load(CONF / f"{name.split(':')[0]}.yaml"))
    for key in path:
        content = content[key]  # type: ignore[index,call-overload]
    assert isinstance(content, dict)
    library: dict[str, Any] = {}
    for default in defaults:
        library |= {f.name: getattr(default, f.name) for f in dataclasses.fields(default)}
    values = {key: value for key, value in content.items() if not isinstance(value, dict)}
    unknown = set(values) - set(library) - ONLY_CONFIGURED.get(name, set())
    assert not unknown, f"{name} has keys that the library does not: {unknown}"
    different = {
        key: (value, library[key])
        for key, value in values.items()
        if key in library
        and not (value is None and key in SETTLED.get(name, ()))
        and (tuple(value) if isinstance(value, list) else value) != library[key]
    }
    assert not different, f"{name}: (configured, library's default) differ: {different}"


def test_every_option_of_the_flow_policy_can_be_set() -> None:
    content: Any = OmegaConf.to_container(OmegaConf.load(CONF / "policy/flow.yaml"))
    assert set(content["flow"]) == {f.name for f in dataclasses.fields(FlowPolicyOptions)} - {"contact", "mask"}
    assert set(content["contact"]) == {f.name for f in dataclasses.fields(ContactOptions)}


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
    cfg = compose("train", override) if override.split("=")[0] in os.listdir(CONF) else changed(defaults, override)
    with pytest.raises(UserError, match=re.escape(word)):
        validate(cfg)


@pytest.fixture(scope="module")
def defaults(schemas: None) -> Any:
    """conf/train.yaml, composed once, since that takes a while."""
    with hydra.initialize_config_dir(version_base="1.3", config_dir=str(CONF)):
        return hydra.compose("train")


def changed(raw: Any, override: str) -> Any:
    return OmegaConf.to_object(OmegaConf.merge(raw, OmegaConf.from_dotlist([override])))


def test_the_camera_of_the_task_can_be_another_than_that_of_the_samples() -> None:
    from fb3d_rl.algos import setup

    cfg = compose("train", "camera=sapien", "camera.shader=default", "camera.fov=50")
    assert setup.env_options(cfg).camera == CameraOptions(fov=50, kind="sapien", shader="default")
    assert setup.sample_options(cfg).camera == CameraOptions(fov=50)  # samples drawn before stay valid


def test_a_missing_checkpoint_is_named() -> None:
    with pytest.raises(UserError, match="checkpoint"):
        validate(compose("evaluate", "policy=artflownet"))


@pytest.mark.parametrize(
    ("override", "word"), [("port=0", "port=0"), ("port=70000", "65535"), ("policy=bc", "policy.name")]
)
def test_what_the_live_page_cannot_do_is_named(override: str, word: str) -> None:
    with pytest.raises(UserError, match=re.escape(word)):
        validate(compose("view", override))


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("train", ["algo=bc"]),
        ("train", ["algo=screwnet"]),
        ("evaluate", ["policy=normal"]),
        ("evaluate", ["policy=dagger", "checkpoint=x.pt"]),
        ("evaluate", ["policy=ump_di", "checkpoint=x.pt"]),
    ],
)
def test_what_needs_the_mask_is_not_run_without(name: str, words: list[str]) -> None:
    validate(compose(name, *words))
    with pytest.raises(UserError, match=r"leave policy\.mask=target"):
        validate(compose(name, *words, "policy.mask=none"))


def test_what_learns_to_open_has_no_other_goal() -> None:
    validate(compose("train", "algo=artflownet", "protocol=goal_state"))
    for name, words in {"train": ["algo=bc"], "evaluate": ["policy=dagger", "checkpoint=x.pt"]}.items():
        with pytest.raises(UserError, match="learns to open only"):
            validate(compose(name, *words, "protocol=goal_state"))


def test_infinity_can_be_given() -> None:
    assert compose("train", "env.suction.breaking_force=inf").env.suction.breaking_force == math.inf


@pytest.mark.parametrize("split", ["test", "[train_test,test]", "[test,Laptop,10098]", "10098"])
def test_splits_can_be_given_as_a_name_an_id_or_a_list(split: str) -> None:
    validate(compose("train", "assets=partnet_mobility", "assets.root=.", f"assets.split={split}"))


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
            choices = [one if "[" in one[0] else one[0].split(",") for one in choices]
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
        validate(compose(name, *(word for word in chosen if word != "job")))
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
    targets = re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    named = {target for path in TEXTS for target in re.findall(r"(?:^|`)make (\w+)", path.read_text(), re.MULTILINE)}
    assert {"train", "test", "check"} <= named <= {*targets}
