"""The run folder of a command: a new one, or one that is resumed with its own configuration."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from fb3d_rl import config
from fb3d_rl.errors import UserError
from fb3d_rl.options import schema
from fb3d_rl.settings import leaves

CONFIG = "config.yaml"
LOCK = ".lock"
RUN_FILES = frozenset(
    {
        CONFIG, "metrics.jsonl", "checkpoint.pt", "best.safetensors", "rows.csv", "decision_times.jsonl",
        "flow_rows.csv", "flow_rows_all_parts.csv", "summary.json", "report.html", "clouds.npz", "flow.png", "videos",
        "samples", "met", "buffer", "objects",
    }
)  # fmt: skip
"""The files of a run; a new run needs a folder without any of them."""


def changes_no_number(key: str) -> bool:
    """Whether a run may go on with another value of this dotted key: where it computes, and where its log goes."""
    return key in ("device", "data.workers") or key.startswith(("collector.", "logger."))


def first_process() -> bool:
    """Whether this process is the one that writes, where ``torchrun`` started several."""
    return os.environ.get("RANK", "0") == "0"


def is_new(out: Path, *but: str) -> bool:
    """Whether a run folder holds nothing yet, ``but`` files of these names."""
    return {path.name for path in out.iterdir()} <= {LOCK, *but}


@contextmanager
def locked(out: Path) -> Iterator[None]:
    """Keep other processes from writing to the run folder; the lock goes with this process, however it ends.

    Raises:
        UserError: another process writes to it.
    """
    if not first_process():
        yield
        return
    left_behind = (out / LOCK).exists()
    lock = FileLock(out / LOCK)
    try:
        lock.acquire(timeout=0)
    except Timeout as error:
        raise UserError(
            f"{out} is being written to by another process; wait for its end, or choose another folder: "
            "hydra.run.dir=DIR"
        ) from error
    try:
        yield
    except UserError:
        if not left_behind:  # a refused run leaves no file
            (out / LOCK).unlink(missing_ok=True)
        raise
    finally:
        lock.release()


def configuration(raw: DictConfig, name: str, out: Path) -> DictConfig:
    """The configuration of the run in ``out``: ``raw`` in a new folder, else what that one was begun with.

    Args:
        raw: as composed from the command line.
        name: of the command's file in conf/.
        out: the run folder.

    Raises:
        UserError: the folder is used, or holds no run to go on with, or one with other settings.
    """
    resume = bool(raw.get("resume", False))
    begun = (out / CONFIG).is_file()
    if not first_process():
        return raw if not resume else _resumed(raw, name, out)
    # What a sweep had not begun when it was interrupted begins now.
    if resume and (begun or HydraConfig.get().mode != RunMode.MULTIRUN or not is_new(out)):
        if not begun:
            raise UserError(f"resume=true, but {out} holds no run ({CONFIG}); name its folder: hydra.run.dir=RUN")
        return _resumed(raw, name, out)
    used = sorted({path.name for path in out.iterdir()} & RUN_FILES)
    if used:
        raise UserError(
            f"{out} holds a run already ({', '.join(used[:3])}): go on with it by resume=true, or choose another "
            "folder: hydra.run.dir=DIR"
        )
    fresh = raw.copy()
    if "resume" in fresh:
        fresh.resume = False
    OmegaConf.save(fresh, out / CONFIG)
    return fresh


def _resumed(raw: DictConfig, name: str, out: Path) -> DictConfig:
    """The folder's configuration, with what this command changes of it."""
    kept = OmegaConf.load(out / CONFIG)
    if not isinstance(kept, DictConfig):
        raise UserError(f"{out / CONFIG} is no configuration of a run; restore the file or begin another run")
    asked, before, touched = _leaves(raw), _leaves(kept), sorted(_touched(raw, name))
    for key in touched:
        if not changes_no_number(key) and asked.get(key) != before.get(key):
            raise UserError(
                f"{out} was begun with {key}={before.get(key)}, not {asked.get(key)}: leave it out to go on, as a "
                "resumed run takes its settings from its folder, or choose another folder: hydra.run.dir=DIR"
            )
    typed = OmegaConf.structured(schema(config.COMMANDS[name]))
    if "algo" in kept:
        kinds = config.algorithms()
        config.one_of("algo.name", kept.algo.name, tuple(kinds))
        typed.algo = OmegaConf.structured(schema(kinds[kept.algo.name]))
    merged = OmegaConf.merge(typed, kept)
    assert isinstance(merged, DictConfig)
    # What a key that it lacks was then is not today's default.
    missing = sorted(key for key in _leaves(typed) if not any(f"{had}.".startswith(f"{key}.") for had in before))
    if missing:
        raise UserError(
            f"{out} was begun with another version of fb3d_rl, without {', '.join(missing[:3])}: go on with that "
            "version, or begin another run"
        )
    for key in touched:
        if changes_no_number(key):
            OmegaConf.update(merged, key, asked[key])
    merged.resume = True
    return merged


def _touched(raw: DictConfig, name: str) -> set[str]:
    """The dotted keys that the command line sets, be it by a group such as ``protocol=closed``."""
    from hydra import compose

    keys: set[str] = set()
    known = _leaves(raw)
    for override in OverridesParser.create().parse_overrides(list(HydraConfig.get().overrides.task)):
        key = override.key_or_group
        if key == "resume":
            continue
        below = {leaf for leaf in known if leaf == key or leaf.startswith(f"{key}.")}
        if isinstance(override.value(), str) and (Path(_conf()) / key).is_dir():
            # What the group sets: whatever differs from a composition that goes without it.
            without = _leaves(compose(name, [f"~{key}"]))
            single = _leaves(compose(name, [override.input_line or ""]))
            below = {leaf for leaf in {*without, *single} if without.get(leaf, _leaves) != single.get(leaf, _leaves)}
            below |= _own_keys(key)  # even where it says what is the default
        keys |= below or {key}
    return keys


def _own_keys(group: str) -> set[str]:
    """The dotted keys that any file of a group sets in the group's own part of the configuration."""
    keys: set[str] = set()
    for path in (Path(_conf()) / group).glob("*.yaml"):
        package = re.search(r"^# @package (\S+)", path.read_text(), re.MULTILINE)
        part = package.group(1) if package else group
        if part != "_global_":
            keys |= {f"{part}.{leaf}" for leaf in _leaves(OmegaConf.load(path)) if leaf != "defaults"}
    return keys


def _conf() -> str:
    sources = HydraConfig.get().runtime.config_sources
    return next(source.path for source in sources if source.provider == "main")


def _leaves(config: Any) -> dict[str, Any]:
    """Values by their dotted keys, as YAML has them; a list is one value."""
    tree: Any = OmegaConf.to_container(config, resolve=True, throw_on_missing=False)
    return dict(leaves(tree))
