"""Means with standard error, confidence interval and p-value by Student's t, of independent or clustered values."""

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Int64, Shaped
from scipy.special import stdtr, stdtrit


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


def interval_around(mean: float, standard_error: float, count: int | float, *, alpha: float = 0.05) -> MeanInterval:
    """Confidence interval around a mean that is known already.

    Args:
        mean: of the values.
        standard_error: of the mean.
        count: Number of independent values; Student's t has one degree of freedom less, which may be a fraction.
        alpha: probability that the interval misses the true mean.
    """
    if count < 2:
        return MeanInterval(mean, math.nan, (math.nan, math.nan), math.nan, int(count))
    # Equal values differ by rounding alone: without this, t would be the ratio of two rounding errors.
    if standard_error < 1e-12 * max(abs(mean), 1.0):
        return MeanInterval(mean, 0.0, (mean, mean), float(mean == 0), int(count))
    # the t distribution rather than the normal one: seeds are few, 3 values make the interval twice as wide
    half = float(stdtrit(count - 1, 1 - alpha / 2)) * standard_error
    p_value = 2 * float(stdtr(count - 1, -abs(mean) / standard_error))
    return MeanInterval(mean, standard_error, (mean - half, mean + half), p_value, int(count))


def prediction_interval(values: Shaped[np.ndarray, "n"], *, alpha: float = 0.05) -> MeanInterval:
    """Mean of some values, with the interval in which the next value lies.

    Args:
        values: Independent samples, such as the gain of each run.
        alpha: Probability that the next value lies outside.
    """
    mean = mean_interval(values)
    error = mean.standard_error * math.sqrt(mean.count + 1)  # spread of the values, and error of their mean
    return interval_around(mean.mean, error, mean.count, alpha=alpha)


def draw_clusters(count: int, num_draws: int, rng: np.random.Generator) -> Int64[np.ndarray, "draws count"]:
    """How often each draw takes each of at least two clusters: one draw fewer than there are (Rao and Wu 1988).

    Args:
        count: Number of clusters.
        num_draws: Number of bootstrap draws.
        rng: Source of the draws.
    """
    return rng.multinomial(count - 1, np.full(count, 1 / count), num_draws)


def cluster_bootstrap(
    values: Shaped[np.ndarray, "*runs n"],
    clusters: Shaped[np.ndarray, "n"],
    *,
    num_draws: int = 4000,
    seed: int = 0,
    level: float = 0.95,
) -> MeanInterval:
    """Mean of values that are independent between clusters only, with its confidence interval.

    Whole clusters are drawn with replacement, one fewer than there are, which makes the variance over the draws the
    unbiased one (the rescaled bootstrap, Rao and Wu 1988): clusters of a single value give the interval of
    `mean_interval`. Several runs are drawn alike, crossed with the clusters. The interval is Student's around the mean,
    with the degrees of freedom of clusters and runs (Satterthwaite), so that few of them make it wide.

    Args:
        values: Samples [n], or [runs, n] of several training runs on the same scenarios; not finite ones are left out.
        clusters: Label of each sample, such as its street network; samples of one label may depend on each other.
        num_draws: Bootstrap draws; 4000 give the standard error within about 1 %. Of more than 5000 clusters fewer are
            drawn, for memory and time.
        seed: Seed of the draws.
        level: Probability that the interval holds the true mean; the ends at 0.9 are one-sided bounds at 95 %.

    Returns:
        Its `count` is the number of samples with a value in some run; the interval is NaN for a single cluster.
    """
    values = np.atleast_2d(values)
    is_finite = np.isfinite(values)
    # 1. Sums and counts of each run and cluster [R, G]; those without any value take no part.
    labels, cluster = np.unique(clusters, return_inverse=True)
    sums, counts = np.zeros((2, len(values), len(labels)))
    np.add.at(sums.T, cluster, np.where(is_finite, values, 0.0).T)
    np.add.at(counts.T, cluster, is_finite.T)
    has_run, has_cluster = counts.any(1), counts.any(0)
    sums, counts = sums[has_run][:, has_cluster], counts[has_run][:, has_cluster]
    count = int(is_finite.any(0).sum())
    if not count:
        return mean_interval(np.zeros(0))
    mean, alpha = float(sums.sum() / counts.sum()), 1 - level
    num_runs, num_clusters = counts.shape
    if num_clusters < 2:
        return replace(interval_around(mean, math.nan, 1), count=count)
    # 2. How often each draw takes each run and each cluster; a single run stands for itself.
    num_draws = min(num_draws, max(20_000_000 // num_clusters, 400))
    rng = np.random.default_rng(seed)
    drawn = [
        draw_clusters(size, num_draws, rng) if size > 1 else np.ones((num_draws, 1))
        for size in (num_runs, num_clusters)
    ]  # [draws, R], [draws, G]

    def variance(run_weights: np.ndarray, cluster_weights: np.ndarray) -> float:
        """Variance of the mean over the draws."""
        totals, sizes = (((run_weights @ table) * cluster_weights).sum(1) for table in (sums, counts))
        return float(np.var(totals[sizes > 0] / sizes[sizes > 0]))

    # 3. Degrees of freedom of the sum of both variances.
    of_runs = variance(drawn[0], np.ones((1, num_clusters)))
    of_clusters = variance(np.ones((1, num_runs)), drawn[1])
    error = math.sqrt(variance(*drawn))
    squares = of_clusters**2 / (num_clusters - 1) + of_runs**2 / max(num_runs - 1, 1)
    degrees = (of_runs + of_clusters) ** 2 / squares if squares else num_clusters - 1.0
    return replace(interval_around(mean, error, degrees + 1, alpha=alpha), count=count)
