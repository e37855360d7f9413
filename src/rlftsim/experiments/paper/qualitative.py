"""The same scenario with the same noise before and after fine-tuning.

Nothing is picked by eye. Scenarios are sorted by the decrease in the rate of evaluated agents that collide or
leave the road. Shown are those of the largest decrease, the one in the middle, and the one of the largest
increase; of each, the rollout with the largest change.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from rlftsim.evaluation.columns import SCORES
from rlftsim.evaluation.compare import paired_values
from rlftsim.evaluation.evaluate import simulate_states
from rlftsim.experiments import tables
from rlftsim.experiments.model_specs import BASE, Base, FineTuned
from rlftsim.experiments.results import Experiment, ExperimentResult
from rlftsim.experiments.rows import RMM, Row
from rlftsim.experiments.suite import ExperimentSuite
from rlftsim.policies.registry import find_device
from rlftsim.realism import compute_features, scenario_log
from rlftsim.rollout.policy import Policy
from rlftsim.rollout.simulate import simulate
from rlftsim.scenario.batch import collate
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.scenario.types import Scenario
from rlftsim.viewer.page import Animation, Panel
from rlftsim.viewer.scene import build_scene, rollout_trajectories

SPECS: dict[str, Base | FineTuned] = {"base": BASE, "RLFTSim (MLOO)": FineTuned("mloo")}
NUM_BEST = 3
VERDICTS = {"Collisions": "collision_rate", "Off-road driving": "offroad_rate", "RMM": RMM}


@dataclass(frozen=True, eq=False)
class PairedAnimation:
    """One rollout of a scenario by two policies with the same noise."""

    scenario_id: str
    rollout: int
    rates: tuple[float, float]
    """Events an evaluated agent, over all rollouts, with either policy."""
    events: tuple[int, int]
    """Events of the rollout that is shown."""
    animation: Animation


@dataclass(frozen=True, eq=False)
class Pairs:
    """Rows of both models, and the animations by their rank in the order of scenarios, in words."""

    rows: Mapping[str, Row]
    animations: Mapping[str, PairedAnimation]


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
    return Pairs(rows, animations)


def choose_scenarios(
    ids: list[str], base_rate: Float[np.ndarray, "n"], tuned_rate: Float[np.ndarray, "n"], num_best: int = NUM_BEST
) -> dict[str, str]:
    """Ids of the scenarios to show by their rank in the order, in words; each at most once, the best first.

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


def animate_pair(
    rank: str, scenario: Scenario, policies: Mapping[str, Policy], suite: ExperimentSuite, *, prefers_increase: bool
) -> PairedAnimation:
    """Animation of the first rollout in which the number of events changes most from the first to the second policy.

    Args:
        rank: Rank of the scenario in words, such as "1. of 40", for the caption.
        scenario: Scenario with its future; simulated as in an evaluation, with the suite's seed and sampling.
        policies: Two policies by their names, the base model first.
        suite: Settings of the evaluation, and its device.
        prefers_increase: True takes the rollout of the largest increase, False that of the largest decrease.
    """
    device = find_device(suite.device)
    log = scenario_log(scenario, device)
    features = {
        name: compute_features(log, simulate_states(policy, scenario, suite.evaluation, device))
        for name, policy in policies.items()
    }
    # Events: evaluated agents that collide at some step, plus those that leave the road at some step.
    base, tuned = (
        torch.stack([f.collision.any(-1), f.offroad.any(-1)]).sum(dim=(0, 2))  # [2, N, E] -> [N]
        for f in features.values()
    )
    rollout = int(((tuned - base) * (1 if prefers_increase else -1)).argmax())
    # Noise depends on the number of the rollout alone, so that simulating this one alone repeats it.
    rollout_ids, batch = range(rollout, rollout + 1), collate([scenario]).to(device)
    seed, sampling = suite.evaluation.seed, suite.evaluation.sampling
    panels = []
    for name, policy in policies.items():
        rollouts = simulate(policy, batch, num_rollouts=rollout_ids, seed=seed, sampling=sampling)
        # Marks of the rollout that is shown: [1, E, T].
        flags = {mark: getattr(features[name], mark)[rollout : rollout + 1].cpu() for mark in ("collision", "offroad")}
        motion = rollout_trajectories(scenario, rollouts, row=0).with_evaluated_flags(scenario, **flags)
        panels.append(Panel(name, motion))
    num_evaluated = len(scenario.evaluated_indices)
    rates = (float(base.double().mean()) / num_evaluated, float(tuned.double().mean()) / num_evaluated)
    events = (int(base[rollout]), int(tuned[rollout]))
    caption = (
        f"{rank}, rollout {rollout}: {events[0]} collisions and departures from the road before, {events[1]} after; "
        f"over all rollouts {rates[0]:.2f} and {rates[1]:.2f} events an agent."
    )
    animation = Animation(f"Scenario {scenario.scenario_id}", build_scene(scenario), panels, caption=caption)
    return PairedAnimation(scenario.scenario_id, rollout, rates, events, animation)


def summarize(pairs: Pairs, suite: ExperimentSuite) -> ExperimentResult:
    """The table, the animations, and the rule by which they were chosen.

    Args:
        pairs: Rows and animations that `run` made; nothing is simulated here.
        suite: Suite whose budget the notes state.
    """
    base, tuned = (pairs.rows[name] for name in SPECS)
    cells = tuple(
        (rank, pair.scenario_id, str(pair.rollout), *(f"{r:.2f}" for r in pair.rates), *map(str, pair.events))
        for rank, pair in pairs.animations.items()
    )
    headings = ("place", "scenario", "rollout", "rate before", "rate after", "events before", "events after")
    note = (
        "Events: evaluated agents that collide, plus those that leave the road; an agent that does both counts "
        "twice. Rate: events an evaluated agent, mean over rollouts."
    )
    return ExperimentResult(
        title="The same scenario with the same noise, before and after fine-tuning",
        tables=(
            tables.build_table("All held-out scenarios", [base, tuned], SCORES),
            tables.TextTable("Shown", headings, cells, note),
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
            "rows": tables.to_numbers([base, tuned], SCORES),
            "pairs": [
                {name: getattr(pair, name) for name in ("scenario_id", "rollout", "rates", "events")}
                for pair in pairs.animations.values()
            ],
        },
        animations=tuple(pair.animation for pair in pairs.animations.values()),
    )


EXPERIMENT = Experiment(
    "What changes in a scenario that is driven with the same noise before and after fine-tuning?", run, summarize
)
