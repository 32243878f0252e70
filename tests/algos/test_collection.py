"""Collecting ends where trials bring nothing, and not where a few do not."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from fb3d_rl.algos import collection
from fb3d_rl.algos.collection import RowsOptions, collect
from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.camera.raycast import CameraOptions
from fb3d_rl.contract import F32, GROUPS
from fb3d_rl.data.samples import SampleOptions
from fb3d_rl.env.options import Trial
from fb3d_rl.errors import UserError
from fb3d_rl.policies.hand import VelocityLimits
from fb3d_rl.rollout.collectors import Episode, Workers
from fb3d_rl.rollout.trials import BARREN
from fb3d_rl.scene.posed import Posed

SAMPLES = SampleOptions(points=64, camera=CameraOptions(resolution=24))
STEPS = 6


def episode(held: bool) -> TensorDict:
    """An expert's episode, in the second half of which the hand holds the part, or in none."""
    shapes = {key: entry for key, entry in GROUPS["observation"].items()}
    frames = TensorDict({}, batch_size=[STEPS])
    for key, entry in shapes.items():
        frames[key] = torch.zeros(STEPS, *(64 if size == "N" else size for size in entry.shape), dtype=entry.dtype)
    frames["observation", "attached"] = (torch.arange(STEPS) >= STEPS // 2)[:, None] & held
    frames["observation", "tool_pose"] = torch.tensor([0, 0, 0, 1.0, 0, 0, 0]).expand(STEPS, 7).clone()
    frames["action"] = frames["expert", "action"] = torch.zeros(STEPS, 8)
    frames["expert", "acts"] = torch.ones(STEPS, 1, dtype=torch.bool)
    frames["elapsed_steps"] = torch.arange(STEPS, dtype=torch.int32)[:, None]
    for key in ("success", "contact"):
        frames["next", key] = torch.zeros(STEPS, 1, dtype=torch.bool)
    frames["next", "normalized_distance"] = torch.ones(STEPS, 1, dtype=F32)
    return frames


class Fake:
    """Workers whose trials end as it is told: "held", "free" or "crashed"; they fail a test that asks for too many."""

    def __init__(self, ends: Iterator[str]) -> None:
        self.ends, self.run_trials = ends, 0

    def run(self, trials: Sequence[Trial], keys: object) -> Iterator[Episode]:
        for index in range(len(trials)):
            self.run_trials += 1
            assert self.run_trials < 10 * BARREN, "it goes on for ever"
            end = next(self.ends)
            yield Episode(index, error="Boom: 1") if end == "crashed" else Episode(index, episode(end == "held"))


@pytest.fixture
def collected(procedural_objects: dict[str, ArticulatedObject], monkeypatch: pytest.MonkeyPatch) -> Any:
    view = Posed(procedural_objects["Microwave"], SAMPLES.camera)

    def drawn(views: object, options: object, rng: object, count: int) -> list[Any]:
        return [SimpleNamespace(object=view.obj.id, link=1, start=(0.0,), view=None, seed=0)] * count

    monkeypatch.setattr(collection, "draw_trials", drawn)

    def run(ends: Iterator[str], labels: int, attached_only: bool = True) -> tuple[Fake, int]:
        workers = Fake(ends)
        rows = RowsOptions(VelocityLimits(1.0, 1.0), attached_only=attached_only)
        rng = np.random.default_rng(0)
        round_ = collect(cast(Workers, workers), [view], SAMPLES, rows, 0, 1.0, 0, labels, rng)
        return workers, sum(len(frames) for frames, _ in round_.episodes)

    return run


def test_trials_without_a_label_end_with_what_to_change(collected: Any) -> None:
    with pytest.raises(UserError, match=r"trials gave no label: .*env\.horizon.*algo\.oracle=false"):
        collected(itertools.repeat("free"), 240)


def test_trials_that_all_crash_end_with_the_reason(collected: Any) -> None:
    for attached_only in (True, False):
        with pytest.raises(UserError, match="they crashed, the last one with: Boom: 1"):
            collected(itertools.repeat("crashed"), 240, attached_only)


@pytest.mark.parametrize("unlucky", ["free", "crashed"])
def test_bad_luck_is_no_error(collected: Any, unlucky: str) -> None:
    """One trial in twenty brings labels; the batches are of one trial each, so nearly all are without."""
    workers, labels = collected(itertools.cycle([unlucky] * 19 + ["held"]), 12)
    assert labels == 12 and workers.run_trials >= 80
