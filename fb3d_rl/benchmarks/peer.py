"""PointNet++ on PyTorch Geometric and torch-cluster with FlowBot3D's sizes: what ArtFlowNet's speed is compared with.

For :mod:`fb3d_rl.benchmarks.network` only, which installs the two packages.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch_geometric.nn import MLP, PointNetConv, fps, global_max_pool, knn_interpolate, radius


class _Abstraction(nn.Module):
    def __init__(self, ratio: float, reach: float, widths: list[int]) -> None:
        super().__init__()
        self.ratio, self.reach = ratio, reach
        self.conv = PointNetConv(MLP(widths), add_self_loops=False)

    def forward(self, features: Tensor, points: Tensor, cloud: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        chosen = fps(points, cloud, ratio=self.ratio)
        row, col = radius(points, points[chosen], self.reach, cloud, cloud[chosen], max_num_neighbors=64)
        features = self.conv((features, features[chosen]), (points, points[chosen]), torch.stack([col, row]))
        return features, points[chosen], cloud[chosen]


class PeerPointNet2(nn.Module):
    """As :class:`fb3d_rl.models.artflownet.ArtFlowNet` from outside."""

    def __init__(self) -> None:
        super().__init__()
        self.sa1 = _Abstraction(0.2, 0.2, [1 + 3, 64, 64, 128])
        self.sa2 = _Abstraction(0.25, 0.4, [128 + 3, 128, 128, 256])
        self.sa3 = MLP([256 + 3, 256, 512, 1024])
        self.fp3 = MLP([1024 + 256, 256, 256])
        self.fp2 = MLP([256 + 128, 256, 128])
        self.fp1 = MLP([128 + 1, 128, 128, 128])
        self.head = MLP([128, 128, 128, 3], norm=None)

    def forward(self, points: Tensor, valid: Tensor, part_mask: Tensor) -> Tensor:
        """Points [B, N, 3], valid and part_mask [B, N] -> flow [B, N, 3]."""
        cloud0 = torch.arange(len(points), device=points.device)[:, None].expand_as(valid)[valid]
        points0, features0 = points[valid], part_mask[valid].float()[:, None]
        features1, points1, cloud1 = self.sa1(features0, points0, cloud0)
        features2, points2, cloud2 = self.sa2(features1, points1, cloud1)
        whole = global_max_pool(self.sa3(torch.cat([features2, points2], 1)), cloud2)
        features2 = self.fp3(torch.cat([whole[cloud2], features2], 1))
        features1 = self._propagate(self.fp2, features2, points2, cloud2, features1, points1, cloud1)
        rows = self._propagate(self.fp1, features1, points1, cloud1, features0, points0, cloud0)
        flow = points.new_zeros(points.shape)
        flow[valid] = self.head(rows)
        return flow

    @staticmethod
    def _propagate(
        layers: MLP, features: Tensor, points: Tensor, cloud: Tensor, skip: Tensor, fine: Tensor, fine_cloud: Tensor
    ) -> Tensor:
        near = knn_interpolate(features, points, fine, cloud, fine_cloud, k=3)
        rows: Tensor = layers(torch.cat([near, skip], 1))
        return rows
