"""Files are replaced in one step, also where the disk is full: nothing is left beside them."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure

from fb3d_rl.drawing.picture import write_picture
from fb3d_rl.files import replacing, write_text
from fb3d_rl.models.artflownet import ArtFlowNet
from fb3d_rl.models.export import export
from fb3d_rl.training.checkpoint import save_checkpoint

Limit = Callable[[int], AbstractContextManager[None]]


def clouds(folder: Path) -> None:
    one = np.zeros((1, 64, 3), dtype=np.float32)
    there = np.ones((1, 64), dtype=bool)
    np.savez(folder / "clouds.npz", points=one, valid=there, part_mask=there, flow_true=one + 1, flow_predicted=one + 1,
             title=np.array(["Box 1, lid"]))  # fmt: skip


def checkpoint(path: Path) -> None:
    state = {"model": {"weight": torch.zeros(10000)}, "step": 1}
    save_checkpoint(path, algo="artflownet", config={}, model_kwargs={}, state=state, seed=0)


WRITERS: dict[str, tuple[str, Callable[[Path], object]]] = {
    "text": ("page.html", lambda path: write_text(path, 20000 * "x")),
    "checkpoint": ("checkpoint.pt", checkpoint),
    "weights": ("net.safetensors", lambda path: ArtFlowNet(neighbors=8).save_pretrained(path)),
    "picture": ("flow.png", lambda path: write_picture(path.parent)),
    "program": ("net.pt2", lambda path: export(ArtFlowNet(neighbors=8), path, 16)),
}


@pytest.mark.parametrize(
    "kind", [*(k for k in WRITERS if k != "program"), pytest.param("program", marks=pytest.mark.slow)]
)
def test_a_full_disk_leaves_the_old_file_and_nothing_else(tmp_path: Path, full_disk: Limit, kind: str) -> None:
    name, write = WRITERS[kind]
    clouds(tmp_path)
    Figure().savefig(tmp_path / "warm.png")  # matplotlib's own cache of fonts
    (tmp_path / name).write_bytes(b"old")
    before = sorted(tmp_path.iterdir())
    with full_disk(2000), pytest.raises(OSError) as raised:
        write(tmp_path / name)
    assert raised.value.filename == str(tmp_path / name)
    assert sorted(tmp_path.iterdir()) == before and (tmp_path / name).read_bytes() == b"old"


def test_an_interrupt_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt), replacing(tmp_path / "a.txt") as beside:
        beside.write_text("half")
        raise KeyboardInterrupt
    assert not list(tmp_path.iterdir())
