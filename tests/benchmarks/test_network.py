"""Contenders take turns on the same clouds and say what they used."""

from __future__ import annotations

from pathlib import Path

import pytest

from fb3d_rl.assets.articulation import ArticulatedObject
from fb3d_rl.benchmarks import network as network_speed
from fb3d_rl.benchmarks.network import draw_clouds, install_peer
from fb3d_rl.contract import check
from fb3d_rl.errors import UserError
from fb3d_rl.models.cloud_network import BACKBONES


def silent(text: str) -> None:
    assert text


@pytest.mark.slow
@pytest.mark.alone
def test_every_contender_has_its_numbers(
    procedural_objects: dict[str, ArticulatedObject], monkeypatch: pytest.MonkeyPatch
) -> None:
    clouds = draw_clouds(list(procedural_objects.values()), 4, seed=0)
    check(clouds, "sample")
    monkeypatch.setattr(network_speed, "PRECISIONS", ("fp32",))
    found = network_speed.network_speed(clouds, (4, 2), 1, None, "cpu", silent)
    for backbone in BACKBONES:
        for batch in (4, 2):
            assert found[f"{backbone} fp32, B={batch}, clouds/s"] > 0
            assert 0.1 < found[f"{backbone} fp32, B={batch}, peak memory, GiB"] < 8
        assert 0 < found[f"{backbone} fp32, B=4, share of time that its products need"] < 1
    assert found["delayed fp32, B=4, clouds/s"] > found["pointnet2 fp32, B=4, clouds/s"]


def test_what_cannot_be_measured_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(network_speed, "PEER", ("no-such-package-of-fb3d",))
    with pytest.raises(UserError, match="no-such-package-of-fb3d cannot be installed"):
        install_peer(tmp_path / "peer", silent)
    (tmp_path / "peer").mkdir(exist_ok=True)
    (tmp_path / "peer" / "installed").touch()
    install_peer(tmp_path / "peer", silent)  # nothing is left to do
