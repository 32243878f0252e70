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

from fb3d_rl.models.encoders import AttentionPointNet, seen_from_tip

SPREAD = 0.03
"""Distance (m) from the expert's contact point at which a point's score should be that of a standard deviation."""

NEIGHBOURHOOD = 0.06
"""The contact point is a mean of the points within this distance (m) of the point with the highest score."""


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


class Told(NamedTuple):
    """What :class:`Guide` tells about B situations.

    Attributes:
        points: [B, N, 3] the points relative to the tip.
        scores: [B, N] their scores, -1e9 of those that are not valid.
        standoff: [B, 3] direction from the contact point to the hand, of any length.
        phase: [B, P] logits of the phases.
    """

    points: Tensor
    scores: Tensor
    standoff: Tensor
    phase: Tensor

    @torch.no_grad()
    def intention(self) -> Intention:
        """The intention that is the likeliest."""
        points = self.points
        best = points.gather(1, self.scores.argmax(1)[:, None, None].expand(-1, 1, 3))
        away = (points - best).norm(dim=-1) > NEIGHBOURHOOD
        weight = self.scores.masked_fill(away, -1e9).softmax(1)
        phase = functional.one_hot(self.phase.argmax(1), self.phase.shape[1]).to(points.dtype)
        return Intention((weight[:, None] @ points)[:, 0], functional.normalize(self.standoff, dim=1), phase)

    def loss(self, true: Intention, goes: Tensor, contact: bool, phase: bool) -> Tensor:
        """Mean of the cross-entropy of the points, 1 - cosine of the standoffs, and the cross-entropy of the phases.

        Args:
            true: the expert's intention.
            goes: [B] bool, where it goes to a contact point; contact and standoff count there only.
            contact: whether contact point and standoff count.
            phase: whether phases do.
        """
        value = self.scores.new_zeros(())
        if contact:
            off = (self.points - true.contact[:, None]).square().sum(-1) / (2 * SPREAD**2)
            wanted = (-off).masked_fill(self.scores < -1e8, -1e9).softmax(1)
            each = -(wanted * self.scores.log_softmax(1)).sum(1)
            each = each + 1 - functional.cosine_similarity(self.standoff, true.standoff)
            value = value + each.masked_fill(~goes, 0.0).mean()
        if phase:
            value = value + functional.cross_entropy(self.phase, true.phase)
        return value


class Guide(nn.Module):
    """Tells the expert's intention.

    Args:
        inputs: as of :class:`~fb3d_rl.models.encoders.PointNet`.
        context: likewise.
        phases: P, how many phases there are.
        width: as of the same.
        contact: whether :meth:`words` say the contact point.
        phase: whether they say the phase.
    """

    SCALES = (0.02, 0.05, 0.15)

    def __init__(self, inputs: int, context: int, phases: int, width: int, contact: bool, phase: bool) -> None:
        super().__init__()
        self.contact, self.phase = contact, phase
        self.network = AttentionPointNet(inputs, context, 3 + phases, width, heads=1)
        self.size = contact * (6 + len(self.SCALES) + 3 + 4) + phase * phases

    def forward(self, points: Tensor, features: Tensor, valid: Tensor, context: Tensor) -> Told:
        """See :class:`~fb3d_rl.models.encoders.PointNet` for the shapes."""
        output, scores = self.network.attend(points, features, valid, context)
        return Told(points, scores[:, 0], output[:, :3], output[:, 3:])

    def words(self, intention: Intention, held: Tensor) -> Tensor:
        """An intention as a network can read it [B, size]; no contact point where the part is ``held`` [B, 1] (0 or 1).

        Beside the point and the standoff these are where the tip is in the frame of the approach line: how far in
        front of the point, and how far off the line.
        """
        said = []
        if self.contact:
            point, axis = intention.contact, intention.standoff
            ahead = -(point * axis).sum(-1, keepdim=True)
            aside = -point - ahead * axis
            said.append(torch.cat([seen_from_tip(point, self.SCALES), axis, ahead, aside], dim=-1) * (1 - held))
        if self.phase:
            said.append(intention.phase)
        return torch.cat(said, dim=-1)
