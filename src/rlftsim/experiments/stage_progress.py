"""Progress over the stages of an experiment: number, title and time left of each."""

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

from rlftsim.jobs.progress import log


class StageProgress:
    """Logs a line for each stage: its number, and about how long the rest takes.

    Args:
        stages: titles of all stages ahead, in order, and whether each was finished earlier. The first word of a
            title is the kind of stage ("fine-tune", "evaluate"); stages of one kind are taken to last equally long.
    """

    def __init__(self, stages: Mapping[str, bool]):
        self._open = dict(stages)
        self._total = len(stages)
        self._seconds: dict[str, list[float]] = {}

    @contextmanager
    def stage(self, title: str) -> Iterator[None]:
        """Count and time a stage. Titles that were not announced, or are done already, are not counted."""
        if title not in self._open:
            yield
            return
        number, is_done = self._total - len(self._open) + 1, self._open[title]
        log.info(f"{number}/{self._total}  {title}{'  (finished before)' if is_done else self._time_left()}")
        start = time.monotonic()
        yield
        del self._open[title]
        # Stages that were finished before take no time, and say nothing about others of their kind.
        if not is_done:
            self._seconds.setdefault(_kind(title), []).append(time.monotonic() - start)

    def _time_left(self) -> str:
        """In words; empty as long as one kind of stage has not been timed."""
        ahead = [_kind(title) for title, is_done in self._open.items() if not is_done]
        if not ahead or not all(kind in self._seconds for kind in ahead):
            return ""
        # Every open stage lasts as long as the mean of its kind.
        minutes = sum(sum(self._seconds[kind]) / len(self._seconds[kind]) for kind in ahead) / 60
        return f"  (about {minutes:.0f} min to go)" if minutes >= 1 else "  (less than a minute to go)"


def _kind(title: str) -> str:
    return title.partition(" ")[0]
