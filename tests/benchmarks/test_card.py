"""What is measured on a GPU, run on a CPU, where there are no kernels and no graph."""

from __future__ import annotations

import pytest

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.benchmarks import card
from fb3d_rl.benchmarks.network import draw_clouds


@pytest.mark.slow
def test_every_number_is_there_and_a_graph_changes_no_loss(
    procedural_objects: dict[str, ArticulatedObject], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(card, "STEPS", 1)
    monkeypatch.setattr(card, "WARM_UP", 1)
    monkeypatch.setattr(card, "MANY", 3)
    said: list[str] = []
    found = card.card_speed(draw_clouds(list(procedural_objects.values()), 4, seed=0), 2, 2, said.append, "cpu")
    assert found["losses with the graph"] == found["losses without"]
    assert len(set(found["losses without"])) == 6  # it learns
    for name, more in card.CONTENDERS:
        assert found[" ".join([name, *(f"{k}={v}" for k, v in more.items())]) + ", B=2, clouds/s"] > 0
    for name in ("delayed", "pointnet2"):
        assert found[f"{name}: 3 clouds predicted, ms"] > 0
    assert "pointnet2" in said
    assert ("PyTorch Geometric" in found) or found["PyTorch Geometric, our neighbours, B=2, clouds/s"] > 0
