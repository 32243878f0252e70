"""Every configuration composes, converts to its schema and is valid; every key is read; defaults are the library's."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import hydra
import pytest
import yaml
from hydra.core.global_hydra import GlobalHydra
from omegaconf import OmegaConf

from fb3d_rl import config
from fb3d_rl.camera.raycast import CameraOptions
from fb3d_rl.camera.views import ViewRange
from fb3d_rl.config import EvaluateConfig, TrainConfig, ViewConfig, validate
from fb3d_rl.contract import UserError
from fb3d_rl.data.samples import SampleOptions
from fb3d_rl.env.options import EnvOptions, GripperOptions, SuctionOptions
from fb3d_rl.env.workers import CollectorOptions
from fb3d_rl.perception.contact import ContactOptions
from fb3d_rl.policies.flow_policy import FlowPolicyOptions

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


def sources() -> str:
    files = [*(ROOT / "fb3d_rl/algos").glob("*.py"), *(ROOT / "launch").glob("*.py")]
    return "\n".join(path.read_text() for path in files)


def groups_of(schema: type) -> dict[str, type]:
    found = {f.name: getattr(config, str(f.type), None) for f in dataclasses.fields(schema)}
    return {name: group for name, group in found.items() if isinstance(group, type) and dataclasses.is_dataclass(group)}


def test_every_key_is_read_by_code() -> None:
    text = sources()
    for schema in SCHEMAS.values():
        groups = groups_of(schema)
        assert len(groups) >= 5
        for group, content in {**groups, "cfg": schema}.items():
            for key in (f.name for f in dataclasses.fields(content)):
                if group != "cfg" or key not in groups:
                    assert re.search(rf"\b{group}\.{key}\b", text), f"no code reads {group}.{key}"


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
def test_values_out_of_range_are_named(override: str, word: str) -> None:
    with pytest.raises(UserError, match=re.escape(word)):
        validate(compose("train", override))


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


def documented_commands() -> list[str]:
    """Lines `python launch/...` and `make ...` of the README and of results/."""
    text = "\n".join(path.read_text() for path in (ROOT / "README.md", *sorted((ROOT / "results").glob("**/*.md"))))
    return sorted(set(re.findall(r"python launch/[a-z]+\.py[^`\n#]*", text)))


@pytest.mark.parametrize("command", documented_commands())
def test_documented_commands_are_understood(command: str, tmp_path: Path) -> None:
    script, *words = command.replace("DIR", str(tmp_path)).split()[1:]
    assert (ROOT / script).is_file()
    name, sweep = Path(script).stem, "-m" in words
    if name in SCHEMAS:
        chosen = [word.split(",")[0] if sweep else word for word in words if not word.startswith(("hydra.", "-"))]
        validate(compose(name, *chosen))
