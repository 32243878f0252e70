"""What else algo=artflownet can start from: weights of another run, and clouds that a policy met."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from fb3d_rl import contract
from fb3d_rl.algos.artflownet import MET, SAMPLES, run, training_rows
from fb3d_rl.contract import UserError
from fb3d_rl.data.generate import load_samples
from fb3d_rl.models.artflownet import ArtFlowNet
from fb3d_rl.training.run_log import read_rows

Config = Callable[[str, list[str]], Any]
SMALL = [
    "experiment=smoke",
    "assets.categories=[Microwave]",
    "algo.epochs=1.0",
    "algo.batch_size=4",
    "algo.neighbors=16",
    "algo.log_every=1",
    "algo.evaluate_every=null",
    "data.points=128",
    "data.train_samples=12",
    "data.workers=0",
    "camera.resolution=48",
    "evaluation.trials=0",
    "env.horizon=40",
]


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    """Of a network that was never trained; its policy goes somewhere all the same."""
    path = tmp_path / "net.safetensors"
    ArtFlowNet(neighbors=16, generator=torch.Generator().manual_seed(7)).save_pretrained(path)
    return path


@pytest.mark.slow
def test_clouds_that_a_policy_met_are_trained_on(tmp_path: Path, config: Config, weights: Path) -> None:
    settings = [*SMALL, f"data.met_by={weights}", "data.met_samples=8"]
    run(config("train", settings), tmp_path / "run")
    met = load_samples(tmp_path / "run" / MET)
    contract.check(met, "sample")
    assert len(met) == 8 and (met["privileged", "flow"].norm(dim=-1).amax(-1) > 0.5).all()
    assert (met["privileged", "flow"].norm(dim=-1) > 0)[met["observation", "part_mask"]].float().mean() > 0.99
    clouds = met["observation", "points"]
    assert not torch.equal(clouds[0], clouds[1]), "the hand moves before the object"
    rows = training_rows(config("train", settings), tmp_path / "run")
    assert len(rows) == 20
    assert torch.equal(rows[torch.tensor([13, 2, 12])]["observation", "points"][0], clouds[1])
    samples = load_samples(tmp_path / "run" / SAMPLES)
    assert torch.equal(rows[torch.tensor([13, 2])]["observation", "points"][1], samples["observation", "points"][2])
    assert read_rows(tmp_path / "run" / "metrics.jsonl")[-1]["step"] == 5  # 20 rows, 4 at a time
    # The same trials give the same bits, whatever the backend.
    run(config("train", [*settings, "collector=process", "collector.workers=2"]), tmp_path / "again")
    assert torch.equal(load_samples(tmp_path / "again" / MET)["observation", "points"], clouds)


def test_training_starts_from_given_weights(tmp_path: Path, config: Config, weights: Path) -> None:
    losses = []
    for name, start in (("drawn", []), ("given", [f"algo.start_from={weights}"])):
        run(config("train", [*SMALL, *start]), tmp_path / name)
        losses.append(read_rows(tmp_path / name / "metrics.jsonl")[0]["train/loss"])
    assert losses[0] != losses[1]
    with pytest.raises(UserError, match=r"another network; give algo\.neighbors=16"):
        run(config("train", [*SMALL, f"algo.start_from={weights}", "algo.neighbors=8"]), tmp_path / "other")
    with pytest.raises(UserError, match="no weights"):
        run(config("train", [*SMALL, "algo.start_from=nowhere.safetensors"]), tmp_path / "other")
    assert not (tmp_path / "other").exists()
