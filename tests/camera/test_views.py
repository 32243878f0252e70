"""Viewpoints: where the camera stands, how it is turned, and what range views are drawn from."""

from __future__ import annotations

import numpy as np
import pytest

from fb3d_rl.camera.views import View, ViewRange, look_at

CENTRE = np.array([0.3, -0.7, 1.1])


@pytest.mark.parametrize(
    ("view", "side"),
    [
        (View(0.0, 0.0), (-1, 0, 0)),  # the front faces -x
        (View(90.0, 0.0), (0, -1, 0)),  # counter-clockwise, seen from above
        (View(-90.0, 0.0), (0, 1, 0)),
        (View(180.0, 0.0), (1, 0, 0)),
        (View(0.0, 90.0), (0, 0, 1)),
        (View(0.0, 30.0), (-np.sqrt(0.75), 0, 0.5)),
    ],
)
def test_the_camera_stands_where_the_angles_say(view: View, side: tuple[float, float, float]) -> None:
    np.testing.assert_allclose(look_at(view, CENTRE, 2.5)[:3, 3], CENTRE + 2.5 * np.array(side), atol=1e-12)


@pytest.mark.parametrize("azimuth", [-135.0, -45.0, 0.0, 20.0, 170.0])
@pytest.mark.parametrize("elevation", [-30.0, 0.0, 45.0, 89.0, 90.0])
def test_the_camera_looks_at_the_centre_and_is_upright(azimuth: float, elevation: float) -> None:
    pose = look_at(View(azimuth, elevation), CENTRE, 3.0)
    right, down, forward = pose[:3, 0], pose[:3, 1], pose[:3, 2]
    np.testing.assert_allclose(pose[:3, 3] + 3.0 * forward, CENTRE, atol=1e-12)
    np.testing.assert_allclose(pose[:3, :3].T @ pose[:3, :3], np.eye(3), atol=1e-12)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)
    assert right[2] == pytest.approx(0.0) and down[2] <= 1e-12


def test_views_are_drawn_from_the_whole_range_and_repeat() -> None:
    ranges = ViewRange((-20.0, 50.0), (10.0, 30.0))
    drawn = [ranges.sample(rng) for rng in [np.random.default_rng(0)] for _ in range(2000)]
    for angles, (low, high) in (
        ([v.azimuth for v in drawn], ranges.azimuth),
        ([v.elevation for v in drawn], ranges.elevation),
    ):
        assert low <= min(angles) < low + 0.02 * (high - low)
        assert high >= max(angles) > high - 0.02 * (high - low)
        assert np.mean(angles) == pytest.approx((low + high) / 2, abs=0.03 * (high - low))
    again = np.random.default_rng(0)
    assert drawn[:5] == [ranges.sample(again) for _ in range(5)]


def test_equal_ends_fix_the_view() -> None:
    assert ViewRange((5.0, 5.0), (30.0, 30.0)).sample(np.random.default_rng(0)) == View(5.0, 30.0)
