"""launch/export.py: weights and programs of a checkpoint, and mistakes that are named before anything is written."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from fb3d_rl.algos.weights import load_network
from fb3d_rl.models.artflownet import ArtFlowNet
from fb3d_rl.training.checkpoint import save_checkpoint
from launch.export import main


@pytest.fixture
def checkpoint(tmp_path: Path) -> Path:
    net = ArtFlowNet(neighbors=8, generator=torch.Generator().manual_seed(0))
    path = tmp_path / "run" / "checkpoint.pt"
    state = {"step": 3, "model": net.state_dict()}
    save_checkpoint(path, algo="artflownet", config={"seed": 0}, model_kwargs=net.arguments, state=state, seed=0)
    return path


def test_weights_are_written_and_read(checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "below" / "flow.safetensors"
    assert main([str(checkpoint), str(out)]) == 0
    assert "MiB" in capsys.readouterr().out and out.stat().st_size < 8 * 2**20
    before, after = load_network(checkpoint).state_dict(), load_network(out).state_dict()
    assert before.keys() == after.keys() and all(torch.equal(before[key], after[key]) for key in before)
    assert b'"step":"3"' in out.read_bytes()[:4000], "what made the weights stands in the file"


def test_a_run_folder_stands_for_the_weights_that_it_measured(checkpoint: Path, tmp_path: Path) -> None:
    best, out = checkpoint.with_name("best.safetensors"), tmp_path / "flow.safetensors"
    ArtFlowNet(neighbors=8, generator=torch.Generator().manual_seed(1)).save_pretrained(best)
    assert main([str(checkpoint.parent), str(out)]) == 0
    assert load_network(out).digest() == load_network(checkpoint).digest() != load_network(best).digest()
    assert b'"step":"3"' in out.read_bytes()[:4000]
    checkpoint.unlink()
    assert load_network(checkpoint.parent).digest() == load_network(best).digest()


def test_a_program_runs_with_pytorch_alone(checkpoint: Path, tmp_path: Path) -> None:
    assert main([str(checkpoint), str(tmp_path / "flow.pt2"), "--points", "40"]) == 0
    points, mask = torch.rand(3, 40, 3), torch.rand(3, 40) < 0.5
    program = torch.export.load(tmp_path / "flow.pt2").module()
    expected = load_network(checkpoint)(points, torch.ones_like(mask), mask)
    torch.testing.assert_close(program(points, mask), expected, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["RUN/checkpoint.pt", "flow.onnx"], ".pt2"),
        (["nowhere.pt", "flow.pt2"], "nowhere.pt"),
        (["nowhere.safetensors", "flow.pt2"], "nowhere.safetensors"),
        (["run/..", "flow.safetensors"], "holds no weights"),
        (["RUN/checkpoint.pt", "flow.pt2", "--points", "3"], "16"),
    ],
)
def test_mistakes(
    checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], says: str
) -> None:
    assert main([str(tmp_path / word.replace("RUN", "run")) if "." in word else word for word in arguments]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and says in error and error.count("\n") == 1
    assert {path.name for path in tmp_path.iterdir()} == {"run"}
