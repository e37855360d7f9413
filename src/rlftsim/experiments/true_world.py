"""Agreement of simulated traffic with the world that made the logs: errors, rankings, failures of planners, the report.

Shapes: N rollouts, T types of traffic, of which the first is the truth; P planners, W windows, D sets of weights of the
windows, for which every statistic is computed at once: the first set has equal weights, the others are draws of whole
networks.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from matplotlib.figure import Figure

from rlftsim.errors import DataError
from rlftsim.experiments.results import format_origin
from rlftsim.experiments.tables import TextTable
from rlftsim.jobs.files import write_text
from rlftsim.scenario.maneuver import VEHICLE_CONFLICTS
from rlftsim.statistics import draw_clusters
from rlftsim.training.run_folder import describe_environment
from rlftsim.viewer.figure import COLORS, INK, save_figure

NUM_DRAWS = 2000
CHANGED = 0.05
"""Episodes whose scores differ by more are counted."""
DISTANCES_M = (0.0, 1.0, 5.0, 15.0, np.inf)
REFERENCES = ("replay", "idm")


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


SCORE, HIT, AT_FAULT = "nuplan_style", "hit_rate", "at_fault_collision_rate"


@dataclass(frozen=True, eq=False)
class WindowSet:
    """Windows with a name, in which all statistics are computed."""

    name: str
    episodes: Episodes
    _memo: dict[str, dict[str, Float[np.ndarray, "D T"]]] = field(default_factory=dict)
    """Statistics by score, which several tables show."""

    def measure(self, column: str, statistic: str) -> Float[np.ndarray, "D T"]:
        """Statistic of a score for each draw and type of traffic, see `measure_agreement`."""
        episodes = self.episodes
        if column not in self._memo:
            self._memo[column] = measure_agreement(episodes.values[column], episodes.is_measured, episodes.weights)
        return self._memo[column][statistic]


def choose_sets(episodes: Episodes) -> list[WindowSet]:
    """Random windows, and all windows with a conflict of vehicles."""
    has_conflict = np.array([not conflicts.isdisjoint(VEHICLE_CONFLICTS) for conflicts in episodes.conflicts])
    sets = [WindowSet("random windows", episodes.select(episodes.is_random))]
    return [*sets, WindowSet("conflict windows", episodes.select(has_conflict))] if has_conflict.any() else sets


def format_cell(draws: Float[np.ndarray, "D"], digits: int = 3, sign: str = "") -> str:
    """Estimate with its interval, such as 0.020 [0.011, 0.031]; a dash for NaN."""
    mean, low, high = find_interval(draws)
    return f"{mean:{sign}.{digits}f} [{low:{sign}.{digits}f}, {high:{sign}.{digits}f}]" if np.isfinite(mean) else "–"


def list_rows(episodes: Episodes, cells: Callable[[int], Sequence[str]]) -> tuple[tuple[str, ...], ...]:
    """Rows of all types of traffic but the truth, of cells by the number of the type."""
    return tuple((name, *cells(t)) for t, name in enumerate(episodes.traffic) if t)


def pool_errors(episodes: Episodes, mask: Bool[np.ndarray, "P W"]) -> list[Float[np.ndarray, "D T"]]:
    """Errors of an episode's score and hit rate, over the measured episodes of a mask."""
    tables = [episodes.values[column] for column in (SCORE, HIT)]
    errors = [np.abs(values - values[:, :1]).mean(0) for values in tables]
    return [pool(error, mask & episodes.is_measured, episodes.weights) for error in errors]


def build_error_table(windows: WindowSet) -> TextTable:
    """Errors of the score, the hit rate and the rate of collisions at fault, in each traffic."""
    episodes = windows.episodes
    columns = {
        "score of a planner": (SCORE, "planner_error"), "score of an episode": (SCORE, "episode_error"),
        "bias": (SCORE, "bias"), "off by > 0.05": (SCORE, "changed"), "τ_b": (SCORE, "tau_b"),
        "R²": (SCORE, "r_squared"), "hit rate of a planner": (HIT, "planner_error"),
        "of an episode": (HIT, "episode_error"), "at fault": (AT_FAULT, "planner_error"),
        "PDMS of a planner": ("pdms_style", "planner_error"),
    }  # fmt: skip
    tables = [windows.measure(column, statistic) for column, statistic in columns.values()]
    failures = count_failures(episodes.values[AT_FAULT] > 0, episodes.is_measured)

    def format_errors(t: int) -> list[str]:
        cells = [format_cell(table[:, t], sign="+" * (label == "bias")) for label, table in zip(columns, tables)]
        return [*cells, " · ".join(f"{count:g}" for count in failures[t])]

    note = (
        f"{len(episodes.windows)} windows of {len({*episodes.networks})} networks × {len(episodes.planners)} planners; "
        f"rollouts in traffic with a model: {len(episodes.values[SCORE])}. Errors against the truth; 95 % intervals by "
        "bootstrap over networks, whose draws make absolute errors of means larger. "
        "Failures: at fault in both · missed · false."
    )
    return TextTable(f"Errors, {windows.name}", ("", *columns, "failures"), list_rows(episodes, format_errors), note)


def build_paired_table(windows: WindowSet) -> TextTable:
    """Errors in each traffic minus those of replay and of IDM, by the same draws."""
    traffic = windows.episodes.traffic
    references = [name for name in REFERENCES if name in traffic]
    measured = {
        f"{label} − {name}": table - table[:, [traffic.index(name)]]
        for label, table in (
            ("score of an episode", windows.measure(SCORE, "episode_error")),
            ("hit rate of an episode", windows.measure(HIT, "episode_error")),
        )
        for name in references
    }
    rows = list_rows(windows.episodes, lambda t: [format_cell(table[:, t], sign="+") for table in measured.values()])
    note = "Below zero: smaller errors than those of the other traffic."
    return TextTable(f"Paired differences of errors, {windows.name}", ("", *measured), rows, note)


def build_parts_table(
    windows: WindowSet, title: str, parts: Sequence[tuple[str, Bool[np.ndarray, "P W"]]]
) -> TextTable:
    """Errors of an episode's score and hit rate in parts of the episodes, a row for each traffic."""
    episodes = windows.episodes
    tables = [pool_errors(episodes, mask) for _, mask in parts]
    rows = list_rows(episodes, lambda t: [" · ".join(format_cell(table[:, t]) for table in pair) for pair in tables])
    headings = [f"{label} ({int((mask & episodes.is_measured).sum())} episodes)" for label, mask in parts]
    return TextTable(title, ("", *headings), rows, "Error of the score · error of the hit rate of an episode.")


def split_by_distance(episodes: Episodes) -> list[tuple[str, Bool[np.ndarray, "P W"]]]:
    """Episodes by the planner's distance from the log after 8 s in the truth."""
    distance = episodes.values["distance_m"][0, 0]
    return [
        (f"{low:g}–{high:g} m" if np.isfinite(high) else f"> {low:g} m", (distance >= low) & (distance < high))
        for low, high in pairwise(DISTANCES_M)
    ]


def split_by_conflict(episodes: Episodes) -> list[tuple[str, Bool[np.ndarray, "P W"]]]:
    """Episodes by the conflicts of their windows, which may have several."""
    names = (*VEHICLE_CONFLICTS, "pedestrian")
    masks = [(name, np.array([name in conflicts for conflicts in episodes.conflicts])) for name in names]
    masks.append(("none", np.array([not conflicts for conflicts in episodes.conflicts])))
    return [(name, np.broadcast_to(mask, (len(episodes.planners), len(mask)))) for name, mask in masks]


def build_planner_table(windows: WindowSet, column: str) -> TextTable:
    """Mean of a score by planner and traffic."""
    episodes = windows.episodes
    means = average(episodes.values[column].mean(0), episodes.is_measured, episodes.weights)[0]
    rows = [(name, *(f"{mean:.3f}" for mean in means[t])) for t, name in enumerate(episodes.traffic)]
    return TextTable(f"{column}, {windows.name}", ("", *episodes.planners), tuple(rows))


def list_verdicts(sets: Sequence[WindowSet], models: Sequence[str], ghost: str) -> list[str]:
    """Lines on what holds: whether reaction matters, and the aims for the best of the learned traffic.

    Args:
        sets: Random windows first, then conflict windows if there are any.
        models: Names of the learned traffic.
        ghost: Name of the traffic that does not react.
    """
    lines = []
    for windows in sets:
        episodes = windows.episodes
        if ghost in episodes.traffic:
            row = episodes.traffic.index(ghost)
            score, hit_rate = (episodes.values[column][0][:, episodes.is_measured] for column in (SCORE, HIT))
            error, hits = np.abs(score[row] - score[0]), hit_rate[row] != hit_rate[0]
            lines.append(
                f"{windows.name}: reaction moves the score by more than {CHANGED} in {int((error > CHANGED).sum())} of "
                f"{len(error)} episodes, and who is hit in {int(hits.sum())}."
            )
        for label, column in (("score", SCORE), ("hit rate", HIT)):
            table = windows.measure(column, "planner_error")
            learned = [t for t, name in enumerate(episodes.traffic) if name in models]
            if not learned:
                continue
            best = min(learned, key=lambda t: table[0, t])
            aims = [
                f"{'≤' if table[0, best] <= table[0, episodes.traffic.index(name)] / 2 else 'not ≤'} half of {name}'s "
                f"{table[0, episodes.traffic.index(name)]:.3f}"
                for name in REFERENCES
                if name in episodes.traffic
            ]
            lines.append(
                f"{windows.name}, {label} of a planner: best learned traffic {episodes.traffic[best]} "
                f"{format_cell(table[:, best])}, {', '.join(aims)}."
            )
    return lines


def draw_figure(sets: Sequence[WindowSet], shown: Sequence[str]) -> Figure:
    """Mean of each planner in the truth and in other traffic, a color for each traffic, with 95 % intervals.

    Args:
        sets: Windows, a row of panels for each.
        shown: Names of the traffic to show, at most one for each color.
    """
    figure = Figure(figsize=(9.0, 4.3 * len(sets)), layout="constrained")
    axes = figure.subplots(len(sets), 2, squeeze=False)
    for row, windows in enumerate(sets):
        episodes = windows.episodes
        for axis, (column, label) in zip(axes[row], ((SCORE, "nuPlan-style score"), (HIT, "hit rate"))):
            means = average(episodes.values[column].mean(0), episodes.is_measured, episodes.weights)  # [D, T, P]
            drawn = means[1:] if np.isfinite(means[1:]).any() else means[:1]  # a single network has no draws
            low, high = np.nanquantile(drawn, (0.025, 0.975), axis=0)
            for color, name in zip(COLORS, shown):
                t = episodes.traffic.index(name)
                spans = np.abs(np.stack([means[0] - low, high - means[0]]))  # [2, T, P]
                axis.errorbar(
                    means[0, 0], means[0, t], xerr=spans[:, 0], yerr=spans[:, t], fmt="o", color=color, ms=4.5, lw=0.6,
                    alpha=0.8, label=name,
                )  # fmt: skip
            highest = max(axis.get_xlim()[1], axis.get_ylim()[1])
            axis.plot([0, highest], [0, highest], color=INK, lw=0.8, ls=(0, (4, 3)), zorder=0)
            for p, name in enumerate(episodes.planners if column == SCORE else ()):  # rates lie too close
                axis.annotate(
                    name, (means[0, 0, p], 0.0), xycoords=("data", "axes fraction"), fontsize=6.5, rotation=90,
                    ha="center", va="bottom", color="#79828f", xytext=(0, 3), textcoords="offset points",
                )  # fmt: skip
            axis.set_title(f"{label}, {len(episodes.windows)} {windows.name}", fontsize=10, loc="left", color=INK)
            axis.set(xlabel="in the world itself (SUMO)", ylabel="in simulated traffic")
            axis.spines[["top", "right"]].set_visible(False)
    handles, names = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=len(names), frameon=False, fontsize=9)
    return figure


def write_report(episodes: Episodes, models: Sequence[str], out: Path, *, ghost: str) -> list[str]:
    """Write report.md and figure.png; returns the verdicts.

    Args:
        episodes: Episodes of all windows.
        models: Names of the learned traffic.
        out: Folder of the files.
        ghost: Name of the traffic that does not react.
    """
    sets = choose_sets(episodes)
    episodes = sets[0].episodes
    values = episodes.values
    is_seen = values["off_lane_steps"][0, 0] == 0
    seen_tables = pool_errors(episodes, is_seen)
    tables = [build_error_table(windows) for windows in sets] + [build_paired_table(windows) for windows in sets]
    tables += [
        build_parts_table(sets[0], "By distance from the log after 8 s", split_by_distance(episodes)),
        build_parts_table(sets[0], "By conflict at the current step", split_by_conflict(episodes)),
        TextTable(
            f"Without the {np.mean(~is_seen):.0%} of episodes with steps at which the ego is on no lane of SUMO",
            ("", "score of an episode", "hit rate of an episode"),
            list_rows(episodes, lambda t: [format_cell(table[:, t]) for table in seen_tables]),
        ),
        *(build_planner_table(windows, column) for windows in sets for column in (SCORE, HIT, AT_FAULT)),
        TextTable(
            "CPU seconds of an episode in this process; SUMO's own come on top",
            ("", "mean"),
            tuple((name, f"{np.nanmean(values['seconds'][:, t]):.2f}") for t, name in enumerate(episodes.traffic)),
        ),
    ]
    lines = list_verdicts(sets, models, ghost)
    lines.append(
        f"A road user that is no agent of the scenario came within 20 m of the ego in "
        f"{np.mean(values['num_strangers'][0, 0] > 0):.0%} of the episodes in truth."
    )
    shown = [name for name in (*REFERENCES, "constant velocity", *models) if name in episodes.traffic][: len(COLORS)]
    save_figure(out / "figure.png", draw_figure(sets, shown))
    environment = describe_environment()
    parts = [
        "# Planners in simulated traffic and in the world itself", "\n".join(f"* {line}" for line in lines),
        "![Scores of planners in the world itself and in simulated traffic](figure.png)",
        *(paragraph for table in tables for paragraph in table.paragraphs),
        f"Made with {format_origin(environment)}, on {environment['machine']}.",
    ]  # fmt: skip
    write_text(out / "report.md", "\n\n".join(parts) + "\n")
    return lines
