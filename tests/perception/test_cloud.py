"""Clouds of exactly N points."""

from __future__ import annotations

import numpy as np

from fb3d_rl.perception.cloud import sample_cloud


def test_draws_exactly_n_without_repeats() -> None:
    points = np.arange(300.0).reshape(100, 3)
    links = np.arange(100)
    cloud, ids = sample_cloud(points, links, 40, np.random.default_rng(0))
    assert cloud.shape == (40, 3) and len(set(ids.tolist())) == 40
    assert np.array_equal(cloud, points[ids].astype(np.float32)), "each point keeps its link"
    assert not np.array_equal(ids, np.sort(ids)), "the order is random: balls keep the first points by index"


def test_pads_and_marks_what_is_missing() -> None:
    cloud, ids = sample_cloud(np.ones((5, 3)), np.full(5, 2), 8, np.random.default_rng(0))
    assert (ids >= 0).sum() == 5 and np.array_equal(cloud[ids < 0], np.zeros((3, 3)))
    cloud, ids = sample_cloud(np.zeros((0, 3)), np.zeros(0, dtype=np.int64), 4, np.random.default_rng(0))
    assert np.array_equal(cloud, np.zeros((4, 3))) and (ids == -1).all()


def test_every_point_and_every_order_is_as_likely() -> None:
    links, rng, runs = np.arange(6), np.random.default_rng(0), 4000
    drawn = np.stack([sample_cloud(np.zeros((6, 3)), links, 3, rng)[1] for _ in range(runs)])
    for place in range(3):
        np.testing.assert_allclose(np.bincount(drawn[:, place], minlength=6) / runs, 1 / 6, atol=0.03)


def test_is_repeatable() -> None:
    points, links = np.random.default_rng(1).random((50, 3)), np.zeros(50, dtype=np.int64)
    first, _ = sample_cloud(points, links, 20, np.random.default_rng(7))
    second, _ = sample_cloud(points, links, 20, np.random.default_rng(7))
    assert np.array_equal(first, second)
