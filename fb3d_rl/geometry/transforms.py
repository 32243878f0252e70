"""Rigid transforms and rotations.

Conventions (one statement for the whole package): ``T_ab`` is a 4x4 matrix that maps column vectors in frame b to
frame a; quaternions are wxyz with w >= 0; rotation vectors are axis * angle (rad); every function is batched over
leading dimensions and keeps dtype and device.
"""

from __future__ import annotations

import torch
from torch import Tensor


def normalize(vectors: Tensor, eps: float = 1e-12) -> Tensor:
    """Scale vectors [..., D] to unit length; vectors shorter than ``eps`` become 0."""
    norm = torch.linalg.vector_norm(vectors, dim=-1, keepdim=True)
    return torch.where(norm > eps, vectors / norm.clamp_min(eps), 0.0)


def dot(a: Tensor, b: Tensor) -> Tensor:
    """Inner products [..., 1] of vectors [..., D]."""
    return (a * b).sum(-1, keepdim=True)


def length(vectors: Tensor) -> Tensor:
    """Euclidean norms [..., 1] of vectors [..., D]."""
    return torch.linalg.vector_norm(vectors, dim=-1, keepdim=True)


def alignment(source: Tensor, target: Tensor) -> Tensor:
    """Rotation vectors [..., 3] (rad) of the shortest rotations that take ``source`` to ``target`` [..., 3].

    Supplement I.F with two corrections: the angle is ``phi_12`` about the *unit* axis ``v1 x v2 / |v1 x v2|`` (the text
    halves ``omega`` in place of ``phi_12`` and leaves the axis unnormalised), and opposite vectors turn by pi about an
    axis perpendicular to both, where the cross product vanishes. ``phi_12`` is taken by atan2, which unlike arccos is
    accurate near 0 and pi. A zero vector aligns with anything: rotation 0.
    """
    a, b = normalize(source), normalize(target)
    axis = torch.linalg.cross(a, b)
    sine, cosine = length(axis), dot(a, b)
    turn = axis * (torch.atan2(sine, cosine) / sine.clamp_min(1e-7))
    parallel = sine <= 1e-7
    if not bool(parallel.any()):
        return turn
    # Perpendicular to a: cross with the coordinate axis along which a is shortest.
    shortest = torch.nn.functional.one_hot(a.abs().argmin(-1), 3).to(a)
    half_turn = torch.pi * normalize(torch.linalg.cross(a, shortest))
    return torch.where(parallel, torch.where(cosine >= 0.0, 0.0, half_turn), turn)


def rotate(vectors: Tensor, rotation: Tensor) -> Tensor:
    """Turn vectors [..., 3] by rotation vectors [..., 3] (rad): Rodrigues' formula."""
    angle = length(rotation)
    axis = normalize(rotation)
    once = torch.linalg.cross(axis, vectors)
    return vectors + torch.sin(angle) * once + (1.0 - torch.cos(angle)) * torch.linalg.cross(axis, once)


def skew(vectors: Tensor) -> Tensor:
    """Cross-product matrices [..., 3, 3] of vectors [..., 3]: ``skew(a) @ b == a x b``."""
    x, y, z = vectors.unbind(-1)
    zero = torch.zeros_like(x)
    rows = (zero, -z, y, z, zero, -x, -y, x, zero)
    return torch.stack(rows, dim=-1).reshape(*vectors.shape[:-1], 3, 3)


def axis_angle_to_matrix(axis: Tensor, angle: Tensor) -> Tensor:
    """Rotation matrices [..., 3, 3] about unit ``axis`` [..., 3] by ``angle`` [...] rad (Rodrigues' formula)."""
    k = skew(axis)
    angle = angle[..., None, None]
    eye = torch.eye(3, dtype=axis.dtype, device=axis.device)
    return eye + torch.sin(angle) * k + (1 - torch.cos(angle)) * (k @ k)


def matrix_to_quaternion(rotation: Tensor) -> Tensor:
    """Quaternions wxyz [..., 4], w >= 0, of rotation matrices [..., 3, 3].

    Each component is read from the numerically best of the four classic branches, so rotations by pi are exact.
    """
    m = rotation
    d0, d1, d2 = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    w, x, y, z = 1 + d0 + d1 + d2, 1 + d0 - d1 - d2, 1 - d0 + d1 - d2, 1 - d0 - d1 + d2
    s21, d21 = m[..., 2, 1] + m[..., 1, 2], m[..., 2, 1] - m[..., 1, 2]
    s02, d02 = m[..., 0, 2] + m[..., 2, 0], m[..., 0, 2] - m[..., 2, 0]
    s10, d10 = m[..., 1, 0] + m[..., 0, 1], m[..., 1, 0] - m[..., 0, 1]
    candidates = torch.stack(
        [
            torch.stack([w, d21, d02, d10], -1),
            torch.stack([d21, x, s10, s02], -1),
            torch.stack([d02, s10, y, s21], -1),
            torch.stack([d10, s02, s21, z], -1),
        ],
        dim=-2,
    )
    best = torch.stack([w, x, y, z], -1).argmax(-1)[..., None, None].expand(*m.shape[:-2], 1, 4)
    quaternion = normalize(candidates.gather(-2, best).squeeze(-2))
    return torch.where(quaternion[..., :1] < 0, -quaternion, quaternion)


def quaternion_to_matrix(quaternion: Tensor) -> Tensor:
    """Rotation matrices [..., 3, 3] of quaternions wxyz [..., 4] (normalised first)."""
    unit = normalize(quaternion)
    products = 2 * unit[..., :, None] * unit[..., None, :]
    _, wx, wy, wz, _, xx, xy, xz, _, _, yy, yz, _, _, _, zz = products.flatten(-2).unbind(-1)
    rows = (
        1 - (yy + zz), xy - wz, xz + wy,
        xy + wz, 1 - (xx + zz), yz - wx,
        xz - wy, yz + wx, 1 - (xx + yy),
    )  # fmt: skip
    return torch.stack(rows, dim=-1).reshape(*quaternion.shape[:-1], 3, 3)


def rigid(rotation: Tensor, translation: Tensor) -> Tensor:
    """Transforms [..., 4, 4] of rotations [..., 3, 3] and translations [..., 3]."""
    batch = torch.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1])
    transform = torch.zeros(*batch, 4, 4, dtype=rotation.dtype, device=rotation.device)
    transform[..., :3, :3] = rotation
    transform[..., :3, 3] = translation
    transform[..., 3, 3] = 1.0
    return transform


def inverse(transform: Tensor) -> Tensor:
    """``T_ba`` of rigid ``T_ab`` [..., 4, 4]."""
    rotation = transform[..., :3, :3].mT
    return rigid(rotation, -(rotation @ transform[..., :3, 3:]).squeeze(-1))


def apply(transform: Tensor, points: Tensor) -> Tensor:
    """Map points [..., N, 3] by rigid transforms [..., 4, 4]."""
    return points @ transform[..., :3, :3].mT + transform[..., None, :3, 3]


def euler_xyz_to_matrix(angles: Tensor) -> Tensor:
    """``Rx(roll) @ Ry(pitch) @ Rz(yaw)`` [..., 3, 3] of angles [..., 3] rad: a chain of x, y and z hinges."""
    eye = torch.eye(3, dtype=angles.dtype, device=angles.device).expand(*angles.shape[:-1], 3, 3)
    rx, ry, rz = (axis_angle_to_matrix(eye[..., i, :], angles[..., i]) for i in range(3))
    return rx @ ry @ rz


def euler_xyz_jacobian(angles: Tensor) -> Tensor:
    """Jacobian [..., 3, 3] with ``omega_world = J @ angle_rates`` for :func:`euler_xyz_to_matrix`.

    Its columns are the world directions of the three hinges: x, ``Rx`` y and ``Rx Ry`` z.
    """
    roll_pitch = angles[..., :2]
    (sin_r, sin_p), (cos_r, cos_p) = roll_pitch.sin().unbind(-1), roll_pitch.cos().unbind(-1)
    zero, one = torch.zeros_like(sin_r), torch.ones_like(sin_r)
    rows = (
        one, zero, sin_p,
        zero, cos_r, -sin_r * cos_p,
        zero, sin_r, cos_r * cos_p,
    )  # fmt: skip
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))
