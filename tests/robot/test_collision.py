from __future__ import annotations

import numpy as np
import pytest
import torch

from fb3d_rl.geometry.transforms import axis_angle_to_matrix, normalize
from fb3d_rl.robot.arm import panda, sawyer
from fb3d_rl.robot.capsules import segment_distance
from fb3d_rl.robot.collision import Box, Checker, Obstacles, bodies, box_distance
from fb3d_rl.robot.workspace import SIZE, TABLE, box, cell

SHARES = np.linspace(0.0, 1.0, 201)


def along(ends: np.ndarray) -> np.ndarray:
    """Points [..., 201, 3] of segments [..., 2, 3]."""
    return ends[..., None, 0, :] + SHARES[:, None] * (ends[..., None, 1, :] - ends[..., None, 0, :])


def states(arm, count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(arm.lower, arm.upper, (count, len(arm.joints)))


def test_distances_between_segments_are_those_of_their_nearest_points() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(2, 60, 2, 3))
    a[:10, 1] = a[:10, 0]  # points
    b[5:15, 1] = b[5:15, 0]
    b[15:25] = a[15:25] + rng.normal(size=(10, 1, 3))  # parallel
    between = np.linalg.norm(along(a)[:, :, None] - along(b)[:, None], axis=-1).min((1, 2))
    apart = segment_distance(a, b)
    assert (apart <= between + 1e-12).all()
    assert (apart >= between - 0.03).all()  # half the points' spacing
    np.testing.assert_allclose(apart, segment_distance(b[:, ::-1], a), atol=1e-12)
    crossing = np.array([[[-1.0, 0, 0], [1, 0, 0]], [[0, -1.0, 0], [0, 1, 0]]])
    assert segment_distance(crossing[0], crossing[1]) == 0.0


def test_distances_from_a_box_are_those_from_its_surface() -> None:
    rng = np.random.default_rng(1)
    pose = np.eye(4)
    pose[:3, :3] = axis_angle_to_matrix(normalize(torch.tensor([1.0, 2.0, -1.0]).double()), torch.tensor(0.7)).numpy()
    pose[:3, 3] = (0.3, -0.2, 0.5)
    size = np.array([0.4, 0.2, 0.6])
    grid = np.stack(np.meshgrid(*[np.linspace(-0.5, 0.5, 41)] * 3, indexing="ij"), -1).reshape(-1, 3)
    surface = (grid[np.isclose(np.abs(grid).max(1), 0.5)] * size) @ pose[:3, :3].T + pose[:3, 3]
    points = rng.uniform(-0.3, 1.0, (300, 3))
    inside = (np.abs((points - pose[:3, 3]) @ pose[:3, :3]) < size / 2).all(1)
    brute = np.linalg.norm(points[:, None] - surface, axis=-1).min(1) * np.where(inside, -1, 1)
    assert inside.any()
    np.testing.assert_allclose(box_distance(points, Box(pose, size)), brute, atol=0.01)


def test_the_clearance_of_a_body_is_never_more_than_its_distance_and_little_less() -> None:
    arm, rng = sawyer(), np.random.default_rng(2)
    obstacles = Obstacles([box((0.7, 0.3, 0.2), (0.3, 0.2, 0.4))], rng.uniform((0.3, -0.5, 0), (0.9, 0, 0.6), (300, 3)))
    q = states(arm, 120)
    checker = Checker(arm, obstacles, margin=0.0)
    brute = obstacles.distance(along(bodies(arm, q))).min(-1) - arm.radii
    moving = arm.links > 0
    world = checker.clearance(q).world[:, moving]
    radii = np.broadcast_to(arm.radii[moving], world.shape)
    assert (world <= brute[:, moving] + 1e-6)[brute[:, moving] > -radii].all()
    assert (world < 0.0)[brute[:, moving] < 0.0].all()
    touching = (brute[:, moving] < 0.05) & (brute[:, moving] > -0.1 * radii)
    assert touching.sum() > 30
    assert (world > brute[:, moving] - 0.04 * radii)[touching].all()


def test_a_margin_is_taken_off_all_distances() -> None:
    arm = sawyer()
    obstacles, q = Obstacles(cell()), states(arm, 5)
    bare, wide = (Checker(arm, obstacles, margin).clearance(q) for margin in (0.0, 0.02))
    np.testing.assert_allclose(bare.itself - 0.02, wide.itself)
    np.testing.assert_allclose(bare.world - 0.02, wide.world)


@pytest.mark.parametrize("arm", [sawyer, panda], ids=["sawyer", "panda"])
def test_an_arm_at_home_is_free_in_the_cell_and_none_that_folds_into_itself(arm) -> None:
    arm = arm()
    checker = Checker(arm, Obstacles(cell()))
    assert checker.free(arm.home.numpy()[None]).all()
    itself = Checker(arm, Obstacles()).free(states(arm, 300))
    assert 0.5 < itself.mean() < 1.0


def test_a_cup_in_the_robots_own_base_is_a_collision() -> None:
    arm = sawyer()
    q = states(arm, 20000, 3)
    tips = arm.tip(torch.as_tensor(q))[:, :3, 3].numpy()
    inside = (np.linalg.norm(tips[:, :2], axis=1) < 0.06) & (tips[:, 2] > 0.05) & (tips[:, 2] < 0.2)
    assert inside.sum() > 2
    assert not Checker(arm, Obstacles()).free(q[inside]).any()


def test_a_thin_wall_between_two_free_states_stops_the_motion_before_it() -> None:
    arm = sawyer()
    start = arm.home.numpy().copy()
    goal = start.copy()
    start[0], goal[0] = -0.9, 0.9
    across = torch.as_tensor((start + goal) / 2)
    tip = arm.tip(across)[:3, 3].numpy()
    checker = Checker(arm, Obstacles([box(tip, (0.02, 0.002, 0.02))]), margin=0.0)
    assert checker.free(np.stack([start, goal])).all()
    share = checker.reach(start, goal)
    assert 0.2 < share < 0.6
    assert Checker(arm, Obstacles(), 0.0).reach(start, goal) == 1.0
    fine = start + np.linspace(0.0, share, 400)[:, None] * (goal - start)
    assert checker.free(fine).all()


def test_what_is_said_to_be_reached_is_free_all_the_way() -> None:
    arm, rng = sawyer(), np.random.default_rng(5)
    obstacles = Obstacles(cell(), rng.uniform((0.5, -0.3, 0.0), (0.9, 0.3, 0.4), (400, 3)))
    checker, bare = Checker(arm, obstacles), Checker(arm, obstacles, margin=0.0)
    q = states(arm, 30, 7)
    q = q[checker.free(q)]
    stopped = 0
    for start, goal in zip(q[:-1], q[1:], strict=True):
        share = checker.reach(start, goal)
        stopped += share < 1.0
        fine = start + np.linspace(0.0, share, 600)[:, None] * (goal - start)
        assert bare.free(fine).all()
    assert 0 < stopped


def test_the_beams_stand_around_the_workspace_on_the_table() -> None:
    boxes = cell()
    corners = np.array([[x, y, 0.2] for x in (-0.49, 0.49) for y in (-0.53, 0.53)]) * (*SIZE, 1) / (1.0, 1.08, 1)
    free = Obstacles(boxes).distance(corners + (0.7, 0.0, 0.0))
    assert (free > 0.0).all()
    assert Obstacles(boxes).distance(np.array([0.7, 0.0, TABLE + 0.1])) == pytest.approx(0.1)
    assert Obstacles(boxes).distance(np.array([0.7, 0.0, TABLE - 0.01])) < 0.0
