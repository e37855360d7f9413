"""Monitoring of a run: alarms, closed-loop realism on scenarios held out of training, and the use of the map.

Alarms: a policy that exploits the reward drifts away from the log in ways that a few statistics show. Running means of
these statistics are compared with those of the run's first updates. The level of an alarm is the drift over the
threshold, so the alarm is raised from 1 on. A warning is logged once when the alarm is raised; the run goes on.

Validation draws from no random generator that the training uses, so a run ends with the same bits with and without.

Map use: the nats that a model's predictions of logged tokens lose when the whole map is moved far away. A model with a
low loss may still not read the map: most tokens go straight on or stand still, which history alone predicts. Turning
tokens tell. Vehicles only, since vehicles follow lanes.
"""

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, cast

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional

from rlftsim.errors import ConfigError
from rlftsim.jobs.progress import log
from rlftsim.realism import score_rollouts
from rlftsim.rollout.policy import Policy, Prediction, PretrainablePolicy, Sampling, frozen_copy
from rlftsim.rollout.simulate import check_sampling, simulate
from rlftsim.scenario.batch import ScenarioBatch, collate
from rlftsim.scenario.types import Scenarios
from rlftsim.tokens.vocabulary import CLASS_NAMES, Vocabulary
from rlftsim.training.config import AlarmConfig, ValidationConfig
from rlftsim.training.data import batch_with_futures
from rlftsim.training.parallel import Fabric, all_reduce_sum


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
            config: Number of first updates and window.
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
            logged: Metrics of the update, by name.
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


# ---- validation ----------------------------------------------------------------------------------------------------

WATCHED = {
    "validation_rmm": "meta_metric",
    "validation_kinematic": "kinematic",
    "validation_interactive": "interactive",
    "validation_map_based": "map_based",
    "validation_min_ade_m": "min_average_displacement_error",
    "validation_unlogged_offroad_rate": "unlogged_offroad_rate",
}
"""Logged metric -> field of `RealismResult`."""


def check_validation(model: object, scenarios: Scenarios, config: ValidationConfig) -> None:
    """Refuse before a run any cause that would end the run at the first validation.

    Args:
        model: Model in training, of which a copy simulates.
        scenarios: Held-out scenarios, at least one.
        config: Settings of the validation, of which sampling is tried.

    Raises:
        ConfigError: The model cannot simulate, or not with this sampling, or there is no scenario.
    """
    if not isinstance(model, Policy):
        raise ConfigError(f"{type(model).__name__} cannot simulate, so it cannot be validated: set validation.every=0.")
    if not len(scenarios):
        raise ConfigError("no scenario to validate on: name another split, or set validation.every=0.")
    if config.keep_best and len(config.choose(len(scenarios))) < 2:
        log.warning("a single scenario does not tell the best model: validate on more, or set keep_best=False.")
    if config.top_k is not None:
        check_sampling(frozen_copy(model), scenarios, Sampling(top_k=config.top_k))


class Validator:
    """Validations of a run, each on the same scenarios with the same dice.

    Args:
        scenarios: Held-out scenarios to select from, with futures.
        config: Number and choice of scenarios and rollouts.
        fabric: Processes of the run, which divide the scenarios.
        start: Policy at the start of the run, to which gains refer; None = no gains are logged.

    Raises:
        DataError: A scenario withholds its future.
    """

    def __init__(self, scenarios: Scenarios, config: ValidationConfig, fabric: Fabric, start: nn.Module | None = None):
        self._scenarios, self.config, self._fabric = scenarios, config, fabric
        self._choice = config.choose(len(scenarios))
        clusters = getattr(scenarios, "clusters", np.arange(len(scenarios)))  # lists of scenarios name none
        self._clusters = np.array(clusters)[self._choice]
        if start is not None and len(set(self._clusters)) == 1 and fabric.global_rank == 0:
            log.warning("all scenarios of the validation are of one street network: gains hold for it alone.")
        self._start = None if start is None else self._measure(start)[1]

    def validate(self, model: nn.Module) -> dict[str, float]:
        """Metrics of a model, with the gain in RMM over the start, and the lower bound of the gain.

        Means over scenarios (`WATCHED`), the 95 % interval of the meta-metric's mean (Student's t), where asked for and
        tokens are predicted the loss and map use on vehicles (`describe_map_use`), and the seconds taken.

        Args:
            model: Policy in training; left unchanged, training mode included.
        """
        from rlftsim.statistics import cluster_bootstrap, mean_interval  # scipy: time that configurations need not pay

        values, rmm = self._measure(model)
        if self._start is not None:
            gains = rmm - self._start
            gain = mean_interval(gains, alpha=0.1)
            if 1 < len(set(self._clusters)) < len(gains):
                gain = cluster_bootstrap(gains, self._clusters, level=0.9)
            values |= {"validation_gain": gain.mean, "validation_gain_low": gain.interval[0]}
        return values

    @torch.no_grad()
    def _measure(self, model: nn.Module) -> tuple[dict[str, float], Float[np.ndarray, "n"]]:
        """Metrics of a model, and the meta-metric of each selected scenario, NaN where undefined."""
        from rlftsim.statistics import mean_interval  # as in `validate`

        start, config, fabric = time.perf_counter(), self.config, self._fabric
        # A copy, so that neither the mode nor a cache of the model in training changes.
        frozen: Any = frozen_copy(model)
        # Dealt out in turn; each process fills its rows, and the others add zeros to them.
        rows = list(range(len(self._choice)))[fabric.global_rank :: fabric.world_size]
        scores = torch.zeros(len(self._choice), len(WATCHED), dtype=torch.float64, device=fabric.device)
        measures_map = config.map_use and predicts_tokens(frozen)
        map_use = torch.zeros(2, 3, dtype=torch.float64, device=fabric.device)
        for first in range(0, len(rows), config.scenarios_per_pass):
            selected = rows[first : first + config.scenarios_per_pass]
            batch = batch_with_futures(self._scenarios, [self._choice[row] for row in selected]).to(fabric.device)
            with fabric.autocast():
                rollouts = simulate(
                    frozen, batch, num_rollouts=config.num_rollouts, seed=config.seed,
                    sampling=Sampling(top_k=config.top_k),
                )  # fmt: skip
                if measures_map:
                    map_use += measure_map_use(frozen, batch)
            realism, _ = score_rollouts(batch, rollouts, config.metric)
            scores[selected] = torch.stack([getattr(realism, name).double() for name in WATCHED.values()], -1)
        columns = all_reduce_sum(scores, fabric).cpu().numpy().T  # [metrics, scenarios]
        means = {name: mean_interval(column) for name, column in zip(WATCHED, columns)}
        low, high = means["validation_rmm"].interval
        logged = {name: mean.mean for name, mean in means.items()}
        logged |= {"validation_rmm_low": low, "validation_rmm_high": high}
        if measures_map:
            logged |= describe_map_use(all_reduce_sum(map_use, fabric), "validation_")
        return {**logged, "seconds_validation": time.perf_counter() - start}, columns[0]


# ---- map use -------------------------------------------------------------------------------------------------------

AWAY_M = 5000.0
"""The map is moved by this along both axes: farther than any model looks."""
TURNING_RAD = 0.06
"""A token that changes the heading by more than this in its half second is a turning one."""


def describe_map_use(sums: Float[Tensor, "2 3"], prefix: str = "") -> dict[str, float]:
    """Mean loss and map use (loss without minus with the map), nats per token, of all and of turning tokens.

    NaN where there was no such token.

    Args:
        sums: Results of `measure_map_use`, added over batches and processes.
        prefix: Text before every name.
    """
    count, with_map, without = sums.T  # [2] each
    values = {"loss": with_map / count, "map_use": (without - with_map) / count}
    return {
        f"{prefix}{name}{suffix}": float(value[row])
        for name, value in values.items()
        for row, suffix in enumerate(("", "_turning"))
    }


def predicts_tokens(policy: object) -> bool:
    """True for a policy with measurable map use: predictions of the tokens of a vocabulary along logged tracks."""
    return hasattr(policy, "teacher_forced") and isinstance(getattr(policy, "vocabulary", None), Vocabulary)


@torch.no_grad()
def measure_map_use(policy: PretrainablePolicy, batch: ScenarioBatch) -> Float[Tensor, "2 3"]:
    """Cross-entropy of the logged vehicles' tokens, with the map and with the map 5 km away, as sums that add up.

    Args:
        policy: Policy with a vocabulary, in evaluation mode.
        batch: Scenarios with futures, on the policy's device.

    Returns:
        Rows: all tokens, turning tokens. Columns: their number, loss with the map, loss without it (nats), float64.
    """
    shifted = []
    for scenario in batch.scenarios:
        points = scenario.map_features.points + AWAY_M
        shifted.append(replace(scenario, map_features=replace(scenario.map_features, points=points)))
    losses, turning = _vehicle_losses(policy, batch)
    without, _ = _vehicle_losses(policy, collate(shifted).to(batch.device))
    columns = torch.stack([torch.ones_like(losses), losses, without], -1).double()  # [r, 3]
    return torch.stack([columns.sum(0), columns[turning].sum(0)])


def _vehicle_losses(policy: PretrainablePolicy, batch: ScenarioBatch) -> tuple[Float[Tensor, "r"], Bool[Tensor, "r"]]:
    """Cross-entropy of each predicted vehicle token, nats; and True where the token turns."""
    vocabulary: Vocabulary = cast(Any, policy).vocabulary
    predicted: Prediction = policy.teacher_forced(batch, batch.agent_mask)
    vehicle = CLASS_NAMES.index("vehicle")
    rows = predicted.target_mask & (predicted.class_id == vehicle)
    target = predicted.target[rows]
    turn = vocabulary.poses[vehicle, target, -1, 2]  # [r], heading at the end of the token, rad
    return functional.cross_entropy(predicted.logits[rows], target, reduction="none"), turn.abs() > TURNING_RAD
