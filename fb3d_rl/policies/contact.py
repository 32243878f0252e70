"""Where to touch: the contact-point heuristic (supplement, I.E and I.F) with a check that the hand can get there.

Of the points with at least ``min_flow`` of the largest flow the one that is worth most, foremost the nearest to the
hand, is taken if it is a good place for a suction cup: the surface is flat around it (PCA curvature), it is no rim of
the part, the hand can come and go along with it, and it was not tried before. (The supplement takes the largest flow;
where several points have nearly that, small differences send the hand now here, now there, and no learner can follow.)
Otherwise the nearest good point at least 2 cm from it is (I.E); where no point is good, the demands are dropped one
after the other. The hand comes against the flow (I.F). Where the flow runs along the surface, as on a sliding sash, or
into it, it comes against the surface's normal instead; where something stands in the way, along the normal or the line
of sight, which is free as far as the camera sees.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import cKDTree
from tensordict import TensorClass
from torch import Tensor

from fb3d_rl.assets.gripper import HAND_LENGTH
from fb3d_rl.geometry.points import gather, pca_curvature, squared_distances
from fb3d_rl.geometry.rigid_motion import local_weight, rigid_motion, screw
from fb3d_rl.geometry.transforms import normalize
from fb3d_rl.policies.options import ContactOptions

CANDIDATES = 64
"""Points of a cloud that are remembered as candidates."""


class Contact(TensorClass):
    """Where and how the hand may touch in B clouds: at one point each, or at any of K candidates.

    All of it is 0 where there is nothing to touch.

    Attributes:
        point: [B, 3] or [B, K, 3] world, m.
        flow: [B, 3] or [B, K, 3] unit flow there.
        standoff: [B, 3] or [B, K, 3] unit direction in which the hand stands off the point.
        share: [B, 1] or [B, K, 1] size of the flow there, as a share of the cloud's largest.
    """

    point: Tensor
    flow: Tensor
    standoff: Tensor
    share: Tensor

    @classmethod
    def none(cls, batch: Sequence[int], like: Tensor | None = None) -> Contact:
        """No candidates, K = CANDIDATES rows of zeros, on the device of ``like``."""
        shape, device = (*batch, CANDIDATES), None if like is None else like.device
        vectors = {key: torch.zeros(*shape, 3, device=device) for key in ("point", "flow", "standoff")}
        return cls(**vectors, share=torch.zeros(*shape, 1, device=device), batch_size=torch.Size(batch))

    def at(self, index: Tensor) -> Contact:
        """Of the candidates of each cloud the one at ``index`` [B]."""
        rows = torch.arange(len(index), device=index.device)
        return self.apply(lambda x: x[rows, index])


def choose_contact(
    points: Tensor,
    valid: Tensor,
    part: Tensor | None,
    flow: Tensor,
    camera: Tensor,
    hand: Tensor,
    axis: Tensor,
    avoid: Tensor,
    options: ContactOptions,
) -> tuple[Contact, Contact]:
    """Choose where to touch each cloud and from which side, see the module's description.

    Args:
        points: [B, N, 3] world points, m; the ground is z = 0.
        valid: [B, N] bool.
        part: [B, N] bool, points of the part to open. Without it the flow says what moves, and each point's way is that
            of the motion around it, since several parts may move; all else stands in the way.
        flow: [B, N, 3] flow of the part to open, 0 elsewhere; without ``part`` of whatever moves.
        camera: [B, 3] position of the camera, which tells a surface's outside.
        hand: [B, 3] position of the suction tip, m.
        axis: [B, 3] unit direction from the tip to the hand.
        avoid: [B, N] bool, points not to be touched (tried in vain before).
        options: thresholds.

    Returns:
        The contact, and CANDIDATES candidates: the points that would do as well, for :func:`best_candidate`. Both are 0
        for a cloud without flow, and so are candidates beyond the last one.
    """
    norm = flow.norm(dim=-1).masked_fill(~valid, 0.0)
    largest = norm.amax(-1, keepdim=True)
    moves = norm > 0.05 * largest
    columns = (valid & moves).any(0).nonzero().flatten()  # only these can be chosen
    if not len(columns):
        nothing = Contact.none(camera.shape[:1], camera)
        return nothing.at(torch.zeros(len(camera), dtype=torch.int64, device=camera.device)), nothing
    scene = _Scene(points, valid, valid & ~(moves if part is None else part), camera)
    points, valid, flow, avoid, norm = (x[:, columns] for x in (points, valid, flow, avoid, norm))
    body = None if part is None else part[:, columns] & valid
    on_part = valid & (norm > 0.05 * largest) & (largest > 0)
    share = norm / largest.clamp_min(1e-9)
    surface = _surface(points, flow, on_part, columns, scene, options)
    weak = on_part & (norm >= options.weak_flow * largest)
    movable = weak & (norm >= options.min_flow * largest)
    usual_free, free, standoff = _standoffs(points, surface, weak, scene, options)

    fresh = ~avoid
    worth = _worth(share, points, standoff, hand, axis, options)
    peak = torch.where(movable & fresh, worth, torch.full_like(norm, -torch.inf)).argmax(-1)
    rows = torch.arange(len(points), device=points.device)
    distance = (points - points[rows, peak][:, None]).norm(dim=-1)
    reachable = weak & surface.smooth & fresh & free
    clear = reachable
    if options.collisions:
        clear = _clear(points, body, flow, scene, standoff, reachable, distance, options)
    good = _good(movable, surface.smooth, usual_free, free, fresh, reachable, clear)

    index = _peak_or_stand_in(good, peak, distance, options)
    found = movable.any(-1)[:, None]
    every = Contact(points, surface.direction, standoff, share[..., None], batch_size=points.shape[:1])
    chosen = every.at(index).apply(lambda x: torch.where(found, x, 0.0))
    return chosen, _first(every, good & found)


def _peak_or_stand_in(good: Tensor, peak: Tensor, distance: Tensor, options: ContactOptions) -> Tensor:
    """The peak [B], or the nearest good point [B, N] that is far enough from it if the peak is not good (I.E)."""
    far_enough = good & (distance >= options.min_distance)
    near = torch.where(far_enough, distance, torch.full_like(distance, torch.inf)).argmin(-1)
    return torch.where(good.gather(1, peak[:, None]).squeeze(1) | ~far_enough.any(-1), peak, near)


def best_candidate(candidates: Contact, hand: Tensor, axis: Tensor, options: ContactOptions) -> Contact:
    """The candidate that is worth most to a hand that has moved on since they were chosen.

    Args:
        candidates: of :func:`choose_contact`.
        hand: [B, 3] position of the suction tip, m.
        axis: [B, 3] unit direction from the tip to the hand.
        options: thresholds.
    """
    share = candidates.share.squeeze(-1)
    worth = _worth(share, candidates.point, candidates.standoff, hand, axis, options)
    return candidates.at(worth.masked_fill(share == 0, -torch.inf).argmax(-1))


@dataclass(frozen=True)
class _Scene:
    """What surrounds the points that may be chosen: the cloud [B, N, 3], what is seen and in the way [B, N], camera."""

    cloud: Tensor
    seen: Tensor
    obstacle: Tensor
    camera: Tensor


@dataclass(frozen=True)
class _Surface:
    """The surface at M points: unit flow and normal [B, M, 3], whether flat and no rim [B, M], distances [B, M, N]."""

    direction: Tensor
    normals: Tensor
    smooth: Tensor
    squared: Tensor


def _surface(
    points: Tensor, flow: Tensor, on_part: Tensor, columns: Tensor, scene: _Scene, options: ContactOptions
) -> _Surface:
    """The surface around each point [B, M, 3], which are the cloud's ``columns``."""
    squared = squared_distances(points, scene.cloud)
    among = squared[:, :, columns].masked_fill_(~on_part[:, None], torch.inf)
    nearest = among.topk(min(options.neighbors, len(columns)), largest=False)  # as knn finds them
    curvature, normals = pca_curvature(points, nearest, on_part, scene.camera)
    smooth = (curvature <= options.curvature) & ~_rim(points, nearest, options)
    return _Surface(normalize(flow), normals, smooth, squared)


def _standoffs(
    points: Tensor, surface: _Surface, weak: Tensor, scene: _Scene, options: ContactOptions
) -> tuple[Tensor, Tensor, Tensor]:
    """From which side to come to each point: whether the usual way is free, whether any is [B, M], the way [B, M, 3].

    The usual way is against the flow, or against the normal where the flow runs along the surface or into it. The
    others are the normal and the line of sight, of which the first free one is taken; the usual one where none is.
    """
    sight = normalize(scene.camera[:, None] - points)
    along = (surface.direction * surface.normals).sum(-1, keepdim=True)
    usual = torch.where(along >= options.facing, surface.direction, surface.normals)
    usual_free = torch.ones_like(weak)
    if options.collisions:
        usual = torch.where(_underground(points, usual, options)[..., None], sight, usual)
        usual_free = ~_blocked(points, scene, surface.squared, usual, options)
    free, standoff = usual_free, usual
    for way in (surface.normals, sight):
        todo = (weak & ~free).any(0).nonzero().flatten()
        opened = torch.zeros_like(free)
        opened[:, todo] = ~_blocked(points[:, todo], scene, surface.squared[:, todo], way[:, todo], options)
        opened &= ~free
        free, standoff = free | opened, torch.where(opened[..., None], way, standoff)
    return usual_free, free, standoff


def _good(
    movable: Tensor, smooth: Tensor, usual_free: Tensor, free: Tensor, fresh: Tensor, reachable: Tensor, clear: Tensor
) -> Tensor:
    """The points that meet the strictest list of demands that any point of the cloud meets, [B, M] bool."""
    tiers = [
        movable & smooth & usual_free & fresh & clear,
        movable & smooth & free & fresh & clear,
        reachable & clear,
        movable & smooth & free & fresh,
        movable & free & fresh,
        movable & smooth & fresh,
        movable & fresh,
        movable,
    ]
    first = torch.stack([tier.any(-1) for tier in tiers], dim=-1).int().argmax(-1)  # the first tier with a point
    index = first[:, None, None].expand(-1, 1, movable.shape[1])
    return torch.stack(tiers, dim=1).gather(1, index).squeeze(1)


def _first(contacts: Contact, good: Tensor) -> Contact:
    """The first CANDIDATES of the good contacts, then 0; a cloud's points are in random order."""
    order = good.int().argsort(dim=-1, descending=True, stable=True)[:, :CANDIDATES]
    missing = CANDIDATES - order.shape[1]

    def kept(values: Tensor) -> Tensor:
        chosen = gather(torch.where(good[..., None], values, 0.0), order)
        return torch.nn.functional.pad(chosen, (0, 0, 0, missing))

    return contacts.apply(kept)


def _worth(
    share: Tensor, points: Tensor, standoff: Tensor, hand: Tensor, axis: Tensor, options: ContactOptions
) -> Tensor:
    """What points [B, N] are worth to a hand: their share of the largest flow, less the way there and the turning."""
    way = (points - hand[:, None]).norm(dim=-1)
    return share - options.near * way - options.turning * (1 - (standoff * axis[:, None]).sum(-1))


def _rim(points: Tensor, nearest: tuple[Tensor, Tensor], options: ContactOptions) -> Tensor:
    """Whether the part's points ``nearest`` to each point (:func:`knn`) lie to one side of it, [B, N] bool."""
    squared, index = nearest
    weight = squared.isfinite().to(points.dtype)[..., None]
    total = weight.sum(2).clamp_min(1.0)
    mean = (gather(points, index) * weight).sum(2) / total
    spread = (squared.clamp_max(1e6).sqrt() * weight[..., 0]).sum(2) / total[..., 0]
    return (mean - points).norm(dim=-1) > options.rim * spread


def _blocked(points: Tensor, scene: _Scene, squared: Tensor, standoff: Tensor, options: ContactOptions) -> Tensor:
    """Whether the cloud, or the ground, is in the cylinder that the hand needs before each point, [B, M] bool.

    ``squared`` [B, M, N] are the squared distances from the M points to the N of the cloud.
    """
    middle, half = (options.reach + options.clearance) / 2, (options.reach - options.clearance) / 2
    # In place and with one comparison: memory for M times N numbers takes longer to come by than to fill.
    ahead = (standoff @ scene.cloud.mT).sub_((standoff * points).sum(-1, keepdim=True))  # [B, M, N]
    outside = torch.addcmul(squared, ahead, ahead, value=-1).sub_(options.hand_radius**2)
    beyond = ahead.sub_(middle).abs_().sub_(half)
    inside = (torch.maximum(outside, beyond, out=outside) < 0).logical_and_(scene.seen[:, None])
    return (inside.sum(-1, dtype=torch.int32) > 1) | _underground(points, standoff, options)


def _underground(points: Tensor, standoff: Tensor, options: ContactOptions) -> Tensor:
    """Whether the hand's far end would come from below the ground z = 0, [B, N] bool."""
    return points[..., 2] + (options.run_up + HAND_LENGTH) * standoff[..., 2] < 0


def _clear(
    points: Tensor,
    part: Tensor | None,
    flow: Tensor,
    scene: _Scene,
    standoff: Tensor,
    wanted: Tensor,
    distance: Tensor,
    options: ContactOptions,
) -> Tensor:
    """Which points the hand can hold all along their way with the part, [B, M] bool.

    The way is that of the part's rigid motion; the hand, a few balls behind the point, must not meet the scene's
    obstacles or the ground. At most ``candidates`` of the ``wanted`` points are looked at, from the
    smallest to the largest ``distance``; the others count as not clear.
    """
    count = min(options.candidates, points.shape[1])
    order = torch.where(wanted, distance, torch.inf).argsort(-1)
    among = torch.linspace(0, 1, count, device=points.device) * (wanted.sum(-1, keepdim=True) - 1).clamp_min(0)
    index = order.gather(1, among.round().long())  # [B, K]
    contact, away = gather(points, index), gather(standoff, index)
    centre, velocity, omega = _motions(points, part, flow, contact)
    speed = (velocity + torch.linalg.cross(omega, contact - centre)).norm(dim=-1)
    time = options.sweep / speed.clamp_min(1e-6)
    time = torch.minimum(time, options.sweep_angle / omega.norm(dim=-1).clamp_min(1e-6))
    share = torch.linspace(0, 1, options.sweep_steps + 1, device=points.device)[1:]
    turn, shift = screw(velocity[:, :, None], omega[:, :, None], time[..., None] * share)  # [B, K, steps, 3, 3]
    arm, away = (contact - centre)[:, :, None, :, None], away[:, :, None, :, None]
    at = (turn @ arm).squeeze(-1) + shift + centre[:, :, None]
    reach = torch.linspace(options.clearance, HAND_LENGTH, 3, device=points.device)
    hand = at[..., None, :] + reach[:, None] * (turn @ away).mT  # [B, K, steps, balls, 3]
    meets = torch.stack(
        [
            _within(balls, stuff[mask], options.hand_radius)
            for balls, stuff, mask in zip(hand, scene.cloud, scene.obstacle, strict=True)
        ]
    )
    clear = (~meets & (hand[..., 2] > 0)).flatten(2).all(-1)
    result = torch.zeros_like(wanted).scatter(1, index, clear)
    return result & wanted


def _motions(points: Tensor, part: Tensor | None, flow: Tensor, contact: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Centre, its velocity and the angular velocity [B, 1 or K, 3] with which the points ``contact`` [B, K, 3] move.

    All of them with the part; without a mask each with what moves around it.
    """
    if part is not None:
        centre = (points * part[..., None]).sum(1) / part.sum(-1, keepdim=True).clamp_min(1)
        velocity, omega = rigid_motion(points, flow, part.to(points.dtype), centre, 1e-4)
        return centre[:, None], velocity[:, None], omega[:, None]
    weight = local_weight(flow[:, None], squared_distances(contact, points))
    count = contact.shape[1]
    cloud, moves = (x[:, None].expand(-1, count, -1, -1).flatten(0, 1) for x in (points, flow))
    velocity, omega = rigid_motion(cloud, moves, weight.flatten(0, 1), contact.flatten(0, 1), 1e-4)
    return contact, velocity.view_as(contact), omega.view_as(contact)


def _within(points: Tensor, others: Tensor, radius: float) -> Tensor:
    """Whether any of others [N, 3] is nearer than ``radius`` to each point [..., 3]; by a search tree, on the CPU."""
    distance, _ = cKDTree(others.cpu()).query(points.flatten(0, -2).cpu(), distance_upper_bound=radius)
    return torch.from_numpy(np.isfinite(distance)).to(points.device).view(points.shape[:-1])
