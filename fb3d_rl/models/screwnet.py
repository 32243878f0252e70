"""ScrewNet: the part's screw parameters in place of its flow (FlowBot3D, section V, "Screw Parameters")."""

from __future__ import annotations

from torch import Tensor

from fb3d_rl.geometry.transforms import normalize
from fb3d_rl.kinematics.joint_screw import JointScrew, flow_of_screw
from fb3d_rl.models.cloud_network import CloudNetwork


class ScrewNet(CloudNetwork):
    """Predict how the part's joint moves, and the flow that follows from it.

    The network is ArtFlowNet's with another output: each point of the part votes for the joint's type, axis
    and origin, and the mean of the votes counts. Votes for joints are those of Li et al. 2020 (category-level pose
    estimation of articulated objects).

    Args: as of :class:`CloudNetwork`; ``part_mask_input`` has to be true.

    Shapes:
        points [B, N, 3] f32, m, world axes; valid [B, N] bool; part_mask [B, N] bool -> flow [B, N, 3] f32 of the
        masked part, largest norm 1; 0 elsewhere, and where no point of the part is seen.
    """

    NAME = "screwnet"
    OUTPUTS = 7

    def votes(self, points: Tensor, valid: Tensor, part_mask: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """What each point votes for: log odds that the joint is revolute [B, N], axis [B, N, 3] of any length, and
        a point on the axis [B, N, 3], m. On invalid points they mean nothing.
        """
        turns, axis, offset = self.per_point(points, valid, part_mask).float().split((1, 3, 3), dim=-1)
        return turns.squeeze(-1), axis, points.masked_fill(~valid[..., None], 0.0) + offset

    def screw(self, points: Tensor, valid: Tensor, part_mask: Tensor) -> JointScrew:
        """The screw [B] that the part's points vote for."""
        turns, axis, origin = self.votes(points, valid, part_mask)
        part = (part_mask & valid).to(points.dtype)
        share = part / part.sum(1, keepdim=True).clamp_min(1.0)

        def mean(votes: Tensor) -> Tensor:
            return (votes * share[..., None]).sum(1)

        return JointScrew((turns * share).sum(1) > 0, normalize(mean(axis)), mean(origin))

    def forward(self, points: Tensor, valid: Tensor, part_mask: Tensor) -> Tensor:
        """See the class."""
        screw = self.screw(points, valid, part_mask)
        return flow_of_screw(screw, points.masked_fill(~valid[..., None], 0.0), part_mask & valid)
