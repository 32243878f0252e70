"""Drawing and finding markers: what is drawn at a pose is found there."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from fb3d_rl.errors import UserError
from fb3d_rl.robot.calibration import pose_error
from fb3d_rl.robot.calibration_session import LENS
from fb3d_rl.robot.marker import Marker, draw, find, project

from .cells import chosen

Array = NDArray[np.float64]
SHAPE = (720, 1280)


def poses(count: int, seed: int = 0) -> Array:
    """T_camera_marker [count, 4, 4] in view."""
    camera, mount, flange = chosen(np.random.default_rng(seed), count)
    return np.linalg.inv(camera) @ flange @ mount


def picture(pose: Array, marker: Marker, blur: float = 0.7, seed: int = 0) -> NDArray[np.uint8]:
    drawn = cv2.GaussianBlur(draw(np.full(SHAPE, 110.0, np.float32), pose, marker, LENS), (0, 0), blur)
    return np.clip(np.rint(drawn + np.random.default_rng(seed).normal(size=SHAPE) * 3.0), 0, 255).astype(np.uint8)


def test_projection_is_that_of_opencv() -> None:
    pose = poses(1)[0]
    matrix = np.array([[LENS.fx, 0.0, LENS.cx], [0.0, LENS.fy, LENS.cy], [0.0, 0.0, 1.0]])
    corners = Marker().corners
    theirs = cv2.projectPoints(corners, cv2.Rodrigues(pose[:3, :3])[0], pose[:3, 3], matrix, None)[0]
    np.testing.assert_allclose(project(pose, corners, LENS), theirs[:, 0], atol=1e-6)


@pytest.mark.parametrize("marker", [Marker(), Marker(0.12, "5X5_100", 37), Marker(0.1, "APRILTAG_36h11", 5)])
def test_a_marker_is_found_where_it_was_drawn(marker: Marker) -> None:
    """Corners without bias: OpenCV's own refinement puts them .19 pixels inwards, and the marker 4 mm too far away."""
    off, inwards, errors = [], [], []
    for i, pose in enumerate(poses(20)):
        found = find(picture(pose, marker, seed=i), marker, LENS)
        assert found is not None
        true = project(pose, marker.corners, LENS)
        off.append(found.rays * LENS.fx + (LENS.cx, LENS.cy) - true)
        outward = (true - true.mean(0)) / np.linalg.norm(true - true.mean(0), axis=1, keepdims=True)
        inwards.append((off[-1] * outward).sum(1).mean())
        errors.append(pose_error(found.pose, pose))
    assert np.sqrt(np.square(off).mean()) < 0.04
    assert abs(np.mean(inwards)) < 0.02 and np.abs(np.mean(off, axis=(0, 1))).max() < 0.02
    assert (np.median(errors, axis=0) < (0.2, 0.0005)).all()


def test_distortion_is_taken_out() -> None:
    lens = LENS._replace(distortion=(-0.2, 0.05, 0.002, -0.001, 0.0))
    matrix = np.array([[LENS.fx, 0.0, LENS.cx], [0.0, LENS.fy, LENS.cy], [0.0, 0.0, 1.0]])
    pixels = np.stack(np.meshgrid(np.arange(1280.0), np.arange(720.0)), axis=-1).reshape(-1, 1, 2)
    straight = cv2.undistortPoints(pixels, matrix, np.array(lens.distortion), P=matrix).reshape(*SHAPE, 2)
    for pose in poses(4):
        ideal = picture(pose, Marker())
        bent = cv2.remap(
            ideal, straight[..., 0].astype(np.float32), straight[..., 1].astype(np.float32), cv2.INTER_CUBIC
        )
        found, wrong = find(bent, Marker(), lens), find(bent, Marker(), LENS)
        assert found is not None and wrong is not None
        assert pose_error(found.pose, pose)[1] < 0.002 < 0.005 < pose_error(wrong.pose, pose)[1]


def test_what_is_not_there_once_is_not_found() -> None:
    pose = poses(1)[0]
    other = pose.copy()
    other[0, 3] += 0.25 if project(pose, np.zeros((1, 3)), LENS)[0, 0] < LENS.cx else -0.25
    marker = Marker()
    blank = np.full(SHAPE, 110, np.uint8)
    assert find(blank, marker, LENS) is None
    assert find(picture(pose, Marker(id=1)), marker, LENS) is None
    twice = draw(draw(np.full(SHAPE, 110.0, np.float32), pose, marker, LENS), other, marker, LENS)
    assert find(twice.astype(np.uint8), marker, LENS) is None
    beside = draw(draw(np.full(SHAPE, 110.0, np.float32), pose, marker, LENS), other, Marker(id=1), LENS)
    found = find(beside.astype(np.uint8), marker, LENS)
    assert found is not None and pose_error(found.pose, pose)[1] < 0.002


def test_a_marker_at_the_border_or_outside_is_drawn_as_far_as_it_is_seen() -> None:
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    for x, seen in ((0.0, True), (-1.05, True), (-2.0, False)):
        pose[:3, 3] = (x, 0.0, 1.0)
        drawn = draw(np.full(SHAPE, 110.0, np.float32), pose, Marker(), LENS)
        assert drawn.shape == SHAPE and (np.abs(drawn - 110.0) > 1.0).any() == seen


@pytest.mark.parametrize(("marker", "says"), [(Marker(dictionary="4x4"), "4X4_50"), (Marker(id=50), "0 to 49")])
def test_markers_that_do_not_exist_are_refused(marker: Marker, says: str) -> None:
    with pytest.raises(UserError, match=says):
        find(np.zeros(SHAPE, np.uint8), marker, LENS)
