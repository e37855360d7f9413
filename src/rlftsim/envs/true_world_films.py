"""Films of planners in the world that made a log, and in other traffic, side by side."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from rlftsim.envs.result import build_animation
from rlftsim.envs.true_world import TrueWorldConfig
from rlftsim.envs.true_world_traffic import list_conflicts
from rlftsim.errors import EpisodeFailure
from rlftsim.jobs.progress import log, progress_bar
from rlftsim.viewer.page import write_page


def write_films(
    config: TrueWorldConfig, choices: Sequence[tuple[str, str, int]], traffic: Sequence[str], path: Path
) -> None:
    """Write a page of films of single episodes, each in several types of traffic side by side.

    An episode in which SUMO or the planner fails this time is left out, with a warning.

    Args:
        config: Windows, planners and types of traffic of the rows.
        choices: Window, planner and rollout of each film, from top to bottom.
        traffic: Names of the types of traffic, from left to right.
        path: File of the page.
    """
    trips = {(trip.window, trip.planner, trip.rollout, trip.surroundings.name): trip for trip in config.trips}
    films = []
    with progress_bar("films", len(choices)) as advance:
        for window, planner, rollout in choices:
            chosen = [trips.get((window, planner, rollout, name), trips[window, planner, 0, name]) for name in traffic]
            try:
                results = [trip.run()[0] for trip in chosen]
            except EpisodeFailure as failure:
                log.warning(f"no film of {planner} in {window}: {failure}")
                continue
            finally:
                advance()
            scores = (f"{name}: {result.planner.nuplan_style:.2f}" for name, result in zip(traffic, results))
            animation = build_animation(dict(zip(scores, (result.record for result in results))))
            conflicts = ", ".join(sorted(list_conflicts(config.data, window))) or "none"
            caption = f"Conflicts at the current step: {conflicts}. Rollout {rollout}."
            films.append(replace(animation, title=f"{planner} in {window}", caption=caption))
    caption = "The same planner from the same step on; beside each traffic the planner's nuPlan-style score."
    write_page(path, "Windows in which traffic errs most about a planner", films, caption=caption)
