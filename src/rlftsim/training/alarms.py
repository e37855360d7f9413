"""Alarms: a policy that earns rewards by what nobody wants drifts away from the record in ways a person can name.

Running means of a few statistics are compared with those of the run's first updates. An alarm is a number in the log, the drift over
its threshold, so that it rings from 1 on; it is told once when it begins to ring, and stops nothing.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

from rlftsim.errors import require_positive


@dataclass(frozen=True)
class AlarmConfig:
    """How far is too far."""

    first_updates: int = 20
    """Updates whose mean the later ones are compared with; until then nothing rings."""
    window: int = 20
    """Updates a running mean looks back, roughly."""
    min_ade_rise: float = 0.5
    """Share by which minADE may rise."""
    diversity_fall: float = 0.5
    """Share by which the spread of the rollouts' ends may fall."""
    red_light_rise: float = 0.05
    """By how much the share of evaluated agents that pass a red light may rise."""
    speed_drift_mps: float = 1.0
    """By how much the mean speed, against that of the record at the same steps, may change either way."""

    def __post_init__(self) -> None:
        require_positive(
            self,
            ("first_updates", "window", "min_ade_rise", "diversity_fall", "red_light_rise", "speed_drift_mps"),
        )


@dataclass(frozen=True)
class Gauge:
    """One thing that is watched."""

    alarm: str
    """Its name in the log."""
    statistic: str
    """Name in the log of what is watched."""
    words: str
    """What a person is told, with the values now and at the start."""
    drift: Callable[[float, float, AlarmConfig], float]
    """From the values at the start and now to drift over threshold."""


GAUGES = (
    Gauge(
        "alarm_min_ade",
        "min_ade_m",
        "even the best rollouts lie {now:.2f} m from the record, {start:.2f} m at the start",
        lambda start, now, limit: (now - start) / (limit.min_ade_rise * max(start, 1e-6)),
    ),
    Gauge(
        "alarm_diversity",
        "diversity_m",
        "rollouts grow alike: their ends scatter by {now:.2f} m, {start:.2f} m at the start",
        lambda start, now, limit: (start - now) / (limit.diversity_fall * max(start, 1e-6)),
    ),
    Gauge(
        "alarm_red_light",
        "traffic_light_violation_rate",
        "{now:.1%} of the evaluated agents pass a red light, {start:.1%} at the start",
        lambda start, now, limit: (now - start) / limit.red_light_rise,
    ),
    Gauge(
        "alarm_speed",
        "speed_gap_mps",
        "mean speed lies {now:+.2f} m/s from the record's, {start:+.2f} m/s at the start",
        lambda start, now, limit: abs(now - start) / limit.speed_drift_mps,
    ),
)


@dataclass(frozen=True)
class Running:
    """Means of a statistic. Values that are not finite leave them as they are."""

    start: float = 0.0
    """Over the first updates."""
    now: float = 0.0
    """Over the latest."""
    count: int = 0

    def after(self, value: float, config: AlarmConfig) -> "Running":
        """The means with one more update."""
        if not math.isfinite(value):
            return self
        count = self.count + 1
        if count <= config.first_updates:
            mean = self.start + (value - self.start) / count
            return Running(mean, mean, count)
        return replace(self, now=self.now + (value - self.now) / config.window, count=count)


@dataclass
class Alarms:
    """The watched means of a run, which its checkpoints hold."""

    means: dict[str, Running] = field(default_factory=lambda: {gauge.alarm: Running() for gauge in GAUGES})

    def watch(self, logged: Mapping[str, float], config: AlarmConfig) -> tuple[dict[str, float], list[str]]:
        """Take in the statistics of an update.

        Args:
            logged: by the names of the log.
            config: the thresholds.

        Returns:
            Every alarm's number, and what to tell of those that begin to ring.
        """
        levels, told = {}, []
        for gauge in GAUGES:
            before = self.means[gauge.alarm]
            after = self.means[gauge.alarm] = before.after(logged[gauge.statistic], config)
            levels[gauge.alarm] = gauge.drift(after.start, after.now, config)
            if levels[gauge.alarm] >= 1 > gauge.drift(before.start, before.now, config):
                told.append(f"{gauge.alarm}: {gauge.words.format(now=after.now, start=after.start)}")
        return levels, told

    def to_numbers(self) -> dict[str, float]:
        """For a checkpoint."""
        return {f"{name}.{key}": value for name, mean in self.means.items() for key, value in vars(mean).items()}

    def load_numbers(self, numbers: Mapping[str, float]) -> None:
        """Go on from a checkpoint."""
        for name in self.means:
            start, now, count = (numbers[f"{name}.{key}"] for key in ("start", "now", "count"))
            self.means[name] = Running(start, now, int(count))
