"""Rows are picked like a list's entries, and torch's DataLoader and loops go over what lies on disk."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch.utils.data import DataLoader
from torchrl.data import TensorDictReplayBuffer, TensorStorage

from fb3d_rl.algos.learners import Labels
from fb3d_rl.camera.views import View
from fb3d_rl.data.demonstrations import DemonstrationBuffer, EpisodeInfo
from fb3d_rl.data.generate import DONE, Joined, empty_rows, load_samples
from fb3d_rl.data.picking import pick

SIZE = 7
NUMBERS = torch.arange(SIZE)

ROWS = {
    "number": (3, [3]),
    "NumPy's number": (np.int64(2), [2]),
    "tensor's number": (torch.tensor(2), [2]),
    "last": (-1, [6]),
    "slice": (slice(1, 4), [1, 2, 3]),
    "backwards": (slice(None, None, -3), [6, 3, 0]),
    "list": ([4, -7, 4], [4, 0, 4]),
    "range": (range(2, 4), [2, 3]),
    "empty list": ([], []),
    "tensor": (torch.tensor([5, 1]), [5, 1]),
    "array": (np.array([5, 1]), [5, 1]),
    "mask": (NUMBERS % 3 == 0, [0, 3, 6]),
    "list of truths": ([True, False, False, False, False, True, False], [0, 5]),
}
NONE = [SIZE, -SIZE - 1, [0, SIZE], torch.tensor([-SIZE - 1]), [True], [[0, 1]], True, 1.0, [0.5]]


@pytest.fixture
def kinds(tmp_path: Path) -> dict[str, Callable[[], TensorDictBase]]:
    """Everything that holds rows, each with its row's number as "x"."""
    buffer = DemonstrationBuffer.create(tmp_path / "demos", SIZE)
    for rows in NUMBERS.split(4):
        frames = TensorDict(
            {
                "x": rows[:, None],
                "elapsed_steps": torch.arange(len(rows))[:, None],
                "expert": {"twist": rows[:, None].float()},
            },
            batch_size=[len(rows)],
        )
        buffer.extend(frames, EpisodeInfo("o", "Box", 1, (), View(0.0, 0.0), steps=len(rows)))
    buffer.commit()
    stored = empty_rows(tmp_path / "samples", SIZE, 64)
    stored["object"][:] = NUMBERS
    (tmp_path / "samples" / DONE).write_text(json.dumps({"recipe": {}}))
    samples = load_samples(tmp_path / "samples")
    parts = [TensorDictReplayBuffer(storage=TensorStorage(part)) for part in (samples[:3], samples[3:])]
    return {"demonstrations": buffer, "labels": Labels(buffer, 2), "joined": Joined(*parts), "samples": samples}


def number(rows: TensorDictBase) -> list[int]:
    return list(rows["x" if "x" in rows.keys() else "object"].flatten().tolist())


@pytest.mark.parametrize("kind", ["demonstrations", "labels", "joined"])
def test_rows_are_picked_as_of_a_list(kinds: dict[str, TensorDictBase], kind: str) -> None:
    rows = kinds[kind]
    for name, (index, expected) in ROWS.items():
        picked = rows[index]
        single = not isinstance(index, (slice, range, list)) and np.ndim(index) == 0
        assert picked.batch_size == torch.Size([] if single else [len(expected)]), name
        assert number(picked) == expected, name
    for index in NONE:
        with pytest.raises(IndexError):
            rows[index]
    assert [number(row) for row in rows] == [[k] for k in range(SIZE)]  # and it ends


@pytest.mark.parametrize("kind", ["demonstrations", "labels", "joined", "samples"])
@pytest.mark.parametrize("workers", [0, pytest.param(2, marks=pytest.mark.slow)])
def test_a_data_loader_gives_batches(kinds: dict[str, TensorDictBase], kind: str, workers: int) -> None:
    # A worker that was handed tensordict's own class knows nothing of fb3d_rl.
    collate = torch.stack if workers and kind == "samples" else None
    batches = list(DataLoader(kinds[kind], batch_size=3, num_workers=workers, collate_fn=collate))
    assert all(isinstance(batch, TensorDictBase) for batch in batches)
    assert [number(batch) for batch in batches] == [[0, 1, 2], [3, 4, 5], [6]]
    generator = torch.Generator().manual_seed(1)
    mixed = DataLoader(kinds[kind], batch_size=4, shuffle=True, generator=generator, collate_fn=lambda rows: rows)
    assert sum(map(len, mixed)) == SIZE


def test_nothing_has_no_first_row() -> None:
    with pytest.raises(IndexError):
        pick(0, 0, lambda numbers: TensorDict({}, batch_size=[len(numbers)]))
