"""A cup's velocity: its place comes before its tilt, and both before the joints' comfort."""

from __future__ import annotations

import pytest
import torch

from fb3d_rl.errors import UserError
from fb3d_rl.robot.arm import sawyer
from fb3d_rl.robot.velocity import resolve_cup


def test_a_cup_moves_and_turns_as_asked_where_the_arm_can() -> None:
    arm = sawyer()
    velocity, turn = torch.tensor([0.03, -0.02, 0.04]), torch.tensor([0.1, 0.2, -0.1])
    found = resolve_cup(arm, arm.home, velocity, turn)
    twist = arm.jacobian(arm.home) @ found.velocity
    torch.testing.assert_close(twist[:3], velocity.double(), atol=1e-3, rtol=0.0)
    torch.testing.assert_close(twist[3:], turn.double(), atol=0.02, rtol=0.0)
    assert found.share == pytest.approx(1.0, abs=0.02) and not found.held.any()


def test_a_turn_that_is_too_fast_gives_way_and_the_place_does_not() -> None:
    arm = sawyer()
    velocity, turn = torch.tensor([0.0, 0.0, 0.05]), torch.tensor([8.0, 0.0, 0.0])
    found = resolve_cup(arm, arm.home, velocity, turn)
    twist = arm.jacobian(arm.home) @ found.velocity
    torch.testing.assert_close(twist[:3], velocity.double(), atol=3e-3, rtol=0.0)
    assert 0.1 < float(twist[3]) < 8.0
    assert float((found.velocity.abs() - arm.velocity.clamp_max(1.0)).max()) < 1e-9


def test_a_number_that_is_none_is_refused() -> None:
    arm = sawyer()
    with pytest.raises(UserError, match="not finite"):
        resolve_cup(arm, arm.home, torch.full((3,), torch.nan), torch.zeros(3))
