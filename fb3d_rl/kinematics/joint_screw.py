"""A joint's screw parameters, and the flow and the projection of its part: each follows from the others.

A point's articulation projection (FlowBot++, Zhang et al., CoRL 2023) leads from it to the nearest point of the joint's
axis, m. Parts that slide have none: it is 0 there.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from fb3d_rl.geometry.rigid_motion import rigid_motion
from fb3d_rl.geometry.transforms import dot, length, normalize

TURNS = 3e-3
"""A part turns if its points' motions differ by more than this share of the largest one."""

UNEXPLAINED = 0.05
"""Largest residual (root mean square) of a flow that one screw explains; flows of several joints leave more."""


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


def projection_of_screw(screw: JointScrew, points: Tensor, part: Tensor) -> Tensor:
    """The projection [B, N, 3] (m) of points [B, N, 3] (m) on a part [B, N] (bool); 0 off it, and where it slides."""
    axis, way = screw.axis[:, None], screw.origin[:, None] - points
    across = way - dot(way, axis) * axis
    return across.masked_fill(~(part & screw.revolute[:, None])[..., None], 0.0)


def projection_of_flow(points: Tensor, flow: Tensor, part: Tensor) -> tuple[Tensor, Tensor]:
    """The projection [B, N, 3] of a part whose true flow is known, as of :func:`screw_of_flow`.

    Returns:
        It, and which clouds [B] bool have one: those whose flow is that of one joint which turns.
    """
    screw, unexplained = screw_of_flow(points, flow, part)
    turns = screw.revolute & (unexplained < UNEXPLAINED) & screw.axis.any(-1)
    return projection_of_screw(screw, points, part & turns[:, None]), turns


def screw_of_projection(points: Tensor, flow: Tensor, projection: Tensor, part: Tensor) -> tuple[JointScrew, Tensor]:
    """The screw behind a predicted flow and projection.

    A point's flow f and projection r are perpendicular to the axis and to each other, and f x r is along it, the way
    that opens. Both are made unit and perpendicular (Gram-Schmidt, FlowBot++); the axis is the mean of their products,
    the origin that of p + r, where the projections end, in least squares, each point weighted by |f|.

    Whether the part turns is not asked of the spread of the flow's directions, which is 0 for a flat door: it
    turns if the flow about that axis is nearer to f than any constant flow.

    Args:
        points: [B, N, 3] m.
        flow: [B, N, 3] of any scale.
        projection: [B, N, 3] m.
        part: [B, N] bool, the part's points.

    Returns:
        The screw, and its residual [B] in [0, 1]: the sine of the angle between f and the screw's flow as vectors of
        all of the part's points. It is 0 for a perfect prediction and 1 for a cloud without flow. Of a cap on a thread
        that is seen all around, the axis is found, and the residual is the sine of the thread's angle; of one seen from
        one side, the axis is tilted towards it.
    """
    p, f, r = (x.masked_fill(~part[..., None], 0.0).double() for x in (points, flow, projection))
    size = length(f)
    weight = size / size.sum(1, keepdim=True).clamp_min(1e-9)
    f = normalize(f)
    across = normalize(r - dot(r, f) * f)
    axis = normalize((weight * torch.linalg.cross(f, across)).sum(1))
    origin = (weight * (p + r)).sum(1)
    nothing = torch.zeros_like(part[:, 0])
    turning = JointScrew(~nothing, axis, origin)
    sliding = JointScrew(nothing, normalize((size * f).sum(1)), origin)
    residuals = [_residual(flow_of_screw(screw, p, part), size * f) for screw in (turning, sliding)]
    turns = residuals[0] < residuals[1]
    screw = JointScrew(turns, torch.where(turns[:, None], axis, sliding.axis), origin)
    residual = torch.where(turns, residuals[0], residuals[1])
    return JointScrew(turns, *(x.to(points) for x in screw[1:])), residual


def _residual(fitted: Tensor, flow: Tensor) -> Tensor:
    """Sine [B] of the angle between flows [B, N, 3] as vectors; 1 if that is more than a right angle, or one is 0."""
    cosine = (normalize(fitted.flatten(1)) * normalize(flow.flatten(1))).sum(-1).clamp(0.0, 1.0)
    return (1.0 - cosine.square()).sqrt()
