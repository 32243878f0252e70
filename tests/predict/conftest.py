from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.camera.views import View
from fb3d_rl.models.artflownet import ArtFlowNet
from fb3d_rl.scene.posed import Posed


class Seen(NamedTuple):
    points: NDArray[np.float32]
    part: NDArray[np.bool_]
    camera: NDArray[np.float64]


@pytest.fixture(scope="session")
def net() -> ArtFlowNet:
    return ArtFlowNet.from_pretrained()


@pytest.fixture(scope="session")
def see(procedural_objects: dict[str, ArticulatedObject]) -> Callable[..., Seen]:
    """What a noisy camera sees of an object, not thinned: every pixel."""

    def seen(category: str = "Microwave", azimuth: float = 20.0, noise: float = 0.002, seed: int = 0) -> Seen:
        posed, rng = Posed(procedural_objects[category]), np.random.default_rng(seed)
        link = posed.openable[0]
        poses = posed.poses(posed.closed + 0.3 * (posed.opened - posed.closed))
        view = View(azimuth, 30.0)
        points, links = posed.camera.capture(poses, view, further=False)
        points = points + rng.normal(size=points.shape) * noise
        part = np.isin(links, list(posed.obj.descendants(link)))
        order = rng.permutation(len(points))
        pose: Any = posed.camera.pose(view)
        return Seen(points[order].astype(np.float32), part[order], pose[:3, 3])

    return seen
