"""From a validated configuration to objects and options; shared by training and evaluation."""

from __future__ import annotations

import os
import platform
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import torch

from fb3d_rl import procedural
from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.assets.catalog import (
    LOST_GEOMETRY,
    Entry,
    entry_of,
    folder_entries,
    lost_geometry,
    procedural_catalog,
)
from fb3d_rl.assets.folders import MANISKILL
from fb3d_rl.assets.splits import validation_ids
from fb3d_rl.camera.options import CameraOptions
from fb3d_rl.camera.views import ViewRange
from fb3d_rl.data.options import SampleOptions
from fb3d_rl.drawing.video import require_encoder
from fb3d_rl.env.options import EnvOptions
from fb3d_rl.env.torchrl_env import require_simulator
from fb3d_rl.errors import UserError
from fb3d_rl.evaluation.evaluate import Protocol
from fb3d_rl.importer.catalog import given_catalog, holds_folders, path_catalog
from fb3d_rl.options import taken
from fb3d_rl.policies.hand import VelocityLimits
from fb3d_rl.policies.options import FlowPolicyOptions
from fb3d_rl.rollout.options import CollectorOptions, ScheduleOptions
from fb3d_rl.rollout.run import limits_of
from fb3d_rl.training.checkpoint import git_revision

if TYPE_CHECKING:
    from fb3d_rl.assets.options import AssetsOptions
    from fb3d_rl.config import CommandConfig, ViewConfig

Config = TypeVar("Config", bound="CommandConfig")


@dataclass(frozen=True)
class TrainEntries:
    """The objects of a training run in three disjoint lists: for training, validation and evaluation.

    Attributes:
        train, validation, held_out: these.
        made: ids of those that are procedural.
    """

    train: list[Entry]
    validation: list[Entry]
    held_out: list[Entry]
    made: frozenset[str] = frozenset()

    def drawn(self, given_share: float | None) -> list[Entry]:
        """The training objects to draw flow samples of in turn: those that were given as often as it takes for about
        this share of the samples to be theirs. None: each once.
        """
        given = [entry for entry in self.train if entry.id not in self.made]
        made = [entry for entry in self.train if entry.id in self.made]
        if given_share is None or not given or not made:
            return self.train
        return given * max(1, round(given_share / (1.0 - given_share) * len(made) / len(given))) + made


def train_entries(assets: AssetsOptions, out: Path, seed: int) -> TrainEntries:
    """The objects of a training run."""
    made = _made(assets, out, seed, assets.train_count)
    train = [entry for entry in made if entry.split == "train_train"]
    held_out = [entry for entry in made if entry.split != "train_train"]
    if assets.source != "procedural":
        train = given_catalog(assets, assets.split, out / "objects") + train
        held_out = given_catalog(assets, assets.eval_split, out / "objects") + _beside_real(held_out)
    kept = validation_ids({entry.id: entry.category for entry in train}, assets.validation_share)
    if assets.validation_share and not kept:
        print("note: too few training objects to keep one for validation; there is no validation during training")
    return TrainEntries(
        [entry for entry in train if entry.id not in kept],
        [entry for entry in train if entry.id in kept],
        held_out,
        frozenset(entry.id for entry in made),
    )


def eval_entries(assets: AssetsOptions, out: Path, seed: int) -> list[Entry]:
    """Objects to evaluate on."""
    made = _made(assets, out, seed, 0)
    if assets.source == "procedural":
        return made
    return given_catalog(assets, assets.split, out / "objects") + _beside_real(made)


def _made(assets: AssetsOptions, out: Path, seed: int, train_count: int) -> list[Entry]:
    """The procedural objects, if the configuration has any."""
    if assets.source != "procedural" and not (assets.categories or assets.unseen_categories):
        return []
    return procedural_catalog(
        out / "objects", assets.categories, train_count, assets.eval_count, seed, assets.unseen_categories
    )


def _beside_real(entries: list[Entry]) -> list[Entry]:
    """The same entries under other split names, so that no mean mixes them with PartNet-Mobility's."""
    return [replace(entry, split=f"procedural_{entry.split}") for entry in entries]


def one_object(cfg: ViewConfig, out: Path) -> ArticulatedObject:
    """The object that ``cfg.object`` names; a procedural one is made below ``out``.

    Raises:
        UserError: it names no object, or a folder of several.
    """
    word = None if cfg.object is None else str(cfg.object)
    if word is not None and Path(word).expanduser().exists():
        entries = folder_entries(word) if holds_folders(word) else path_catalog(word)
        if len(entries) > 1:
            raise UserError(
                f"object={word} holds {len(entries)} objects; give one of its folders, or "
                f"assets=partnet_mobility assets.root={word} object=ID"
            )
        return entries[0].load()
    if cfg.assets.source == "procedural":
        if word in procedural.FAMILIES:  # also if assets.categories leaves it out
            return procedural_catalog(out, [word], 0, 1, cfg.seed)[0].load()
        return entry_of(eval_entries(cfg.assets, out, cfg.seed), word).load()
    if cfg.assets.source == "files":
        return entry_of(given_catalog(cfg.assets, "all"), word).load()
    return entry_of(folder_entries(cfg.assets.paths[0]), word).load()


def object_root(cfg: ViewConfig) -> str | None:
    """Where :func:`one_object` finds its object; None if it is made anew, and gone with the folder that it is made in.

    It is the path from which :class:`~fb3d_rl.rollout.demonstrations.Assets` can read it again.
    """
    word = None if cfg.object is None else Path(str(cfg.object)).expanduser()
    if word is not None and word.exists():
        return str(word.resolve())
    if cfg.assets.source == "procedural":
        return None
    given = cfg.assets.paths[0]
    return given if given == MANISKILL else str(Path(given).expanduser().resolve())


def load(entries: list[Entry]) -> list[tuple[ArticulatedObject, str]]:
    """Read the objects; each with its split."""
    return [(entry.load(), entry.split) for entry in entries]


def sample_options(cfg: CommandConfig) -> SampleOptions:
    """How flow samples are drawn: ray-cast where the task renders with SAPIEN."""
    kind = "raycast" if cfg.camera.kind == "sapien" else cfg.camera.kind
    optics = CameraOptions(cfg.camera.resolution, cfg.camera.fov, cfg.camera.margin, kind)
    return replace(taken(SampleOptions, cfg.data), views=taken(ViewRange, cfg.camera), camera=optics)


def settled(cfg: Config, part_mask_input: bool | None = None) -> Config:
    """The configuration with values for policy.mask and env.suction.hold where they are null.

    Args:
        cfg: the configuration.
        part_mask_input: whether the acting network was trained with the mask; None for the network that ``cfg`` trains,
            if there is one.
    """
    if part_mask_input is None:
        part_mask_input = getattr(getattr(cfg, "algo", None), "part_mask_input", True)
    mask = cfg.policy.mask or ("target" if part_mask_input else "none")
    suction = replace(cfg.env.suction, hold=cfg.env.suction.hold or ("any" if mask == "none" else "target"))
    return replace(cfg, policy=replace(cfg.policy, mask=mask), env=replace(cfg.env, suction=suction))


def env_options(cfg: CommandConfig) -> EnvOptions:
    """The task's constants."""
    camera, views = taken(CameraOptions, cfg.camera), taken(ViewRange, cfg.camera)
    return replace(settled(cfg).env, views=views, points=cfg.data.points, camera=camera)


def flow_policy_options(cfg: CommandConfig) -> FlowPolicyOptions:
    """The options of the flow policy, with the mask that it gets."""
    policy = settled(cfg).policy
    assert policy.mask is not None
    return replace(policy.flow, mask=policy.mask, contact=policy.contact)


def velocity_limits(cfg: CommandConfig) -> VelocityLimits:
    """The gripper's velocities at action 1."""
    return limits_of(env_options(cfg))


def protocol(cfg: CommandConfig, resume: bool = False) -> Protocol:
    """The settings of the evaluation; with ``resume`` it keeps the run folder's rows.

    Raises:
        UserError: the device is missing, or the simulator (for trials), or ffmpeg (for videos).
    """
    device = choose_device(cfg.device)
    if cfg.evaluation.trials != 0:
        require_simulator()
        if cfg.evaluation.videos:
            require_encoder()
    return Protocol(
        samples=sample_options(cfg),
        env=env_options(cfg),
        collector=collector_options(cfg),
        trials=cfg.evaluation.trials,
        samples_per_object=cfg.data.eval_samples,
        clouds=cfg.evaluation.clouds,
        videos=cfg.evaluation.videos,
        seed=cfg.seed,
        schedule=taken(ScheduleOptions, cfg.evaluation),
        decision_seconds=cfg.evaluation.decision_seconds,
        resume=resume,
        device=device,
    )


def choose_device(name: str) -> torch.device:
    """The device for "auto", "cpu" or "cuda".

    Raises:
        UserError: CUDA was asked for and there is none.
    """
    if name == "cuda" and not torch.cuda.is_available():
        raise UserError("device=cuda, but torch finds no CUDA device; use device=auto or device=cpu")
    return torch.device("cuda" if name != "cpu" and torch.cuda.is_available() else "cpu")


def collector_options(cfg: CommandConfig, spare: int = 0) -> CollectorOptions:
    """Where trials run, on all cores but ``spare`` unless the configuration names a number of workers."""
    count: int | None = cfg.collector.workers  # null in a configuration
    return replace(cfg.collector, workers=max(1, workers(None) - spare) if count is None else count)


def workers(count: int | None) -> int:
    """Worker processes: as configured, or one per core."""
    return (os.cpu_count() or 1) if count is None else count


def facts(cfg: CommandConfig, trained_on: Sequence[Entry] = ()) -> dict[str, Any]:
    """The facts about a run that summary.json lists besides the metrics."""
    lost = lost_geometry(entry.known for entry in trained_on if entry.known is not None)
    return {
        **({LOST_GEOMETRY: lost} if lost else {}),
        "command": " ".join(["python", *sys.argv]),
        "seed": cfg.seed,
        "git_revision": git_revision(),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}, "
        f"torch {torch.__version__}",
        "assets": asdict(cfg.assets),
    }
