"""Are the maneuvers that the lanes propose the legal ones, and named right? Draws a sample to be judged by eye, and counts.

    python benchmarks/goal_proposals.py synthetic --out benchmarks/goal_proposals.png
    python benchmarks/goal_proposals.py DATA --out somewhere/outside/the/repository.png

The picture shows the proposals of the first vehicles (evaluated, on a lane, with two maneuvers or more) of 20 scenarios in random
order. What is counted is over all evaluated agents of the split: of those whose maneuver is logged, how many get it proposed without
a look at the log; whether a goal lies off the road; whether one lies out of reach.
"""

import argparse
from collections import Counter
from pathlib import Path

import numpy as np

from rlftsim.experiments.goal_proposals import road_test
from rlftsim.goals.lane_paths import BRISK, HORIZON_S
from rlftsim.goals.proposals import (
    CurrentAgent,
    Proposal,
    logged_maneuver,
    no_proposal_reason,
    propose_from_lanes,
)
from rlftsim.scenario.open import open_dataset
from rlftsim.scenario.types import ObjectType, Scenario
from rlftsim.viewer.goal_picture import DrawnGoal, GoalPanel, draw_goals

SAMPLE, COLUMNS, DOTS_PER_INCH = 20, 5, 62


def main() -> None:
    """Draw and count."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data")
    parser.add_argument("--split", default="validation")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    scenarios = open_dataset(arguments.data, arguments.split)
    order = np.random.default_rng(arguments.seed).permutation(len(scenarios))
    panels: list[GoalPanel] = []
    counts: Counter[str] = Counter()
    for position in order:
        scenario = scenarios[int(position)]
        by_track = {
            int(t): propose_from_lanes(scenario, int(t), road_test(scenario)) for t in scenario.evaluated_indices
        }
        count(counts, scenario, by_track)
        worth = [t for t, found in by_track.items() if len(found) > 1 and is_vehicle(scenario, t)]
        if worth and len(panels) < SAMPLE:
            panels.append(panel(len(panels) + 1, scenario, worth[0], by_track[worth[0]]))
    draw_goals(arguments.out, panels, columns=COLUMNS, dots_per_inch=DOTS_PER_INCH)
    for number, one in enumerate(panels, 1):
        print(f"| {number} | {one.title.partition(': ')[2]} | {', '.join(m.label for m in one.marks)} |")
    for name, value in sorted(counts.items()):
        print(f"{name}: {value}")


def is_vehicle(scenario: Scenario, track: int) -> bool:
    """Whether a track is a vehicle."""
    return int(scenario.tracks.object_type[track]) == ObjectType.VEHICLE


def panel(number: int, scenario: Scenario, track: int, proposals: tuple[Proposal, ...]) -> GoalPanel:
    """The proposals of one agent."""
    speed = CurrentAgent.from_track(scenario, track).speed_mps
    marks = tuple(DrawnGoal(p.object_id, p.position, p.maneuver.value, p.path[:, :2]) for p in proposals)
    title = f"{number}: {scenario.scenario_id}, agent {scenario.tracks.object_id[track]}, {speed:.1f} m/s"
    return GoalPanel(title, scenario, marks)


def count(counts: Counter[str], scenario: Scenario, by_track: dict[int, tuple[Proposal, ...]]) -> None:
    """Add one scenario to what is counted."""
    test = road_test(scenario)
    for track, proposals in by_track.items():
        counts["agents"] += 1
        reason = no_proposal_reason(scenario, track)
        logged = logged_maneuver(scenario, track)
        if reason is not None:
            counts[f"without proposals: {reason}"] += 1
        elif logged is not None:
            counts[f"logged {logged.maneuver}, in all"] += 1
            counts[f"logged {logged.maneuver}, proposed"] += logged.maneuver in {p.maneuver for p in proposals}
        driver = CurrentAgent.from_track(scenario, track)
        for proposal in proposals:
            counts[f"proposed {proposal.maneuver}"] += 1
            counts["proposed, out of reach"] += is_out_of_reach(proposal, driver)
            if test is not None:
                last = proposal.path[-2:]
                heading = np.arctan2(*(last[1] - last[0])[1::-1])
                counts["proposed, off the road"] += bool(test(last[1:], np.array([heading]), driver.size)[0] > 0.1)


def is_out_of_reach(proposal: Proposal, driver: CurrentAgent) -> bool:
    """Whether not even full acceleration covers the way, or full braking overshoots it."""
    way_m = float(np.linalg.norm(np.diff(proposal.path[:, :2], axis=0), axis=1).sum())
    most = driver.speed_mps * HORIZON_S + BRISK.acceleration_mps2 * HORIZON_S**2 / 2
    return not driver.speed_mps**2 / (2 * BRISK.braking_mps2) - 1 <= way_m <= most


if __name__ == "__main__":
    main()
