"""The rigid motion of a flow: exact on rigid flows, tame where the points cannot tell, followed along its screw."""

from __future__ import annotations

import torch

from fb3d_rl.geometry.rigid_motion import rigid_motion, screw
from fb3d_rl.geometry.transforms import skew


def random(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_finds_the_motion_of_a_rigid_flow_whatever_the_weights() -> None:
    points, velocity, omega, at = random(2, 50, 3), random(2, 3, seed=1), random(2, 3, seed=2), random(2, 3, seed=3)
    flow = velocity[:, None] + torch.linalg.cross(omega[:, None], points - at[:, None])
    weight = random(2, 50, seed=4).square()
    found = rigid_motion(points, flow, weight, at, 0.0)
    torch.testing.assert_close(found, (velocity, omega))
    weight[:, 25:] = 0.0
    flow[:, 25:] = 100.0
    torch.testing.assert_close(rigid_motion(points, flow, weight, at, 0.0), (velocity, omega))


def test_points_in_a_row_and_clouds_without_weight_give_no_wild_motion() -> None:
    row = torch.zeros(1, 20, 3, dtype=torch.float64)
    row[..., 0] = torch.linspace(0.0, 1.0, 20)
    flow = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64) + 1e-3 * random(1, 20, 3)
    velocity, omega = rigid_motion(row, flow, torch.ones(1, 20), row[:, 0] + 0.1, 1e-2)
    assert omega.norm() < 0.01 and velocity[0, 1] > 0.9
    nothing = rigid_motion(row, flow, torch.zeros(1, 20), row[:, 0], 1e-2)
    assert not any(value.any() for value in nothing)


def test_screw_is_the_exponential_map() -> None:
    velocity, omega = random(6, 3), random(6, 3, seed=1)
    omega[0] = 0.0
    for time in (1e-6, 1e-3, 0.02, 1.0, 3.0):
        twist = torch.zeros(6, 4, 4, dtype=torch.float64)
        twist[:, :3, :3], twist[:, :3, 3] = skew(omega), velocity
        expected = torch.matrix_exp(time * twist)
        turn, shift = screw(velocity, omega, torch.full((6,), time, dtype=torch.float64))
        torch.testing.assert_close(turn, expected[:, :3, :3], atol=1e-6, rtol=0)
        torch.testing.assert_close(shift, expected[:, :3, 3], atol=1e-6, rtol=0)
