"""Stages of an experiment, run in order with number, title and time left in the log."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from rlftsim.jobs.progress import log


@dataclass(frozen=True)
class Stage:
    """Work that an experiment needs, such as a training or an evaluation."""

    title: str
    """The first word names the activity ("fine-tune", "evaluate"); stages of an activity should last equally long."""
    is_finished: bool
    """True = finished by an earlier call: running the stage takes no time."""
    run: Callable[[], object]


def run_stages(stages: Sequence[Stage]) -> None:
    """Run stages and log a line for each: number, title, and about how long the remaining stages take.

    Args:
        stages: Stages in order. A title that comes again is neither counted nor logged again.
    """
    remaining = {stage.title: stage.is_finished for stage in stages}
    total, seconds = len(remaining), {}  # of each activity's stages, without those that were finished before
    for stage in stages:
        if stage.title not in remaining:
            stage.run()
            continue
        number = total - len(remaining) + 1
        status = "  (finished before)" if stage.is_finished else _format_time_left(remaining, seconds)
        log.info(f"{number}/{total}  {stage.title}{status}")
        start = time.monotonic()
        stage.run()
        del remaining[stage.title]
        if not stage.is_finished:
            seconds.setdefault(stage.title.partition(" ")[0], []).append(time.monotonic() - start)


def _format_time_left(remaining: dict[str, bool], seconds: dict[str, list[float]]) -> str:
    """Time left in words; empty as long as an activity has not been timed."""
    activities = [title.partition(" ")[0] for title, is_finished in remaining.items() if not is_finished]
    if not all(activity in seconds for activity in activities):
        return ""
    # Every stage lasts as long as the mean of its activity.
    minutes = sum(sum(seconds[activity]) / len(seconds[activity]) for activity in activities) / 60
    return f"  (about {minutes:.0f} min to go)" if minutes >= 1 else "  (less than a minute to go)"
