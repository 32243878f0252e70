"""Encoders of a cloud around the gripper's tip and of proprioception: points and a context vector -> one vector."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import cast

import torch
from torch import Tensor, nn

from fb3d_rl.models.artflownet import ArtFlowNet
from fb3d_rl.models.pointnet2 import GlobalAbstraction, Level, SetAbstraction


def mlp(*widths: int) -> nn.Sequential:
    """Linear layers with ReLU between them."""
    layers: list[nn.Module] = []
    for a, b in zip(widths[:-1], widths[1:], strict=True):
        layers += [nn.Linear(a, b), nn.ReLU()]
    return nn.Sequential(*layers[:-1])


class PointNet(nn.Module):
    """PointNet (Qi et al. 2017): an MLP on every point, the maximum over the points, an MLP on that.

    Args:
        inputs: features per point besides its position.
        context: entries of the vector that goes with the cloud (proprioception).
        outputs: entries of the result.
        width: width of the layers.

    Shapes:
        points [B, N, 3] f32, m, relative to the suction tip; features [B, N, inputs] f32; valid [B, N] bool; context
        [B, context] f32 -> [B, outputs]. A cloud without points counts as one whose features are all 0.
    """

    def __init__(self, inputs: int, context: int, outputs: int, width: int = 64) -> None:
        super().__init__()
        self.local = mlp(3 + inputs, width, width, 4 * width)
        self.out = mlp(4 * width + context, 4 * width, 4 * width, outputs)

    def forward(self, points: Tensor, features: Tensor, valid: Tensor, context: Tensor) -> Tensor:
        """See the class."""
        local = self.local(torch.cat([points, features], dim=-1)).relu()
        return self.out(torch.cat([local.masked_fill(~valid[..., None], 0.0).amax(1), context], dim=-1))


class PointNet2Encoder(nn.Module):
    """The downward half of PointNet++ (Qi et al. 2017b), as in ArtFlowNet, then an MLP.

    Args and Shapes: as of :class:`PointNet`; at least one point of the batch is valid.
    """

    def __init__(self, inputs: int, context: int, outputs: int, width: int = 64) -> None:
        super().__init__()
        self.sa1 = SetAbstraction(inputs, (width // 2, width // 2, width), ratio=0.2, radius=0.2, neighbors=32)
        self.sa2 = SetAbstraction(width, (width, width, 2 * width), ratio=0.25, radius=0.4, neighbors=32)
        self.sa3 = GlobalAbstraction(2 * width, (2 * width, 4 * width))
        self.out = mlp(4 * width + context, 4 * width, 4 * width, outputs)

    def forward(self, points: Tensor, features: Tensor, valid: Tensor, context: Tensor) -> Tensor:
        """See :class:`PointNet`."""
        level = Level.of(points, valid)
        fine, level1 = self.sa1(level.flat(features), level)
        middle, level2 = self.sa2(fine, level1)
        return self.out(torch.cat([self.sa3(middle, level2), context], dim=-1))


class DP3Encoder(nn.Module):
    """The encoder of 3D Diffusion Policy (Ze et al. 2024), which people who train on ManiSkill or with LeRobot expect.

    An MLP with layer norm on every point, the maximum over the points, a projection with layer norm; proprioception has
    an MLP of its own, and the last layer gets both.

    Args and Shapes: as of :class:`PointNet`.
    """

    def __init__(self, inputs: int, context: int, outputs: int, width: int = 64) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for a, b in ((3 + inputs, width), (width, 2 * width), (2 * width, 4 * width)):
            layers += [nn.Linear(a, b), nn.LayerNorm(b), nn.ReLU()]
        self.local = nn.Sequential(*layers)
        self.project = nn.Sequential(nn.Linear(4 * width, width), nn.LayerNorm(width))
        self.felt = mlp(context, width, width)
        self.out = mlp(2 * width, 4 * width, 4 * width, outputs)

    def forward(self, points: Tensor, features: Tensor, valid: Tensor, context: Tensor) -> Tensor:
        """See :class:`PointNet`."""
        local = self.local(torch.cat([points, features], dim=-1)).masked_fill(~valid[..., None], 0.0)
        return self.out(torch.cat([self.project(local.amax(1)), self.felt(context)], dim=-1))


def seen_from_tip(points: Tensor, scales: Sequence[float]) -> Tensor:
    """Places [..., 3] relative to the tip (m) as a network can read them [..., 6 + number of scales]: itself, its
    direction, and how near it is on each of the scales (m).
    """
    distance = points.norm(dim=-1, keepdim=True)
    near = [torch.exp(-distance / scale) for scale in scales]
    return torch.cat([points, points / (distance + 0.1), *near], dim=-1)


class AttentionPointNet(nn.Module):
    """PointNet with attention: each head attends to one place in the cloud.

    A first MLP sees every point on its own; the maximum over the points is the cloud's vector, as in PointNet. A
    second one gets each point with that vector and scores it for ``heads`` heads; the softmax of a head's scores
    over the cloud is its attention. What it attends to, as a mean position relative to the tip, mean flow and mean
    features, is an input of the last MLP: a maximum over features could hardly encode a position to millimetres.

    Args:
        inputs: features per point besides its position.
        context: entries of the vector that goes with the cloud (proprioception).
        outputs: entries of the result.
        heads: number of attention heads.
        width: width of the layers.

    Shapes: as of :class:`PointNet`.
    """

    SCALES = (0.03, 0.1, 0.3)
    """Distances (m) from the tip that the network distinguishes: touching, near, in front of the object."""

    def __init__(self, inputs: int, context: int, outputs: int, width: int = 64, heads: int = 8) -> None:
        super().__init__()
        own = 3 + 3 + len(self.SCALES) + inputs
        self.first, self.second = nn.Linear(own, width), nn.Linear(width, width)
        self.scene = mlp(width + context, 2 * width, 2 * width)
        self.again = nn.Linear(width, width)
        self.told = nn.Linear(2 * width, width)
        self.score = nn.Linear(width, heads, bias=False)
        self.out = mlp(2 * width + heads * (own + width) + context, 4 * width, 4 * width, outputs)

    def forward(self, points: Tensor, features: Tensor, valid: Tensor, context: Tensor) -> Tensor:
        """See the class."""
        return self.out(self.attend(points, features, valid, context)[0])

    def attend(
        self, points: Tensor, features: Tensor, valid: Tensor, context: Tensor, among: Tensor | None = None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """What the last MLP reads [B, ...], the points' scores [B, heads, N] and features [B, N, width].

        Args:
            points: as of :class:`PointNet`.
            features: likewise.
            valid: likewise.
            context: likewise.
            among: [B, N] bool, the points that may be attended to, all others score -1e9; None: those that are valid.
        """
        own = torch.cat([seen_from_tip(points, self.SCALES), features], dim=-1)
        local = self.second(self._first(own).relu()).relu()
        # A product and max cost half of masked_fill and amax, whose gradients copy and compare the whole cloud.
        pooled = (local * valid[..., None].to(local.dtype)).max(1).values
        scene = self.scene(torch.cat([pooled, context], dim=-1))
        again = torch.relu(self.again(local) + self.told(scene)[:, None])
        scores = (self.score.weight @ again.mT).masked_fill(~(valid if among is None else among)[:, None], -1e9)
        weight = scores.softmax(-1)  # [B, heads, N]
        attended = torch.cat([weight @ own, weight @ again], dim=-1)  # [B, heads, own + width]
        return torch.cat([scene, attended.flatten(1), context], dim=-1), scores, again

    def _first(self, own: Tensor) -> Tensor:
        """The first layer, with zeros up to a multiple of four inputs: else its gradient takes three times as long."""
        pad = partial(nn.functional.pad, pad=(0, -own.shape[-1] % 4))
        return nn.functional.linear(pad(own), pad(self.first.weight), self.first.bias)


class ArtFlowNetEncoder(nn.Module):
    """The published ArtFlowNet's features of each point, read with attention: who predicts flow has seen the part.

    Its batch norm keeps the statistics that it was published with.

    Args:
        inputs: as of :class:`PointNet`; the first of them is the part mask.
        context: likewise.
        outputs: likewise.
        width: likewise.

    Shapes: as of :class:`PointNet`.
    """

    def __init__(self, inputs: int, context: int, outputs: int, width: int = 64) -> None:
        super().__init__()
        self.flow = ArtFlowNet.from_pretrained()
        backbone = self.flow.network
        last = cast(nn.Linear, backbone.head[-1])
        backbone.outputs, backbone.head[-1] = last.in_features, nn.Identity()
        self.attention = AttentionPointNet(inputs + last.in_features, context, outputs, width)
        self._published = {name: value.clone() for name, value in self.flow.state_dict().items()}

    def publish(self) -> None:
        """Take the published weights again, after all weights were drawn at random."""
        self.flow.load_state_dict(self._published)

    def train(self, mode: bool = True) -> ArtFlowNetEncoder:
        """As every module's, but for batch norm."""
        super().train(mode)
        self.flow.eval()
        return self

    def forward(self, points: Tensor, features: Tensor, valid: Tensor, context: Tensor) -> Tensor:
        """See :class:`PointNet`."""
        seen = self.flow.per_point(points, valid, features[..., 0] > 0)
        return self.attention(points, torch.cat([features, seen], dim=-1), valid, context)


ENCODERS: dict[str, type[PointNet | PointNet2Encoder | AttentionPointNet | DP3Encoder | ArtFlowNetEncoder]] = {
    "pointnet": PointNet,
    "pointnet2": PointNet2Encoder,
    "attention": AttentionPointNet,
    "dp3": DP3Encoder,
    "artflownet": ArtFlowNetEncoder,
}
"""The encoders by name."""
