"""The rigid motion behind a flow: fit it to a part's points, follow it further than the flow's small step."""

from __future__ import annotations

import torch
from torch import Tensor

from fb3d_rl.geometry.transforms import axis_angle_to_matrix, normalize, skew

LOCAL = 0.1
"""Distance (m) at which :func:`local_weight` gives a quarter of the weight at the place itself."""


def rigid_motion(points: Tensor, flow: Tensor, weight: Tensor, at: Tensor, ridge: float) -> tuple[Tensor, Tensor]:
    """Velocity v at ``at`` and angular velocity omega of the rigid motion that fits a flow best.

    Minimises sum_i w_i |v + omega x (p_i - at) - f_i|^2 with the weights scaled to sum 1: v is eliminated, what is
    left are the equations of angular momentum about the weighted mean of the points.

    Args:
        points: [B, N, 3] m.
        flow: [B, N, 3] displacement or velocity of each point.
        weight: [B, N] non-negative weights; a cloud whose weights are all 0 has no motion.
        at: [B, 3] m.
        ridge: added to the moments of inertia (m^2), so that omega stays small where all points are on a line.

    Returns:
        v [B, 3] in the unit of the flow and omega [B, 3] in that unit per m.
    """
    rows = torch.cat([points - at[:, None], flow, torch.ones_like(weight)[..., None]], dim=-1).double()
    sums = rows.mT @ (weight[..., None] * rows)  # [B, 7, 7], in double since differences follow
    total = sums[:, 6, 6, None].clamp_min(1e-9)
    mean = sums[:, 6, :6] / total
    covariance = sums[:, :3, :6] / total[..., None] - mean[:, :3, None] * mean[:, None]
    spread, moment = covariance.split(3, dim=-1)
    eye = torch.eye(3, dtype=spread.dtype, device=spread.device)
    inertia = (spread.diagonal(dim1=1, dim2=2).sum(-1)[:, None, None] + ridge) * eye - spread
    momentum = torch.linalg.cross(eye[None], moment).sum(1)  # the mean of arm x flow
    omega = torch.cholesky_solve(momentum[..., None], torch.linalg.cholesky(inertia)).squeeze(-1)
    velocity = mean[:, 3:] - torch.linalg.cross(omega, mean[:, :3])
    return velocity.to(points), omega.to(points)


def local_weight(flow: Tensor, squared: Tensor) -> Tensor:
    """Weights [..., N] to fit the motion at a place where no mask separates the parts.

    Points that move more count more, and near points much more than those farther away than ``LOCAL``.

    Args:
        flow: [..., N, 3] of each point, 0 where a point does not count.
        squared: [..., N] squared distance of each point from the place, m^2.
    """
    return flow.norm(dim=-1) / (1.0 + squared / LOCAL**2).square()


def screw(velocity: Tensor, omega: Tensor, time: Tensor) -> tuple[Tensor, Tensor]:
    """Where a constant rigid motion takes a body (the exponential map of SE(3)).

    A point x becomes ``turn @ x + shift``; the origin is the point that ``velocity`` is of.

    Args:
        velocity: [..., 3] of the body's point at the origin.
        omega: [..., 3] angular velocity, rad per unit of time.
        time: [...].

    Returns:
        turn [..., 3, 3] and shift [..., 3].
    """
    turned = omega * time[..., None]
    angle = turned.norm(dim=-1)
    turn = axis_angle_to_matrix(normalize(turned), angle)
    cross, size = skew(turned), angle.clamp_min(1e-4)[..., None, None]
    first = 0.5 * torch.sinc(0.5 * size / torch.pi).square()  # (1 - cos) / angle^2
    second = torch.where(size > 1e-2, (size - size.sin()) / size**3, 1 / 6)
    eye = torch.eye(3, dtype=omega.dtype, device=omega.device)
    mean_turn = eye + first * cross + second * (cross @ cross)
    return turn, (mean_turn @ (velocity * time[..., None])[..., None]).squeeze(-1)
