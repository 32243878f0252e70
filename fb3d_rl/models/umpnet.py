"""UMPNet's networks (Xu, He and Song, RA-L 2022) on clouds: where a part can be moved, how far, and to or from what."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from fb3d_rl.contract import GOAL_POINTS
from fb3d_rl.geometry.points import gather
from fb3d_rl.models.cloud_network import BACKBONES, CloudNetwork, from_centre
from fb3d_rl.models.encoders import mlp

TOWARDS, STILL, AWAY = range(3)
"""What the arrow of time says of a pull: it brings the part towards the other image's state, does not move it, or away
from there."""


class Seen(NamedTuple):
    """What the networks make of B pairs of clouds, for each point of the present one.

    Attributes:
        movable: [B, N] log odds that a pull at a point moves it.
        now: [B, N, F] features of the present cloud alone.
        both: [B, N, F] features of both clouds of a pair.
    """

    movable: Tensor
    now: Tensor
    both: Tensor

    def at(self, contact: Tensor) -> tuple[Tensor, Tensor]:
        """The features [B, K, F] at points number contact [B, K]."""
        return gather(self.now, contact), gather(self.both, contact)


class UmpNet(CloudNetwork):
    """The position network, DistNet, and the arrow of time (AoT).

    UMPNet sees an image in which its gripper holds the part; here a PointNet++ gives each point a feature vector, and
    pulls are judged from that of the held point. As in the paper the position and the distance are inferred from the
    present alone, the arrow of time from the present and another image: the goal's, or the first one of an
    exploration. Those two clouds lie in one, the present first, in which a flag tells them apart.

    Args: as of :class:`CloudNetwork`; ``part_mask_input``, the flag, has to be true.

    Shapes:
        points [B, N + GOAL_POINTS, 3] f32, m, world axes; valid, likewise, bool; other, likewise, bool, the points of
        the other image; contact [B, K] int64; directions [B, K, S, 3], unit -> log odds [B, N] that a point can be
        moved; distance [B, K, S], how far a pull moves the point, in strokes; arrow [B, K, S, 3], logits of TOWARDS,
        STILL, AWAY.
    """

    NAME = "umpnet"
    OUTPUTS = 64

    def add_layers(self) -> None:
        """See the base class."""
        arguments = self.arguments
        self.present = BACKBONES[str(arguments["backbone"])](
            inputs=0, outputs=self.OUTPUTS + 1, neighbors=int(arguments["neighbors"])
        )
        self.distance = mlp(self.OUTPUTS + 3, 128, 128, 1)
        self.arrow = mlp(self.OUTPUTS + 3, 128, 128, 3)

    def see(self, points: Tensor, valid: Tensor, other: Tensor) -> Seen:
        """Look at pairs of clouds once, for any number of pulls."""
        now, known = points[:, :-GOAL_POINTS], valid[:, :-GOAL_POINTS]
        alone = self.present(from_centre(now, known), known, None)
        return Seen(alone[..., -1], alone[..., :-1], self.per_point(points, valid, other)[:, :-GOAL_POINTS])

    def judge(self, at: tuple[Tensor, Tensor], directions: Tensor) -> tuple[Tensor, Tensor]:
        """Distances [..., S] and the arrow's logits [..., S, 3] of pulls along ``directions`` [..., S, 3] at points
        with the features [..., F] of :meth:`Seen.at`.
        """
        now, both = (
            torch.cat([x[..., None, :].expand(*directions.shape[:-1], -1), directions.to(x.dtype)], dim=-1) for x in at
        )
        return self.distance(now).squeeze(-1), self.arrow(both)

    def forward(
        self, points: Tensor, valid: Tensor, other: Tensor, contact: Tensor, directions: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """See the class."""
        seen = self.see(points, valid, other)
        return seen.movable, *self.judge(seen.at(contact), directions)


def score(distance: Tensor, arrow: Tensor) -> Tensor:
    """How far pulls bring the part away from the other image's state, negative towards it.

    UMPNet multiplies the distance by the sign of the most probable answer of the arrow of time; here it is the expected
    sign, which tells pulls apart that have the same answer.
    """
    odds = arrow.softmax(-1)
    sign: Tensor = odds[..., AWAY] - odds[..., TOWARDS]
    return sign * distance.relu()
