"""Run folders: what one holds, and which of them lie below a folder such as a sweep's."""

from __future__ import annotations

import json
import os
import re
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from fb3d_rl.errors import UserError
from fb3d_rl.evaluation import tables
from fb3d_rl.robot.rows import FILE as ROBOT
from fb3d_rl.robot.rows import RobotRow, read_robot
from fb3d_rl.rollout.rows import FlowRow, TrialRow, read_flow, read_trials
from fb3d_rl.settings import leaves

CLOUD_ARRAYS = ("points", "valid", "part_mask", "flow_true", "flow_predicted", "title")

_FILES = (
    "config.yaml",
    "metrics.jsonl",
    "rows.csv",
    "flow_rows.csv",
    "flow_rows_all_parts.csv",
    "summary.json",
    "clouds.npz",
)


@dataclass(frozen=True)
class Run:
    """What a run folder holds; everything that is missing is empty or None."""

    path: Path
    config: str
    log: list[dict[str, Any]]
    rows: list[TrialRow]
    flow: list[FlowRow]
    flow_all_parts: list[FlowRow]
    summary: dict[str, Any]
    clouds: dict[str, NDArray[Any]] | None
    robot: list[RobotRow] = field(default_factory=list)

    @cached_property
    def settings(self) -> dict[str, str]:
        """The configuration as flat texts, "algo.lr" -> "0.001".

        Raises:
            UserError: config.yaml is not a YAML mapping.
        """
        if not self.config:
            return {}
        try:
            content = yaml.safe_load(self.config)
        except yaml.YAMLError as error:
            raise UserError(f"Cannot read {self.path / 'config.yaml'}: it is not valid YAML ({error}).") from error
        if not isinstance(content, dict):
            raise UserError(f"Cannot read {self.path / 'config.yaml'}: it is not a YAML mapping.")
        return {key: "null" if value is None else str(value) for key, value in leaves(content)}

    @property
    def seed(self) -> int | None:
        """The run's seed, if summary.json or config.yaml has it."""
        seed = self.summary.get("seed")
        if seed is None and self.settings.get("seed", "").isdigit():
            return int(self.settings["seed"])
        return seed if isinstance(seed, int) else None


def is_run(path: Path) -> bool:
    """Whether ``path`` holds any of a run's files."""
    return any((path / name).is_file() for name in _FILES)


def read_run(path: Path) -> Run:
    """Read a run folder. Without a ``summary.json`` the summary is computed from the rows.

    Raises:
        UserError: ``path`` is not a run folder, or one of its files cannot be read.
    """
    if not is_run(path):
        raise UserError(f"{path} is not a run folder: it holds none of {', '.join(_FILES)}.")
    has = {name: (path / name).is_file() for name in _FILES}
    rows = read_trials(path / "rows.csv") if has["rows.csv"] else []
    flow = read_flow(path / "flow_rows.csv") if has["flow_rows.csv"] else []
    return Run(
        path=path,
        config=_read_text(path / "config.yaml") if has["config.yaml"] else "",
        log=_read_log(path / "metrics.jsonl") if has["metrics.jsonl"] else [],
        rows=rows,
        flow=flow,
        flow_all_parts=read_flow(path / "flow_rows_all_parts.csv") if has["flow_rows_all_parts.csv"] else [],
        summary=_read_summary(path / "summary.json") if has["summary.json"] else tables.summary(rows, flow),
        clouds=_read_clouds(path / "clouds.npz") if has["clouds.npz"] else None,
        robot=read_robot(path / ROBOT) if (path / ROBOT).is_file() else [],
    )


def find_runs(paths: Sequence[Path]) -> tuple[list[Path], list[Path]]:
    """Run folders at or below ``paths``, at any depth, in the order of their names.

    Returns:
        The finished ones (with a ``summary.json``) and those that only began (a ``config.yaml`` without one).

    Raises:
        UserError: a path is no folder, or there is no finished run at or below it.
    """
    finished: list[Path] = []
    unfinished: list[Path] = []
    for path in paths:
        if not path.is_dir():
            raise UserError(f"{path} is not a folder.")
        runs = [folder for folder in _folders(path) if _state(folder)]
        if not runs:
            raise UserError(f"{path} is not a run folder and holds none: no summary.json, no config.yaml.")
        finished += [folder for folder in runs if _state(folder) == "finished"]
        unfinished += [folder for folder in runs if _state(folder) == "unfinished"]
    if not finished:
        names = ", ".join(map(str, unfinished))
        raise UserError(f"There is nothing to compare: none of these runs is finished (summary.json): {names}")
    return list(dict.fromkeys(finished)), list(dict.fromkeys(unfinished))


def _state(folder: Path) -> str:
    if (folder / "summary.json").is_file():
        return "finished"
    return "unfinished" if (folder / "config.yaml").is_file() else ""


def _folders(path: Path) -> Iterator[Path]:
    """``path`` and the folders below it, those inside of runs left out (they hold objects and samples)."""
    for name, below, _ in os.walk(path):
        below.sort(key=_natural)
        if _state(Path(name)):
            below.clear()
        yield Path(name)


def _natural(name: str) -> tuple[list[str | float], str]:
    """Sort key that takes numbers by their value: seed=2 comes before seed=10."""
    parts = re.split(r"(\d+(?:\.\d+)?)", name)
    return [float(part) if i % 2 else part for i, part in enumerate(parts)], name


def labels(paths: Sequence[Path]) -> list[str]:
    """Shortest tails of the paths that tell the runs apart."""
    parts = [path.resolve().parts for path in paths]
    for length in range(1, max(map(len, parts), default=0) + 1):
        found = ["/".join(p[-length:]) for p in parts]
        if len(set(found)) == len(found):
            return found
    raise UserError("The same run is given twice.")


def _read_text(path: Path) -> str:
    try:
        return path.read_text("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"Cannot read {path}: {error}") from error


def _read_summary(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(_read_text(path))
    except json.JSONDecodeError as error:
        raise UserError(f"Cannot read {path}: it is not valid JSON ({error}).") from error
    if not isinstance(content, dict) or not isinstance(content.get("by_category"), dict):
        raise UserError(f'Cannot read {path}: it is not a summary of a run (no "by_category").')
    return content


def _read_log(path: Path) -> list[dict[str, Any]]:
    lines = _read_text(path).split("\n")
    entries = []
    # The part after the last newline is empty, or a line that a killed run did not finish.
    for number, line in enumerate(lines[:-1], start=1):
        try:
            entry = json.loads(line)
        except json.JSONDecodeError as error:
            raise UserError(f"Cannot read {path}, line {number}: {error}") from error
        if not isinstance(entry, dict):
            raise UserError(f"Cannot read {path}, line {number}: it is not a JSON object.")
        entries.append(entry)
    return entries


def _read_clouds(path: Path) -> dict[str, NDArray[Any]]:
    try:
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in CLOUD_ARRAYS}
    except (OSError, EOFError, ValueError, KeyError, zipfile.BadZipFile, zlib.error) as error:
        raise UserError(f"Cannot read {path}: {error}") from error
