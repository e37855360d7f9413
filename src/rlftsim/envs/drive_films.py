"""Films of scenarios that a planner drives, the types of traffic side by side."""

from collections.abc import Sequence
from pathlib import Path

from rlftsim.envs.drive_scenario import DriveConfig, load_source
from rlftsim.envs.planner_episode import run_planner
from rlftsim.envs.planners.registry import load_planner
from rlftsim.envs.result import build_animation
from rlftsim.evaluation.drive_results import DriveResult, find_failures, is_failure, rank_scenarios
from rlftsim.viewer.film import to_film


def choose_films(results: Sequence[DriveResult], choice: str) -> list[str]:
    """Ids of the scenarios to film, the worst first; none in which the planner failed.

    Args:
        results: Results of a planner in all types of traffic.
        choice: "first"; "worst:N" for the N lowest scores `nuplan_style` in any traffic; "failures" for scenarios in
            which the planner is at fault for a collision or leaves the road.
    """
    failed = {scenario_id for result in results for scenario_id in result.failures}
    if choice == "first":
        return [scenario_id for scenario_id in results[0].scenario_ids if scenario_id not in failed][:1]
    worst = [scenario for scenario in rank_scenarios(results) if scenario.scenario_id not in failed]
    if choice == "failures":
        failing = {scenario_id for result in results for scenario_id in find_failures(result)}
        return [scenario.scenario_id for scenario in worst if scenario.scenario_id in failing]
    return [scenario.scenario_id for scenario in worst[: int(choice.partition(":")[2])]]


def write_film(config: DriveConfig, scenario_id: str, out: Path) -> Path:
    """Write a film of a scenario, the types of traffic side by side; returns the path.

    With `film="failures"` each traffic shows the first rollout with a failure, else the first rollout.

    Args:
        config: Planner, data, types of traffic and number of rollouts.
        scenario_id: Scenario of the data set.
        out: Folder for the film SCENARIO.webp.

    Raises:
        EpisodeFailure: The planner or SUMO fails in this scenario.
    """
    records, scores = {}, []
    for traffic in config.traffic:
        source, planner = load_source(config, traffic), load_planner(config.planner)
        rollouts = range(config.num_rollouts if config.film == "failures" else 1)
        scenarios = [source.scenario(scenario_id)]
        episodes = run_planner(source, planner, scenarios, seed=config.seed, rollouts=rollouts)
        results = (result for (result,), _ in episodes)
        first = next(results)
        shown = first if is_failure(first.scores) else next((r for r in results if is_failure(r.scores)), first)
        records[f"{config.planner} in {traffic}"] = shown.record
        scores.append(shown.planner.nuplan_style)
    path = out / f"{scenario_id}.webp"
    to_film(path, build_animation(records, scores), steps_per_frame=2, dots_per_inch=70)
    return path
