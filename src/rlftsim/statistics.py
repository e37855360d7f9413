"""Means with standard error, confidence interval and p-value by Student's t."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Shaped
from scipy import stats


@dataclass(frozen=True)
class MeanInterval:
    """A mean with its standard error, confidence interval and p-value by Student's t."""

    mean: float
    """NaN without a single value."""
    standard_error: float
    """Standard deviation (n - 1) over the root of n; NaN for fewer than two values."""
    interval: tuple[float, float]
    """Confidence interval of level 1 - alpha; NaN for fewer than two values."""
    p_value: float
    """Two-sided, for a true mean of 0; NaN for fewer than two values."""
    count: int


def mean_interval(values: Shaped[np.ndarray, "n"], *, alpha: float = 0.05) -> MeanInterval:
    """Mean of some values with its confidence interval.

    Args:
        values: independent samples; those that are not finite are left out.
        alpha: probability that the interval misses the true mean.
    """
    values = values[np.isfinite(values)]
    count = len(values)
    mean = float(values.mean()) if count else math.nan
    error = float(values.std(ddof=1)) / math.sqrt(count) if count > 1 else math.nan
    return interval_around(mean, error, count, alpha=alpha)


def interval_around(mean: float, standard_error: float, count: int, *, alpha: float = 0.05) -> MeanInterval:
    """Confidence interval around a mean that is known already.

    Args:
        mean: of the values.
        standard_error: of the mean.
        count: number of values.
        alpha: probability that the interval misses the true mean.
    """
    if count < 2:
        return MeanInterval(mean, math.nan, (math.nan, math.nan), math.nan, count)
    # Equal values differ by rounding alone: without this, t would be the ratio of two rounding errors.
    if standard_error < 1e-12 * max(abs(mean), 1.0):
        return MeanInterval(mean, 0.0, (mean, mean), float(mean == 0), count)
    # the t distribution rather than the normal one: seeds are few, 3 values make the interval twice as wide
    half = float(stats.t.ppf(1 - alpha / 2, count - 1)) * standard_error
    p_value = 2 * float(stats.t.sf(abs(mean) / standard_error, count - 1))
    return MeanInterval(mean, standard_error, (mean - half, mean + half), p_value, count)
