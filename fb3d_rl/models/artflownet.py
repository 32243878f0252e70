"""ArtFlowNet: where each visible point of an articulated object would move (FlowBot3D, section IV-A;
supplement, II.A).
"""

from __future__ import annotations

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from fb3d_rl.models.dense import initialize
from fb3d_rl.models.pointnet2 import PointNet2


class ArtFlowNet(nn.Module):
    """Predict 3D articulation flow with PointNet++.

    The network subtracts the mean of a cloud's valid points first and does not scale: its ball radii are
    metres. So its output does not change when the scene is moved, and it sees real sizes.

    Args:
        part_mask_input: feed the mask of the part to open as an input channel. Without it, the mask is
            ignored.
        neighbors: points kept in a ball. 64 is PointNet++'s; 32 is faster.
        generator: draws the first weights (on the CPU); None leaves them to torch's global generator.

    Shapes:
        points [B, N, 3] f32, m, world axes; valid [B, N] bool; part_mask [B, N] bool -> flow [B, N, 3] f32,
        world axes, trained towards a largest norm of 1 in a cloud; 0 on invalid points.
    """

    def __init__(
        self, part_mask_input: bool = True, neighbors: int = 64, generator: torch.Generator | None = None
    ) -> None:
        super().__init__()
        self.part_mask_input = part_mask_input
        self.arguments = {"part_mask_input": part_mask_input, "neighbors": neighbors}
        self.network = PointNet2(inputs=int(part_mask_input), outputs=3, neighbors=neighbors)
        if generator is not None:
            initialize(self.network, generator)

    def forward(self, points: Tensor, valid: Tensor, part_mask: Tensor) -> Tensor:
        """See the class."""
        inside = valid[..., None].to(points.dtype)
        # Padding may hold anything, even NaN, which a product with 0 would keep.
        points = points.masked_fill(~valid[..., None], 0.0)
        centre = points.sum(1, keepdim=True) / inside.sum(1, keepdim=True).clamp(min=1.0)
        features = part_mask[..., None].to(points.dtype) if self.part_mask_input else None
        return self.network(points - centre, valid, features)


def artflownet_module(net: ArtFlowNet) -> TensorDictModule:
    """Read the observation's points, valid and part_mask; write ("prediction", "flow")."""
    keys = [("observation", "points"), ("observation", "valid"), ("observation", "part_mask")]
    return TensorDictModule(net, in_keys=keys, out_keys=[("prediction", "flow")])
