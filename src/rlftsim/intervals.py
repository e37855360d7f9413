"""A mean and how sure one may be of it: standard error, interval and p-value by Student's t."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Shaped
from scipy import stats


@dataclass(frozen=True)
class MeanInterval:
    """A mean with what Student's t says about it."""

    mean: float
    """NaN without a single value."""
    standard_error: float
    """Standard deviation (n - 1) over the root of n; NaN for fewer than two values."""
    interval: tuple[float, float]
    """Holds the true mean with probability 1 - alpha; NaN for fewer than two values."""
    p_value: float
    """Two-sided, of a true mean of 0; NaN where it cannot be told."""
    count: int


def mean_interval(values: Shaped[np.ndarray, "n"], *, alpha: float = 0.05) -> MeanInterval:
    """Of some values; those that are not finite are left out."""
    values = values[np.isfinite(values)]
    count = len(values)
    mean = float(values.mean()) if count else math.nan
    error = float(values.std(ddof=1)) / math.sqrt(count) if count > 1 else math.nan
    return interval_around(mean, error, count, alpha=alpha)


def interval_around(mean: float, standard_error: float, count: int, *, alpha: float = 0.05) -> MeanInterval:
    """Of `count` values whose mean and standard error are known already."""
    if count < 2:
        return MeanInterval(mean, math.nan, (math.nan, math.nan), math.nan, count)
    if standard_error < 1e-12 * max(abs(mean), 1.0):  # rounding alone: the same value everywhere
        return MeanInterval(mean, 0.0, (mean, mean), float(mean == 0), count)
    half = float(stats.t.ppf(1 - alpha / 2, count - 1)) * standard_error
    p_value = 2 * float(stats.t.sf(abs(mean) / standard_error, count - 1))
    return MeanInterval(mean, standard_error, (mean - half, mean + half), p_value, count)
