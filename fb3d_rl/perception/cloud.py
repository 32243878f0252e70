"""The cloud that policies see: exactly N foreground points with a valid mask."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def sample_cloud(
    points: NDArray[np.float64], links: NDArray[np.int64], count: int, rng: np.random.Generator
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Draw exactly ``count`` of the points, without replacement and in random order; pad if there are fewer.

    Args:
        points: [P, 3] world points of the object only (gripper and ground removed), m.
        links: [P] the link that each point lies on.
        count: N.
        rng: the generator that draws.

    Returns:
        Points [N, 3] float32 and their links [N] int64; padding has the point 0 and the link -1.
    """
    order = rng.choice(len(points), min(count, len(points)), replace=False)
    cloud = np.zeros((count, 3), dtype=np.float32)
    ids = np.full(count, -1, dtype=np.int64)
    cloud[: len(order)] = points.take(order, axis=0)
    ids[: len(order)] = links.take(order)
    return cloud, ids
