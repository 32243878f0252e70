"""A joint's screw parameters, and the flow of its part: each follows from the other."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from fb3d_rl.geometry.rigid_motion import rigid_motion
from fb3d_rl.geometry.transforms import normalize

TURNS = 3e-3
"""A part turns if its points' motions differ by more than this share of the largest one."""


class JointScrew(NamedTuple):
    """How the parts of B clouds move.

    Attributes:
        revolute: [B] bool; else prismatic.
        axis: [B, 3] unit direction of sliding, or of turning (right-hand rule), the way that opens.
        origin: [B, 3] a point on the axis of turning, m; meaningless where a part slides.
    """

    revolute: Tensor
    axis: Tensor
    origin: Tensor


def flow_of_screw(screw: JointScrew, points: Tensor, part: Tensor) -> Tensor:
    """The flow [B, N, 3] of points [B, N, 3] (m) on a part [B, N] (bool): the axis where it slides, axis x (p - origin)
    where it turns; largest norm 1 in a cloud, 0 off the part.
    """
    axis = screw.axis[:, None]
    turning = torch.linalg.cross(axis, points - screw.origin[:, None])
    velocity = torch.where(screw.revolute[:, None, None], turning, axis).masked_fill(~part[..., None], 0.0)
    return velocity / velocity.norm(dim=-1).amax(1)[:, None, None].clamp_min(1e-9)


def screw_of_flow(points: Tensor, flow: Tensor, part: Tensor) -> tuple[JointScrew, Tensor]:
    """The screw whose flow fits best: that of the rigid motion of least squares.

    Args:
        points: [B, N, 3] m.
        flow: [B, N, 3], largest norm 1 in a cloud.
        part: [B, N] bool, the part's points.

    Returns:
        The screw, its origin the axis' nearest point to the part's mean; and the root mean square [B] of its flow's
        error: near 0 for one part, large where the points belong to parts that move by different joints. A cloud
        without flow has an axis of 0.
    """
    weight = part.to(points.dtype)
    count = weight.sum(1, keepdim=True).clamp_min(1.0)
    # Padding may hold anything, even NaN.
    points, flow = (x.masked_fill(~part[..., None], 0.0) for x in (points, flow))
    centre = points.sum(1) / count
    velocity, omega = rigid_motion(points, flow, weight, centre, 1e-9)
    arm = (points - centre[:, None]).masked_fill(~part[..., None], 0.0)
    turned = torch.linalg.cross(omega[:, None], arm)
    revolute = turned.norm(dim=-1).amax(1) > TURNS
    nearest = torch.linalg.cross(omega, velocity) / omega.square().sum(-1, keepdim=True).clamp_min(1e-12)
    axis = normalize(torch.where(revolute[:, None], omega, velocity))
    screw = JointScrew(revolute, axis, centre + nearest * revolute[:, None])
    error = flow_of_screw(screw, points, part) - flow
    return screw, (error.square().sum((1, 2)) / count.squeeze(1)).sqrt()
