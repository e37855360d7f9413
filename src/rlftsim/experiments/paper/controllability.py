"""Basis of the experiments in which only the ego has a goal, given alone: models, rates by scenario, curves."""

from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from rlftsim.evaluation.columns import format_estimate
from rlftsim.evaluation.goal_attainment import Attained, attain_goals
from rlftsim.evaluation.scenario_source import choose_scenarios
from rlftsim.experiments.model_specs import BASE, ModelSpec
from rlftsim.experiments.paper.goal_conditioning import GOAL_FREE, GUIDED, START
from rlftsim.experiments.suite import ExperimentSuite
from rlftsim.experiments.tables import TextTable
from rlftsim.goals.goals_file import GoalEntry
from rlftsim.policies.registry import load_policy
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.statistics import MeanInterval, mean_interval
from rlftsim.viewer.figure import Band, draw_subplots

RATES = {"passed": "passed [%]", "reached": "reached [%]"}
"""Fractions of the rollouts of a goal (attributes of `Attained`), and their headings."""
SEED_NOTE = "Of every fine-tuned row one model is evaluated, that of seed 0, whatever `--seeds` says."
ROWS: Mapping[str, ModelSpec] = {"base": BASE, START: GOAL_FREE, **GUIDED}
Attainment = Mapping[str, tuple[Attained, ...]]
"""Outcome of every goal, in the order of the goals, by row."""
Curves = Mapping[str, Mapping[str, MeanInterval]]
"""Mean rates by row and heading."""


def open_held_out(suite: ExperimentSuite) -> tuple[ScenarioDataset, tuple[str, ...]]:
    """Held-out scenarios of a suite, and the ids to measure on."""
    dataset = ScenarioDataset(suite.data, suite.evaluation.split)
    return dataset, tuple(choose_scenarios(dataset, suite.evaluation))


def measure_attainment(
    suite: ExperimentSuite, rows: Mapping[str, ModelSpec], goals: Sequence[GoalEntry], *, name: str
) -> dict[str, tuple[Attained, ...]]:
    """Attainment of every goal by each row's model, in the order of the goals; missing models are trained.

    Args:
        suite: Scenarios, settings and models; outcomes that the folder already has are read, not measured again.
        rows: Model specifications by row. Models without goal conditioning are measured against
            the same goals, as a baseline.
        goals: Goals of the suite's scenarios; each is given alone, whatever goals the scenario has besides.
        name: Name of the folder of outcomes, that of the experiment.
    """
    models, attained = suite.models(list(rows.values())), {}
    for row, spec in rows.items():
        out = suite.out / "attainment" / name / suite.evaluation_name(spec)
        policy = load_policy(models[spec], suite.device)
        attained[row] = attain_goals(policy, suite.data, out, suite.evaluation, goals, title=f"goals, {row}")
    return attained


def compute_scenario_rates(outcomes: Iterable[Attained], rate: str) -> dict[str, float]:
    """Mean rate over the goals of each scenario, by scenario id.

    Args:
        outcomes: Outcomes of goals, several per scenario at will.
        rate: Attribute of `Attained`, such as "passed" or "reached_once".
    """
    # The scenario is the unit of all intervals: goals of one scenario are not independent.
    rates: dict[str, list[float]] = {}
    for outcome in outcomes:
        rates.setdefault(outcome.entry.scenario_id, []).append(getattr(outcome, rate))
    return {scenario_id: float(np.mean(values)) for scenario_id, values in rates.items()}


def estimate_mean(values: Iterable[float]) -> MeanInterval:
    """Mean of rates with an interval; NaN without a single rate."""
    return mean_interval(np.array(list(values), float))


def estimate_curves(
    attained: Attainment, headings: Iterable[str], select_rates: Callable[[Sequence[Attained], str], Iterable[float]]
) -> Curves:
    """Mean rate of each row under each heading.

    Args:
        attained: Outcomes of the goals by row.
        headings: Names of the conditions that goals are in, such as offsets in time.
        select_rates: Function of a row's outcomes and a heading that returns the rates of which the mean is taken.
    """
    headings = list(headings)
    return {row: {h: estimate_mean(select_rates(outcomes, h)) for h in headings} for row, outcomes in attained.items()}


def build_rate_table(title: str, curves: Curves, unit: str = "") -> TextTable:
    """Table of mean rates in percent with standard errors.

    Args:
        title: Title above the table.
        curves: Rates by row and heading; all rows have the same goals.
        unit: Words of the note for the unit of the rates, such as "percentage of rollouts, ".
    """
    count = max(mean.count for curve in curves.values() for mean in curve.values())
    cells = tuple((row, *map(format_rate, curve.values())) for row, curve in curves.items())
    note = f"Ego of {count} held-out scenarios; {unit}mean ± standard error over scenarios."
    return TextTable(title, ("", *next(iter(curves.values()))), cells, note)


def format_rate(rate: MeanInterval) -> str:
    """Mean rate in percent with standard error; a dash without a single rate."""
    return format_estimate(rate, lambda value: f"{100 * value:.1f}")


def format_verdict(start_rates: Mapping[str, float], rates: Mapping[str, float]) -> str:
    """Verdict on the mean gain of rates, paired by scenario, in percentage points.

    Args:
        start_rates: Rates of the goal-free model by scenario id.
        rates: Rates of the compared model; all of these scenarios are in `start_rates`.
    """
    gain = estimate_mean(rate - start_rates[scenario_id] for scenario_id, rate in rates.items())
    if gain.count < 2:
        return "no verdict: fewer than two scenarios."
    low, high = (100 * limit for limit in gain.interval)
    verdict = "no difference" if low <= 0 <= high else f"difference, for the {'better' if gain.mean > 0 else 'worse'}"
    return (
        f"{verdict}: {100 * gain.mean:+.1f} points, 95% interval over {gain.count} scenarios [{low:+.1f}, {high:+.1f}]."
    )


def draw_rates(
    panels: Mapping[str, Curves], *, title: str, x_label: str, ticks: Sequence[str], is_joined: bool = True
) -> Figure:
    """Figure of rates in percent, two panels in a row; models without goals are dashed.

    Args:
        panels: Curves of each panel by title, with a rate for each tick.
        title: Title above all panels.
        x_label: Quantity and unit of the horizontal axes.
        ticks: Names of the positions on the horizontal axis.
        is_joined: True joins the dots of a curve, where the ticks have an order.
    """
    bands = {heading: _build_bands(curves) for heading, curves in panels.items()}
    y_label = "rollouts [%], 95 % interval"
    return draw_subplots(bands, title=title, x_label=x_label, y_label=y_label, ticks=ticks, is_joined=is_joined)


def _build_bands(curves: Curves) -> tuple[Band, ...]:
    bands = []
    for number, (name, curve) in enumerate(curves.items()):
        # Curves are shifted a little, so that their intervals lie beside each other.
        x = np.arange(len(curve)) + 0.07 * (number - (len(curves) - 1) / 2)
        mean, low, high = 100 * np.array([(m.mean, *m.interval) for m in curve.values()]).T  # each [ticks]
        has_goals = name in GUIDED
        color = list(GUIDED).index(name) if has_goals else 4 + (name == START)
        style = "measured" if has_goals else "theory"
        bands.append(Band(name, x, mean, low.clip(0, 100), high.clip(0, 100), style=style, color=color))
    return tuple(bands)
