"""Indexing of rows on disk as of a list or a tensor, so that loops and torch's DataLoader work with them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torch.utils.data._utils.collate import default_collate_fn_map

Index = int | slice | Sequence[int] | Tensor | NDArray[Any]
"""A number, counted from the end if negative, a slice, numbers [K], or a mask of all rows."""


def pick(index: Index, size: int, take: Callable[[Tensor], TensorDictBase]) -> TensorDictBase:
    """The rows that ``index`` picks among ``size``: a TensorDict [] for a single number, else [K].

    Args:
        index: see :data:`Index`.
        size: number of rows.
        take: gives the rows [K] of numbers [K] int64 that lie in [0, size).

    Raises:
        IndexError: there is no such row.
    """
    if isinstance(index, Tensor):
        index = index.numpy(force=True)
    elif not isinstance(index, (int, np.integer, slice)):
        index = np.asarray(index)
    if isinstance(index, np.ndarray) and not index.size:
        index = np.zeros(0, dtype=np.int64)  # an empty list has no type of its own
    numbers = np.asarray(np.arange(size)[index])
    if numbers.ndim > 1:
        raise IndexError("rows are picked by a number, a slice, a list of numbers or a mask")
    rows = take(torch.from_numpy(np.ascontiguousarray(numbers.reshape(-1))))
    return rows if numbers.ndim else rows[0]


def _collate(batch: Any, *, collate_fn_map: object = None) -> TensorDictBase:
    """The default batches of torch's DataLoader for rows, which it would else treat as dictionaries."""
    rows: TensorDictBase = batch if isinstance(batch, TensorDictBase) else torch.stack(batch)
    return rows


default_collate_fn_map[TensorDict] = _collate
