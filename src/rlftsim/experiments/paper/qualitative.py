"""The same scenario with the same noise before and after fine-tuning.

Nothing is picked by eye. Scenarios are sorted by the decrease in the rate of evaluated agents that collide or
leave the road. Shown are those of the largest decrease, the one in the middle, and the one of the largest
increase; of each, the rollout with the largest change.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from rlftsim.evaluation.columns import SCORES
from rlftsim.evaluation.compare import paired_values
from rlftsim.experiments import tables
from rlftsim.experiments.model_specs import BASE, Base, FineTuned
from rlftsim.experiments.paired_animation import PairedAnimation, animate_pair
from rlftsim.experiments.results import Experiment, ExperimentResult
from rlftsim.experiments.rows import RMM, Row
from rlftsim.experiments.suite import ExperimentSuite
from rlftsim.scenario.dataset import ScenarioDataset

BEFORE, AFTER = "base", "RLFTSim (MLOO)"
SPECS: dict[str, Base | FineTuned] = {BEFORE: BASE, AFTER: FineTuned("mloo")}
NUM_BEST = 3
VERDICTS = {"Collisions": "collision_rate", "Off-road driving": "offroad_rate", "RMM": RMM}


@dataclass(frozen=True, eq=False)
class Pairs:
    """Rows of both models, and the animations that are shown, by their place in the order of scenarios."""

    rows: Mapping[str, Row]
    shown: Mapping[str, PairedAnimation]


def run(suite: ExperimentSuite) -> Pairs:
    """Both rows, and the chosen scenarios simulated again."""
    rows = suite.evaluate({name: (spec,) for name, spec in SPECS.items()})
    policies = {name: suite.policy(spec) for name, spec in SPECS.items()}
    # Rate of events of a scenario: collision rate plus off-road rate.
    before, after = (rows[name].mean for name in SPECS)
    # A rate may be missing, such as off-road driving on a map without road edges: it counts as 0.
    ids, *collisions = paired_values(before, after, "collision_rate")
    _, *offroad = paired_values(before, after, "offroad_rate")
    rates = [np.nan_to_num(a) + np.nan_to_num(b) for a, b in zip(collisions, offroad)]  # [scenarios], before and after
    scenarios, shown = ScenarioDataset(suite.data, suite.evaluation.split), {}
    for place, scenario_id in choose_scenarios(list(ids), rates[0], rates[1]).items():
        scenario, is_worst = scenarios.by_id(scenario_id), place.startswith("last")
        shown[place] = animate_pair(place, scenario, policies, suite, prefers_increase=is_worst)
    return Pairs(rows, shown)


def choose_scenarios(
    ids: list[str], before: Float[np.ndarray, "n"], after: Float[np.ndarray, "n"], num_best: int = NUM_BEST
) -> dict[str, str]:
    """Ids of the scenarios to show by their place in the order, in words; each at most once, the best first.

    Args:
        ids: of the scenarios.
        before: rate of events of each scenario before fine-tuning.
        after: and after it.
        num_best: of those with the largest decrease.
    """
    order = [ids[i] for i in np.argsort(after - before, kind="stable")]
    places = {f"{n + 1}. of {len(ids)}": order[n] for n in range(min(num_best, len(order)))}
    places |= {"in the middle": order[len(order) // 2], f"last of {len(ids)}": order[-1]}
    # With few scenarios one may have several places: it keeps the first.
    first_place = {scenario_id: place for place, scenario_id in reversed(places.items())}
    return {place: i for place, i in places.items() if first_place[i] == place}


def summarize(pairs: Pairs, suite: ExperimentSuite) -> ExperimentResult:
    """The table, the animations, and the rule by which they were chosen.

    Args:
        pairs: of `run`; the animations are made already, nothing is simulated here.
        suite: for the notes.
    """
    before, after = (pairs.rows[name] for name in SPECS)
    cells = tuple(
        (place, one.scenario_id, str(one.rollout), *(f"{r:.2f}" for r in one.rates), *map(str, one.events))
        for place, one in pairs.shown.items()
    )
    headings = ("place", "scenario", "rollout", "rate before", "rate after", "events before", "events after")
    note = (
        "Events: evaluated agents that collide, plus those that leave the road; an agent that does both counts "
        "twice. Rate: events an evaluated agent, mean over rollouts."
    )
    return ExperimentResult(
        title="The same scenario with the same noise, before and after fine-tuning",
        tables=(
            tables.build_table("All held-out scenarios", [before, after], SCORES),
            tables.TextTable("Shown", headings, cells, note),
        ),
        verdicts=tuple(f"{heading}, {after.against(before, column)}" for heading, column in VERDICTS.items()),
        notes=(
            f"Scenarios are sorted by the decrease in the rate. Shown are the {NUM_BEST} of the largest decrease, "
            "the one in the middle, and the one of the largest increase or smallest decrease; of each, the first "
            "rollout with the largest change. No other rule, nothing picked by eye.",
            "Both models get the same uniform noise, so all differences come from the models.",
            suite.budget.note,
        ),
        numbers={
            "rows": tables.to_numbers([before, after], SCORES),
            "pairs": [
                {"scenario_id": p.scenario_id, "rollout": p.rollout, "rates": p.rates, "events": p.events}
                for p in pairs.shown.values()
            ],
        },
        animations=tuple(one.animation for one in pairs.shown.values()),
    )


EXPERIMENT = Experiment(
    "What changes in a scenario that is driven with the same noise before and after fine-tuning?", run, summarize
)
