"""Simulated test sets: 95 % intervals hold the truth that the sets were drawn from, and are no wider than need be."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from fb3d_rl.evaluation.intervals import UNIT, limits, wilson

Array = NDArray[np.float64]

CATEGORIES = {
    "ours": (6, 3, 4, 2, 1, 5, 4, 1, 7, 2, 8, 1, 4, 18, 1, 1),
    "even": (4,) * 5,
    "one to eight": (1, 1, 2, 2, 3, 4, 5, 6, 8, 8),
    "one is large": (40, 2, 2, 2, 2),
    "three": (6, 6, 6),
    "pairs": (2,) * 11,
    "one each": (1,) * 12,
}
"""Test sets as numbers of objects of each category."""


def drawn(rng: np.random.Generator, mean: Array | float, correlation: float, shape: tuple[int, int]) -> Array:
    """Rates of a beta distribution with this mean, of which two draws of one rate correlate so much."""
    if correlation == 0:
        return np.broadcast_to(mean, shape)
    more = 1 / correlation - 1
    return rng.beta(np.maximum(np.multiply(mean, more), 1e-9), np.maximum((1 - np.asarray(mean)) * more, 1e-9), shape)


def tried(rng: np.random.Generator, rates: Array, trials: int | None) -> Array:
    """Share of each object's trials that succeed; of 1 to 5 trials where ``trials`` is None."""
    counts = rng.integers(1, 6, rates.shape) if trials is None else np.full(rates.shape, trials)
    return rng.binomial(counts, rates) / counts


def equal(n: int) -> Array:
    return np.full(n, 1 / n)


def held(ends: tuple[Array, Array], truth: Array | float) -> float:
    low, high = ends
    return float(np.mean((low <= truth + 1e-12) & (truth <= high + 1e-12)))


def success_coverage(
    numbers: Sequence[int], rates: Sequence[float], correlations: Sequence[float], sets: int, least: float
) -> None:
    """Holds the intervals of success rates to ``least``, and their width to Wilson's of the objects."""
    rng = np.random.default_rng(0)
    for n in numbers:
        for rate in rates:
            for trials in (1, 2, 5, None):
                for correlation in correlations if trials != 1 else (0.0,):
                    values = tried(rng, drawn(rng, rate, correlation, (sets, n)), trials)
                    low, high = limits(values, equal(n), UNIT, share=True)
                    case = (n, rate, trials, correlation)
                    assert held((low, high), rate) >= least, case
                    lower, upper = wilson(values.mean(1), n)
                    assert (low <= lower + 1e-12).all() and (high >= upper - 1e-12).all(), case
                    assert np.mean(high - low) < 1.3 * np.mean(upper - lower), case


def test_success_intervals_hold_the_true_rate() -> None:
    success_coverage((10, 20, 72, 100), (0.5, 0.9, 0.97, 0.99), (0.0, 0.3), sets=1500, least=0.94)


@pytest.mark.slow
def test_success_intervals_hold_the_true_rate_in_all_cases() -> None:
    numbers = (5, 8, 10, 11, 15, 20, 30, 50, 72, 100)
    rates = (0.5, 0.55, 0.6, 0.65, 0.7, 0.75, 0.8, 0.85, 0.9, 0.93, 0.95, 0.96, 0.97, 0.98, 0.985, 0.99)
    success_coverage(numbers, rates, (0.0, 0.1, 0.3, 0.6), sets=3000, least=0.945)


def class_coverage(rates: Sequence[float], sets: int, least: float) -> None:
    """Holds the intervals of class means to ``least``; the truth is the mean of the rates of the set's categories."""
    rng = np.random.default_rng(0)
    for name, sizes in CATEGORIES.items():
        category = np.repeat(np.arange(len(sizes)), sizes)
        weights = 1 / (len(sizes) * np.array(sizes)[category])
        for rate in rates:
            for between in (0.0, 0.1, 0.3):
                of_category = drawn(rng, rate, between, (sets, len(sizes)))
                for trials, within in ((1, 0.0), (None, 0.0), (None, 0.3)):
                    values = tried(rng, drawn(rng, of_category[:, category], within, (sets, len(category))), trials)
                    share = held(limits(values, weights, UNIT, share=True), of_category.mean(1))
                    assert share >= least, (name, rate, between, trials, within)


def test_class_mean_intervals_hold_the_true_class_mean() -> None:
    class_coverage((0.5, 0.97), sets=1000, least=0.94)


@pytest.mark.slow
def test_class_mean_intervals_hold_the_true_class_mean_in_all_cases() -> None:
    class_coverage((0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.97, 0.99), sets=4000, least=0.95)


def test_differences_of_policies_that_are_nearly_always_tied_hold_the_truth() -> None:
    rng = np.random.default_rng(0)
    for n in (5, 10, 20, 50, 100):
        for untied in (0.01, 0.03, 0.1, 0.3):
            for first in (0.5, 0.8, 1.0):
                draw = rng.random((2000, n))
                values = np.where(draw < untied * first, 1.0, np.where(draw < untied, -1.0, 0.0))
                truth = untied * (2 * first - 1)
                assert held(limits(values, equal(n), (-1.0, 1.0)), truth) >= 0.95, (n, untied, first)
    low, high = limits(np.zeros(72), equal(72), (-1.0, 1.0))
    assert high == pytest.approx(-low) and 0.02 < high < 0.06, (
        "72 ties: about 3 in 72 could differ unseen, not none and not many"
    )


def test_distances_hold_their_mean_though_failures_are_rare() -> None:
    rng = np.random.default_rng(0)
    for n in (5, 10, 20, 50, 100):
        for rate in (0.6, 0.9, 0.97, 0.99):
            opened = rng.random((2000, n)) < rate
            values = np.where(opened, rng.uniform(0.03, 0.1, opened.shape), rng.uniform(0.3, 1.0, opened.shape))
            assert held(limits(values, equal(n), UNIT), rate * 0.065 + (1 - rate) * 0.65) >= 0.95, (n, rate)


def test_unbounded_values_have_students_interval() -> None:
    from scipy.stats import ttest_1samp

    values = np.random.default_rng(0).normal(3.0, 2.0, 8)
    expected = ttest_1samp(values, 0).confidence_interval(0.95)
    assert limits(values, equal(8)) == pytest.approx((expected.low, expected.high))
    low, high = limits(np.array([0.1, 0.2, 3.0]), equal(3), (0.0, np.inf))
    assert low == 0 and high > 3, "an error is not negative"
