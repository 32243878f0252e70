"""FlowBot++ (Zhang et al., CoRL 2023): each point's flow, and its projection on the joint's axis."""

from __future__ import annotations

from torch import Tensor

from fb3d_rl.models.cloud_network import CloudNetwork


class FlowProjectionNet(CloudNetwork):
    """Predict the part's flow and its articulation projection.

    The network is ArtFlowNet's with six numbers for each point in place of three. The projection is in the frame and
    scale of the points, m, as that of any other vectors of the cloud.

    Args: as of :class:`CloudNetwork`; ``part_mask_input`` has to be true.

    Shapes:
        points [B, N, 3] f32, m, world axes; valid [B, N] bool; part_mask [B, N] bool -> flow [B, N, 3] f32 as
        ArtFlowNet's.
    """

    NAME = "flowbotpp"
    OUTPUTS = 6

    def motions(self, points: Tensor, valid: Tensor, part_mask: Tensor) -> tuple[Tensor, Tensor]:
        """Flow [B, N, 3] and projection [B, N, 3] (m, :mod:`fb3d_rl.kinematics.joint_screw`); the latter means
        something on a part that turns only.
        """
        flow, projection = self.per_point(points, valid, part_mask).float().split(3, dim=-1)
        return flow, projection

    def forward(self, points: Tensor, valid: Tensor, part_mask: Tensor) -> Tensor:
        """See the class."""
        return self.motions(points, valid, part_mask)[0]
