"""3D articulation flow (3DAF): how each visible point would move if the part opened a little (supplement, II.B)."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from fb3d_rl.kinematics.tree import KinematicTree

STEP = 0.01
"""Displacement of the joint, rad or m."""


def articulation_flow(tree: KinematicTree, points: Tensor, links: Tensor, poses: Tensor, direction: Tensor) -> Tensor:
    """Displacement of world points when the joints move by ``STEP * direction``.

    As the supplement's II.B has it: take the kinematic chain at the current joint state, displace the joint, transform
    the points of the parts that move (all that the joint carries), and take the difference. A step to one side would
    cut across a revolute joint's arc, so the difference is taken over half a step each way, along the tangent. It has a
    closed form: ``2 sin(STEP / 2) a x (p - o)`` for a joint that turns about the unit axis a through o (Rodrigues'
    formula, in which the terms with the cosine cancel), ``STEP a`` for one that slides. Where several joints move at
    once (all movable parts, or a joint and those that follow it), a point gets the sum of the displacements of all the
    joints that carry it; a follower's is its ratio times as large.

    Args:
        tree: the object's kinematic tree with L links and J joints.
        points: [..., N, 3] world points (m) on the object.
        links: [..., N] int64, the link of each point; points with -1 (padding) get 0.
        poses: T_world_link [..., L, 4, 4] of the links now.
        direction: [..., J] signs: +1 or -1 for the joints that move, towards opening, and 0 for the others.

    Returns:
        [..., N, 3] displacement in metres for each point, in the dtype of ``points``.
    """
    dtype = tree.axes.dtype
    frames = poses.index_select(-3, tree.movable).to(dtype)
    along = direction.to(dtype)[..., tree.drivers] * tree.ratio
    turn, slide = (frames[..., :3, :3] @ tree.screws * along[..., None, None]).unbind(-1)
    turn = 2.0 * math.sin(0.5 * STEP) * turn
    # Each joint's displacement turn x p + offset, [..., M, 6], and its sum over the joints that carry a link.
    offset = STEP * slide - torch.linalg.cross(turn, frames[..., :3, 3])
    per_link = tree.carried @ torch.cat([turn, offset], dim=-1)
    turn, offset = per_link.gather(-2, (links + 1)[..., None].expand(*links.shape, 6)).split(3, dim=-1)
    return (torch.linalg.cross(turn, points.to(dtype)) + offset).to(points.dtype)


def normalize_flow(flow: Tensor, eps: float = 1e-9) -> Tensor:
    """Scale each cloud's flow [..., N, 3] so that its largest norm is 1; a cloud that does not move stays 0."""
    largest = torch.linalg.vector_norm(flow, dim=-1).amax(dim=-1)[..., None, None]
    return flow / torch.where(largest > eps, largest, torch.inf)
