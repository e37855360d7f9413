"""The same scenario with the same noise before and after fine-tuning: what vanishes, what stays, what appears.

Nothing is picked by eye. Scenarios are sorted by how far the share of evaluated agents that collide or leave the road falls; shown are those
where it falls farthest, the one in the middle, and the one where it rises most. Of each, the rollout in which that shows most.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rlftsim.experiments.columns import SCORES
from rlftsim.experiments.compare import paired_values
from rlftsim.experiments.contestants import BASE, Base, FineTuned
from rlftsim.experiments.evaluate import simulate_states
from rlftsim.experiments.findings import (
    Experiment,
    Findings,
    TextTable,
    budget_note,
    result_table,
    row_numbers,
    verdict_line,
)
from rlftsim.experiments.workshop import Row, Workshop
from rlftsim.realism import build_scenario_log, compute_features
from rlftsim.recipes.models import find_device
from rlftsim.rollout.policy import Policy
from rlftsim.rollout.simulate import simulate
from rlftsim.scenario.batch import collate
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.scenario.types import Scenario
from rlftsim.viewer.page import Animation, Panel
from rlftsim.viewer.scene import build_scene, rollout_trajectories

BEFORE, AFTER = "base", "RLFTSim (MLOO)"
CONTESTANTS: dict[str, Base | FineTuned] = {BEFORE: BASE, AFTER: FineTuned("mloo")}
NUM_BEST = 3


@dataclass(frozen=True, eq=False)
class Pair:
    """A scenario as both models drive it, in the rollout of the same number."""

    place: str
    """In the order of scenarios, in words."""
    scenario_id: str
    rollout: int
    rates: tuple[float, float]
    """Events an evaluated agent, over all rollouts, before and after."""
    events: tuple[int, int]
    """Of the rollout that is shown."""
    animation: Animation


@dataclass(frozen=True, eq=False)
class Pairs:
    """What was measured and what is shown of it."""

    rows: Mapping[str, Row]
    pairs: tuple[Pair, ...]


def measure(workshop: Workshop) -> Pairs:
    """Both evaluations, and the scenarios that are to be shown simulated again."""
    rows = workshop.measure({name: (contestant,) for name, contestant in CONTESTANTS.items()})
    policies = {name: workshop.policy(contestant) for name, contestant in CONTESTANTS.items()}
    before, after = (rows[name] for name in CONTESTANTS)
    scenarios = ScenarioDataset(workshop.data, workshop.evaluation.split)
    chosen = choose_scenarios(*_event_rates(before, after))
    return Pairs(rows, tuple(_pair(place, scenarios.by_id(i), policies, workshop) for place, i in chosen.items()))


def choose_scenarios(
    ids: list[str], before: Float[np.ndarray, "n"], after: Float[np.ndarray, "n"], num_best: int = NUM_BEST
) -> dict[str, str]:
    """Ids of the scenarios to show by their place in the order, in words; each at most once, the best first.

    Args:
        ids: of the scenarios.
        before: how bad each is before.
        after: and after.
        num_best: of those that fall farthest.
    """
    order = [ids[i] for i in np.argsort(after - before, kind="stable")]
    places = {f"{n + 1}. of {len(ids)}": order[n] for n in range(min(num_best, len(order)))}
    places |= {"in the middle": order[len(order) // 2], f"last of {len(ids)}": order[-1]}
    first_place = {scenario_id: place for place, scenario_id in reversed(places.items())}
    return {place: i for place, i in places.items() if first_place[i] == place}


def conclude(measured: Pairs, workshop: Workshop) -> Findings:
    """The table, the pairs, and by which rule they were taken."""
    before, after = (measured.rows[name] for name in CONTESTANTS)
    cells = tuple(
        (pair.place, pair.scenario_id, str(pair.rollout), *(f"{r:.2f}" for r in pair.rates), *map(str, pair.events))
        for pair in measured.pairs
    )
    headings = ("place", "scenario", "rollout", "rate before", "rate after", "events before", "events after")
    note = (
        "Events: evaluated agents that collide, plus those that leave the road; who does both counts twice. Rate: events an evaluated agent, mean "
        "over rollouts."
    )
    return Findings(
        title="The same scenario with the same noise, before and after fine-tuning",
        tables=(
            result_table("All held-out scenarios", [before, after], SCORES),
            TextTable("What is shown", headings, cells, note),
        ),
        verdicts=tuple(
            f"{heading}, {verdict_line(before, after, column)}"
            for heading, column in (
                ("Collisions", "collision_rate"),
                ("Off-road driving", "offroad_rate"),
                ("RMM", "meta_metric"),
            )
        ),
        notes=(
            f"Scenarios are sorted by how far the rate falls. Shown are the {NUM_BEST} where it falls farthest, the one in the middle, and the "
            "one where it rises most or falls least; of each, the first rollout in which that shows most. No other rule, nothing picked by eye.",
            "Both models are handed the same uniform numbers, so they differ by what they make of them.",
            budget_note(workshop),
        ),
        numbers={
            "rows": row_numbers([before, after], SCORES),
            "pairs": [
                {"scenario_id": p.scenario_id, "rollout": p.rollout, "rates": p.rates, "events": p.events}
                for p in measured.pairs
            ],
        },
        animations=tuple(pair.animation for pair in measured.pairs),
    )


def _event_rates(before: Row, after: Row) -> tuple[list[str], Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Ids, and collision rate plus off-road rate of each scenario."""
    ids, *collisions = paired_values(before.mean, after.mean, "collision_rate")
    _, *offroad = paired_values(before.mean, after.mean, "offroad_rate")
    first, second = (np.nan_to_num(a) + np.nan_to_num(b) for a, b in zip(collisions, offroad))
    return list(ids), first, second


def _pair(place: str, scenario: Scenario, policies: Mapping[str, Policy], workshop: Workshop) -> Pair:
    device = find_device(workshop.device)
    log = build_scenario_log(scenario, device)
    marks = {
        name: compute_features(log, simulate_states(policy, scenario, workshop.evaluation, device))
        for name, policy in policies.items()
    }
    events = [_events(features.collision) + _events(features.offroad) for features in marks.values()]  # [N] each
    change = (events[1] - events[0]) * (1 if place.startswith("last") else -1)
    rollout = int(change.argmax())
    scene, batch = build_scene(scenario), collate([scenario]).to(device)
    panels = []
    for name, policy in policies.items():
        drawn = simulate(
            policy, batch, num_rollouts=range(rollout, rollout + 1), seed=workshop.evaluation.seed,
            sampling=workshop.evaluation.sampling,
        )  # fmt: skip
        shown = {mark: getattr(marks[name], mark)[rollout : rollout + 1].cpu() for mark in ("collision", "offroad")}
        panels.append(Panel(name, rollout_trajectories(scenario, drawn, row=0).with_evaluated_flags(scenario, **shown)))
    rates = [float(count.double().mean()) / len(scenario.evaluated_indices) for count in events]
    counts = [int(count[rollout]) for count in events]
    caption = (
        f"{place}, rollout {rollout}: {counts[0]} collisions and departures from the road before, {counts[1]} after; "
        f"over all rollouts {rates[0]:.2f} and {rates[1]:.2f} events an agent."
    )
    title = f"Scenario {scenario.scenario_id}"
    return Pair(
        place, scenario.scenario_id, rollout, (rates[0], rates[1]), (counts[0], counts[1]),
        Animation(title, scene, panels, caption=caption),
    )  # fmt: skip


def _events(happens: Bool[Tensor, "N E T"]) -> Tensor:
    """Agents to whom it ever happens, by rollout."""
    return happens.any(-1).sum(-1).to(torch.int64)


EXPERIMENT = Experiment(
    question="What changes in a scenario that is driven with the same noise before and after fine-tuning?",
    measure=measure,
    conclude=conclude,
)
