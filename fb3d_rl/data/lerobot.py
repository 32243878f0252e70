"""Demonstrations as a data set in LeRobot's format v3.0, out and in, without LeRobot itself.

LeRobot rather than Minari, because most robot-learning policies that can be downloaded train from it, and v3.0 rather
than v2.1, because LeRobot reads nothing older since 0.4. The layout is that of huggingface.co/docs/lerobot,
"LeRobotDataset v3.0": ``data/*/*.parquet`` holds the rows, ``meta/info.json`` the features,
``meta/episodes/*/*.parquet`` the place of each episode, ``meta/tasks.parquet`` the sentences of the tasks, and
``meta/stats.json`` the features' minimum, maximum, mean and standard deviation.

A key becomes a feature of its own shape, joined by dots: clouds are "observation.points", float32 [N, 3]. The table of
episodes is in ``meta/fb3d_rl.json``, which LeRobot does not read. So what is read back equals what was written in every
bit. Not kept: the buffer's capacity, and keys with a dot in their name. Statistics of single episodes, which LeRobot
needs to merge data sets only, are left out.

Data sets of other projects can be read if their features have the names and shapes of the data contract. Their episodes
count as successful, unless a column "record.success" says otherwise: LeRobot's format has no field for it, and failed
demonstrations are rarely published.
"""

from __future__ import annotations

import itertools
import json
import os
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase

from fb3d_rl.data.demonstrations import DemonstrationBuffer, EpisodeInfo, demonstrated, foreign_episode, new_buffer
from fb3d_rl.errors import UserError

VERSION = "v3.0"
ABOUT = "meta/fb3d_rl.json"
DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
EPISODES = "meta/episodes/chunk-000/file-000.parquet"
FILE_MB, CHUNK_FILES = 100, 1000
"""LeRobot's defaults: megabytes of a file, files of a folder."""
COLUMNS = {
    "timestamp": "float32",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}
"""The columns that every data set of LeRobot has."""


def write(buffer: DemonstrationBuffer, folder: Path, rate: int) -> None:
    """Write all episodes to a new ``folder``.

    Args:
        buffer: the demonstrations.
        folder: the new folder; after an error it does not exist.
        rate: control steps per second.

    Raises:
        UserError: there is something at ``folder``, nothing in the buffer, a key has a dot in its name, or pyarrow is
            not installed.
    """
    _, parquet = _arrow()
    if folder.exists():
        raise UserError(f"{folder} exists already; choose another folder")
    if not len(buffer):
        raise UserError(f"{buffer.path} holds no episode, and LeRobot knows no empty data set")
    dotted = [key for key in buffer.keys if "." in str(key)]
    if dotted:
        raise UserError(f"LeRobot's format has no place for the key {dotted[0]}, which has a dot in its name")
    tasks = list(dict.fromkeys(_sentence(info) for info in buffer.episodes))
    part = folder.with_name(f".{folder.name}.part")
    shutil.rmtree(part, ignore_errors=True)
    try:
        (part / EPISODES).parent.mkdir(parents=True)
        stats, places = _write_rows(buffer, part, rate, tasks)
        parquet.write_table(_episode_table(buffer, places), part / EPISODES)
        parquet.write_table(_task_table(tasks), part / "meta" / "tasks.parquet")
        about = {"about": buffer.about, "episodes": [asdict(info) for info in buffer.episodes]}
        for name, content in (
            ("meta/info.json", _info(buffer, rate, len(tasks))),
            ("meta/stats.json", {name: item.result() for name, item in stats.items()}),
            (ABOUT, about),
        ):
            (part / name).write_text(json.dumps(content, indent=4) + "\n")
        os.replace(part, folder)
    finally:
        shutil.rmtree(part, ignore_errors=True)


def read(folder: Path, out: Path | str) -> DemonstrationBuffer:
    """Make a buffer at ``out`` of the data set in ``folder``.

    Raises:
        UserError: a file is missing or damaged, the format is another version's, the features are not the task's, there
            is something at ``out``, or pyarrow is not installed.
    """
    arrow, _ = _arrow()
    try:
        info = json.loads((folder / "meta" / "info.json").read_text())
        if info["codebase_version"] != VERSION:
            raise UserError(
                f"{folder} is in LeRobot's format {info['codebase_version']}; convert it to {VERSION} with "
                "python -m lerobot.datasets.v30.convert_dataset_v21_to_v30"
            )
        own = json.loads((folder / ABOUT).read_text()) if (folder / ABOUT).is_file() else {}
        about = own.get("about", {"source": str(folder), "fps": info["fps"]})
        with new_buffer(out, max(info["total_frames"], 1), about) as buffer:
            for k, frames in enumerate(_read_rows(folder, info["features"])):
                frames = demonstrated(frames)
                buffer.extend(frames, EpisodeInfo.from_dict(own["episodes"][k]) if own else _stranger(frames))
            if len(buffer) != info["total_frames"] or not len(buffer):
                raise ValueError(
                    f"{len(buffer)} of its {info['total_frames']} frames are there; was it written to the end?"
                )
    except (OSError, ValueError, KeyError, TypeError, IndexError, arrow.ArrowException) as error:
        raise UserError(f"{folder} cannot be read as a data set of LeRobot ({error})") from error
    return buffer


def _stranger(frames: TensorDictBase) -> EpisodeInfo:
    """Facts about an episode [T] that has no entry in :data:`ABOUT`; its rows may say of success and round."""
    info, record = foreign_episode("unknown", True, len(frames)), frames.get("record", None)
    if record is None:
        return info
    last = record[-1]
    return replace(info, success=bool(last.get("success", True)), round=int(last.get("round", 0)))


class _Stats:
    """Statistics over the first axis of arrays that come one after the other."""

    def __init__(self, shape: Sequence[int]) -> None:
        self.count = 0
        self.least, self.most = np.full(shape, np.inf), np.full(shape, -np.inf)
        self.mean, self.deviation = np.zeros(shape), np.zeros(shape)

    def add(self, values: NDArray[Any]) -> None:
        """Add ``values`` [T, *shape]; means and squared deviations are combined as in Chan et al. 1979."""
        values, count = values.astype(np.float64), len(values)
        self.least, self.most = np.minimum(self.least, values.min(0)), np.maximum(self.most, values.max(0))
        shift, total = values.mean(0) - self.mean, self.count + count
        self.deviation += values.var(0) * count + shift**2 * self.count * count / total
        self.mean += shift * count / total
        self.count = total

    def result(self) -> dict[str, list[Any]]:
        """The statistics in LeRobot's layout."""
        std = np.sqrt(self.deviation / self.count)
        arrays = {"min": self.least, "max": self.most, "mean": self.mean, "std": std}
        return {name: value.tolist() for name, value in arrays.items()} | {"count": [self.count]}


def _write_rows(
    buffer: DemonstrationBuffer, folder: Path, rate: int, tasks: Sequence[str]
) -> tuple[dict[str, _Stats], list[tuple[int, int]]]:
    """Write data/; return each column's statistics, and the folder and file of each episode."""
    arrow, parquet = _arrow()
    features = _features(buffer)
    stats = {name: _Stats(feature["shape"]) for name, feature in features.items()}
    places: list[tuple[int, int]] = []
    writer, file, size = None, -1, 0
    try:
        for k, info in enumerate(buffer.episodes):
            columns = _columns(buffer, k, rate, tasks.index(_sentence(info)))
            content = {name: _column(values) for name, values in columns.items()}
            table = arrow.table(content)
            if writer is None or size + table.nbytes > FILE_MB * 2**20:
                if writer is not None:
                    writer.close()
                file, size = file + 1, 0
                path = folder / DATA.format(chunk_index=file // CHUNK_FILES, file_index=file % CHUNK_FILES)
                path.parent.mkdir(parents=True, exist_ok=True)
                writer = parquet.ParquetWriter(path, table.schema)
            writer.write_table(table)
            size += table.nbytes
            places.append((file // CHUNK_FILES, file % CHUNK_FILES))
            for name, values in columns.items():
                stats[name].add(values.reshape(len(values), *features[name]["shape"]))
    finally:
        if writer is not None:
            writer.close()
    return stats, places


def _columns(buffer: DemonstrationBuffer, k: int, rate: int, task: int) -> dict[str, NDArray[Any]]:
    """The columns [T, ...] of episode ``k``."""
    frames, first = buffer.frames(k), buffer.first_row(k)
    steps = np.arange(len(frames))
    columns = {".".join(_names(key)): frames.get(key).numpy() for key in buffer.keys if key != "episode"}
    own = (steps / rate, steps, np.full_like(steps, k), first + steps, np.full_like(steps, task))
    return columns | {name: values.astype(COLUMNS[name]) for name, values in zip(COLUMNS, own, strict=True)}


def _column(values: NDArray[Any]) -> Any:
    """[T, ...] as a column: numbers where there is one a row, else lists, or lists of lists."""
    arrow, _ = _arrow()
    column = arrow.array(values.reshape(-1))
    shape = values.shape if values.shape[1:] != (1,) else values.shape[:1]
    for axis in range(len(shape) - 1, 0, -1):
        count = int(np.prod(shape[:axis]))
        offsets = arrow.array(np.arange(count + 1) * shape[axis], arrow.int32())
        column = arrow.ListArray.from_arrays(offsets, column)
    return column


def _features(buffer: DemonstrationBuffer) -> dict[str, dict[str, Any]]:
    features: dict[str, dict[str, Any]] = {
        ".".join(_names(key)): {"dtype": str(dtype).removeprefix("torch."), "shape": list(shape), "names": None}
        for key, (shape, dtype) in buffer.keys.items()
        if key != "episode"
    }
    return features | {name: {"dtype": dtype, "shape": [1], "names": None} for name, dtype in COLUMNS.items()}


def _info(buffer: DemonstrationBuffer, rate: int, tasks: int) -> dict[str, Any]:
    return {
        "codebase_version": VERSION,
        "robot_type": "floating_suction_gripper",
        "total_episodes": len(buffer.episodes),
        "total_frames": len(buffer),
        "total_tasks": tasks,
        "chunks_size": CHUNK_FILES,
        "data_files_size_in_mb": FILE_MB,
        "video_files_size_in_mb": 200,
        "fps": rate,
        "splits": {"train": f"0:{len(buffer.episodes)}"},
        "data_path": DATA,
        "video_path": None,
        "features": _features(buffer),
    }


def _episode_table(buffer: DemonstrationBuffer, places: Sequence[tuple[int, int]]) -> Any:
    arrow, _ = _arrow()
    count = len(buffer.episodes)
    lengths = [info.rows for info in buffer.episodes]
    ends = list(itertools.accumulate(lengths))
    return arrow.table(
        {
            "episode_index": list(range(count)),
            "tasks": [[_sentence(info)] for info in buffer.episodes],
            "length": lengths,
            "data/chunk_index": [chunk for chunk, _ in places],
            "data/file_index": [file for _, file in places],
            "dataset_from_index": [end - length for end, length in zip(ends, lengths, strict=True)],
            "dataset_to_index": ends,
            "meta/episodes/chunk_index": [0] * count,
            "meta/episodes/file_index": [0] * count,
        }
    )


def _task_table(tasks: Sequence[str]) -> Any:
    """The table of tasks, with pandas' metadata: LeRobot reads the sentences as its index."""
    arrow, _ = _arrow()
    index = "__index_level_0__"
    about = {
        "index_columns": [index],
        "column_indexes": [],
        "columns": [
            {"name": "task_index", "field_name": "task_index", "pandas_type": "int64", "numpy_type": "int64",
             "metadata": None},
            {"name": None, "field_name": index, "pandas_type": "unicode", "numpy_type": "object", "metadata": None},
        ],
        "pandas_version": "2.0.0",
    }  # fmt: skip
    table = arrow.table({"task_index": list(range(len(tasks))), index: list(tasks)})
    return table.replace_schema_metadata({"pandas": json.dumps(about)})


def _read_rows(folder: Path, features: dict[str, dict[str, Any]]) -> Iterator[TensorDictBase]:
    """The frames [T] of each episode."""
    _, parquet = _arrow()
    wanted = {
        name: feature
        for name, feature in features.items()
        if name not in COLUMNS and feature["dtype"] not in ("image", "video", "string")
    }
    for path in sorted((folder / "data").glob("*/*.parquet")):
        table = parquet.read_table(path, columns=["episode_index", *wanted])
        episodes = table["episode_index"].to_numpy()
        rows = TensorDict({}, batch_size=[len(episodes)])
        for name, feature in wanted.items():
            values = _flat(table[name]).astype(feature["dtype"], copy=False).reshape(len(episodes), *feature["shape"])
            rows[tuple(name.split("."))] = torch.tensor(values)
        starts = [0, *(np.flatnonzero(np.diff(episodes)) + 1).tolist(), len(episodes)]
        for first, after in itertools.pairwise(starts):
            yield rows[first:after].clone()


def _flat(column: Any) -> NDArray[Any]:
    values = column.combine_chunks()
    values = getattr(values, "storage", values)
    while hasattr(values, "flatten") and str(values.type).startswith(("list", "large_list", "fixed_size_list")):
        values = values.flatten()
    flat: NDArray[Any] = values.to_numpy(zero_copy_only=False)
    return flat


def _names(key: Any) -> tuple[str, ...]:
    return key if isinstance(key, tuple) else (key,)


def _sentence(info: EpisodeInfo) -> str:
    return f"open a part of the {info.category}"


def _arrow() -> tuple[Any, Any]:
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise UserError("LeRobot's format needs pyarrow; install it: pip install pyarrow") from error
    return pyarrow, pyarrow.parquet
