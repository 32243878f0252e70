"""Generate flow samples in worker processes, without a simulator, into a TensorDict memory map."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import as_completed
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase

from fb3d_rl import contract
from fb3d_rl.assets.partnet_mobility import content_of, load_object
from fb3d_rl.camera.embree import use_one_thread
from fb3d_rl.children import withheld, worker_pool
from fb3d_rl.data.picking import Index, pick
from fb3d_rl.data.samples import FLOWS, SampleKind, SampleOptions
from fb3d_rl.errors import UserError
from fb3d_rl.files import write_text
from fb3d_rl.scene.posed import Posed

if TYPE_CHECKING:  # takes seconds, which every worker process would wait
    from torchrl.data import ReplayBuffer

DONE = "samples.json"

DAMAGED = (OSError, ValueError, KeyError, TypeError, AttributeError, RuntimeError)
"""The exceptions of reading a data set with missing or damaged files."""


Job: TypeAlias = tuple[Path, Path, int, np.ndarray, int, SampleOptions, SampleKind]
"""The arguments of :func:`_draw_object`."""


def generate_samples(
    out: Path,
    folders: Sequence[Path],
    count: int,
    seed: int,
    options: SampleOptions,
    workers: int,
    progress: Callable[[int], None] = lambda done: None,
    kind: SampleKind = FLOWS,
) -> TensorDictBase:
    """Fill a memory map with ``count`` samples of the objects in ``folders``.

    Given the objects and the count, sample i depends on (seed, i) only, not on the number of workers. The counts of the
    objects' samples differ by one at most. A finished data set in ``out`` that was made from the same
    arguments, and from objects of the same content in any folder, is reused.

    Args:
        out: folder of the memory map; an unfinished one is drawn anew.
        folders: PartNet-Mobility object folders; of one that is listed k times, k times as many samples are drawn.
        count: number of samples S.
        seed: seed of all draws.
        options: how samples are drawn.
        workers: number of worker processes; 0 draws in this process.
        progress: called with the number of samples drawn so far.
        kind: what is drawn.

    Returns:
        TensorDict [S] of the contract's group "sample" plus "object" [S] int64, an index into ``folders``, and
        "target" [S] int64, the index of the link to open (-1: all movable parts).

    Raises:
        UserError: none of the objects ever shows an openable part, or ``out`` holds another finished data set.
    """
    recipe = {
        "objects": [[folder.name, content_of(folder)] for folder in folders],
        "count": count,
        "seed": seed,
        "options": asdict(options),
        "version": 3,
        **({} if kind == FLOWS else {"kind": kind.name}),
    }
    done = finished_rows(out, recipe)
    if done is not None:
        progress(count)
        return done
    empty_rows(out, count, options.points, kind)
    owner = np.random.default_rng([seed, 0]).permutation(count) % len(folders)
    first = {folder: f for f, folder in reversed(list(enumerate(folders)))}
    owner = np.array([first[folder] for folder in folders])[owner]
    order, starts = owner.argsort(kind="stable"), np.bincount(owner, minlength=len(folders)).cumsum()
    rows_of = np.split(order, starts[:-1])
    jobs = [
        (out / "rows", folder, f, rows_of[f], seed, options, kind)
        for folder, f in sorted(first.items(), key=lambda item: item[1])
    ]
    missing = _draw_objects(jobs, workers, progress)
    rows = TensorDict.load_memmap(out / "rows")
    _refill(rows, sorted(missing), count)
    finish(out, recipe, refilled=len(missing))
    return rows


def _draw_objects(jobs: Sequence[Job], workers: int, progress: Callable[[int], None]) -> list[int]:
    """:func:`_draw_object` of each job, in this process or in others; the rows that could not be drawn."""
    missing: list[int] = []
    drawn = 0
    if workers == 0:
        for job in jobs:
            missing += _draw_object(*job)
            drawn += len(job[3])
            progress(drawn)
        return missing
    with worker_pool(workers, _quiet) as pool:
        with withheld():
            futures = {pool.submit(_draw_object, *job): len(job[3]) for job in jobs}
        for future in as_completed(futures):
            missing += future.result()
            drawn += futures[future]
            progress(drawn)
    return missing


def finished_rows(out: Path, recipe: Mapping[str, Any]) -> TensorDictBase | None:
    """The rows of the finished data set in a folder; None if there is none or it is damaged.

    Raises:
        UserError: they were made from another recipe.
    """
    try:
        kept, wanted = recipe_of(out), json.loads(json.dumps(recipe))
    except DAMAGED:
        return None  # missing or damaged: it is drawn anew
    if kept != wanted:
        differing = sorted(key for key in {*kept, *wanted} if kept.get(key) != wanted.get(key))
        raise UserError(
            f"{out} holds a finished data set that was made with other {', '.join(differing)}; choose another folder, "
            "or remove it yourself"
        )
    try:
        return _rows(out)
    except DAMAGED:
        return None


def recipe_of(out: Path) -> dict[str, Any]:
    """The recipe of the finished data set in a folder."""
    recipe: dict[str, Any] = json.loads((out / DONE).read_text())["recipe"]
    return recipe


def finish(out: Path, recipe: Mapping[str, Any], **facts: int) -> None:
    """Mark the data set in a folder as finished, with its recipe."""
    write_text(out / DONE, json.dumps({"recipe": recipe, **facts}))


class Joined:
    """The rows of several replay buffers, one after the other."""

    def __init__(self, *parts: ReplayBuffer) -> None:
        self.parts = parts
        self.starts = torch.tensor([0, *(len(part) for part in parts)]).cumsum(0)

    def __len__(self) -> int:
        return int(self.starts[-1])

    def __getitem__(self, index: Index) -> TensorDictBase:
        """The rows that ``index`` picks (:func:`fb3d_rl.data.picking.pick`), in that order."""
        return pick(index, len(self), self._take)

    def _take(self, index: torch.Tensor) -> TensorDictBase:
        owner = torch.searchsorted(self.starts, index, right=True) - 1
        order = owner.argsort(stable=True)
        taken = [part[index[owner == k] - self.starts[k]] for k, part in enumerate(self.parts)]
        rows: TensorDictBase = torch.cat(taken)[order.argsort()]
        return rows


def load_samples(folder: Path, kind: SampleKind | None = None) -> TensorDictBase:
    """The finished data set that :func:`generate_samples` left in a folder, as rows [S] on disk.

    Raises:
        UserError: there is none, it is damaged, or not of that ``kind``.
    """
    if not (folder / DONE).is_file():
        raise UserError(f"{folder} holds no finished flow samples; give the samples/ of a run of algo=artflownet")
    try:
        rows, found = _rows(folder), recipe_of(folder).get("kind", FLOWS.name)
        contract.check(rows, "sample")
    except DAMAGED as error:
        raise UserError(f"the flow samples at {folder} are damaged ({error}); copy or draw them anew") from error
    if kind is not None and found != kind.name:
        raise UserError(f"{folder} holds {found}, not {kind.name}: give a data set that this algorithm has drawn")
    return rows


def _rows(folder: Path) -> TensorDictBase:
    """The rows of a data set, after a check that its files are complete.

    Raises:
        ValueError or another of DAMAGED: a file is missing or incomplete.
    """
    for about in (folder / "rows").rglob("meta.json"):
        for name, entry in json.loads(about.read_text()).items():
            if isinstance(entry, dict) and "dtype" in entry:
                size = math.prod(entry["shape"]) * getattr(torch, entry["dtype"].removeprefix("torch.")).itemsize
                file = about.parent / f"{name}.memmap"
                # Torch would make a file that is missing, and lengthen one that is too short.
                if file.stat().st_size != size:
                    raise ValueError(f"{file.name} has another size")
    return TensorDict.load_memmap(folder / "rows")


def _quiet() -> None:
    # One thread a worker: the workers are the parallelism.
    torch.set_num_threads(1)
    use_one_thread()


def empty_rows(out: Path, count: int, points: int, kind: SampleKind = FLOWS) -> TensorDictBase:
    """A memory map of ``count`` rows of zeros in a folder, which is emptied first."""
    row = kind.blank(points).update({"object": torch.zeros((), dtype=torch.int64)})
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    rows: TensorDictBase = row.expand(count).memmap_like(out / "rows")
    return rows


def _draw_object(
    rows_dir: Path, folder: Path, index: int, rows: np.ndarray, seed: int, options: SampleOptions, kind: SampleKind
) -> list[int]:
    """Draw the samples ``rows`` of one object into the memory map; return those that could not be drawn."""
    if not len(rows):
        return []
    posed = Posed(load_object(folder), options.camera)
    if not posed.openable:
        return [int(row) for row in rows]
    table = TensorDict.load_memmap(rows_dir)
    missing = []
    for row in rows.tolist():
        sample = kind.draw(posed, options, np.random.default_rng([seed, 1, row]))
        if sample is None:
            missing.append(row)
            continue
        sample["object"] = torch.tensor(index)
        table[row] = sample
    return missing


def _refill(rows: TensorDictBase, missing: list[int], count: int) -> None:
    """Fill the rows that could not be drawn with copies of evenly spread other rows."""
    if not missing:
        return
    present = np.setdiff1d(np.arange(count), missing)
    if not len(present):
        raise UserError("no sample could be drawn: none of the objects shows a part that can be opened")
    for k, row in enumerate(missing):
        rows[row] = rows[int(present[k * len(present) // len(missing)])].clone()
