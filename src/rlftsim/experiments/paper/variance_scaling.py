"""Figure 3: variance of a rollout's reward against the number N of rollouts behind the reward, with fits."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from rlftsim.evaluation.reward_variance import MIN_SIZES_FOR_A_SLOPE, REWARDS, Variances, measure_variances
from rlftsim.experiments.model_specs import BASE
from rlftsim.experiments.results import Experiment, ExperimentResult, TextTable
from rlftsim.experiments.suite import ExperimentSuite
from rlftsim.statistics import MeanInterval, mean_interval
from rlftsim.viewer.figure import Band, draw_bands

FROM_SIZES = (2, 8)
"""Slopes are fitted from each of these on: over all N, and where N is large enough for laws of large numbers."""
CLAIMED_SLOPE = {"mloo": -2.0, "rloo": 0.0}
"""Of the logarithm of the variance against that of N, as the paper has it for large N."""


def run(suite: ExperimentSuite) -> Variances:
    """Variances of the base model's rewards, see `measure_variances`."""
    return measure_variances(suite.policy(BASE), suite.data, suite.out / "variances", suite.evaluation)


def fit_slope(variance: Float[np.ndarray, "sizes"], sizes: Sequence[int], first: int = 0) -> float:
    """Slope of the straight line fitted to logarithms; NaN where a variance is zero.

    Args:
        variance: Variance [sizes] of the reward at each number of rollouts.
        sizes: Numbers of rollouts N, as many as there are variances.
        first: Smallest N that the line is fitted to.
    """
    # a reward that never varies at some N has no logarithm there
    if not (variance > 0).all():
        return float("nan")
    is_fitted = np.array(sizes) >= first
    return float(np.polyfit(np.log(np.array(sizes)[is_fitted]), np.log(variance[is_fitted]), 1)[0])


def law(sizes: Sequence[int]) -> dict[str, Float[np.ndarray, "sizes"]]:
    """Variances under a metric that is a mean over independent rollouts, up to a factor.

    1 / (N (N - 1)) for MLOO, from the proof in the paper's appendix, and N / (N - 1) for RLOO.
    """
    size = np.array(sizes, float)
    return {"mloo": 1 / (size * (size - 1)), "rloo": size / (size - 1)}


@dataclass(frozen=True)
class Scaling:
    """Fit to the variances of a reward."""

    middle: Float[np.ndarray, "sizes"]
    """Geometric mean over scenarios."""
    low: Float[np.ndarray, "sizes"]
    """One standard deviation of the logarithm below."""
    high: Float[np.ndarray, "sizes"]
    alpha: float
    """Of alpha / N^2, fitted to the logarithms of `middle`."""
    slopes: dict[int, MeanInterval]
    """Over the scenarios' own slopes, by the smallest size they are fitted to."""


def fit_scaling(variance: Float[np.ndarray, "scenarios sizes"], sizes: Sequence[int]) -> Scaling:
    """Fit of a reward; scenarios in which a reward never varies are left out.

    Args:
        variance: Variance [scenarios, sizes] of the reward at each number of rollouts.
        sizes: Numbers of rollouts N, as many as there are columns.
    """
    varied = np.log(variance[(variance > 0).all(1)])  # [varied scenarios, sizes]
    middle, spread = varied.mean(0), varied.std(0)
    slopes = {
        first: mean_interval(np.array([fit_slope(line, sizes, first) for line in np.exp(varied)]))
        for first in FROM_SIZES
        if sum(size >= first for size in sizes) >= MIN_SIZES_FOR_A_SLOPE
    }
    # least squares of log(alpha) - 2 log(N) to the logarithms: the mean of the residuals
    alpha = float(np.exp((middle + 2 * np.log(sizes)).mean()))
    return Scaling(np.exp(middle), np.exp(middle - spread), np.exp(middle + spread), alpha, slopes)


def summarize(measured: Variances, suite: ExperimentSuite) -> ExperimentResult:
    """Slopes with intervals, beside the paper's claim and the slopes of independent rollouts.

    Args:
        measured: Variances of both rewards by scenario and number of rollouts.
        suite: Suite with the metric for the notes; no rollout is simulated here.
    """
    sizes = measured.sizes
    scalings = {name: fit_scaling(values, sizes) for name, values in measured.by_reward.items()}
    rows = tuple((str(size), *(f"{scalings[name].middle[k]:.3g}" for name in REWARDS)) for k, size in enumerate(sizes))
    note = f"Geometric mean over the scenarios; base model, metric {suite.evaluation.metric}."
    slopes, verdicts, plain_slopes = [], [], {}
    for name, curve in law(sizes).items():
        plain_slopes[name] = []
        for first, slope in scalings[name].slopes.items():
            # slope of the law over the same N, so that both have the same curvature at small N
            law_slope, (low, high) = fit_slope(curve, sizes, first), slope.interval
            title, interval = f"{name.upper()}, N ≥ {first}", f"[{low:.3f}, {high:.3f}]"
            slopes.append((title, f"{slope.mean:.3f}", interval, f"{law_slope:.3f}", f"{CLAIMED_SLOPE[name]:g}"))
            plain_slopes[name].append(
                {
                    "from_size": first, "slope": slope.mean, "interval": slope.interval, "of_law": law_slope,
                    "scenarios": slope.count,
                }
            )  # fmt: skip
            if slope.count < 2:
                verdicts.append(f"{title}: no verdict: fewer than two scenarios in which the reward varies.")
                continue
            verdict = "no difference from" if low <= law_slope <= high else "difference from"
            verdicts.append(
                f"{title}: {verdict} the slope {law_slope:.3f} of independent rollouts: slope {slope.mean:.3f}, 95% "
                f"interval over {slope.count} scenarios {interval}."
            )
    headings = ("", "slope", "95 % interval", "of independent rollouts", "the paper, large N")
    slope_note = "Mean and interval over the scenarios' own slopes (Student's t)."
    return ExperimentResult(
        title="Variance of the rewards against the number of rollouts",
        tables=(
            TextTable("Variance of a rollout's reward", ("N", "MLOO", "RLOO"), rows, note),
            TextTable("Slope in logarithms", headings, tuple(slopes), slope_note),
        ),
        verdicts=tuple(verdicts),
        notes=(
            "The paper fits alpha / N² to its MLOO curve (Fig. 3) and gives no slope; it finds RLOO to flatten out.",
            "Its proof has 1 / (N (N − 1)) for MLOO, which is steeper than 1 / N² at small N, and N / (N − 1) for "
            "RLOO: the slopes of independent rollouts are those of these laws over the same N. They hold where a score "
            "is a mean over rollouts; the meta-metric is one only when N is large: of few rollouts it is a geometric "
            "mean of nearly empty histograms.",
            "Small variance alone makes no better gradient: a reward that is scaled down has it too. What matters is "
            "the variance beside the differences that a policy is to learn.",
        ),
        numbers={
            "sizes": sizes,
            "rewards": {
                name: {"variance": scaling.middle.tolist(), "alpha": scaling.alpha, "slopes": plain_slopes[name]}
                for name, scaling in scalings.items()
            },
            "scenario_ids": measured.scenario_ids,
            "by_scenario": {name: values.tolist() for name, values in measured.by_reward.items()},
        },
        figure=_draw_figure(scalings["mloo"], scalings["rloo"], np.array(sizes, float)),
    )


def _draw_figure(mloo: Scaling, rloo: Scaling, sizes: Float[np.ndarray, "sizes"]) -> Figure:
    bands = [
        Band("MLOO", sizes, mloo.middle, mloo.low, mloo.high),
        Band(f"{mloo.alpha:.2g} / N²", sizes, mloo.alpha / sizes**2, style="theory"),
        Band("RLOO", sizes, rloo.middle, rloo.low, rloo.high, color=1),
    ]
    return draw_bands(
        bands, title="Variance of a rollout's reward", x_label="rollouts N", log=True, ticks=sizes.astype(int).tolist(),
        y_label="variance, geometric mean ± 1 std",
    )  # fmt: skip


EXPERIMENT = Experiment(
    "Does the variance of the leave-one-out reward fall with the square of the number of rollouts?", run, summarize
)
