"""The same scenario with the same noise before and after fine-tuning.

No scenario is picked by eye. Scenarios are sorted by the decrease in the rate of evaluated agents that collide or
leave the road. Shown are those of the largest decrease, the middle of the
order, and the largest increase; of each, the rollout with the largest change.
"""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from rlftsim.evaluation.columns import SCORES
from rlftsim.evaluation.compare import paired_values
from rlftsim.experiments.model_specs import BASE, Base, FineTuned
from rlftsim.experiments.paired_animation import PairedAnimation, animate_pair
from rlftsim.experiments.results import Experiment, ExperimentResult
from rlftsim.experiments.suite import ExperimentSuite
from rlftsim.experiments.tables import RMM, Row, TextTable, build_table, to_numbers
from rlftsim.scenario.dataset import ScenarioDataset

SPECS: dict[str, Base | FineTuned] = {"base": BASE, "RLFTSim (MLOO)": FineTuned("mloo")}
NUM_BEST = 3
VERDICTS = {"Collisions": "collision_rate", "Off-road driving": "offroad_rate", "RMM": RMM}


Pairs = tuple[Mapping[str, Row], Mapping[str, PairedAnimation]]
"""Rows of both models, and the animations by rank in the order of scenarios, in words."""


def run(suite: ExperimentSuite) -> Pairs:
    """Both rows, and the chosen scenarios simulated again."""
    rows = suite.evaluate({name: (spec,) for name, spec in SPECS.items()})
    policies = {name: suite.policy(spec) for name, spec in SPECS.items()}
    # Rate of events of a scenario: collision rate plus off-road rate.
    base, tuned = (rows[name].mean for name in SPECS)
    # A rate may be missing, such as off-road driving on a map without road edges: it counts as 0.
    ids, *collisions = paired_values(base, tuned, "collision_rate")
    _, *offroad = paired_values(base, tuned, "offroad_rate")
    rates = [np.nan_to_num(a) + np.nan_to_num(b) for a, b in zip(collisions, offroad)]  # [scenarios], base and tuned
    scenarios = ScenarioDataset(suite.data, suite.evaluation.split)
    animations = {
        rank: animate_pair(
            rank, scenarios.by_id(scenario_id), policies, suite, prefers_increase=rank.startswith("last")
        )
        for rank, scenario_id in choose_scenarios(list(ids), rates[0], rates[1]).items()
    }
    return rows, animations


def choose_scenarios(
    ids: list[str], base_rate: Float[np.ndarray, "n"], tuned_rate: Float[np.ndarray, "n"], num_best: int = NUM_BEST
) -> dict[str, str]:
    """Ids of the scenarios to show by rank in the order, in words; each at most once, the best first.

    Args:
        ids: Ids of all n scenarios.
        base_rate: Rate of events [n] in each scenario before fine-tuning.
        tuned_rate: Rate of events [n] after fine-tuning.
        num_best: Number of scenarios with the largest decrease to show.
    """
    order = [ids[i] for i in np.argsort(tuned_rate - base_rate, kind="stable")]
    by_rank = {f"{n + 1}. of {len(ids)}": scenario_id for n, scenario_id in enumerate(order[:num_best])}
    by_rank |= {"in the middle": order[len(order) // 2], f"last of {len(ids)}": order[-1]}
    # With few scenarios one may have several ranks: it keeps the first.
    first_rank = {scenario_id: rank for rank, scenario_id in reversed(by_rank.items())}
    return {rank: scenario_id for rank, scenario_id in by_rank.items() if first_rank[scenario_id] == rank}


def summarize(pairs: Pairs, suite: ExperimentSuite) -> ExperimentResult:
    """The table, the animations, and the rule that chose the scenarios.

    Args:
        pairs: Rows and animations that `run` made; no rollout is simulated here.
        suite: Suite with the budget for the notes.
    """
    rows, animations = pairs
    base, tuned = (rows[name] for name in SPECS)
    cells = tuple(
        (rank, pair.scenario_id, str(pair.rollout), *(f"{r:.2f}" for r in pair.rates), *map(str, pair.events))
        for rank, pair in animations.items()
    )
    headings = ("place", "scenario", "rollout", "rate before", "rate after", "events before", "events after")
    note = (
        "Events: evaluated agents that collide, plus those that leave the road; an agent that does both counts "
        "twice. Rate: events an evaluated agent, mean over rollouts."
    )
    return ExperimentResult(
        title="The same scenario with the same noise, before and after fine-tuning",
        tables=(
            build_table("All held-out scenarios", [base, tuned], SCORES),
            TextTable("Shown", headings, cells, note),
        ),
        verdicts=tuple(f"{heading}, {tuned.against(base, column)}" for heading, column in VERDICTS.items()),
        notes=(
            f"Scenarios are sorted by the decrease in the rate. Shown are the {NUM_BEST} of the largest decrease, "
            "the one in the middle, and the one of the largest increase or smallest decrease; of each, the first "
            "rollout with the largest change. No other rule, nothing picked by eye.",
            "Both models get the same uniform noise, so all differences come from the models.",
            suite.budget.note,
        ),
        numbers={
            "rows": to_numbers([base, tuned], SCORES),
            "pairs": [
                {name: getattr(pair, name) for name in ("scenario_id", "rollout", "rates", "events")}
                for pair in animations.values()
            ],
        },
        animations=tuple(pair.animation for pair in animations.values()),
    )


EXPERIMENT = Experiment(
    "What changes in a scenario that is driven with the same noise before and after fine-tuning?", run, summarize
)
