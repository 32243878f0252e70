"""Rigid transforms, against scipy and their own definitions, on distinct transforms that are not the identity."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from fb3d_rl.geometry import transforms as tf

TURNS = Rotation.random(64, rng=np.random.default_rng(0))
AXES = torch.nn.functional.normalize(torch.randn(32, 3, generator=torch.Generator().manual_seed(0)).double(), dim=-1)


def draw(seed: int, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def matrices() -> Tensor:
    return torch.as_tensor(TURNS.as_matrix())


def half_turns() -> Tensor:
    """Rotations by pi about random axes, the coordinate axes and the diagonals between them."""
    corners = torch.tensor([[x, y, z] for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if x or y or z])
    axes = torch.cat([AXES, torch.nn.functional.normalize(corners.double(), dim=-1)])
    return torch.as_tensor(Rotation.from_rotvec(math.pi * axes.numpy()).as_matrix())


def wxyz(rotation: Rotation) -> np.ndarray:
    xyzw = rotation.as_quat(canonical=True)
    return xyzw[:, [3, 0, 1, 2]]


def close(actual: Tensor, expected: Tensor | np.ndarray, atol: float = 1e-12) -> None:
    torch.testing.assert_close(actual, torch.as_tensor(expected), atol=atol, rtol=0.0)


def test_quaternions_are_scipys_in_wxyz_order() -> None:
    close(tf.matrix_to_quaternion(matrices()), wxyz(TURNS))
    close(tf.quaternion_to_matrix(torch.as_tensor(wxyz(TURNS))), TURNS.as_matrix())


@pytest.mark.parametrize("rotation", [matrices(), half_turns(), torch.eye(3, dtype=torch.float64)[None]])
def test_quaternion_round_trip(rotation: Tensor) -> None:
    quaternion = tf.matrix_to_quaternion(rotation)
    close(quaternion.norm(dim=-1), torch.ones(len(rotation), dtype=torch.float64))
    assert (quaternion[..., 0] >= 0).all()
    close(tf.quaternion_to_matrix(quaternion), rotation, atol=1e-10)


@pytest.mark.parametrize("gap", [1e-3, 1e-6, 1e-9])
def test_quaternion_round_trip_near_half_turns(gap: float) -> None:
    rotation = tf.axis_angle_to_matrix(AXES, torch.full((len(AXES),), math.pi - gap, dtype=torch.float64))
    close(tf.quaternion_to_matrix(tf.matrix_to_quaternion(rotation)), rotation, atol=1e-10)


def test_quaternion_of_any_length_and_sign_is_the_same_turn() -> None:
    quaternion = torch.as_tensor(wxyz(TURNS))
    close(tf.quaternion_to_matrix(-3.5 * quaternion), TURNS.as_matrix())


def test_axis_angle_is_scipys() -> None:
    vectors = draw(1, 40, 3) * 2
    expected = Rotation.from_rotvec(vectors.numpy()).as_matrix()
    close(tf.axis_angle_to_matrix(tf.normalize(vectors), vectors.norm(dim=-1)), expected)
    close(tf.axis_angle_to_matrix(torch.zeros(3).double(), torch.tensor(0.0).double()), np.eye(3))


def test_skew_is_the_cross_product() -> None:
    a, b = draw(2, 4, 5, 3), draw(3, 4, 5, 3)
    close((tf.skew(a) @ b[..., None]).squeeze(-1), np.cross(a.numpy(), b.numpy()))


def test_normalize_leaves_zero_vectors_alone() -> None:
    vectors = torch.tensor([[0.0, 0.0, 0.0], [3.0, 0.0, 4.0], [1e-13, 0.0, 0.0]]).double()
    close(tf.normalize(vectors), [[0.0, 0.0, 0.0], [0.6, 0.0, 0.8], [0.0, 0.0, 0.0]] @ np.eye(3))


def test_rigid_transforms_compose_invert_and_apply() -> None:
    a = tf.rigid(matrices()[:8], draw(4, 8, 3))
    b = tf.rigid(matrices()[8:16], draw(5, 8, 3))
    points = draw(6, 8, 7, 3)
    close(tf.apply(a @ b, points), tf.apply(a, tf.apply(b, points)))
    close(tf.apply(tf.inverse(a), tf.apply(a, points)), points)
    close(tf.inverse(a @ b), tf.inverse(b) @ tf.inverse(a))
    close(tf.inverse(a), torch.linalg.inv(a))
    close(tf.apply(a, points)[3, 2], TURNS[3].apply(points[3, 2].numpy()) + a[3, :3, 3].numpy())


def test_rigid_broadcasts_and_keeps_dtype() -> None:
    one = tf.rigid(torch.eye(3), torch.ones(5, 2, 3))
    assert one.shape == (5, 2, 4, 4) and one.dtype == torch.float32
    assert tf.inverse(one).dtype == torch.float32
    assert tf.matrix_to_quaternion(one[..., :3, :3]).dtype == torch.float32


def test_euler_angles_are_a_chain_of_x_y_z_hinges() -> None:
    angles = draw(9, 30, 3)
    close(tf.euler_xyz_to_matrix(angles), Rotation.from_euler("XYZ", angles.numpy()).as_matrix())


def test_euler_jacobian_is_the_finite_difference() -> None:
    angles, rates, step = draw(10, 50, 3), draw(11, 50, 3), 1e-6
    ahead, behind = (tf.euler_xyz_to_matrix(angles + sign * step * rates) for sign in (1, -1))
    spin = (ahead - behind) / (2 * step) @ tf.euler_xyz_to_matrix(angles).mT  # skew(omega), in the world
    omega = (tf.euler_xyz_jacobian(angles) @ rates[..., None]).squeeze(-1)
    close(tf.skew(omega), spin, atol=1e-8)
