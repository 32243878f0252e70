from __future__ import annotations

from pathlib import Path

import pytest
import torch

from fb3d_rl.errors import UserError
from fb3d_rl.training.checkpoint import fitting, load_checkpoint, save_checkpoint


def save(path: Path, value: float = 1.0) -> None:
    state = {"step": 3, "model": {"weight": torch.full((2,), value)}}
    save_checkpoint(path, algo="artflownet", config={"seed": 4}, model_kwargs={"neighbors": 8}, state=state, seed=4)


def test_round_trip_is_atomic_and_describes_itself(tmp_path: Path) -> None:
    path = tmp_path / "new" / "checkpoint.pt"
    save(path)
    save(path, 2.0)
    content = load_checkpoint(path, algo="artflownet")
    assert content["model_kwargs"] == {"neighbors": 8}
    assert content["config"] == {"seed": 4}
    assert (content["step"], content["seed"]) == (3, 4)
    assert content["git_revision"]
    assert content["state"]["model"]["weight"].tolist() == [2.0, 2.0]
    assert [file.name for file in path.parent.iterdir()] == ["checkpoint.pt"]


def test_failed_save_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.pt"
    save(path)
    state = {"step": 4, "model": {"weight": (i for i in range(3))}}  # a generator cannot be stored
    with pytest.raises(TypeError):
        save_checkpoint(path, algo="artflownet", config={}, model_kwargs={}, state=state, seed=0)
    assert load_checkpoint(path)["step"] == 3
    assert [file.name for file in tmp_path.iterdir()] == ["checkpoint.pt"]


def test_every_bad_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no checkpoint at"):
        load_checkpoint(tmp_path / "missing.pt")
    path = tmp_path / "checkpoint.pt"
    save(path)
    whole = path.read_bytes()
    for content in (b"", b"not a checkpoint", whole[: len(whole) // 2], whole[:-30]):
        path.write_bytes(content)
        with pytest.raises(UserError, match="damaged"):
            load_checkpoint(path)
    torch.save({"weight": torch.zeros(1)}, path)
    with pytest.raises(UserError, match="not a checkpoint of this version"):
        load_checkpoint(path)
    torch.save(Path("an object, not a tensor"), path)
    with pytest.raises(UserError, match="damaged"):
        load_checkpoint(path)
    save(path)
    with pytest.raises(UserError, match="of artflownet, not of bc"):
        load_checkpoint(path, algo="bc")


def test_a_file_that_was_cut_anywhere_is_named(tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.pt"
    state = {"step": 3, "model": {"weight": torch.zeros(5000)}}
    save_checkpoint(path, algo="artflownet", config={}, model_kwargs={}, state=state, seed=4)
    whole = path.read_bytes()
    assert len(whole) > 20000
    for size in sorted({*range(12), *range(0, len(whole), 199), *range(len(whole) - 60, len(whole))}):
        path.write_bytes(whole[:size])
        with pytest.raises(UserError, match="damaged"):
            load_checkpoint(path)


@pytest.mark.parametrize("key", ["algo", "config", "model_kwargs", "state", "step", "seed", "git_revision"])
def test_what_a_file_lacks_is_named(tmp_path: Path, key: str) -> None:
    path = tmp_path / "checkpoint.pt"
    save(path)
    content = load_checkpoint(path)
    for change in ({}, {key: torch.zeros(1)}):
        torch.save({name: value for name, value in content.items() if name != key} | change, path)
        with pytest.raises(UserError, match=f'lacks "{key}"'):
            load_checkpoint(path, algo="artflownet")


def test_what_does_not_fit_is_told_without_torchs_words() -> None:
    with (
        pytest.raises(UserError, match="run/checkpoint.pt holds other weights") as raised,
        fitting("run/checkpoint.pt"),
    ):
        torch.nn.Linear(2, 3).load_state_dict({"weight": torch.zeros(3, 4)})
    assert "\n" not in str(raised.value) and "state_dict" not in str(raised.value)
