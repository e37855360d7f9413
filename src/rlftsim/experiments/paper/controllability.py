"""Common parts of the experiments in which only the ego has a goal, one at a time: models, rates by scenario,
verdicts, curves."""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from rlftsim.evaluation.goal_attainment import Attained
from rlftsim.experiments.model_specs import BASE
from rlftsim.experiments.paper.goal_conditioning import GOAL_FREE, GUIDED, START
from rlftsim.experiments.suite import ExperimentSuite
from rlftsim.experiments.suite_goals import measure_attainment
from rlftsim.goals.goals_file import GoalEntry
from rlftsim.statistics import MeanInterval, mean_interval
from rlftsim.viewer.figure import Band

RATES = {"passed": "passed [%]", "reached": "reached [%]"}
"""Fractions of the rollouts of a goal (attributes of `Attained`), and their headings."""
SEED_NOTE = "Of every fine-tuned row one model is evaluated, that of seed 0, whatever `--seeds` says."
Attainment = Mapping[str, tuple[Attained, ...]]
"""Outcome of every goal, in the order of the goals, by row."""


def attain(suite: ExperimentSuite, goals: Sequence[GoalEntry], name: str) -> dict[str, tuple[Attained, ...]]:
    """Outcome of every goal with the base model, the goal-free model and the four guided variants.

    Args:
        suite: models and settings; models that are missing are trained.
        goals: each is given alone. Models without goal conditioning are measured against the same goals.
        name: of the experiment, and of the folder with the outcomes.
    """
    return measure_attainment(suite, {"base": BASE, START: GOAL_FREE, **GUIDED}, goals, name=name)


def rates_by_scenario(attained: Iterable[Attained], rate: str) -> dict[str, float]:
    """Mean rate over the goals of each scenario.

    Args:
        attained: outcomes of goals.
        rate: attribute of `Attained`.
    """
    # The scenario is the unit of all intervals: goals of one scenario are not independent.
    collected: dict[str, list[float]] = {}
    for one in attained:
        collected.setdefault(one.entry.scenario_id, []).append(getattr(one, rate))
    return {scenario_id: float(np.mean(own)) for scenario_id, own in collected.items()}


def estimate(values: Iterable[float]) -> MeanInterval:
    """Mean of rates with its interval; NaN without a single one."""
    return mean_interval(np.array(list(values), float))


def paired_gain(before: Mapping[str, float], after: Mapping[str, float]) -> MeanInterval:
    """Mean gain of rates, paired by scenario.

    Args:
        before: rates by scenario.
        after: rates by scenario; all of these scenarios are in `before`.
    """
    return estimate(after[scenario_id] - before[scenario_id] for scenario_id in after)


def cell(rate: MeanInterval) -> str:
    """A mean rate in percent with its standard error, where there is one; a dash without a single rate."""
    if not rate.count:
        return "–"
    error = f" ± {100 * rate.standard_error:.1f}" if rate.count > 1 else ""
    return f"{100 * rate.mean:.1f}{error}"


def gain_verdict(gain: MeanInterval) -> str:
    """A paired difference of rates as a verdict, in percentage points."""
    low, high = (100 * v for v in gain.interval)
    if gain.count < 2:
        return "no verdict: fewer than two scenarios."
    verdict = "no difference" if low <= 0 <= high else f"difference, for the {'better' if gain.mean > 0 else 'worse'}"
    return (
        f"{verdict}: {100 * gain.mean:+.1f} points, 95% interval over {gain.count} scenarios [{low:+.1f}, {high:+.1f}]."
    )


def bands_of(curves: Mapping[str, Sequence[MeanInterval]]) -> tuple[Band, ...]:
    """Curves of rates in percent for a figure; models without goals are dashed."""
    bands = []
    for number, (name, curve) in enumerate(curves.items()):
        # Curves are shifted a little, so that their intervals lie beside each other.
        x = np.arange(len(curve)) + 0.07 * (number - (len(curves) - 1) / 2)
        mean, low, high = (100 * np.array(v) for v in ([m.mean for m in curve], *zip(*(m.interval for m in curve))))
        has_goals = name in GUIDED
        color = list(GUIDED).index(name) if has_goals else 4 + (name == START)
        style = "measured" if has_goals else "theory"
        bands.append(Band(name, x, mean, low.clip(0, 100), high.clip(0, 100), style=style, color=color))
    return tuple(bands)
