"""Means over objects and over categories, each with a 95 % interval.

Definitions
    The *instance mean* is the mean over objects; the *class mean* is the mean over categories of each category's
    instance mean, so that a category counts the same however many objects it has.

Intervals
    An object is the unit, however many trials it has. In a mean of weighted objects (weights that add up to 1)
    n = 1 / sum(weights squared) of them count (Kish): all in an instance mean; in a class mean fewer, since the one
    object of a category weighs as much as the ten of another.

    - Bounded values (success, contact, distance, cosine, their differences): a mean is safe only against what was
      not met yet; a policy that opened 20 of 20 objects may fail at the next. So a limit is that of the objects and
      one more, which has the worst possible value on that side: 0 for the lower limit of a success, 1 for the upper
      one. It is a quantile of their mean under weights from a Dirichlet distribution (Gaffke 2005; Learned-Miller
      and Thomas 2019), taken from the beta distribution of the same mean and variance. Where each object has one
      trial that succeeds or not, this is Clopper's and Pearson's interval, to the last digit.
    - A share of trials (success, contact) has an interval that holds Wilson's score interval for n objects
      (Wilson 1927), so that trials of one object never count as further objects.
    - Unbounded values (errors of the flow, what trials took): Student's t with n - 1 degrees of freedom; none where
      all values are the same.

    What they hold in simulated test sets (tests/evaluation/test_coverage.py). Success, 5 to 100 objects of 1 to 5
    trials, true rates of .5 to .99, objects alike or not: the true mean in 95 % of the sets or more, at 1.05 times
    the width of Wilson's intervals on average. (Percentiles of a bootstrap over objects: 10 % at worst, 82 % on
    average; Wilson's 86 % at worst.) Class means, 3 to 16 categories of 1 to 40 objects, alike or not: 95 % or more
    (bootstrap 38 % at worst, Wilson's 88 %); but 80 % where a category's only object is all that can go either way.
    Differences of policies that are nearly always tied: 95 % or more. Test sets of 10 to 50 objects drawn from those
    in results/: normalized distance and cosine 96 % or more; RMSE 87 to 95 %, magnitude error 90 to 95 %, since few
    objects with large errors are easily missed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import betaincinv, ndtri, stdtrit

LEVEL = 0.95
_UPPER = (1 + LEVEL) / 2

Interval = tuple[float, float]
UNIT: Interval = (0.0, 1.0)
UNBOUNDED: Interval = (-math.inf, math.inf)


def wilson(value: ArrayLike, n: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Wilson's score interval (level :data:`LEVEL`) of proportions ``value`` in [0, 1] of ``n`` draws: both limits.

    Written out because scipy's takes whole counts only, while an object's mean may be any fraction.
    """
    mean, z = np.asarray(value, dtype=np.float64), float(ndtri(_UPPER))
    centre = (mean + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * np.sqrt(mean * (1 - mean) / n + z * z / (4 * n * n))
    # The limits at 0 and 1 are exact on paper; keep rounding from putting the value outside.
    return np.clip(centre - half, 0.0, mean), np.clip(centre + half, mean, 1.0)


def limits(
    values: ArrayLike, weights: ArrayLike, bounds: Interval = UNBOUNDED, share: bool = False
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The interval of a weighted mean of objects, as this module's docstring defines it.

    Args:
        values: [..., O], of each object.
        weights: [O], which add up to 1; where a bound is infinite those of at least two objects.
        bounds: between which values lie; one that is passed moves to the value that passes it.
        share: Wilson's interval is to lie inside.

    Returns:
        Lower and upper limits [...].
    """
    values, weights = np.asarray(values, dtype=np.float64), np.asarray(weights, dtype=np.float64)
    n, mean = float(1 / np.sum(weights**2)), values @ weights
    lowest, highest = np.minimum(bounds[0], values.min(-1)), np.maximum(bounds[1], values.max(-1))
    if math.inf in (-bounds[0], bounds[1]):
        squares = (values - mean[..., None]) ** 2 @ weights
        half = stdtrit(n - 1, _UPPER) * np.sqrt(squares / (n - 1))
        return np.maximum(mean - half, lowest), np.minimum(mean + half, highest)
    low = _beyond(values, weights, lowest, lowest, highest, 1 - _UPPER)
    high = _beyond(values, weights, highest, lowest, highest, _UPPER)
    if share:
        lower, upper = wilson(mean, n)
        return np.minimum(low, lower), np.maximum(high, upper)
    return low, high


def _beyond(
    values: NDArray[np.float64],
    weights: NDArray[np.float64],
    further: NDArray[np.float64],
    lowest: NDArray[np.float64],
    highest: NDArray[np.float64],
    quantile: float,
) -> NDArray[np.float64]:
    """Quantile of the mean that objects and a ``further`` one have with weights drawn from a Dirichlet distribution.

    Of the beta distribution between ``lowest`` and ``highest`` with that mean's expectation and variance, which it is
    where values are yes or no.
    """
    n = float(1 / np.sum(weights**2))
    centre = (n * (values @ weights) + further) / (n + 1)
    squares = n * ((values - centre[..., None]) ** 2 @ weights) + (further - centre) ** 2
    place, variance = (centre - lowest) / (highest - lowest), squares / ((n + 1) * (n + 2) * (highest - lowest) ** 2)
    certain = place * (1 - place) < 1e-12  # to rounding all of them have the worst value
    size = place * (1 - place) / np.where(certain, 1.0, variance) - 1
    first, second = (np.where(certain, 1.0, share * size) for share in (place, 1 - place))
    return np.where(certain, further, lowest + (highest - lowest) * betaincinv(first, second, quantile))


@dataclass(frozen=True)
class Means:
    """Instance and class mean with their intervals, None where they are not defined."""

    instance: float | None
    instance_ci95: Interval | None
    class_: float | None
    class_ci95: Interval | None


def means(objects: Mapping[tuple[str, str], float], bounds: Interval = UNBOUNDED, share: bool = False) -> Means:
    """Means over objects with intervals, as this module's docstring defines them.

    Args:
        objects: value of each (category, object).
        bounds: lowest and highest value that is possible.
        share: a value is a share of trials.
    """
    if not objects:
        return Means(None, None, None, None)
    values = np.array(list(objects.values()), dtype=np.float64)
    _, category, sizes = np.unique([key[0] for key in objects], return_inverse=True, return_counts=True)
    instance, class_ = float(values.mean()), float((np.bincount(category, values) / sizes).mean())
    if math.inf in (-bounds[0], bounds[1]) and np.ptp(values) == 0:
        return Means(instance, None, class_, None)

    def interval(mean: float, weights: NDArray[np.float64]) -> Interval:
        low, high = limits(values, weights, bounds, share)
        return min(mean, float(low)), max(mean, float(high))  # not outside by rounding

    equal, by_category = np.full(len(values), 1 / len(values)), 1 / (len(sizes) * sizes[category])
    return Means(instance, interval(instance, equal), class_, interval(class_, by_category))
