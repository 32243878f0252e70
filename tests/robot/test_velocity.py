from __future__ import annotations

import numpy as np
import pytest
import torch

from fb3d_rl.errors import UserError
from fb3d_rl.robot.arm import panda, sawyer
from fb3d_rl.robot.collision import Checker, Obstacles
from fb3d_rl.robot.velocity import resolve

TWIST = torch.tensor([0.02, -0.01, 0.03, 0.1, 0.0, -0.1], dtype=torch.float64)


@pytest.mark.parametrize("arm", [sawyer, panda], ids=["sawyer", "panda"])
def test_far_from_limits_the_tip_moves_as_asked(arm) -> None:
    arm = arm()
    result = resolve(arm, arm.home, TWIST, Checker(arm, Obstacles()))
    torch.testing.assert_close(arm.jacobian(arm.home) @ result.velocity, TWIST, atol=1e-6, rtol=0.0)
    assert result.share == pytest.approx(1.0, abs=1e-6)
    assert result.slowed == 1.0 and not bool(result.held.any())


def test_what_is_too_fast_is_slowed_without_another_direction() -> None:
    arm = sawyer()
    slow, fast = (resolve(arm, arm.home, factor * TWIST, speed=0.3) for factor in (0.1, 50.0))
    assert float(fast.velocity.abs().max()) == pytest.approx(0.3)
    torch.testing.assert_close(fast.velocity / 0.3, slow.velocity / slow.velocity.abs().max(), atol=1e-6, rtol=0.0)
    assert fast.share < 0.5


def test_a_joint_stops_before_its_limit_and_others_take_over() -> None:
    arm, step = sawyer(), 0.02
    q = arm.home.clone()
    q[0] = arm.upper[0] - 0.02
    sideways = torch.linalg.cross(torch.tensor([0.0, 0.0, 1.0]).double(), arm.tip(q)[:3, 3])
    twist = torch.cat([0.1 * sideways / sideways.norm(), torch.zeros(3).double()])
    assert float(torch.linalg.pinv(arm.jacobian(q))[0] @ twist) > 0.0  # left alone it would go beyond
    first = resolve(arm, q, twist)
    assert first.share > 0.5
    for _ in range(150):
        result = resolve(arm, q, twist)
        q = q + step * result.velocity
        assert bool(arm.within(q, 0.0).all())
    assert bool(result.held[0])


def test_a_limit_lets_a_joint_go_back() -> None:
    arm = sawyer()
    q = arm.home.clone()
    q[1] = arm.lower[1]
    away = arm.jacobian(q) @ torch.tensor([0.0, 0.2, 0, 0, 0, 0, 0]).double()
    result = resolve(arm, q, away)
    assert float(result.velocity[1]) > 0.0 and not bool(result.held[1])
    assert result.share > 0.95


def test_a_stretched_arm_is_damped() -> None:
    arm = sawyer()
    q = torch.zeros(7, dtype=torch.float64)  # stretched out
    assert float(torch.linalg.svdvals(arm.jacobian(q)).min()) < 1e-2
    outward = torch.tensor([0.1, 0, 0, 0, 0, 0]).double()
    result = resolve(arm, q, outward, speed=100.0)
    assert float(result.velocity.norm()) < 5.0
    assert bool(torch.isfinite(result.velocity).all())


def test_bodies_of_the_robot_keep_apart() -> None:
    arm, step = sawyer(), 0.02
    checker, bare = Checker(arm, Obstacles()), Checker(arm, Obstacles(), margin=0.0)
    q, slowed = arm.home.clone(), []
    for _ in range(200):
        inwards = torch.tensor([0.0, 0.0, 0.15]).double() - arm.tip(q)[:3, 3]
        twist = torch.cat([0.2 * inwards / inwards.norm(), torch.zeros(3).double()])
        result = resolve(arm, q, twist, checker)
        q = q + step * result.velocity
        slowed.append(result.slowed)
        assert bare.free(q.numpy()[None]).all()
    assert slowed[0] == 1.0 and slowed[-1] < 0.3


def test_a_velocity_that_is_not_finite_is_refused() -> None:
    with pytest.raises(UserError, match="not finite"):
        resolve(sawyer(), sawyer().home, TWIST * torch.nan)


def test_a_twist_of_nothing_moves_nothing() -> None:
    arm = sawyer()
    result = resolve(arm, arm.home, torch.zeros(6))
    assert not bool(result.velocity.any())
    assert np.isfinite(result.share)
