"""Long rollouts held against the log of the same world, in windows of 10 s.

A agents, S steps of 0.1 s after the current one, K vehicles that follow another.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from rlftsim.errors import ConfigError, DataError
from rlftsim.evaluation.in_memory import simulate_in_memory
from rlftsim.jobs.files import write_text
from rlftsim.jobs.progress import progress_bar
from rlftsim.rollout.policy import Policy, Sampling, get_device
from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.batch import collate
from rlftsim.scenario.types import (
    CURRENT_STEP,
    HISTORY_STEPS,
    STEP_S,
    ObjectType,
    Scenario,
    Scenarios,
    count_steps,
)
from rlftsim.viewer.scene import compute_overlap

WINDOW_STEPS = 100
STRIDE = 5
"""Steps between samples of density, speed, gaps and overlaps."""
NEAR_M = 60.0
MOVING_MPS = 0.5
LANE_HALF_WIDTH_M, LONGEST_GAP_M = 1.8, 60.0
HEADINGS = (
    "world", "seconds", "agents within 60 m", "that move", "speed of these [m/s]", "W1 of speed [m/s]", "W1 of gap [m]",
    "ego [m/s]", "collisions per agent-min", "entries per min",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Motion:
    """Agents of a world over time, map frame."""

    position: Float[np.ndarray, "A S 2"]
    heading: Float[np.ndarray, "A S"]
    size: Float[np.ndarray, "A 2"]
    valid: Bool[np.ndarray, "A S"]
    is_vehicle: Bool[np.ndarray, "A"]
    ego: int

    def steps(self, steps: slice) -> "Motion":
        """Motion over some of the steps."""
        cut = {name: getattr(self, name)[:, steps] for name in ("position", "heading", "valid")}
        return replace(self, **cut)


def read_log(scenario: Scenario) -> Motion:
    """Motion of all agents of a log after the current step, those included that are seen later.

    Args:
        scenario: World with a log of any length.
    """
    tracks, future = scenario.tracks, slice(CURRENT_STEP + 1, None)
    size = np.where(tracks.valid[..., None], tracks.size, 0).max(1)[:, :2]
    return Motion(
        tracks.position[:, future, :2] - scenario.origin, tracks.heading[:, future], size, tracks.valid[:, future],
        tracks.object_type == ObjectType.VEHICLE, scenario.ego_index,
    )  # fmt: skip


def read_rollouts(scenario: Scenario, rollouts: Rollouts) -> Iterator[Motion]:
    """Motion in each rollout of a scenario.

    Args:
        scenario: World as it was simulated, with visitors where agents enter.
        rollouts: Rollouts of that world alone.
    """
    tracks, simulated = scenario.tracks, scenario.simulated_indices
    ego = int(np.flatnonzero(simulated == scenario.ego_index)[0])
    for number in range(rollouts.num_rollouts):
        position, heading = rollouts.position[0, number].cpu().numpy(), rollouts.heading[0, number].cpu().numpy()
        valid = np.ones(heading.shape, bool) if rollouts.valid is None else rollouts.valid[0, number].cpu().numpy()
        is_vehicle = tracks.object_type[simulated] == ObjectType.VEHICLE
        count = len(simulated)  # padding comes behind
        size = tracks.size[simulated, CURRENT_STEP, :2]
        yield Motion(position[:count], heading[:count], size, valid[:count], is_vehicle, ego)


@dataclass(frozen=True, eq=False)
class WindowSamples:
    """Samples of 10 s of one or more worlds, as many of each measure as there are."""

    density: Float[np.ndarray, "_"]
    """Agents within 60 m of the ego."""
    driving: Float[np.ndarray, "_"]
    """Of these, those that move."""
    speed: Float[np.ndarray, "_"]
    """Speeds of the moving agents within 60 m, m/s."""
    gap: Float[np.ndarray, "_"]
    """Distance to the next vehicle ahead on the lane of each moving vehicle within 60 m, m."""
    ego_speed: Float[np.ndarray, "_"]
    collisions: Float[np.ndarray, "_"]
    """Agents that begin to overlap another agent, in each world."""
    entries: Float[np.ndarray, "_"]
    """Agents that appear, in each world."""
    agent_minutes: Float[np.ndarray, "_"]
    """In each world."""


@dataclass(frozen=True, eq=False)
class WindowEvaluation:
    """Rollouts and logs of the same worlds, by windows of 10 s."""

    name: str
    windows: tuple[WindowSamples, ...]
    log: tuple[WindowSamples, ...]

    def write(self, path: Path) -> None:
        """Write the table as CSV, whole or not at all."""
        write_text(path, "".join(f"{','.join(row)}\n" for row in (HEADINGS, *self.rows())))

    def rows(self) -> list[list[str]]:
        """Cells under `HEADINGS`: the log, then the rollouts with ratios to the log in parentheses."""
        return [
            _describe_window(name, number, samples, log)
            for name, windows in (("log", self.log), (self.name, self.windows))
            for number, (samples, log) in enumerate(zip(windows, self.log))
        ]


def _describe_window(name: str, number: int, samples: WindowSamples, log: WindowSamples) -> list[str]:
    def compare(field: str) -> str:
        value, truth = (np.mean(getattr(of, field)) if len(getattr(of, field)) else np.nan for of in (samples, log))
        return f"{value:.1f}" if samples is log else f"{value:.1f} ({value / max(truth, 0.01):.2f})"

    minutes = samples.agent_minutes.sum()
    return [
        name, f"{10 * number}-{10 * number + 10}", compare("density"), compare("driving"), compare("speed"),
        f"{compute_distance(samples.speed, log.speed):.2f}", f"{compute_distance(samples.gap, log.gap):.1f}",
        compare("ego_speed"), f"{samples.collisions.sum() / minutes:.2f}", f"{6 * samples.entries.mean():.0f}",
    ]  # fmt: skip


def evaluate_windows(
    policy: Policy,
    scenarios: Scenarios,
    *,
    seconds: float,
    name: str,
    num_rollouts: int,
    seed: int = 0,
    sampling: Sampling = Sampling(),  # noqa: B008
    entries: str | None = None,
) -> WindowEvaluation:
    """Samples of the rollouts of a policy and of the logs of the same worlds.

    Args:
        policy: Policy in evaluation mode, which moves all agents.
        scenarios: Worlds with logs as long as the rollouts.
        seconds: Length of the rollouts, a multiple of 10.
        name: Name of the rollouts in the table.
        num_rollouts: Number of rollouts of each world.
        seed: Seed of the rollouts.
        sampling: Temperature and truncation of the decisions.
        entries: Name or file of the model of who enters; None = nobody enters or leaves.

    Raises:
        ConfigError: A length that is no multiple of 10 s, or entries that do not fit the policy.
        DataError: No scenario, or a log that ends before the rollouts.
    """
    num_steps = count_steps(seconds)
    if num_steps % WINDOW_STEPS:
        raise ConfigError(f"seconds={seconds:g}: windows last 10 s: take a multiple, or leave it out for the 8 s.")
    for scenario in (scenarios[position] for position in range(len(scenarios))):
        left = scenario.num_steps - HISTORY_STEPS
        if left < num_steps:
            raise DataError(
                f"scenario {scenario.scenario_id}: its log goes on for {left * STEP_S:.1f} s, too short to hold "
                f"{seconds:g} s against: rlftsim synthesize --seconds {seconds + 10:g} makes longer ones."
            )
    logs, rollouts = [], []
    with progress_bar(f"evaluate {name}", len(scenarios)) as advance:
        for position in range(len(scenarios)):
            batch = collate([scenarios[position]]).to(get_device(policy))
            simulated = simulate_in_memory(policy, batch, num_rollouts, seed, num_steps, sampling, None, entries)
            assert simulated.provenance is not None
            logs.append(measure_windows(read_log(scenarios[position]).steps(slice(num_steps))))
            rollouts += map(measure_windows, read_rollouts(simulated.provenance.scenarios[0], simulated))
            advance()
    if not logs:
        raise DataError("there are no scenarios to evaluate.")
    return WindowEvaluation(name, *(tuple(map(join_samples, zip(*worlds))) for worlds in (rollouts, logs)))


def measure_windows(motion: Motion) -> list[WindowSamples]:
    """Samples of each 10 s of a world."""
    num_windows = motion.heading.shape[1] // WINDOW_STEPS
    return [_measure(motion.steps(slice(k * WINDOW_STEPS, (k + 1) * WINDOW_STEPS))) for k in range(num_windows)]


def join_samples(samples: Sequence[WindowSamples]) -> WindowSamples:
    """Samples of several worlds, one after the other.

    Args:
        samples: Samples of each world, all of the same window.
    """
    return WindowSamples(*(np.concatenate(values) for values in zip(*(vars(sample).values() for sample in samples))))


def compute_distance(first: Float[np.ndarray, "k"], second: Float[np.ndarray, "m"]) -> float:
    """Wasserstein distance of two samples, in their unit; NaN where one is empty."""
    if not len(first) or not len(second):
        return float("nan")
    levels = np.linspace(0.005, 0.995, 199)
    return float(np.abs(np.quantile(first, levels) - np.quantile(second, levels)).mean())


def _measure(motion: Motion) -> WindowSamples:
    velocity = np.diff(motion.position, axis=1) / STEP_S
    both = motion.valid[:, 1:] & motion.valid[:, :-1]
    sampled = slice(0, velocity.shape[1], STRIDE)
    speed, both = np.linalg.norm(velocity, axis=-1)[:, sampled], both[:, sampled]
    position, heading = motion.position[:, :-1][:, sampled], motion.heading[:, :-1][:, sampled]
    valid = motion.valid[:, :-1][:, sampled]
    others = np.arange(len(valid)) != motion.ego
    near = valid & (np.linalg.norm(position - position[motion.ego], axis=-1) < NEAR_M) & others[:, None]
    moving = near & both & (speed > MOVING_MPS)
    overlap = compute_overlap(
        position[None], heading[None], motion.size[:, 0], motion.size[:, 1], valid[None]
    )[0]  # fmt: skip
    begins = overlap[:, 1:] & ~overlap[:, :-1] & valid[:, :-1]
    appears = motion.valid[:, 1:] & ~motion.valid[:, :-1]
    return WindowSamples(
        density=near.sum(0).astype(float),
        driving=moving.sum(0).astype(float),
        speed=speed[moving],
        gap=_measure_gaps(position, heading, moving & motion.is_vehicle[:, None], valid & motion.is_vehicle[:, None]),
        ego_speed=speed[motion.ego],
        collisions=np.array([float(begins.sum())]),
        entries=np.array([float(appears.sum())]),
        agent_minutes=np.array([motion.valid.sum() * STEP_S / 60]),
    )


def _measure_gaps(
    position: Float[np.ndarray, "A S 2"], heading: Float[np.ndarray, "A S"], follows: Bool[np.ndarray, "A S"],
    valid: Bool[np.ndarray, "A S"],
) -> Float[np.ndarray, "K"]:  # fmt: skip
    """Distance of the centers to the nearest vehicle ahead, of those that have one within 60 m."""
    agent, step = np.nonzero(follows)
    offset = position[:, step] - position[agent, step]  # [A, K, 2]
    cos, sin = np.cos(heading[agent, step]), np.sin(heading[agent, step])
    ahead, left = offset[..., 0] * cos + offset[..., 1] * sin, offset[..., 1] * cos - offset[..., 0] * sin
    leads = valid[:, step] & (ahead > 0.5) & (ahead < LONGEST_GAP_M) & (np.abs(left) < LANE_HALF_WIDTH_M)
    gap = np.where(leads, ahead, np.inf).min(0)
    return gap[np.isfinite(gap)]
