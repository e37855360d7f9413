"""Figure 3: how much a rollout's reward scatters, against the number N of rollouts it is computed from.

Many rollouts of a scenario are simulated once. For each N, random subsets of N of them are scored as training would score them, and
the rewards of all their members are kept; their mean is 0 by construction, so their mean square is their variance.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from matplotlib.figure import Figure
from torch import Tensor

from rlftsim.errors import ConfigError, DataError
from rlftsim.experiments.evaluate import EvaluateConfig, check_jobs, choose_scenarios, simulate_states
from rlftsim.experiments.findings import Experiment, Findings, TextTable
from rlftsim.experiments.workshop import Workshop
from rlftsim.files import write_text
from rlftsim.intervals import MeanInterval, mean_interval
from rlftsim.processor import one_thread
from rlftsim.progress import progress_bar
from rlftsim.realism import Features, ScenarioLog, build_scenario_log, compute_features, metric_by_name, score_features
from rlftsim.recipes.models import load_policy
from rlftsim.rollout.policy import Policy, device_of
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.scenario.types import Scenario
from rlftsim.training.rewards.base import leave_one_out
from rlftsim.training.rewards.mloo import compute_mloo
from rlftsim.viewer.figure import Band, draw_bands
from rlftsim.workers import run_tasks

SIZES = (2, 3, 4, 6, 8, 12, 16, 24, 32)
REWARDS = ("mloo", "rloo")
FROM_SIZES = (2, 8)
"""Slopes are fitted from each of these on: over all N, and where N is large enough for laws of large numbers."""
MIN_SIZES_FOR_A_SLOPE = 3
MEMBERS_A_SIZE = 128
"""Rewards averaged over for each N, about; whole subsets of N are drawn until there are as many."""
CLAIMED_SLOPE = {"mloo": -2.0, "rloo": 0.0}
"""Of the logarithm of the variance against that of N, as the paper has it for large N."""

RewardsOf = Callable[[Int[np.ndarray, "n"]], tuple[Tensor, Tensor]]
"""From the numbers of some rollouts to the `mloo` and `rloo` reward [n] of each among just these."""


@dataclass(frozen=True, eq=False)
class Variances:
    """Variance of the reward of a rollout, by scenario and number of rollouts."""

    scenario_ids: tuple[str, ...]
    sizes: tuple[int, ...]
    by_reward: dict[str, Float[np.ndarray, "scenarios sizes"]]


def measure(workshop: Workshop) -> Variances:
    """Variances of the base model's rewards; a file a scenario is kept, so an interrupted measurement goes on."""
    config = workshop.evaluation
    dataset = ScenarioDataset(workshop.data, config.split)
    sizes = tuple(size for size in SIZES if size <= config.num_rollouts)
    if len(sizes) < MIN_SIZES_FOR_A_SLOPE:
        raise ConfigError(
            f"a slope over N = 2, 3, 4, ... needs 4 rollouts at least, got {config.num_rollouts}: set --num-rollouts 32."
        )
    job = _Job(
        load_policy(str(workshop.base()), workshop.device), workshop.data, config, sizes, workshop.out / "variances"
    )
    check_jobs(config, device_of(job.policy))
    chosen = choose_scenarios(dataset, config)
    ids = [dataset.scenario_ids[i] for i in chosen]
    missing = [i for i in chosen if _read(job.path_of(dataset.scenario_ids[i]), sizes) is None]
    with progress_bar("variances", len(chosen), len(chosen) - len(missing)) as advance, one_thread():
        run_tasks(partial(_measure_scenario, job), missing, jobs=config.jobs, advance=advance)
    found = [(scenario_id, _read(job.path_of(scenario_id), sizes)) for scenario_id in ids]
    kept = [(scenario_id, values) for scenario_id, values in found if values is not None and len(values)]
    if not kept:
        raise DataError(f"{workshop.data}: not one of {len(ids)} scenarios can be scored.")
    stacked = np.stack([values for _, values in kept])  # [scenarios, rewards, sizes]
    return Variances(tuple(i for i, _ in kept), sizes, {name: stacked[:, k] for k, name in enumerate(REWARDS)})  # fmt: skip


def variance_by_size(
    rewards_of: RewardsOf, num_rollouts: int, sizes: Sequence[int], rng: np.random.Generator
) -> Float[np.ndarray, "rewards sizes"]:
    """Mean square of the rewards in random subsets of the rollouts.

    Args:
        rewards_of: scores a subset.
        num_rollouts: to draw from.
        sizes: numbers of rollouts in a subset.
        rng: draws.
    """
    variances = np.zeros((len(REWARDS), len(sizes)))
    for column, size in enumerate(sizes):
        num_subsets = 1 if size == num_rollouts else max(MEMBERS_A_SIZE // size, 2)
        chosen = [np.sort(rng.permutation(num_rollouts)[:size]) for _ in range(num_subsets)]
        squares = [[float(reward.double().square().mean()) for reward in rewards_of(subset)] for subset in chosen]
        variances[:, column] = np.mean(squares, axis=0)
    return variances


def slope_of(variance: Float[np.ndarray, "sizes"], sizes: Sequence[int], first: int = 0) -> float:
    """Of the straight line fitted to the logarithms from the size `first` on; NaN where a variance is zero."""
    used = np.array(sizes) >= first
    if not (variance > 0).all():
        return float("nan")
    return float(np.polyfit(np.log(np.array(sizes)[used]), np.log(variance[used]), 1)[0])


def law(sizes: Sequence[int]) -> dict[str, Float[np.ndarray, "sizes"]]:
    """How the variances fall for a metric that is a mean over independent rollouts: 1 / (N (N - 1)) and N / (N - 1)."""
    size = np.array(sizes, float)
    return {"mloo": 1 / (size * (size - 1)), "rloo": size / (size - 1)}


@dataclass(frozen=True)
class Scaling:
    """What the variances of one reward say."""

    middle: Float[np.ndarray, "sizes"]
    """Geometric mean over scenarios."""
    low: Float[np.ndarray, "sizes"]
    """One standard deviation of the logarithm below."""
    high: Float[np.ndarray, "sizes"]
    alpha: float
    """Of alpha / N^2, fitted to the logarithms of `middle`."""
    slopes: dict[int, MeanInterval]
    """Over the scenarios' own slopes, by the smallest size they are fitted to."""


def scaling_of(variance: Float[np.ndarray, "scenarios sizes"], sizes: Sequence[int]) -> Scaling:
    """Fit of one reward; scenarios in which a reward never varies are left out."""
    varied = np.log(variance[(variance > 0).all(1)])
    middle, spread = varied.mean(0), varied.std(0)
    slopes = {
        first: mean_interval(np.array([slope_of(line, sizes, first) for line in np.exp(varied)]))
        for first in FROM_SIZES
        if sum(size >= first for size in sizes) >= MIN_SIZES_FOR_A_SLOPE
    }
    alpha = float(np.exp((middle + 2 * np.log(sizes)).mean()))
    return Scaling(np.exp(middle), np.exp(middle - spread), np.exp(middle + spread), alpha, slopes)


def conclude(measured: Variances, workshop: Workshop) -> Findings:
    """Slopes with their intervals, beside what the paper claims and what independent rollouts would give."""
    sizes = measured.sizes
    scalings = {name: scaling_of(values, sizes) for name, values in measured.by_reward.items()}
    expected = {
        (name, first): slope_of(curve, sizes, first)
        for name, curve in law(sizes).items()
        for first in scalings[name].slopes
    }
    rows = tuple((str(size), *(f"{scalings[name].middle[k]:.3g}" for name in REWARDS)) for k, size in enumerate(sizes))
    note = f"Geometric mean over the scenarios; base model, metric {workshop.evaluation.metric}."
    return Findings(
        title="Variance of the rewards against the number of rollouts",
        tables=(TextTable("Variance of a rollout's reward", ("N", "MLOO", "RLOO"), rows, note), _slopes(scalings, expected)),
        verdicts=tuple(_verdict(name, first, scalings[name], expected[name, first]) for name, first in expected),
        notes=(
            "The paper fits alpha / N² to its MLOO curve (Fig. 3) and gives no slope; it finds RLOO to flatten out.",
            "Its proof has 1 / (N (N − 1)) for MLOO, which is steeper than 1 / N² at small N, and N / (N − 1) for RLOO: the "
            "slopes of independent rollouts are those of these laws over the same N. They hold where a score is a mean over rollouts; the "
            "meta-metric is one only when N is large: of few rollouts it is a geometric mean of nearly empty histograms.",
            "Small variance alone makes no better gradient: a reward that is scaled down has it too. What matters is the "
            "variance beside the differences that a policy is to learn.",
        ),
        numbers={
            "sizes": sizes,
            "rewards": {
                name: {
                    "variance": s.middle.tolist(),
                    "alpha": s.alpha,
                    "slopes": [
                        {"from_size": first, "slope": m.mean, "interval": m.interval, "of_law": expected[name, first], "scenarios": m.count}
                        for first, m in s.slopes.items()
                    ],
                }
                for name, s in scalings.items()
            },
            "scenario_ids": measured.scenario_ids,
            "by_scenario": {name: values.tolist() for name, values in measured.by_reward.items()},
        },
        figure=_figure(scalings, sizes),
    )  # fmt: skip


def _slopes(scalings: dict[str, Scaling], expected: dict[tuple[str, int], float]) -> TextTable:
    rows = []
    for (name, first), law_slope in expected.items():
        slope = scalings[name].slopes[first]
        low, high = slope.interval
        numbers = (f"{slope.mean:.3f}", f"[{low:.3f}, {high:.3f}]", f"{law_slope:.3f}", f"{CLAIMED_SLOPE[name]:g}")
        rows.append((f"{name.upper()}, N ≥ {first}", *numbers))
    headings = ("", "slope", "95 % interval", "of independent rollouts", "the paper, large N")
    note = "Mean and interval over the scenarios' own slopes (Student's t)."
    return TextTable("Slope in logarithms", headings, tuple(rows), note)


def _verdict(name: str, first: int, scaling: Scaling, expected: float) -> str:
    slope = scaling.slopes[first]
    low, high = slope.interval
    if slope.count < 2:
        return f"{name.upper()}, N ≥ {first}: no verdict: fewer than two scenarios in which the reward varies."
    verdict = "no difference from" if low <= expected <= high else "difference from"
    return (
        f"{name.upper()}, N ≥ {first}: {verdict} the slope {expected:.3f} of independent rollouts: slope {slope.mean:.3f}, "
        f"95% interval over {slope.count} scenarios [{low:.3f}, {high:.3f}]."
    )


def _figure(scalings: dict[str, Scaling], sizes: Sequence[int]) -> Figure:
    across = np.array(sizes, float)
    mloo, rloo = scalings["mloo"], scalings["rloo"]
    bands = [
        Band("MLOO", across, mloo.middle, mloo.low, mloo.high),
        Band(f"{mloo.alpha:.2g} / N²", across, mloo.alpha / across**2, style="theory"),
        Band("RLOO", across, rloo.middle, rloo.low, rloo.high, colour=1),
    ]
    return draw_bands(
        bands, title="Variance of a rollout's reward", x_label="rollouts N", log=True, ticks=sizes,
        y_label="variance, geometric mean ± 1 std",
    )  # fmt: skip


# ---- one scenario -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Job:
    """Handed to other processes."""

    policy: Policy
    data: Path
    config: EvaluateConfig
    sizes: tuple[int, ...]
    folder: Path

    def path_of(self, scenario_id: str) -> Path:
        return self.folder / f"{scenario_id}.json"


def _read(path: Path, sizes: Sequence[int]) -> Float[np.ndarray, "..."] | None:
    """What was measured in a scenario [rewards, sizes]; empty for one without scores, None where it is missing or damaged."""
    try:
        values = json.loads(path.read_text())
    except (OSError, ValueError):
        return None
    return np.array(values["variances"], float) if values.get("sizes") == list(sizes) else None


def _measure_scenario(job: _Job, position: int, advance: Callable[[int], None], is_stopped: Callable[[], bool]) -> None:
    if is_stopped():
        return
    scenario = ScenarioDataset(job.data, job.config.split, cache_size=1)[position]
    values: dict[str, object] = {"sizes": list(job.sizes), "variances": []}
    try:
        values["variances"] = _variances_of(scenario, job).tolist()
    except DataError as error:
        values["skipped"] = str(error)
    write_text(job.path_of(scenario.scenario_id), json.dumps(values) + "\n")
    advance(1)


def _variances_of(scenario: Scenario, job: _Job) -> Float[np.ndarray, "rewards sizes"]:
    """Simulate once, score subsets.

    Raises:
        DataError: the scenario cannot be scored.
    """
    device = device_of(job.policy)
    log = build_scenario_log(scenario, device)
    features = compute_features(log, simulate_states(job.policy, scenario, job.config, device))
    rewards_of = partial(_rewards_of, log, features, job.config.metric)
    rng = np.random.default_rng([job.config.seed, *scenario.scenario_id.encode()])
    return variance_by_size(rewards_of, job.config.num_rollouts, job.sizes, rng)


def _rewards_of(
    log: ScenarioLog, features: Features, metric: str, chosen: Int[np.ndarray, "n"]
) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"]]:
    """Both rewards of some rollouts, as training computes them from these rollouts alone."""
    index = torch.from_numpy(chosen).to(features.linear_speed.device)
    some = {name: values[index] for name, values in vars(features).items() if isinstance(values, Tensor)}
    scores = score_features(log, replace(features, **some), metric_by_name(metric))  # type: ignore[arg-type]
    return compute_mloo(scores.leave_one_out_meta_metric[None])[0], leave_one_out(scores.single_meta_metric[None])[0]


EXPERIMENT = Experiment(
    question="Does the variance of the leave-one-out reward fall with the square of the number of rollouts?",
    measure=measure,
    conclude=conclude,
)
