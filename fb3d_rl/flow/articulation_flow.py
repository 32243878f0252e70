"""3D articulation flow (3DAF): how each visible point would move if the part opened a little (supplement, II.B)."""

from __future__ import annotations

import torch
from torch import Tensor

from fb3d_rl.flow.kinematics import KinematicTree
from fb3d_rl.geometry.transforms import inverse

STEP = 0.01
"""Displacement of the joint, rad or m."""


def articulation_flow(
    tree: KinematicTree, points: Tensor, links: Tensor, qpos: Tensor, direction: Tensor, base: Tensor
) -> Tensor:
    """Displacement of world points when the joints move by ``STEP * direction``.

    As the supplement's II.B has it: take the kinematic chain at the current joint state, displace the joint, transform
    the points of the parts that move (all that the joint carries), and take the difference. A finite step chords a
    revolute joint's arc, so the displacement is measured over half a step each way: its error is of the third order.
    Where several joints move at once (all movable parts), a point gets the sum of the displacements of all the
    joints that carry it.

    Args:
        tree: the object's kinematic tree with L links and J joints.
        points: [..., N, 3] world points (m) on the object in the state ``qpos``.
        links: [..., N] int64, the link of each point; points with -1 (padding) get 0.
        qpos: [..., J] joint state (rad or m).
        direction: [..., J] signs: +1 or -1 for the joints that move, towards opening, and 0 for the others.
        base: T_world_base [..., 4, 4].

    Returns:
        [..., N, 3] displacement in metres for each point, in the dtype of ``points``.
    """
    dtype = tree.origins.dtype
    base, world = base.to(dtype), points.to(dtype)
    half = 0.5 * STEP * direction.to(dtype)
    position = qpos.to(dtype)
    poses = base[..., None, :, :] @ tree.forward(torch.stack([position, position + half, position - half]))
    # T_world_link(q +- half) T_world_link(q)^-1 moves a world point along with its link.
    at_rest = inverse(poses[0])
    ahead, behind = poses[1] @ at_rest, poses[2] @ at_rest
    change = ahead - behind  # [..., L, 4, 4], exactly 0 for links that stand still
    index = links.clamp_min(0)[..., None, None].expand(*links.shape, 4, 4)
    per_point = change.gather(-3, index)
    flow = (per_point[..., :3, :3] * world[..., None, :]).sum(-1) + per_point[..., :3, 3]
    return torch.where((links >= 0)[..., None], flow, torch.zeros_like(flow)).to(points.dtype)


def normalize_flow(flow: Tensor, eps: float = 1e-9) -> Tensor:
    """Scale each cloud's flow [..., N, 3] so that its largest norm is 1; a cloud that does not move stays 0."""
    largest = flow.norm(dim=-1).amax(dim=-1)[..., None, None]
    return torch.where(largest > eps, flow / largest.clamp_min(eps), torch.zeros_like(flow))
