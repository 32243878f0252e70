"""An object family from outside the package: generated, read, checked and observed as any other."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from fb3d_rl import contract
from fb3d_rl.assets.partnet_mobility import load_object
from fb3d_rl.camera.options import CameraOptions
from fb3d_rl.data.samples import SampleOptions, draw_sample
from fb3d_rl.kinematics.opening import openable_links, opening_range
from fb3d_rl.kinematics.validation import examine
from fb3d_rl.procedural import FAMILIES, ObjectSpec, Part, generate
from fb3d_rl.procedural.shapes import box, rectangle, wall
from fb3d_rl.scene.posed import Posed

# ------------------------------------------------------------------------------------------------------------- the toy


def chest(rng: np.random.Generator) -> ObjectSpec:
    """A hollow box, open at the top, with a lid that is hinged on its back edge."""
    wide, deep, high = rng.uniform(0.3, 0.6, 3)
    bottom = box("bottom_panel", (-wide, wide), (0.0, 0.02), (-deep, deep))
    sides = wall("side_panel", rectangle(), (0.02, high), (wide, deep), (wide, deep), 0.03)
    plate = box("lid_surface", (-wide, wide), (high + 0.01, high + 0.05), (-deep, deep))
    lid = Part("rotation_lid", "hinge", (-1.0, 0.0, 0.0), rng.uniform(1.2, 1.8), (plate,), (0.0, high + 0.01, -deep))
    return ObjectSpec("Chest", "free", "chest_body", (bottom, *sides), (lid,))


# ----------------------------------------------------------------------------------------------------------- its tests


@pytest.fixture
def folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    monkeypatch.setitem(FAMILIES, "Chest", chest)
    return [tmp_path / name for name in generate(tmp_path, ["Chest"], 3, seed=0)]


def test_chests_are_sound_and_differ(folders: list[Path]) -> None:
    for folder in folders:
        verdict = examine(folder)
        assert (verdict.category, verdict.openable, verdict.findings) == ("Chest", 1, ())
    assert len({opening_range(load_object(folder))[1][0] for folder in folders}) == 3


def test_the_lid_s_flow_lifts_it(folders: list[Path]) -> None:
    for folder in folders:
        posed = Posed(load_object(folder), CameraOptions(resolution=48))
        sample = draw_sample(posed, SampleOptions(points=200, all_parts_share=0.0), np.random.default_rng(1))
        assert sample is not None
        contract.check(sample, "sample")
        assert sample["target"] == openable_links(posed.obj)[0]
        part, flow = sample["observation", "part_mask"], sample["privileged", "flow"]
        assert part.sum() > 20 and not flow[~part].any()
        assert flow.norm(dim=-1).max() == pytest.approx(1.0)
        closed = draw_sample(
            posed, SampleOptions(points=200, all_parts_share=0.0, closed_share=1.0), np.random.default_rng(2)
        )
        assert closed is not None
        lifted = closed["privileged", "flow"][closed["observation", "part_mask"]]
        outer = lifted[lifted.norm(dim=-1) > 0.3]
        assert len(outer) > 20 and torch.all(outer[:, 2] > 0.2), "up: the world's z"
