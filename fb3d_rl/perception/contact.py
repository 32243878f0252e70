"""Where to touch: the contact-point heuristic (supplement, I.E and I.F) with a check that the hand can get there."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from fb3d_rl.geometry.points import gather, knn, pca_curvature
from fb3d_rl.geometry.transforms import normalize


@dataclass(frozen=True)
class ContactOptions:
    """Thresholds of the contact-point heuristic.

    Attributes:
        neighbors: points that make a neighbourhood.
        curvature: PCA curvature above which a point is no good place for a suction cup.
        rim: a point whose neighbours on the part lie to one side is on its rim: largest distance from the point to
            their mean, as a share of their mean distance.
        min_distance: where the max-flow point is discarded, its stand-in is at least this far away (I.E), m.
        min_flow: share of the cloud's largest flow that a contact point must have.
        facing: cosine between flow and surface normal below which the hand approaches along the normal.
        hand_radius: radius (m) of the free cylinder that the hand needs in front of the point.
        clearance: where that cylinder starts, in front of the point, m.
        reach: where that cylinder ends, m.
    """

    neighbors: int = 12
    curvature: float = 0.03
    rim: float = 0.45
    min_distance: float = 0.02
    min_flow: float = 0.5
    facing: float = 0.35
    hand_radius: float = 0.05
    clearance: float = 0.06
    reach: float = 0.6


def choose_contact(
    points: Tensor, valid: Tensor, flow: Tensor, camera: Tensor, avoid: Tensor, options: ContactOptions
) -> tuple[Tensor, Tensor, Tensor]:
    """Choose where to touch each cloud and from which side.

    The point of largest flow is taken if it is a good place for a suction cup: the surface is flat around it (PCA
    curvature), it is no rim of the part, no point of the cloud stands in the hand's way and it was not tried before.
    Otherwise the nearest good point at least 2 cm from it is (I.E); where no point is good, the demands are dropped
    one after the other. The hand comes against the flow (I.F). Where the flow runs along the surface, as on a
    sliding sash, or into it, it comes against the surface's normal instead.

    Args:
        points: [B, N, 3] world points, m.
        valid: [B, N] bool.
        flow: [B, N, 3] flow of the part to open, 0 elsewhere.
        camera: [B, 3] position of the camera, which tells a surface's outside.
        avoid: [B, N] bool, points not to be touched (tried in vain before).
        options: thresholds.

    Returns:
        Contact point [B, 3], unit flow there [B, 3] and unit direction [B, 3] in which the hand stands off it. All are
        0 for a cloud without flow.
    """
    norm = flow.norm(dim=-1)
    largest = norm.amax(-1, keepdim=True)
    movable = valid & (norm >= options.min_flow * largest) & (largest > 0)
    on_part = valid & (norm > 0.05 * largest) & (largest > 0)
    curvature, normals = pca_curvature(points, options.neighbors, on_part, camera)
    direction = normalize(flow)
    along = (direction * normals).sum(-1, keepdim=True)
    standoff = torch.where(along >= options.facing, direction, normals)

    smooth = (curvature <= options.curvature) & ~_rim(points, on_part, options)
    free = ~_blocked(points, valid, standoff, options)
    fresh = ~avoid
    tiers = [
        movable & smooth & free & fresh,
        movable & free & fresh,
        movable & smooth & fresh,
        movable & fresh,
        movable,
    ]
    score = torch.stack([tier.any(-1) for tier in tiers], dim=-1).int().argmax(-1)  # the first tier with a point
    good = torch.stack(tiers, dim=1).gather(1, score[:, None, None].expand(-1, 1, valid.shape[1])).squeeze(1)

    peak = torch.where(movable & fresh, norm, torch.full_like(norm, -1.0)).argmax(-1)
    rows = torch.arange(len(points), device=points.device)
    distance = (points - points[rows, peak][:, None]).norm(dim=-1)
    far_enough = good & (distance >= options.min_distance)
    near = torch.where(far_enough, distance, torch.full_like(distance, torch.inf)).argmin(-1)
    index = torch.where(good[rows, peak] | ~far_enough.any(-1), peak, near)
    found = movable.any(-1)[:, None]
    return tuple(torch.where(found, x[rows, index], torch.zeros_like(x[rows, index]))
                 for x in (points, direction, standoff))  # type: ignore[return-value]  # fmt: skip


def _rim(points: Tensor, on_part: Tensor, options: ContactOptions) -> Tensor:
    """Whether the part's points around each point lie to one side of it, [B, N] bool."""
    squared, index = knn(points, points, options.neighbors, on_part)
    weight = squared.isfinite().to(points.dtype)[..., None]
    total = weight.sum(2).clamp_min(1.0)
    mean = (gather(points, index) * weight).sum(2) / total
    spread = (squared.clamp_max(1e6).sqrt() * weight[..., 0]).sum(2) / total[..., 0]
    return (mean - points).norm(dim=-1) > options.rim * spread


def _blocked(points: Tensor, valid: Tensor, standoff: Tensor, options: ContactOptions) -> Tensor:
    """Whether other points stand in the cylinder that the hand needs in front of each point, [B, N] bool."""
    offset = points[:, None] - points[:, :, None]  # [B, N, N, 3]: from point i to point j
    ahead = (offset * standoff[:, :, None]).sum(-1)
    aside = (offset.square().sum(-1) - ahead.square()).clamp_min(0).sqrt()
    inside = (ahead > options.clearance) & (ahead < options.reach) & (aside < options.hand_radius) & valid[:, None]
    return inside.sum(-1) > 1
