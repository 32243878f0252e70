"""Named streams of random numbers that follow from one seed and never meet those of another."""

from __future__ import annotations

import zlib

import numpy as np


def derived(seed: int, *names: str | int) -> int:
    """A seed of 63 bits for the stream that ``names`` name: NumPy's SeedSequence(seed), spawned by these names.

    Arithmetic such as ``seed + 1`` would give one run's second stream to another run as its first.
    """
    key = tuple(name if isinstance(name, int) else zlib.crc32(name.encode()) for name in names)
    low, high = np.random.SeedSequence(seed, spawn_key=key).generate_state(2, np.uint32).tolist()
    return int(low | (high & 0x7FFFFFFF) << 32)
