"""Hand-eye calibration against transforms that are known."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from fb3d_rl.errors import UserError
from fb3d_rl.robot.calibration import pose_error
from fb3d_rl.robot.calibration_session import LENS
from fb3d_rl.robot.hand_eye import HandEye, calibrate, park_martin, turning
from fb3d_rl.robot.marker import project

from .cells import MARKER, Array, camera_and_mount, chosen, small, turned_by

DEGREES, METRES = 0.3, 0.001
"""Noise of the marker's pose along each axis."""


def rays_of(seen: Array) -> Array:
    """Corners [N, 4, 2] in the image of markers at T_camera_marker [N, 4, 4]."""
    return (project(seen, MARKER.corners, LENS) - (LENS.cx, LENS.cy)) / LENS.fx


def rms(values: list[tuple[float, float]]) -> Array:
    return np.sqrt(np.square(values).mean(0))


def noisy(seed: int, turn: float | None = None) -> tuple[Array, Array, Array]:
    """T_base_camera, and 30 samples T_base_flange and T_camera_marker with the noise of the requirement."""
    rng = np.random.default_rng(seed)
    if turn is None:
        camera, mount, flange = chosen(rng)
    else:
        (camera, mount), flange = camera_and_mount(rng), turned_by(rng, turn)
    seen = np.linalg.inv(camera) @ flange @ mount @ small(rng, 30, DEGREES, METRES)
    return camera, flange @ small(rng, 30, 0.02, 0.0002), seen


@pytest.mark.parametrize("corners", [False, True])
def test_without_noise_both_transforms_are_found(corners: bool) -> None:
    camera, mount, flange = chosen(np.random.default_rng(0), 12)
    seen = np.linalg.inv(camera) @ flange @ mount
    given = (rays_of(seen), MARKER.corners) if corners else ()
    found = calibrate(flange, seen, *given)
    np.testing.assert_allclose(found.camera, camera, atol=1e-8)
    np.testing.assert_allclose(found.marker, mount, atol=1e-8)
    assert found.rotation_errors.max() < 1e-5 and found.position_errors.max() < 1e-8 and not found.outliers.any()


def test_thirty_noisy_samples_give_two_tenths_of_a_degree_and_two_millimetres() -> None:
    errors = []
    for seed in range(25):
        camera, flange, seen = noisy(seed)
        errors.append(pose_error(calibrate(flange, seen).camera, camera))
    turn, shift = np.median(errors, axis=0)
    assert turn <= 0.2 and shift <= 0.002


def test_refinement_betters_the_closed_form_at_small_turns() -> None:
    closed, refined = [], []
    for seed in range(15):
        camera, flange, seen = noisy(seed, turn=15.0)
        closed.append(pose_error(park_martin(flange, seen)[0], camera))
        refined.append(pose_error(calibrate(flange, seen).camera, camera))
    assert (2.0 * np.median(refined, axis=0) < np.median(closed, axis=0)).all()


@pytest.mark.parametrize("corners", [False, True])
def test_standard_errors_are_those_that_happen(corners: bool) -> None:
    """The robot's error moves all corners of a sample together; were each its own, half of it would be said."""
    errors, told = [], []
    point = np.array([0.1, 0.0, 1.0])
    points: list[tuple[float, float]] = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        camera, mount, flange = chosen(rng)
        seen = np.linalg.inv(camera) @ flange @ small(rng, 30, 0.05, 0.0005) @ mount
        if corners:
            rays = rays_of(seen) + 0.05 / LENS.fx * rng.normal(size=(30, 4, 2))
            found = calibrate(flange, seen, rays, MARKER.corners)
        else:
            found = calibrate(flange, seen @ small(rng, 30, 0.3, 0.001))
        errors.append(pose_error(found.camera, camera))
        told.append((found.rotation_error, found.position_error))
        off = (found.camera - camera) @ np.append(point, 1.0)
        points.append((float(np.linalg.norm(off)), found.point_error(point)))
    ratios = np.append(rms(errors) / rms(told), np.divide(*rms(points)))
    assert (0.7 < ratios).all() and (ratios < 1.4).all()


@pytest.mark.parametrize("corners", [False, True])
def test_wrong_samples_are_named_and_do_not_count(corners: bool) -> None:
    errors = []
    for seed in range(5):
        camera, flange, seen = noisy(seed)
        rays = rays_of(seen)
        wrong = [3, 11, 20, 21, 28]
        flange[wrong] = flange[np.roll(wrong, 1)]
        given = (rays, MARKER.corners) if corners else ()
        found = calibrate(flange, seen, *given)
        assert np.flatnonzero(found.outliers).tolist() == wrong
        errors.append(pose_error(found.camera, camera))
    assert (np.median(errors, axis=0) <= (0.2, 0.002)).all()


def test_flipped_markers_do_not_count_beside_corners() -> None:
    """The second pose that four corners leave is mirrored about the line of sight; corners know nothing of it."""
    camera, mount, flange = chosen(np.random.default_rng(1))
    seen = np.linalg.inv(camera) @ flange @ mount
    rays = rays_of(seen)
    for i in (0, 7, 19):
        turn, shift = cv2.solvePnPGeneric(MARKER.corners, rays[i], np.eye(3), None, flags=cv2.SOLVEPNP_IPPE_SQUARE)[1:3]
        seen[i, :3, :3], seen[i, :3, 3] = cv2.Rodrigues(turn[1])[0], shift[1].ravel()
    found = calibrate(flange, seen, rays, MARKER.corners)
    np.testing.assert_allclose(found.camera, camera, atol=1e-6)


def test_turning_tells_axes_apart() -> None:
    rng = np.random.default_rng(0)
    one, all_ = turned_by(rng, 30.0, axes=0.0), turned_by(rng, 30.0)
    np.testing.assert_allclose(turning(one)[1:], 0.0, atol=1e-5)
    assert (turning(all_) > 15.0).all()
    # The same in every frame.
    base = small(rng, 1, 90.0, 1.0)[0]
    np.testing.assert_allclose(turning(base @ all_), turning(all_))


@pytest.mark.parametrize(
    ("turn", "axes", "count", "says"),
    [
        (30.0, 0.0, 30, "one axis"),
        (30.0, 0.03, 30, "one axis"),
        (2.0, 1.0, 30, "hardly turn"),
        (30.0, 1.0, 4, "too few"),
    ],
)
def test_samples_that_determine_nothing_are_refused(turn: float, axes: float, count: int, says: str) -> None:
    rng = np.random.default_rng(0)
    (camera, mount), flange = camera_and_mount(rng), turned_by(rng, turn, count, axes)
    with pytest.raises(UserError, match=says):
        calibrate(flange, np.linalg.inv(camera) @ flange @ mount)


def test_unusable_arrays_are_refused() -> None:
    _, flange, seen = noisy(0)
    with pytest.raises(UserError, match="equally many"):
        calibrate(flange, seen[1:])
    seen[4, 0, 3] = np.nan
    with pytest.raises(UserError, match="not finite"):
        calibrate(flange, seen)


@pytest.mark.skipif(not hasattr(cv2, "calibrateHandEye"), reason="OpenCV 5.0.0 has no calibrateHandEye")
def test_the_closed_form_is_that_of_opencv() -> None:
    for seed in range(5):
        camera, flange, seen = noisy(seed)
        inverse = np.linalg.inv(flange)
        rotation, shift = cv2.calibrateHandEye(
            inverse[:, :3, :3], inverse[:, :3, 3], seen[:, :3, :3], seen[:, :3, 3], method=cv2.CALIB_HAND_EYE_PARK
        )
        theirs = np.eye(4)
        theirs[:3, :3], theirs[:3, 3] = rotation, shift.ravel()
        turn, metres = pose_error(park_martin(flange, seen)[0], theirs)
        # Not to the last bit: pairs whose two angles disagree do not count here.
        assert turn < 0.1 and metres < 0.002
        refined: HandEye = calibrate(flange, seen)
        assert sum(pose_error(refined.camera, camera)) < sum(pose_error(theirs, camera))
