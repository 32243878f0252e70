from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
import torch

from fb3d_rl.errors import UserError
from fb3d_rl.robot.arm import SPEED, sawyer
from fb3d_rl.robot.capsules import segment_distance
from fb3d_rl.robot.collision import Checker, Obstacles, bodies
from fb3d_rl.robot.inverse import precontact_poses
from fb3d_rl.robot.planning import Failure, plan
from fb3d_rl.robot.timing import rounded, timed
from fb3d_rl.robot.workspace import box, cell

CONTACT = (np.array([0.62, 0.05, 0.2]), np.array([-1.0, 0.1, 0.1]))


def cupboard() -> Obstacles:
    """The cell with the cloud of a box on the table, whose front is at x = 0.62 m."""
    spots = np.arange(-0.2, 0.201, 0.015)
    y, z = (grid.ravel() for grid in np.meshgrid(spots, spots + 0.2))
    sides = [np.stack([np.full_like(y, 0.62), y, z], 1)]
    sides += [np.stack([y + 0.82, np.full_like(y, at), z], 1) for at in (-0.2, 0.2)]
    sides.append(np.stack([y + 0.82, z - 0.2, np.full_like(y, 0.4)], 1))
    return Obstacles(cell(), np.concatenate(sides))


def fence() -> Obstacles:
    """A wall between the arm's home and what stands to its right, which the arm has to go over."""
    return Obstacles([*cell(), box((0.5, -0.2, 0.335), (0.6, 0.04, 0.7))])


def poses(point: np.ndarray, flow: np.ndarray) -> torch.Tensor:
    arm = sawyer()
    return precontact_poses(torch.as_tensor(point), torch.as_tensor(flow), arm.tip(arm.home))


def densely(path: np.ndarray) -> np.ndarray:
    """States along a path between which no point of the arm moves 1 cm."""
    pieces = []
    for a, b in zip(path[:-1], path[1:], strict=True):
        count = 2
        while True:
            states = a + np.linspace(0.0, 1.0, count)[:, None] * (b - a)
            if np.linalg.norm(np.diff(bodies(sawyer(), states), axis=0), axis=-1).max() < 0.01:
                break
            count *= 2
        pieces.append(states)
    return np.concatenate(pieces)


def touches(obstacles: Obstacles, states: np.ndarray) -> bool:
    """Whether the arm touches anything, told by many points along each body and by no part of the planner."""
    arm = sawyer()
    ends = bodies(arm, states)
    points = ends[..., :1, :] + np.linspace(0.0, 1.0, 40)[:, None] * (ends[..., 1:, :] - ends[..., :1, :])
    world = (obstacles.distance(points).min(-1) - arm.radii)[:, arm.links > 0].min()
    i, j = np.triu_indices(len(arm.links), 1)
    far = np.abs(arm.links[i] - arm.links[j]) > 2  # neighbours but one overlap by their shape
    itself = (segment_distance(ends[:, i], ends[:, j]) - arm.radii[i] - arm.radii[j])[:, far].min()
    return bool(min(world, itself) < 0.0)


@pytest.mark.parametrize(
    ("obstacles", "contact"),
    [(cupboard, CONTACT), (fence, (np.array([0.6, -0.4, 0.2]), np.array([0.0, 0.2, 1.0])))],
    ids=["cupboard", "fence"],
)
def test_a_path_leads_from_the_start_to_a_pose_before_the_contact_and_touches_nothing(obstacles, contact) -> None:
    arm, around = sawyer(), obstacles()
    found = plan(arm, around, arm.home, poses(*contact), seed=1)
    assert found.failure is None and found.path is not None
    np.testing.assert_array_equal(found.path[0], arm.home)
    torch.testing.assert_close(
        arm.tip(torch.as_tensor(found.path[-1])), poses(*contact)[found.goal], atol=2e-3, rtol=0.0
    )
    states = densely(found.path)
    assert bool(arm.within(torch.as_tensor(states)).all())
    assert not touches(around, states)
    motion = timed(arm, found.path, Checker(arm, around))
    assert not touches(around, densely(motion.positions))


def test_the_fence_is_in_the_straight_way() -> None:
    arm, around = sawyer(), fence()
    found = plan(arm, around, arm.home, poses(np.array([0.6, -0.4, 0.2]), np.array([0.0, 0.2, 1.0])), seed=1)
    assert found.path is not None and len(found.path) > 2
    assert Checker(arm, around).reach(found.path[0], found.path[-1]) < 1.0


def test_the_same_seed_gives_the_same_path_and_another_one_another() -> None:
    arm, around = sawyer(), fence()
    goal = poses(np.array([0.6, -0.4, 0.2]), np.array([0.0, 0.2, 1.0]))
    first, again, other = (plan(arm, around, arm.home, goal, seed=seed).path for seed in (3, 3, 4))
    np.testing.assert_array_equal(first, again)
    assert first.shape != other.shape or not np.array_equal(first, other)


def test_each_failure_has_its_reason_in_a_sentence() -> None:
    arm, around = sawyer(), cupboard()
    goal = poses(*CONTACT)
    inside = poses(CONTACT[0] + (0.3, 0.0, 0.0), CONTACT[1])  # 20 cm behind the front
    far = poses(np.array([2.0, 0.0, 0.5]), CONTACT[1])
    beyond = arm.upper + 0.1
    walled = Obstacles([box(arm.tip(arm.home)[:3, 3], (0.1, 0.1, 0.1))])
    plans = [
        plan(arm, around, arm.home, far),
        plan(arm, around, arm.home, inside),
        plan(arm, walled, arm.home, goal),
        plan(arm, around, beyond, goal),
        plan(arm, fence(), arm.home, poses(np.array([0.6, -0.4, 0.2]), np.array([0.0, 0.2, 1.0])), timeout=0.0),
    ]
    assert [one.failure for one in plans] == [
        Failure.UNREACHABLE, Failure.GOAL, Failure.START, Failure.START_LIMITS, Failure.TIMEOUT
    ]  # fmt: skip
    assert all(one.path is None and one.reason and one.goal == -1 for one in plans)
    assert Counter(one.failure for one in plans)["unreachable"] == 1  # counted by what a row has


def test_numbers_that_are_not_finite_are_refused_in_a_sentence() -> None:
    arm, nan = sawyer(), np.full((4, 3), np.nan)
    with pytest.raises(UserError, match=r"4x3, is not"):
        Obstacles(points=nan)
    for flow in (np.zeros(3), nan[0]):
        with pytest.raises(UserError, match="no way to approach"):
            poses(CONTACT[0], flow)
    with pytest.raises(UserError, match="joint state"):
        plan(arm, cupboard(), arm.home * np.nan, poses(*CONTACT))


def test_a_start_within_the_margin_is_no_collision() -> None:
    arm = sawyer()
    tip = arm.tip(arm.home)[:3, 3].numpy()
    near = Obstacles([box(tip + (0.0, 0.0, -0.026), (0.1, 0.1, 0.05))])  # 1 mm below the cup's opening
    assert not Checker(arm, near).free(arm.home.numpy()[None]).any()
    up = arm.tip(arm.home).clone()[None]
    up[:, 2, 3] += 0.15
    assert plan(arm, near, arm.home, up).failure is None


def test_a_motion_keeps_the_limits_of_velocity_and_acceleration_and_rests_at_its_ends() -> None:
    arm = sawyer()
    path = np.stack([arm.home, arm.home + 0.8, arm.home + torch.tensor([1.2, 0.1, 0.5, 0.2, -0.4, 0.1, 0.3])])
    motion = timed(arm, path, speed=0.7, acceleration=1.5, rate=1000.0)
    np.testing.assert_allclose(motion.positions[[0, -1]], path[[0, -1]], atol=1e-3)
    np.testing.assert_allclose(motion.velocities[[0, -1]], 0.0, atol=1e-3)
    step = motion.times[1]
    velocity = np.diff(motion.positions, axis=0) / step
    assert 0.69 < np.abs(velocity).max() < 0.7 * 1.01
    np.testing.assert_allclose(velocity, (motion.velocities[1:] + motion.velocities[:-1]) / 2, atol=0.01)
    assert 1.4 < np.abs(np.diff(motion.velocities, axis=0) / step).max() < 1.5 * 1.05
    slower = timed(arm, path, speed=0.35, acceleration=1.5)
    assert slower.duration > 1.3 * motion.duration
    assert SPEED == 1.0 and timed(arm, path[:1]).duration == 0.0


def test_a_rounded_path_cuts_corners_and_keeps_straight_pieces() -> None:
    arm = sawyer()
    straight = np.stack([arm.home, arm.home + 1.0])
    curve = rounded(straight)(np.linspace(0.0, 1.0, 50))
    way = np.ones(7) / np.sqrt(7)
    off = curve - straight[0]
    np.testing.assert_allclose(off - (off @ way)[:, None] * way, 0.0, atol=1e-12)
    bent = np.stack([*straight, arm.home + torch.tensor([2.0, 0, 0, 0, 0, 0, 0])])
    apart = np.linalg.norm(rounded(bent)(np.linspace(0.0, 1.0, 2000)) - bent[1], axis=1).min()
    assert 0.02 < apart < 0.15  # smooth, and no farther from the corner than half of what control points are apart
