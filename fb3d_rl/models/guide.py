"""What a learner tells about the expert's intention, and reads when it plans: an auxiliary output.

An action says little about where the expert is going, and where it might go to either of two places their mean is
neither. A score for each point of the cloud chooses one place; the head is told it, from which side the hand comes and
which phase it is, so that what is left to learn is how to move there.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from fb3d_rl.geometry.transforms import alignment
from fb3d_rl.models.encoders import AttentionPointNet, mlp, seen_from_tip

SPREAD = 0.03
"""Distance (m) from the expert's contact point at which a point's score should be that of a standard deviation."""

NEIGHBOURHOOD = 0.06
"""The contact point is a mean of the points within this distance (m) of the point with the highest score."""


KEPT = 3.0
"""By how much the logarithm of another point's probability has to be larger than that of the point chosen before."""


class Intention(NamedTuple):
    """Where the expert goes in B situations.

    Attributes:
        contact: [B, 3] its contact point relative to the tip, m, world axes.
        standoff: [B, 3] unit direction in which the hand stands off it.
        phase: [B, P] probabilities of its phases.
    """

    contact: Tensor
    standoff: Tensor
    phase: Tensor


class Hand(NamedTuple):
    """The hand in B situations.

    Attributes:
        axis: [B, 3] unit direction from the tip to the hand.
        held: [B, 1] whether the part is held, 0 or 1.
        touch: [B, T] what it feels and has felt: hold and force.
    """

    axis: Tensor
    held: Tensor
    touch: Tensor


class Told(NamedTuple):
    """What :class:`Guide` tells about contact points in B situations.

    Attributes:
        points: [B, N, 3] the points relative to the tip.
        scores: [B, N] their scores, -1e9 of those that cannot be touched.
        standoff: [B, N, 3] directions from each of them to the hand, of any length.
        seen: [B, W] what the guide has seen, for its network's last MLP.
    """

    points: Tensor
    scores: Tensor
    standoff: Tensor
    seen: Tensor

    def likeliest(self) -> tuple[Tensor, Tensor]:
        """The likeliest contact point [B, 3] and the unit standoff there [B, 3]."""
        best = self.points.gather(1, self.scores.argmax(1)[:, None, None].expand(-1, 1, 3))
        away = (self.points - best).norm(dim=-1) > NEIGHBOURHOOD
        weight = self.scores.masked_fill(away, -1e9).softmax(1)[:, None]
        return (weight @ self.points)[:, 0], functional.normalize((weight @ self.standoff)[:, 0], dim=1)

    def doubts(self, contact: Tensor) -> Tensor:
        """Whether a point is more than e^KEPT times as likely as the one nearest to ``contact`` [B, 3]: [B, 1]."""
        far = (self.points - contact[:, None]).norm(dim=-1).masked_fill(self.scores < -1e8, torch.inf)
        there = self.scores.gather(1, far.argmin(1, keepdim=True))
        return self.scores.amax(1, keepdim=True) - there > KEPT

    def loss(self, contact: Tensor, standoff: Tensor) -> Tensor:
        """Cross-entropy of the points and 1 - cosine of the standoffs [B], for the expert's own [B, 3] each."""
        off = (self.points - contact[:, None]).square().sum(-1) / (2 * SPREAD**2)
        wanted = (-off).masked_fill(self.scores < -1e8, -1e9).softmax(1)
        side = 1 - functional.cosine_similarity(self.standoff, standoff[:, None], dim=-1)
        return (wanted * (side - self.scores.log_softmax(1))).sum(1)


class Guide(nn.Module):
    """Tells the expert's intention.

    First the contact point, with the standoff at each point; then, for one contact point, the phase. Whether the hand
    is to approach follows from how it stands to the point that was chosen, so only this and what it feels is read for
    that. Where a learner stands still before its own point, the expert, which has chosen another one, is on its way: a
    network that read that the hand stands still would learn to stay on its way for ever.

    Args:
        inputs: as of :class:`~fb3d_rl.models.encoders.PointNet`.
        context: likewise.
        phases: P, how many phases there are.
        width: as of the same.
        contact: whether :meth:`words` say the contact point.
        phase: whether they say the phase.
        touch: T, numbers that the hand feels (:class:`Hand`).
    """

    SCALES, OFF_LINE, TURNS = (0.02, 0.05, 0.15), (0.02, 0.06), (0.05, 0.15)
    """What the words distinguish: distances to the contact point, distances to the approach line (m), angles (rad)."""

    def __init__(
        self, inputs: int, context: int, phases: int, width: int, contact: bool, phase: bool, touch: int = 2
    ) -> None:
        super().__init__()
        self.contact, self.phase = contact, phase
        place = contact * (16 + len(self.SCALES) + len(self.OFF_LINE) + len(self.TURNS))
        self.network = AttentionPointNet(inputs, context, width, width, heads=1)
        if contact:
            self.side = nn.Linear(width, 3)
        if phase:
            self.phases = mlp(place + touch if contact else width + context, 2 * width, phases)
        self.size = place + phase * phases

    def forward(self, points: Tensor, features: Tensor, valid: Tensor, context: Tensor) -> Told:
        """See :class:`~fb3d_rl.models.encoders.PointNet` for the shapes; the first of the features is the part mask.

        Only points of the part can be the contact point, unless none is among those that are read.
        """
        part = valid & (features[..., 0] > 0)
        touchable = torch.where(part.any(1, keepdim=True), part, valid)
        seen, scores, each = self.network.attend(points, features, valid, context, touchable)
        return Told(points, scores[:, 0], self.side(each) if self.contact else torch.zeros_like(points), seen)

    def phase_logits(self, told: Told, contact: Tensor, standoff: Tensor, context: Tensor, hand: Hand) -> Tensor:
        """Logits of the phases [B, P] of a hand that goes to ``contact`` from the side ``standoff``."""
        if self.contact:
            read = [self._place(contact, standoff, hand), hand.touch]
        else:
            read = [self.network.out(told.seen).relu(), context]
        logits: Tensor = self.phases(torch.cat(read, dim=1))
        return logits

    def words(self, intention: Intention, hand: Hand) -> Tensor:
        """An intention as a network can read it [B, size]; no contact point where the part is held."""
        place = [self._place(intention.contact, intention.standoff, hand)] if self.contact else []
        return torch.cat([*place, *([intention.phase] if self.phase else ())], dim=-1)

    def _place(self, point: Tensor, standoff: Tensor, hand: Hand) -> Tensor:
        """A contact point and a standoff as a network can read them.

        Beside these it says how the hand stands to the approach line: how far in front of the point the tip is, how far
        off the line, and the turn from the hand to the line, with how near the last two are to 0: the expert approaches
        when they are small, which a network could hardly tell from their components.
        """
        ahead = -(point * standoff).sum(-1, keepdim=True)
        aside, turn = -point - ahead * standoff, alignment(hand.axis, standoff)
        near = [torch.exp(-aside.norm(dim=-1, keepdim=True) / scale) for scale in self.OFF_LINE]
        near += [torch.exp(-turn.norm(dim=-1, keepdim=True) / scale) for scale in self.TURNS]
        said = torch.cat([seen_from_tip(point, self.SCALES), standoff, ahead, aside, turn, *near], dim=-1)
        return said * (1 - hand.held)
