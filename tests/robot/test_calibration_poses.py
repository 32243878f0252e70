"""Poses to calibrate from: reachable, in view, and turned about axes as different as can be."""

from __future__ import annotations

import numpy as np
import pytest

from fb3d_rl.errors import UserError
from fb3d_rl.robot.calibration_poses import _candidates, choose_poses, in_view, within
from fb3d_rl.robot.calibration_session import LENS, REACH
from fb3d_rl.robot.hand_eye import turning
from fb3d_rl.robot.marker import project

from .cells import MARKER, Array, camera_and_mount, chosen


@pytest.mark.parametrize("seed", range(5))
def test_chosen_poses_are_reachable_and_in_view_from_the_real_camera(seed: int) -> None:
    camera, mount, flange = chosen(np.random.default_rng(seed))
    assert len(flange) == 30 and all(map(REACH, flange))
    seen = np.linalg.inv(camera) @ flange @ mount
    pixels = project(seen, MARKER.corners, LENS)
    assert (pixels > 0.05 * 720).all() and (pixels < (0.95 * 1280, 0.95 * 720)).all()
    assert in_view(seen, MARKER, LENS).all()
    sides = np.linalg.norm(pixels - np.roll(pixels, 1, axis=1), axis=-1)
    assert sides.max(1).min() > 30
    np.testing.assert_array_equal(chosen(np.random.default_rng(seed))[2], flange)


def test_they_turn_further_and_are_spread_wider_than_random_ones() -> None:
    rng = np.random.default_rng(0)
    camera, mount, flange = chosen(rng)
    random = camera @ _candidates(MARKER, LENS, rng) @ np.linalg.inv(mount)
    random = np.stack([pose for pose in random if REACH(pose)])
    draws = [random[rng.choice(len(random), 30, replace=False)] for _ in range(30)]

    def spread(poses: Array) -> float:
        return float(np.linalg.svd(poses[:, :3, 3] - poses[:, :3, 3].mean(0), compute_uv=False)[2])

    assert (turning(flange)[1:] > 1.1 * np.max([turning(draw) for draw in draws], axis=0)[1:]).all()
    assert spread(flange) > np.median([spread(draw) for draw in draws])


def test_a_marker_behind_tilted_away_too_small_or_outside_is_not_in_view() -> None:
    seen = np.tile(np.diag([1.0, -1.0, -1.0, 1.0]), (6, 1, 1))
    seen[:, 2, 3] = (1.0, -1.0, 1.0, 2.0, 1.0, 1.0)
    seen[2, :3, :3] = np.eye(3)  # faces away
    seen[4, 0, 3] = 1.03  # partly outside
    seen[5, :3, :3] = [[1.0, 0.0, 0.0], [0.0, -0.1, 0.995], [0.0, -0.995, -0.1]]  # edge on
    assert in_view(seen, MARKER, LENS).tolist() == [True, False, False, False, False, False]


def test_poses_out_of_reach_are_told() -> None:
    rng = np.random.default_rng(0)
    camera, mount = camera_and_mount(rng)
    asked: list[Array] = []

    def three(flange: Array) -> bool:
        asked.append(flange)
        return len(asked) <= 3

    with pytest.raises(UserError, match="only 3 of 30"):
        choose_poses(30, camera, mount, MARKER, LENS, three, rng)
    with pytest.raises(UserError, match="only 0 of 1 "):
        choose_poses(1, camera, mount, MARKER, LENS, within(0.0, 0.1, 0.0), rng)


def test_the_arm_is_asked_about_poses_that_are_taken_only() -> None:
    rng = np.random.default_rng(0)
    camera, mount = camera_and_mount(rng)
    asked: list[Array] = []
    flange = choose_poses(10, camera, mount, MARKER, LENS, lambda pose: not asked.append(pose), rng)
    np.testing.assert_array_equal(np.stack(asked), flange)
