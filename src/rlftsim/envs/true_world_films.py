"""Films of planners in the world that made a log, and in other traffic, side by side."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from rlftsim.envs.result import build_animation
from rlftsim.envs.true_world import TrueWorldConfig
from rlftsim.envs.true_world_traffic import list_conflicts
from rlftsim.jobs.progress import progress_bar
from rlftsim.viewer.page import write_page


def write_films(
    config: TrueWorldConfig, choices: Sequence[tuple[str, str]], traffic: Sequence[str], path: Path
) -> None:
    """Write a page of films of single episodes, each in several types of traffic side by side.

    Args:
        config: Windows, planners and types of traffic of the rows.
        choices: Window and planner of each film, from top to bottom.
        traffic: Names of the types of traffic, from left to right.
        path: File of the page.

    Raises:
        EpisodeFailure: The planner or SUMO fails.
    """
    trips = {(trip.window, trip.planner, trip.surroundings.name): trip for trip in config.trips if not trip.rollout}
    films = []
    with progress_bar("films", len(choices)) as advance:
        for window, planner in choices:
            results = {name: trips[window, planner, name].run()[0] for name in traffic}
            titles = {f"{name}: {result.planner.nuplan_style:.2f}": result.record for name, result in results.items()}
            conflicts = ", ".join(sorted(list_conflicts(config.data, window))) or "no conflict"
            title, caption = f"{planner} in {window}", f"At the current step: {conflicts}."
            films.append(replace(build_animation(titles), title=title, caption=caption))
            advance()
    caption = "The same planner from the same step on; beside each traffic the planner's nuPlan-style score."
    write_page(path, "Windows in which traffic errs most about a planner", films, caption=caption)
