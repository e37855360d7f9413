"""A natural-gradient step of a few weights that leaves some means unchanged, and the best length of the step.

S scenarios, K weights, C constrained means, X lengths.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

RIDGE = 1e-3
"""Part of the Fisher matrix's diagonal that is added to it, so that features that go together share a weight."""

Vector = Float64[np.ndarray, "K"]


def natural_direction(
    gradient: Vector, fisher: Float64[np.ndarray, "K K"], fixed: Float64[np.ndarray, "C K"], kl: float
) -> Vector:
    """Direction of the largest gain per KL, among directions with a predicted change of 0 in the fixed means.

    Args:
        gradient: Gradient [K] of the objective by the weights.
        fisher: Covariance of the score function, per decision. A weight without covariance stays 0.
        fixed: Gradients of means that are to stay unchanged.
        kl: Predicted KL of the result, ½ e·F e, nats per decision.

    Returns:
        The step of that KL; zeros where the gradient has no part that is free to be followed.
    """
    is_used = np.diag(fisher) > 0
    step = np.zeros_like(gradient)
    metric = fisher[np.ix_(is_used, is_used)]
    metric = metric + RIDGE * np.diag(np.diag(metric))
    free = np.linalg.solve(metric, gradient[is_used]) if is_used.any() else step[is_used]
    constrained = fixed[:, is_used]
    if constrained.any():
        # in the metric of the KL, so that the step changes as little as it has to
        across = np.linalg.solve(metric, constrained.T)  # [K, C]
        free = free - across @ np.linalg.lstsq(constrained @ across, constrained @ free, rcond=1e-10)[0]
    square = free @ metric @ free
    # what projection leaves of a gradient that lies along the constraints is rounding
    if square > 1e-20 * max(gradient @ gradient, 1e-300):
        step[is_used] = free * np.sqrt(2 * kl / square)
    return step


def best_length(lengths: Sequence[float], gains: Float64[np.ndarray, "S X"]) -> float:
    """Length with the greatest gain on the parabola through 0 that fits measured gains best, up to the longest length.

    Args:
        lengths: Lengths that were tried, above 0.
        gains: Measured gain of each length in each scenario.
    """
    tried, mean = np.asarray(lengths), gains.mean(0)
    powers = np.stack([tried, tried**2], 1)[:, : len(tried)]  # a single length has a slope alone
    slope, bend = (*np.linalg.lstsq(powers, mean, rcond=None)[0], 0.0)[:2]
    if bend < 0:
        return float(np.clip(-slope / (2 * bend), 0.0, tried.max()))
    return float(tried.max()) if slope * tried.max() + bend * tried.max() ** 2 > 0 else 0.0


def t_value(values: Float64[np.ndarray, "S"]) -> float:
    """Mean of some scenarios over its standard error; 0 where all are equal, or for a single scenario."""
    spread = values.std(ddof=1) if len(values) > 1 else 0.0
    return float(values.mean() / (spread / np.sqrt(len(values)))) if spread > 0 else 0.0
