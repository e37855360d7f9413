"""Alarms: a policy that exploits the reward drifts away from the log in ways that a few statistics show.

Running means of these statistics are compared with those of the run's first updates. The level of an alarm is the drift
over the threshold, so the alarm is raised from 1 on. A warning is logged once when the alarm is raised; the run goes
on.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

from rlftsim.errors import check_positive, check_types


@dataclass(frozen=True)
class AlarmConfig:
    """Thresholds of the alarms."""

    first_updates: int = 20
    """Updates whose mean the later ones are compared with; until then there are no alarms."""
    window: int = 20
    """Updates that a running mean covers, roughly."""
    min_ade_rise: float = 0.5
    """Fraction by which minADE may rise."""
    diversity_fall: float = 0.5
    """Fraction by which the spread of the rollouts' endpoints may fall."""
    red_light_rise: float = 0.05
    """Rise of the fraction of evaluated agents that run a red light."""
    speed_drift_mps: float = 1.0
    """Change, either way, of the mean speed against that of the log at the same steps."""
    stop: bool = False
    """The run ends with the update at which an alarm is raised; False = it goes on with a warning."""

    def __post_init__(self) -> None:
        check_types(self)
        check_positive(
            self,
            ("first_updates", "window", "min_ade_rise", "diversity_fall", "red_light_rise", "speed_drift_mps"),
        )


@dataclass(frozen=True)
class DriftMonitor:
    """A statistic that is watched."""

    alarm: str
    """Name of the alarm in the metrics."""
    statistic: str
    """Name of the statistic in the metrics."""
    words: str
    """Message for the user, with the values now and at the start."""
    drift: Callable[[float, float, AlarmConfig], float]
    """From the values at the start and now to drift over threshold."""


DRIFT_MONITORS = (
    DriftMonitor(
        "alarm_min_ade",
        "min_ade_m",
        "even the best rollouts lie {now:.2f} m from the log, {start:.2f} m at the start",
        # Relative to the start, as minADE depends on the data; 1e-6 for a start of exactly 0.
        lambda start, now, limit: (now - start) / (limit.min_ade_rise * max(start, 1e-6)),
    ),
    DriftMonitor(
        "alarm_diversity",
        "diversity_m",
        "rollouts become alike: their endpoints scatter by {now:.2f} m, {start:.2f} m at the start",
        lambda start, now, limit: (start - now) / (limit.diversity_fall * max(start, 1e-6)),
    ),
    DriftMonitor(
        "alarm_red_light",
        "traffic_light_violation_rate",
        "{now:.1%} of the evaluated agents run a red light, {start:.1%} at the start",
        lambda start, now, limit: (now - start) / limit.red_light_rise,
    ),
    DriftMonitor(
        "alarm_speed",
        "speed_gap_mps",
        "mean speed differs by {now:+.2f} m/s from the log's, {start:+.2f} m/s at the start",
        lambda start, now, limit: abs(now - start) / limit.speed_drift_mps,
    ),
)


@dataclass(frozen=True)
class Running:
    """Means of a statistic. Values that are not finite leave the means unchanged."""

    start: float = 0.0
    """Over the first updates."""
    now: float = 0.0
    """Over the latest."""
    count: int = 0
    """Updates with a finite value."""

    def add(self, value: float, config: AlarmConfig) -> "Running":
        """The means with a further update.

        Args:
            value: Value of the statistic in that update; not counted where not finite.
            config: number of first updates and window.
        """
        if not math.isfinite(value):
            return self
        count = self.count + 1
        # A plain mean over the first updates; then the start is frozen and `now` becomes an exponential mean.
        if count <= config.first_updates:
            mean = self.start + (value - self.start) / count
            return Running(mean, mean, count)
        return replace(self, now=self.now + (value - self.now) / config.window, count=count)


@dataclass
class Alarms:
    """The watched means of a run, which checkpoints hold."""

    means: dict[str, Running] = field(default_factory=lambda: {m.alarm: Running() for m in DRIFT_MONITORS})

    def watch(self, logged: Mapping[str, float], config: AlarmConfig) -> tuple[dict[str, float], list[str]]:
        """Take in the statistics of an update.

        Args:
            logged: metrics of the update, by name.
            config: Thresholds of the alarms, and the lengths of both means in updates.

        Returns:
            The level of every alarm, and messages of those that are raised by this update.
        """
        levels, raised = {}, []
        for monitor in DRIFT_MONITORS:
            previous_mean = self.means[monitor.alarm]
            mean = self.means[monitor.alarm] = previous_mean.add(logged[monitor.statistic], config)
            levels[monitor.alarm] = monitor.drift(mean.start, mean.now, config)
            # Only on the way up, so that an alarm that lasts is one message and not one per update.
            if levels[monitor.alarm] >= 1 > monitor.drift(previous_mean.start, previous_mean.now, config):
                raised.append(f"{monitor.alarm}: {monitor.words.format(now=mean.now, start=mean.start)}")
        return levels, raised

    def to_numbers(self) -> dict[str, float]:
        """Numbers for a checkpoint."""
        return {f"{name}.{key}": value for name, mean in self.means.items() for key, value in vars(mean).items()}

    def load_numbers(self, numbers: Mapping[str, float]) -> None:
        """Take back the numbers of a checkpoint, which has all that `to_numbers` names."""
        for name in self.means:
            start, now, count = (numbers[f"{name}.{key}"] for key in ("start", "now", "count"))
            # JSON has one kind of number here: all are floats.
            self.means[name] = Running(start, now, int(count))
