"""Agreement of simulated traffic with the world that made the logs: errors, rankings and failures of planners.

Shapes: N rollouts, T types of traffic, of which the first is the truth; P planners, W windows, D sets of weights of the
windows, for which every statistic is computed at once: the first set has equal weights, the others are draws of whole
networks.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from rlftsim.errors import DataError
from rlftsim.statistics import draw_clusters

NUM_DRAWS = 2000
CHANGED = 0.05
"""Episodes whose scores differ by more are counted."""
VEHICLE_CONFLICTS = ("following", "merging", "crossing")
"""In the rows; windows with any of these are the conflict windows."""


@dataclass(frozen=True, eq=False)
class Episodes:
    """Episodes of the same windows and planners in each type of traffic."""

    traffic: tuple[str, ...]
    """Types of traffic, the truth first."""
    planners: tuple[str, ...]
    windows: tuple[str, ...]
    networks: tuple[str, ...]
    """Of each window."""
    conflicts: tuple[frozenset[str], ...]
    """Of each window."""
    is_random: Bool[np.ndarray, "W"]
    """False = the window was chosen for its conflict."""
    values: Mapping[str, Float[np.ndarray, "N T P W"]]
    """Scores by column; NaN = the planner has failed. Traffic that is the same in each rollout is repeated."""

    @cached_property
    def weights(self) -> Float[np.ndarray, "D W"]:
        """Weights of the windows for the estimate and for each draw of networks."""
        _, clusters = np.unique(self.networks, return_inverse=True)
        return draw_weights(clusters, NUM_DRAWS)

    @cached_property
    def is_measured(self) -> Bool[np.ndarray, "P W"]:
        """True where the planner has driven in all traffic and all rollouts."""
        return np.asarray(np.isfinite(self.values["nuplan_style"]).all((0, 1)))

    def select(self, is_chosen: Bool[np.ndarray, "W"]) -> "Episodes":
        """Episodes of some windows."""
        chosen = np.flatnonzero(is_chosen)
        texts = {name: tuple(getattr(self, name)[k] for k in chosen) for name in ("windows", "networks", "conflicts")}
        return replace(
            self,
            **texts,
            is_random=self.is_random[chosen],
            values={name: table[..., chosen] for name, table in self.values.items()},
        )


def arrange_episodes(rows: Sequence[Mapping[str, Any]], truth: str) -> Episodes:
    """Episodes of rows; windows that lack an episode are left out.

    Args:
        rows: Rows of `rlftsim experiment true-world`, in any order.
        truth: Name of the traffic that is the truth.

    Raises:
        DataError: No window has all episodes.
    """
    traffic = tuple(dict.fromkeys([truth, *(row["traffic"] for row in rows)]))
    planners = tuple(dict.fromkeys(row["planner"] for row in rows))
    num_rollouts = 1 + max((row["rollout"] for row in rows), default=0)
    has_rollouts = {row["traffic"] for row in rows if row["rollout"]}
    by_window: dict[str, dict[tuple[int, str, str], Mapping[str, Any]]] = {}
    for row in rows:
        repeated = range(row["rollout"], row["rollout"] + 1) if row["traffic"] in has_rollouts else range(num_rollouts)
        episodes = by_window.setdefault(row["window"], {})
        episodes |= {(rollout, row["traffic"], row["planner"]): row for rollout in repeated}
    count = num_rollouts * len(traffic) * len(planners)
    windows = [name for name, episodes in by_window.items() if len(episodes) == count]
    if not windows:
        raise DataError("no window was driven by all planners in all traffic: go on with the run.")
    first = [next(iter(by_window[name].values())) for name in windows]
    columns = [name for name, value in first[0].items() if isinstance(value, float)]
    shape = (num_rollouts, len(traffic), len(planners), len(windows))
    keys = list(product(range(num_rollouts), traffic, planners, windows))
    values = {
        column: np.array([by_window[w][n, t, p][column] for n, t, p, w in keys]).reshape(shape) for column in columns
    }
    networks = tuple(row["network"] for row in first)
    conflicts = tuple(frozenset(row["conflicts"].split()) for row in first)
    is_random = np.array([row["is_random"] for row in first])
    return Episodes(traffic, planners, tuple(windows), networks, conflicts, is_random, values)


def find_largest_errors(episodes: Episodes, column: str, traffic: str, count: int) -> list[tuple[str, str, int]]:
    """Windows in which a score errs most against the truth, each with the planner and the rollout of that error.

    Args:
        episodes: Episodes of all windows.
        column: Name of the score.
        traffic: Type of traffic that errs.
        count: Number of windows, less where fewer have an error.
    """
    values = episodes.values[column]
    errors = np.abs(values[:, episodes.traffic.index(traffic)] - values[:, 0])  # [N, P, W]
    errors = np.where(episodes.is_measured, errors, 0.0)
    order = np.argsort(-errors.max((0, 1)), kind="stable")[:count]
    worst = [(w, *np.unravel_index(errors[..., w].argmax(), errors.shape[:2])) for w in order if errors[..., w].any()]
    return [(episodes.windows[w], episodes.planners[p], int(n)) for w, n, p in worst]


def draw_weights(clusters: Int[np.ndarray, "W"], num_draws: int) -> Float[np.ndarray, "D W"]:
    """Equal weights, then weights of draws of clusters, see `draw_clusters`; NaN draws for a single cluster.

    Args:
        clusters: Number of each window's cluster, from 0 on.
        num_draws: Draws after the equal weights.
    """
    count = int(clusters.max()) + 1
    if count == 1:  # a single network says nothing about others
        return np.concatenate([np.ones((1, len(clusters))), np.full((num_draws, len(clusters)), np.nan)])
    draws = draw_clusters(count, num_draws, np.random.default_rng(0))
    return np.concatenate([np.ones((1, len(clusters))), draws[:, clusters]])


def average(
    values: Float[np.ndarray, "T P W"], mask: Bool[np.ndarray, "P W"], weights: Float[np.ndarray, "D W"]
) -> Float[np.ndarray, "D T P"]:
    """Weighted means over windows; NaN for a planner without a window.

    Args:
        values: Any number for each episode.
        mask: True = the episode counts.
        weights: Weights of the windows.
    """
    sums = np.einsum("tpw,dw->dtp", np.where(mask, values, 0.0), weights)
    counts = np.einsum("pw,dw->dp", mask.astype(float), weights)
    return sums / np.where(counts > 0, counts, np.nan)[:, None]


def pool(
    values: Float[np.ndarray, "T P W"], mask: Bool[np.ndarray, "P W"], weights: Float[np.ndarray, "D W"]
) -> Float[np.ndarray, "D T"]:
    """Weighted means over all episodes together; NaN without an episode.

    Args:
        values: Any number for each episode.
        mask: True = the episode counts.
        weights: Weights of the windows.
    """
    joined = np.where(mask, values, 0.0).reshape(len(values), 1, -1)  # planners and windows on a single axis
    return average(joined, mask.reshape(1, -1), np.tile(weights, len(mask)))[..., 0]


def compute_tau_b(x: Float[np.ndarray, "*n P"], y: Float[np.ndarray, "*n P"]) -> Float[np.ndarray, "*n"]:
    """Kendall's tau-b of two rankings of P planners; NaN where one ranks nothing.

    Args:
        x: Scores of the planners in one traffic.
        y: Scores of the same planners in another one.
    """
    first, second = np.triu_indices(x.shape[-1], 1)
    a, b = np.sign(x[..., first] - x[..., second]), np.sign(y[..., first] - y[..., second])
    scale = np.sqrt(np.abs(a).sum(-1) * np.abs(b).sum(-1))
    return np.asarray((a * b).sum(-1) / np.where(scale > 0, scale, np.nan))


def compute_r_squared(x: Float[np.ndarray, "*n P"], y: Float[np.ndarray, "*n P"]) -> Float[np.ndarray, "*n"]:
    """Squared correlation of two scores over P planners; NaN where one does not vary.

    Args:
        x: Scores of the planners in one traffic.
        y: Scores of the same planners in another one.
    """
    a, b = x - x.mean(-1, keepdims=True), y - y.mean(-1, keepdims=True)
    scale = (a * a).sum(-1) * (b * b).sum(-1)
    return np.asarray((a * b).sum(-1) ** 2 / np.where(scale > 0, scale, np.nan))


def measure_agreement(
    values: Float[np.ndarray, "N T P W"], mask: Bool[np.ndarray, "P W"], weights: Float[np.ndarray, "D W"]
) -> dict[str, Float[np.ndarray, "D T"]]:
    """Statistics of a score in each traffic against the truth.

    planner_error: mean over planners of the error of a planner's mean; bias: the same with signs; episode_error: mean
    error of an episode, in which rollouts do not cancel; changed: fraction of episodes off by more than 0.05; tau_b and
    r_squared of planners' means. Planners without an episode that counts are left out.

    Args:
        values: Score of each episode.
        mask: True = the episode counts.
        weights: Weights of the windows.
    """
    values, mask = values[:, :, mask.any(1)], mask[mask.any(1)]
    means = average(values.mean(0), mask, weights)
    difference, error = means - means[:, :1], np.abs(values - values[:, :1])
    truth = np.broadcast_to(means[:, :1], means.shape)
    return {
        "planner_error": np.abs(difference).mean(-1),
        "bias": difference.mean(-1),
        "episode_error": pool(error.mean(0), mask, weights),
        "changed": pool((error > CHANGED).mean(0), mask, weights),
        "tau_b": compute_tau_b(truth, means),
        "r_squared": compute_r_squared(truth, means),
    }


def count_failures(
    is_failure: Bool[np.ndarray, "N T P W"], mask: Bool[np.ndarray, "P W"]
) -> list[tuple[float, float, float]]:
    """Episodes that fail in both, in the truth alone, and in the traffic alone, for each type of traffic; means over
    rollouts.

    Args:
        is_failure: True = the planner is at fault for a collision.
        mask: True = the episode counts.
    """
    truth, failed = is_failure[:, :1] & mask, is_failure & mask
    tables = (failed & truth, truth & ~failed, failed & ~truth)
    return list(zip(*(table.sum((2, 3)).mean(0).tolist() for table in tables)))


def find_interval(draws: Float[np.ndarray, "D"], level: float = 0.95) -> tuple[float, float, float]:
    """Estimate, and both ends of the interval by percentiles of the draws; NaN without any.

    Args:
        draws: Statistic for equal weights, then for each draw.
        level: Probability that the interval holds the true value.
    """
    drawn = draws[1:][np.isfinite(draws[1:])]
    ends = np.quantile(drawn, [(1 - level) / 2, (1 + level) / 2]) if len(drawn) else (np.nan, np.nan)
    return float(draws[0]), float(ends[0]), float(ends[1])
