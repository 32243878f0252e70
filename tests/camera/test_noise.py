"""The errors of a depth camera: each term against its statistics, alone and beside the others."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from fb3d_rl.camera.noise import AZURE_KINECT, EXACT, PRESETS, STEREO, TERMS, DepthNoiseOptions, incidence, measured
from fb3d_rl.errors import UserError

TICKS = (np.arange(300) - 149.5) / 504.0
"""About an Azure Kinect's pixels."""


def plane(depth: float = 1.0, tilt: float = 0.0) -> NDArray[np.float64]:
    """Depth of a plane that is turned about the image's vertical by an angle (rad)."""
    inverse = (np.sin(tilt) * TICKS + np.cos(tilt)) / (depth * np.cos(tilt))
    return np.tile(1.0 / inverse, (len(TICKS), 1))


def steps() -> NDArray[np.float64]:
    """A wall at 1.2 m with a box of 100 x 100 pixels before it at 0.9 m, and a corner in which nothing is."""
    depth = plane(1.2)
    depth[100:200, 100:200] = 0.9
    depth[:40, :40] = 0.0
    return depth


def only(*terms: str, **further: Any) -> DepthNoiseOptions:
    values: dict[str, Any] = {**dict.fromkeys(terms, True), **further}
    return replace(EXACT, **values)


def shot(depth: NDArray[Any], options: DepthNoiseOptions, seed: int = 0, **further: Any) -> Any:
    return measured(depth, TICKS, TICKS, options, seed, **further)


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_without_terms_no_bit_changes(kind: Any) -> None:
    depth = steps().astype(kind)
    seen = shot(depth, EXACT, bodies=np.zeros(depth.shape, dtype=np.int64))
    assert seen.depth.dtype == kind and seen.depth.tobytes() == depth.tobytes()
    pixels = np.arange(depth.size).reshape(depth.shape)
    np.testing.assert_array_equal(seen.source, np.where(depth > 0, pixels, -1))


@pytest.mark.parametrize("preset", ["azure_kinect", "stereo"])
def test_same_seed_and_frame_same_bits_and_others_not(preset: str) -> None:
    bodies = (steps() < 1.0).astype(np.int64)
    first, again, frame, seed = (
        shot(steps(), PRESETS[preset], number, frame=image, bodies=bodies).depth
        for number, image in ((4, 1), (4, 1), (4, 2), (5, 1))
    )
    np.testing.assert_array_equal(first, again)
    for other in (frame, seed):
        assert (other != first).mean() > 0.5


@pytest.mark.parametrize("tilt", [0.0, 0.5, 1.0])
def test_the_incidence_on_a_plane_is_exact(tilt: float) -> None:
    ray = np.sqrt(TICKS[None] ** 2 + TICKS[:, None] ** 2 + 1.0)
    expected = np.abs(np.sin(tilt) * TICKS[None] + np.cos(tilt)) / ray
    np.testing.assert_allclose(incidence(plane(1.3, tilt), TICKS, TICKS), expected, atol=1e-9)
    turned = incidence(plane(1.3, tilt).T.copy(), TICKS, TICKS)
    np.testing.assert_allclose(turned, expected.T, atol=1e-9)


def test_bias_is_a_line_in_depth_that_a_session_keeps() -> None:
    depth = plane(1.5, 1.0)
    errors = [shot(depth, only("bias"), seed, frame=frame).depth - depth for seed in range(200) for frame in (0, 7)]
    lines = np.array([np.polyfit(depth.ravel(), error.ravel(), 1) for error in errors[:40]])
    for line, error in zip(lines, errors, strict=False):
        np.testing.assert_allclose(error, np.polyval(line, depth), atol=1e-9)
    np.testing.assert_array_equal(errors[0], errors[1])
    middle = np.array([error[150, 150] for error in errors[::2]])
    largest = 0.005 + 0.001 * depth[150, 150]
    assert np.abs(middle).max() <= largest and np.abs(middle).max() > 0.8 * largest
    assert middle.std() == pytest.approx(np.hypot(0.005, 0.001 * depth[150, 150]) / np.sqrt(3.0), rel=0.15)


@pytest.mark.parametrize("z, tilt", [(0.6, 0.0), (1.0, 0.0), (2.0, 0.0), (1.0, 1.0), (1.0, 0.6)])
@pytest.mark.parametrize("options", [AZURE_KINECT, STEREO], ids=["azure_kinect", "stereo"])
def test_axial_noise_has_the_size_of_its_formula(options: DepthNoiseOptions, z: float, tilt: float) -> None:
    depth = plane(z, tilt)
    error = shot(depth, only("axial", axial_sigma=options.axial_sigma)).depth - depth
    a, b, c = options.axial_sigma
    sigma = (a + b * depth + c * depth**2) / np.maximum(incidence(depth, TICKS, TICKS), 0.2)
    share = error / sigma
    assert share.std() == pytest.approx(1.0, rel=0.02) and abs(share.mean()) < 0.02
    assert abs(np.corrcoef(share[:, 1:].ravel(), share[:, :-1].ravel())[0, 1]) < 0.02


def test_stereo_is_worse_at_edges_and_with_the_square_of_the_depth() -> None:
    depth = steps()
    error = np.abs(shot(depth, only("axial", axial_sigma=STEREO.axial_sigma, axial_edge=0.041)).depth - depth)
    at_edge = np.zeros(depth.shape, dtype=bool)
    at_edge[99:201, 99:201], at_edge[101:199, 101:199] = True, False
    assert error[at_edge].mean() > 4 * error[120:180, 120:180].mean()
    wide, near = (shot(plane(z), only("axial", axial_sigma=STEREO.axial_sigma)).depth.std() for z in (3.0, 1.0))
    assert wide == pytest.approx((1.63 + 0.73 * 3 + 3.95 * 9) / (1.63 + 0.73 + 3.95) * near, rel=0.03)


def test_lateral_noise_sees_a_neighbour() -> None:
    depth = plane(1.0, 0.5)
    seen = shot(depth, only("lateral"))
    np.testing.assert_array_equal(seen.depth, depth.ravel()[seen.source])
    row, column = np.divmod(seen.source, depth.shape[1])
    off = np.stack([row - np.arange(300)[:, None], column - np.arange(300)])[:, 5:-5, 5:-5]
    moved = 0.3173  # |N(0, .5)| > .5
    assert (off != 0).mean() == pytest.approx(moved, rel=0.03) and np.abs(off).max() <= 3


def test_flying_pixels_lie_between_the_two_sides_of_an_edge_only() -> None:
    depth = steps()
    seen = shot(depth, only("flying"))
    flies = (seen.source < 0) & (depth > 0)
    np.testing.assert_array_equal(seen.depth[~flies], depth[~flies])
    band = np.zeros(depth.shape, dtype=bool)
    band[99:201, 99:201], band[101:199, 101:199] = True, False
    assert not flies[~band].any() and flies[band].mean() == pytest.approx(0.3, abs=0.05)
    where = (seen.depth[flies] - 0.9) / 0.3
    assert where.min() >= 0.0 and where.max() <= 1.0 and where.std() == pytest.approx(12**-0.5, rel=0.15)


def test_holes_are_at_edges_only_those_to_nothing_too() -> None:
    depth = steps()
    seen = shot(depth, only("holes", holes_share=1.0))
    lost = (seen.depth == 0) & (depth > 0)
    band = np.zeros(depth.shape, dtype=bool)
    band[99:201, 99:201], band[101:199, 101:199] = True, False
    band[:41, :41] |= depth[:41, :41] > 0
    np.testing.assert_array_equal(lost, band)
    some = shot(depth, only("holes")).depth == 0
    assert some[band].mean() == pytest.approx(0.3, abs=0.05)


def test_a_slanted_surface_is_no_edge_and_a_grazing_one_is_lost() -> None:
    slanted = plane(1.0, 1.3)[:, 150:]  # 75 degrees: neighbours are further apart than the step of an edge
    ticks = TICKS[150:]
    assert np.abs(np.diff(slanted, axis=1)).max() < 0.02 < np.ptp(slanted)
    both = measured(slanted, ticks, TICKS, only("flying", "holes", flying_share=1.0, holes_share=1.0), 0)
    np.testing.assert_array_equal(both.depth, slanted)
    lost = measured(slanted, ticks, TICKS, only("grazing"), 0).depth == 0
    np.testing.assert_array_equal(lost, incidence(slanted, ticks, TICKS) < 0.2)
    flat = measured(plane(1.0, 1.5)[:, 150:170], TICKS[150:170], TICKS, only("grazing"), 0).depth
    assert not flat[:, :5].any()


def test_some_bodies_are_dark_for_a_session_and_lost_in_patches() -> None:
    depth = plane(1.0)
    bodies = np.repeat(np.arange(10), 30)[None].repeat(300, 0)
    dark, lost = [], []
    for seed in range(60):
        invalid = shot(depth, only("dark"), seed, bodies=bodies).depth == 0
        other = shot(depth, only("dark"), seed, frame=1, bodies=bodies).depth == 0
        shares = np.array([invalid[bodies == body].mean() for body in range(10)])
        np.testing.assert_array_equal(shares > 0, [other[bodies == body].any() for body in range(10)])
        dark.append((shares > 0).mean())
        lost.extend(shares[shares > 0])
        if (shares > 0).any():
            strip = invalid[:, bodies[0] == shares.argmax()]
            assert (strip[1:] == strip[:-1]).mean() > 0.7, "patches: neighbours are lost together"
    assert np.mean(dark) == pytest.approx(0.1, abs=0.03) and np.mean(lost) == pytest.approx(0.5, abs=0.05)
    assert shot(depth, only("dark", dark_bodies=1.0)).depth.all(), "without bodies nothing is dark"


def test_rounding_and_limits() -> None:
    depth = plane(2.0, 1.1)
    rounded = shot(depth, only("rounding")).depth
    np.testing.assert_allclose(rounded * 1000, np.rint(rounded * 1000), atol=1e-9)
    assert np.abs(rounded - depth).max() <= 0.0005 + 1e-12
    cut = shot(depth, only("limits", near=1.8, far=2.3)).depth
    inside = (depth >= 1.8) & (depth <= 2.3)
    np.testing.assert_array_equal(cut, np.where(inside, depth, 0.0))
    assert 0.1 < inside.mean() < 0.9


@pytest.mark.parametrize("term", TERMS)
def test_a_term_does_not_change_what_the_others_draw(term: str) -> None:
    bodies = (steps() < 1.0).astype(np.int64)
    every = replace(AZURE_KINECT, dark_bodies=0.6)
    values: dict[str, Any] = {term: False}
    both = [shot(steps(), options, 11, bodies=bodies).depth for options in (every, replace(every, **values))]
    same = np.abs(both[0] - both[1]) < {"bias": 0.0075, "axial": 0.01, "rounding": 0.0006}.get(term, 1e-12)
    assert same.mean() > (0.4 if term in ("lateral", "dark") else 0.95)


def test_the_kinect_stays_within_its_makers_bounds() -> None:
    for z in (0.6, 1.0, 2.0, 3.5):
        shots = np.stack([shot(plane(z), AZURE_KINECT, seed).depth[100:200, 100:200] for seed in range(40)])
        assert (shots > 0).all()
        assert shots.std((1, 2)).max() <= 0.017 and np.abs(shots.mean((1, 2)) - z).max() < 0.011 + 0.001 * z


def test_a_wrong_option_is_one_sentence() -> None:
    with pytest.raises(UserError, match="holes_share=2 is out of range; give a number from 0 to 1"):
        DepthNoiseOptions(holes_share=2)
