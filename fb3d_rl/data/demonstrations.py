"""Control steps on disk with the episodes they belong to: DAgger's replay buffer and demonstrations alike.

A buffer is a folder: TorchRL's memory map of the rows, and ``storage_metadata.json``, TorchRL's own file with the
number of rows, to which the table of episodes is added. That file is replaced in one step and after the rows are on
the disk, so the folder always holds the state of the last commit; ``LazyMemmapStorage(capacity, scratch_dir=folder)``
of TorchRL can load it as well.
"""

from __future__ import annotations

import itertools
import json
import math
import os
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import LazyMemmapStorage, RoundRobinWriter, TensorDictReplayBuffer

from fb3d_rl import contract
from fb3d_rl.camera.views import View
from fb3d_rl.contract import Key
from fb3d_rl.data.picking import Index, pick
from fb3d_rl.errors import UserError
from fb3d_rl.files import replacing

FORMAT = "fb3d_rl demonstrations 1"
TABLE = "storage_metadata.json"
"""Name and part of the content are TorchRL's."""


@dataclass(frozen=True)
class EpisodeInfo:
    """Facts about an episode; with the object they are enough to run it again.

    Attributes:
        object: the object's id.
        category: the object's category.
        link: index of the link to open.
        start: joint state [J] (rad or m) at the start; empty if it is not known, as of data from elsewhere.
        view: the camera's viewpoint.
        seed: seed of the random draws within the episode.
        round: DAgger's round, 0 for demonstrations.
        success: the part was open at the end.
        normalized_distance: |q_goal - q| / |q_goal - q_start| at the end; NaN if it is not known.
        steps: number of control steps of the episode.
        rows: number of them that are kept, from the first one on; set by the buffer.
    """

    object: str
    category: str
    link: int
    start: tuple[float, ...]
    view: View
    seed: int = 0
    round: int = 0
    success: bool = False
    normalized_distance: float = 1.0
    steps: int = 0
    rows: int = 0

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> EpisodeInfo:
        """The inverse of ``dataclasses.asdict``, also once that has been through JSON."""
        return cls(**{**content, "start": tuple(content["start"]), "view": View(**content["view"])})


class DemonstrationBuffer:
    """Rows of control steps, one after the other, and a table of the episodes that they belong to.

    A row holds the keys of the first episode that was added, and ("episode") [1] int64, its entry in :attr:`episodes`.
    The files have room for ``capacity`` rows from the start, but occupy the disk only as they are filled.

    Rows added since the last :meth:`commit` can be read here, but are lost if the process ends.

    Attributes:
        path: the folder.
        capacity: most rows that it can hold.
        about: facts about the data's origin, any that JSON can hold.
        replay: TorchRL's buffer over the rows, to sample from; add rows with :meth:`extend` only.
    """

    def __init__(self, path: Path, capacity: int, about: Mapping[str, Any], episodes: Sequence[EpisodeInfo]) -> None:
        self.path, self.capacity, self.about = path, capacity, dict(about)
        self._episodes, self._ends = list(episodes), _ends(episodes)
        self._load()

    @classmethod
    def create(cls, path: Path | str, capacity: int, about: Mapping[str, Any] | None = None) -> DemonstrationBuffer:
        """Make an empty buffer in a new or empty folder.

        Raises:
            UserError: there is something at ``path``.
        """
        path = Path(path)
        if path.exists() and not (path.is_dir() and not any(path.iterdir())):
            raise UserError(f"{path} exists already; choose another place for the demonstrations")
        path.mkdir(parents=True, exist_ok=True)
        buffer = cls(path, capacity, about or {}, [])
        buffer.commit()
        return buffer

    @classmethod
    def open(cls, path: Path | str) -> DemonstrationBuffer:
        """Open a buffer as of its last commit.

        Raises:
            UserError: there is none, it is damaged, or it is of another version.
        """
        path = Path(path)
        if not (path / TABLE).is_file():
            raise UserError(f"there are no demonstrations at {path}; record some: python launch/demos.py record {path}")
        try:
            table = json.loads((path / TABLE).read_text())
            if not isinstance(table, dict) or table.get("format") != FORMAT:
                raise UserError(f"{path} holds no demonstrations of this version of fb3d_rl")
            for name, size in table["files"].items():
                # Torch would make a file that is missing, and lengthen one that is too short.
                if (path / name).stat().st_size != size:
                    raise ValueError(f"{name} has another size")
            return cls(path, table["capacity"], table["about"], [EpisodeInfo.from_dict(e) for e in table["episodes"]])
        except (OSError, ValueError, KeyError, TypeError, AttributeError, RuntimeError) as error:
            raise UserError(f"the demonstrations at {path} are damaged ({type(error).__name__}: {error})") from error

    def __len__(self) -> int:
        return self._ends[-1]

    def __getitem__(self, index: Index) -> TensorDictBase:
        """Copies of the rows that ``index`` picks (:func:`fb3d_rl.data.picking.pick`).

        Raises:
            IndexError: there is no such row.
        """
        return pick(index, len(self), self.replay.__getitem__)

    @property
    def episodes(self) -> list[EpisodeInfo]:
        """The episodes in the order of their rows."""
        return list(self._episodes)

    @property
    def keys(self) -> dict[Key, tuple[torch.Size, torch.dtype]]:
        """The rows' keys with trailing shape and dtype; none as long as there is no row."""
        return _layout(self.replay[torch.tensor([0])]) if len(self) else {}

    def first_row(self, episode: int) -> int:
        """Index of the first row of an episode."""
        return self._ends[episode]

    def frames(self, episode: int) -> TensorDictBase:
        """The rows of an episode, TensorDict [rows]."""
        first = self.first_row(episode)
        return self[torch.arange(first, first + self._episodes[episode].rows)]

    def extend(self, frames: TensorDictBase, info: EpisodeInfo) -> None:
        """Add an episode, or its beginning.

        Args:
            frames: TensorDict [T], T >= 1; all of its keys are kept.
            info: about the episode.

        Raises:
            ValueError: there is no room for T rows, or they differ from those before in a key, shape or dtype.
            UserError: the disk is full.
        """
        count, size = len(frames), len(self)
        if not 1 <= count <= self.capacity - size:
            raise ValueError(f"{count} rows do not fit into a buffer that has {size} of {self.capacity} rows")
        rows = frames.exclude("episode")
        rows["episode"] = torch.full((count, 1), len(self._episodes))
        if size and (new := _layout(rows)) != (old := self.keys):
            raise ValueError(f"the rows differ from those before: {sorted(map(str, new.items() ^ old.items()))}")
        # On a full disk, writing to mapped memory ends the process.
        if shutil.disk_usage(self.path).free < sum(rows.get(key).nbytes for key in _layout(rows)):
            raise UserError(f"the disk has no room for more rows at {self.path}")
        if not size:
            self._clear()
        self.replay.extend(rows, update_priority=False)
        self._episodes.append(replace(info, rows=count))
        self._ends.append(size + count)

    def commit(self) -> None:
        """Write all that was added to the disk, so that it survives a crash or a power failure."""
        # Without rows there may be files of rows that were dropped.
        below = self.path.rglob("*") if len(self) else ()
        files = [file for file in below if file.is_file() and not file.name.startswith((TABLE, "."))]
        for file in files:
            _sync(file)
        content = {
            "format": FORMAT,
            "capacity": self.capacity,
            "len": len(self),
            "is_pytree": False,
            "metadata": {},
            "files": {str(file.relative_to(self.path)): file.stat().st_size for file in files},
            "about": self.about,
            "episodes": [asdict(info) for info in self._episodes],
        }
        with replacing(self.path / TABLE) as beside:
            beside.write_text(json.dumps(content) + "\n")
            _sync(beside)
        _sync(self.path)

    def truncate(self, rows: int) -> None:
        """Drop all rows from ``rows`` on and commit: back to the state of a checkpoint.

        An episode that extends beyond keeps its beginning.

        Raises:
            ValueError: there are fewer rows.
        """
        if not 0 <= rows <= len(self):
            raise ValueError(f"{len(self)} rows cannot be cut to {rows}")
        kept = []
        for info in self._episodes:
            if rows:
                kept.append(replace(info, rows=min(info.rows, rows)))
                rows -= kept[-1].rows
        self._episodes, self._ends = kept, _ends(kept)
        self.commit()  # before new rows overwrite those of the old commit
        self._load()

    def filter(
        self, path: Path | str, keep: Callable[[EpisodeInfo], bool], about: Mapping[str, Any] | None = None
    ) -> DemonstrationBuffer:
        """Copy the episodes for which ``keep`` is true into a new buffer at ``path``, and commit it.

        Raises:
            UserError: there is something at ``path``, or no episode is kept.
        """
        chosen = [episode for episode, info in enumerate(self._episodes) if keep(info)]
        if not chosen:
            raise UserError(
                f"none of the {len(self._episodes)} episodes of {self.path} is kept; give weaker conditions"
            )
        rows = sum(self._episodes[episode].rows for episode in chosen)
        with new_buffer(path, rows, {**self.about, **(about or {})}) as copy:
            for episode in chosen:
                copy.extend(self.frames(episode), self._episodes[episode])
        return copy

    def _load(self) -> None:
        storage, writer = LazyMemmapStorage(self.capacity, scratch_dir=self.path, existsok=True), RoundRobinWriter()
        self.replay = TensorDictReplayBuffer(storage=storage, writer=writer)
        if len(self):
            storage.loads(self.path)
            writer.load_state_dict({"_cursor": len(self) % self.capacity})

    def _clear(self) -> None:
        """Remove files that were never committed."""
        for entry in self.path.iterdir():
            if entry.is_dir():
                shutil.rmtree(entry)
            elif entry.name != TABLE:
                entry.unlink()


@contextmanager
def new_buffer(path: Path | str, capacity: int, about: Mapping[str, Any]) -> Iterator[DemonstrationBuffer]:
    """A new buffer that is committed in the end; an error leaves nothing of it behind.

    Raises:
        UserError: there is something at ``path``.
    """
    buffer = DemonstrationBuffer.create(path, capacity, about)
    try:
        yield buffer
        buffer.commit()
    except BaseException:
        shutil.rmtree(buffer.path)
        raise


def demonstrated(frames: TensorDictBase) -> TensorDictBase:
    """Frames [T] of foreign data with the keys that they lack; the expert counts as acting in every step.

    Frames of another task of ManiSkill, which have a "state" among what is observed, may have any observation.

    Raises:
        UserError: the observation or the action is not what the data contract says, there is no step, a number is not
            finite, or an action is out of range.
    """
    if not len(frames):
        raise UserError("the data do not fit the task: an episode has no step; leave it out")
    if ("observation", "state") not in frames.keys(include_nested=True):
        if ("observation", "goal_sense") not in frames.keys(include_nested=True):
            frames["observation", "goal_sense"] = torch.ones(len(frames), 1)  # without a goal the task is to open
        try:
            contract.check(frames, "observation")
            contract.check(frames, "action")
        except ValueError as error:
            raise UserError(f"the data do not fit the task: {error}") from error
    _require_numbers(frames)
    steps = len(frames)
    labels: dict[Key, Tensor] = {
        ("expert", "action"): frames["action"],
        ("expert", "acts"): torch.ones(steps, 1, dtype=torch.bool),
        "elapsed_steps": torch.arange(steps, dtype=torch.int32)[:, None],
    }
    for key, value in labels.items():
        if key not in frames.keys(include_nested=True):
            frames[key] = value
    return frames


def _require_numbers(frames: TensorDictBase) -> None:
    """Check the values that a learner reads; what lies at places without a point does not matter.

    Raises:
        UserError: see :func:`demonstrated`.
    """
    if not bool((frames["action"].abs() <= 1.0 + 1e-6).all()):  # NaN is out of range, too
        raise UserError("the data do not fit the task: actions have to lie from -1 to 1; scale them, or leave out NaN")
    observation = frames["observation"]
    for key, value in observation.items():
        seen = value[observation["valid"]] if key == "points" else value
        if value.is_floating_point() and not bool(seen.isfinite().all()):
            raise UserError(f"the data do not fit the task: observation {key} holds NaN or infinity; leave it out")


RECORD: tuple[Key, ...] = tuple(("record", key) for key in ("beta", "policy_version", "round", "success"))
"""The keys that :func:`recorded` adds to a row."""


def recorded(frames: TensorDictBase, info: EpisodeInfo, beta: float, version: int) -> TensorDictBase:
    """Frames [T] with the group "record", which says how they came about; rows that have it keep theirs.

    Args:
        frames: of one episode.
        info: its facts, of which round and success go to each row.
        beta: probability with which the expert acted by DAgger's schedule.
        version: number of fits that the weights of the learner had behind them; -1 if there was no learner.
    """
    if "record" not in frames.keys():
        for key, value in zip(RECORD, (beta, version, info.round, info.success), strict=True):
            frames[key] = torch.full((len(frames), 1), value)
    return frames


def foreign_episode(category: str, success: bool, steps: int, seed: int = 0) -> EpisodeInfo:
    """The facts of an episode of foreign data, whose object and start are unknown."""
    return EpisodeInfo("unknown", category, -1, (), View(0.0, 0.0), seed, 0, success, math.nan, steps)


def _layout(rows: TensorDictBase) -> dict[Key, tuple[torch.Size, torch.dtype]]:
    found = rows.keys(include_nested=True, leaves_only=True)
    return {key: (rows.get(key).shape[1:], rows.get(key).dtype) for key in found}


def _ends(episodes: Sequence[EpisodeInfo]) -> list[int]:
    """Row at which each episode begins, and the one after the last."""
    return [0, *itertools.accumulate(info.rows for info in episodes)]


def _sync(path: Path) -> None:
    """Flush a file, or a folder's list of files, to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
