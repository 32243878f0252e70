"""DirectionNet: how far a pull in a direction at a point opens the part (UMPNet's direction inference, as FlowBot3D's
baseline UMP-DI has it), and the search for the best direction.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from fb3d_rl.geometry.points import gather
from fb3d_rl.geometry.transforms import normalize
from fb3d_rl.models.cloud_network import CloudNetwork
from fb3d_rl.models.encoders import mlp


class DirectionNet(CloudNetwork):
    """Score directions at contact points of a cloud.

    UMPNet (Xu, He and Song 2022) regresses how far an action in a given direction moves the part, from an image; here a
    PointNet++ as in ArtFlowNet gives each point a feature vector, and an MLP scores directions from it. So a cloud is
    encoded once for any number of directions.

    Args: as of :class:`CloudNetwork`; ``part_mask_input`` has to be true.

    Shapes:
        points [B, N, 3] f32, m, world axes; valid, part_mask [B, N] bool; contact [B, K] int64, numbers of points;
        directions [B, K, S, 3], unit, world axes -> scores [B, K, S]: the displacement along the direction, as a share
        of the largest displacement in the cloud, -1 to 1.
    """

    NAME = "ump_di"
    OUTPUTS = 64

    def add_layers(self) -> None:
        """See the base class."""
        self.head = mlp(self.OUTPUTS + 3, 128, 128, 1)

    def score(self, features: Tensor, directions: Tensor) -> Tensor:
        """Scores [..., S] of directions [..., S, 3] at points with ``features`` [..., OUTPUTS] (:meth:`per_point`)."""
        features = features[..., None, :].expand(*directions.shape[:-1], -1)
        scores: Tensor = self.head(torch.cat([features, directions.to(features.dtype)], dim=-1)).squeeze(-1)
        return scores

    def forward(self, points: Tensor, valid: Tensor, part_mask: Tensor, contact: Tensor, directions: Tensor) -> Tensor:
        """See the class."""
        return self.score(gather(self.per_point(points, valid, part_mask), contact), directions)


@dataclass(frozen=True)
class SearchOptions:
    """The cross-entropy method over directions.

    Attributes:
        samples: directions in a round; those of the first are uniform on the sphere.
        rounds: number of rounds.
        elites: number of a round's best directions, around which the next round's are drawn.
        seed: seed of all draws.
    """

    samples: int = 128
    rounds: int = 4
    elites: int = 12
    seed: int = 0


def best_direction(score: Callable[[Tensor], Tensor], options: SearchOptions, device: torch.device) -> Tensor:
    """The direction of the largest score, by the cross-entropy method (Rubinstein 1999).

    Draws depend on the options only: they are the same in each cloud and at each call.

    Args:
        score: directions [B, S, 3], or [1, S, 3] for all clouds alike -> scores [B, S].
        options: options of the search.
        device: device of the directions.

    Returns:
        [B, 3], unit: the best of all directions that were scored.
    """
    generator = torch.Generator().manual_seed(options.seed)
    shape = (options.rounds, 1, options.samples, 3)
    noise = torch.randn(shape, generator=generator).to(device)
    directions = normalize(noise[0])
    best = torch.empty(0)
    for number in range(options.rounds):
        scores = score(directions)
        values, index = scores.topk(options.elites, dim=-1)
        elites = gather(directions.expand(len(scores), -1, -1), index)
        if number == 0:
            best, highest = elites[:, 0], values[:, 0]
        else:
            better = values[:, 0] > highest
            best, highest = torch.where(better[:, None], elites[:, 0], best), torch.maximum(values[:, 0], highest)
        if number + 1 < options.rounds:
            mean, deviation = elites.mean(1, keepdim=True), elites.std(1, keepdim=True)
            directions = normalize(mean + deviation * noise[number + 1])
    return best


@torch.no_grad()
def directions_at(
    net: DirectionNet, points: Tensor, valid: Tensor, part_mask: Tensor, contact: Tensor, options: SearchOptions
) -> Tensor:
    """The direction [B, 3] in which to pull at point number contact [B] of each cloud [B, N]."""
    features = gather(net.per_point(points, valid, part_mask), contact)
    return best_direction(
        lambda directions: net.score(features, directions.expand(len(features), -1, -1)), options, features.device
    )
