"""The dense network equals the fast one, and the exported program both."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from fb3d_rl.errors import UserError
from fb3d_rl.models.artflownet import ArtFlowNet
from fb3d_rl.models.cloud_network import BACKBONES
from fb3d_rl.models.export import DenseArtFlowNet, export


def trained(part_mask_input: bool = True, backbone: str = "pointnet2", hypotheses: int = 1) -> ArtFlowNet:
    """A network whose batch norms have seen data, some with a negative scale, and whose flow is of the size of 1."""
    generator = torch.Generator().manual_seed(0)
    net = ArtFlowNet(part_mask_input, neighbors=16, backbone=backbone, generator=generator, hypotheses=hypotheses)
    for module in net.modules():
        if isinstance(module, torch.nn.BatchNorm1d):
            with torch.no_grad():
                module.weight[::3] *= -1
    for _ in range(20):
        net(*cloud(0))
    with torch.no_grad():
        net.eval().network.head[1].weight /= net(*cloud(0)).abs().max()
    return net.eval()


def cloud(seed: int, batch: int = 2, points: int = 300) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    places = torch.rand(batch, points, 3, generator=generator)
    return places, torch.ones(batch, points, dtype=torch.bool), places[..., 2] > 0.5


@pytest.mark.parametrize("part_mask_input", [True, False])
@pytest.mark.parametrize("backbone", BACKBONES)
@pytest.mark.parametrize("hypotheses", [1, 3])
def test_fast_and_dense_network_are_equal(part_mask_input: bool, backbone: str, hypotheses: int) -> None:
    net = trained(part_mask_input, backbone, hypotheses)
    points, valid, mask = cloud(1)
    torch.testing.assert_close(DenseArtFlowNet(net)(points, mask), net(points, valid, mask), atol=1e-4, rtol=1e-4)
    net, points = net.double(), points.double()  # where no rounding hides a difference
    expected = net(points, valid, mask)
    assert expected.std() > 0.05
    torch.testing.assert_close(DenseArtFlowNet(net)(points, mask), expected, atol=1e-10, rtol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize(("backbone", "hypotheses"), [("pointnet2", 1), ("delayed", 1), ("delayed", 3)])
def test_the_exported_program_equals_the_network(tmp_path: Path, backbone: str, hypotheses: int) -> None:
    net, path = trained(backbone=backbone, hypotheses=hypotheses), tmp_path / "net.pt2"
    export(net, path, 300)
    program = torch.export.load(path).module()
    for seed, batch in ((1, 1), (2, 5)):
        points, valid, mask = cloud(seed, batch)
        torch.testing.assert_close(program(points, mask), net(points, valid, mask), atol=1e-5, rtol=1e-5)
    assert [file.name for file in tmp_path.iterdir()] == ["net.pt2"]


def test_too_few_points_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="16"):
        export(trained(), tmp_path / "net.pt2", 3)
    assert not any(tmp_path.iterdir())
