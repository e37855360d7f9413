"""Long rollouts held against the log of the same world, in windows of 10 s.

Agents are sampled at every fifth step of 0.1 s.
"""

import csv
import hashlib
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from rlftsim.errors import ConfigError, DataError
from rlftsim.evaluation.incidents import Incidents, count_steps_on_map, find_incidents
from rlftsim.evaluation.motion import MOVING_MPS, STRIDE, Motion, find_collisions, measure_gaps, read_log, read_rollouts
from rlftsim.evaluation.resumable import check_same_work
from rlftsim.jobs.files import write_text
from rlftsim.jobs.folder import check_name, describe_differences
from rlftsim.jobs.progress import progress_bar
from rlftsim.rollout.entries import identify_entries, load_entries
from rlftsim.rollout.fingerprint import fingerprint_policy
from rlftsim.rollout.open_world import add_visitors
from rlftsim.rollout.policy import Policy, Sampling, get_device
from rlftsim.rollout.simulate import lead_ego, simulate
from rlftsim.scenario.batch import collate
from rlftsim.scenario.types import (
    HISTORY_STEPS,
    STEP_S,
    Scenario,
    Scenarios,
    count_steps,
    list_scenario_ids,
)

WINDOW_STEPS = 100
NEAR_M = 60.0
LONGEST_GAP_M = 60.0
HEADINGS = (
    "world", "seconds", "agents within 60 m", "that move", "speed of these [m/s]", "W1 of speed [m/s]", "W1 of gap [m]",
    "ego [m/s]", "entries per min", "collisions", "road departures", "red lights", "stand > 20 s, way free [%]",
)  # fmt: skip
TABLES = {"traffic": (0, 1, 2, 3, 4, 5, 6, 7, 8), "incidents per agent-minute": (0, 1, 9, 10, 11, 12)}
"""Columns of each table."""


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
    departures: Float[np.ndarray, "_"]
    """Vehicles that leave the road, in each world."""
    red_lights: Float[np.ndarray, "_"]
    """Vehicles that pass a red light, in each world."""
    stuck: Float[np.ndarray, "_"]
    """1 for a vehicle on a lane that has stood for more than 20 s with nothing ahead, 0 for another one on a lane."""
    entries: Float[np.ndarray, "_"]
    """Agents that appear, in each world."""
    agent_minutes: Float[np.ndarray, "_"]
    """In each world."""


NO_SAMPLES = WindowSamples(*(np.zeros(0) for _ in fields(WindowSamples)))


@dataclass(frozen=True, eq=False, repr=False)
class WindowEvaluation:
    """Rollouts and logs of the same worlds, by windows of 10 s."""

    name: str
    windows: tuple[WindowSamples, ...]
    log: tuple[WindowSamples, ...]
    identity: Mapping[str, object]
    """What the rollouts are of: policy, worlds and settings."""

    def values(self) -> list[dict[str, Any]]:
        """Measures of each window: those of the log, then those of the rollouts."""
        return [
            {"world": name, "start_s": 10 * number, "end_s": 10 * number + 10, **_summarize(samples, log)}
            for name, windows in (("log", self.log), (self.name, self.windows))
            for number, (samples, log) in enumerate(zip(windows, self.log))
        ]

    def rows(self) -> list[list[str]]:
        """Cells under `HEADINGS`, with ratios to the log in parentheses."""
        values = self.values()
        return [_format_values(row, values[index % len(self.log)]) for index, row in enumerate(values)]

    def write(self, path: Path) -> None:
        """Write CSV, a line per window, whole or not at all."""
        lines, text = [{**row, **self.identity} for row in self.values()], io.StringIO()
        writer = csv.DictWriter(text, lines[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows(lines)
        write_text(path, text.getvalue())


def _check_path(path: Path, identity: Mapping[str, object]) -> None:
    """Check that a file is not there with results of other work."""
    if path.exists():
        try:
            with path.open(encoding="utf-8", errors="replace", newline="") as file:
                stored = next(csv.DictReader(file), {})
        except csv.Error:
            stored = {}  # none of ours
        differences = {name: stored.get(name) for name, value in identity.items() if stored.get(name) != str(value)}
        check_same_work(path, describe_differences(differences, identity), "name another --name")


def _summarize(samples: WindowSamples, log: WindowSamples) -> dict[str, float]:
    """Means of a window, by column; NaN where there are no samples."""
    means = {name: float(values.mean()) if len(values) else math.nan for name, values in vars(samples).items()}
    minutes = float(samples.agent_minutes.sum())

    def rate(events: Float[np.ndarray, "_"]) -> float:
        return float(events.sum()) / minutes if minutes else math.nan

    return {
        "agents_within_60_m": means["density"], "moving": means["driving"], "speed_mps": means["speed"],
        "w1_speed_mps": compute_distance(samples.speed, log.speed), "w1_gap_m": compute_distance(samples.gap, log.gap),
        "num_worlds": len(samples.entries),
        "ego_speed_mps": means["ego_speed"], "entries_per_min": 6 * means["entries"],
        "collisions_per_agent_min": rate(samples.collisions),
        "road_departures_per_agent_min": rate(samples.departures),
        "red_lights_per_agent_min": rate(samples.red_lights), "stuck_share": means["stuck"],
    }  # fmt: skip


def _format_values(row: Mapping[str, Any], log: Mapping[str, Any]) -> list[str]:
    """Cells of a row under `HEADINGS`."""

    def compare(name: str) -> str:
        value, truth = row[name], log[name]
        return f"{value:.1f}" if row is log or not truth > 0 else f"{value:.1f} ({value / truth:.2f})"

    return [
        row["world"], f"{row['start_s']}-{row['end_s']}", *map(compare, ("agents_within_60_m", "moving", "speed_mps")),
        f"{row['w1_speed_mps']:.2f}", f"{row['w1_gap_m']:.1f}", compare("ego_speed_mps"),
        f"{row['entries_per_min']:.0f}", f"{row['collisions_per_agent_min']:.2f}",
        f"{row['road_departures_per_agent_min']:.2f}", f"{row['red_lights_per_agent_min']:.2f}",
        f"{100 * row['stuck_share']:.1f}",
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
    ego: Literal["model", "log"] = "model",
    rollouts_per_pass: int = 8,
    out: Path | None = None,
) -> WindowEvaluation:
    """Samples of the rollouts of a policy and of the logs of the same worlds; written to OUT/NAME.csv.

    Args:
        policy: Policy in evaluation mode, which moves all agents.
        scenarios: Worlds with logs as long as the rollouts.
        seconds: Length of the rollouts, a multiple of 10.
        name: Name of the rollouts in the table.
        num_rollouts: Number of rollouts of each world.
        seed: Seed of the rollouts.
        sampling: Temperature and truncation of the decisions.
        entries: Name or file of the model of who enters; None = nobody enters or leaves.
        ego: Who moves the ego. Around the logged one rollouts and log are of the same streets at the same time.
        rollouts_per_pass: Rollouts in memory at once.
        out: Folder of the result; None = in memory alone.

    Raises:
        ConfigError: A length that is no multiple of 10 s, entries that do not fit the policy, or a file of that name
            with the result of other work.
        DataError: No scenario, or a log that ends before the rollouts.
    """
    check_name(name, "an evaluation's name")
    num_steps = count_steps(seconds)
    if num_steps % WINDOW_STEPS:
        raise ConfigError(f"seconds={seconds:g}: windows last 10 s: take a multiple, or leave it out for the 8 s.")
    if ego not in ("model", "log"):
        raise ConfigError(f"ego={ego!r}: expected 'model' or 'log'.")
    for scenario in (scenarios[position] for position in range(len(scenarios))):
        is_logged = scenario.tracks.valid[scenario.ego_index, HISTORY_STEPS : HISTORY_STEPS + num_steps]
        if ego == "log" and not is_logged.all():
            raise DataError(
                f"scenario {scenario.scenario_id}: its log lacks the ego {(is_logged.argmin() + 1) * STEP_S:.1f} s "
                "after now: leave out ego='log', or the scenario."
            )
        left = scenario.num_steps - HISTORY_STEPS
        if left < num_steps:
            raise DataError(
                f"scenario {scenario.scenario_id}: its log goes on for {left * STEP_S:.1f} s, too short to hold "
                f"{seconds:g} s against: rlftsim synthesize --seconds {seconds + 10:g} makes longer ones."
            )
    logs, rollouts, scenario_ids = [], [], list(list_scenario_ids(scenarios))
    entry_model = load_entries(entries)
    identity = {
        "policy": fingerprint_policy(policy), "worlds": hashlib.sha256("".join(scenario_ids).encode()).hexdigest()[:16],
        "rollouts": num_rollouts, "seed": seed, "temperature": sampling.temperature, "top_k": sampling.top_k or "",
        "entries": identify_entries(entries) or "", "ego": ego,
    }  # fmt: skip
    path = None if out is None else out / f"{name}.csv"
    if path is not None:
        _check_path(path, identity)
    with progress_bar(f"evaluate {name}", len(scenarios)) as advance:
        for position in range(len(scenarios)):
            world = scenarios[position]
            scenario = world if entry_model is None else add_visitors(world)
            batch = collate([scenario]).to(get_device(policy))
            force = lead_ego(batch, policy.steps_per_decision) if ego == "log" else None
            logs.append(measure_windows(read_log(world).steps(slice(num_steps)), world))
            for first in range(0, num_rollouts, rollouts_per_pass):
                simulated = simulate(
                    policy, batch, num_rollouts=range(first, min(first + rollouts_per_pass, num_rollouts)), seed=seed,
                    num_steps=num_steps, sampling=sampling, entries=entry_model, force=force,
                )  # fmt: skip
                rollouts += [measure_windows(motion, world) for motion in read_rollouts(scenario, simulated)]
            advance()
    if not logs:
        raise DataError("there are no scenarios to evaluate.")
    windows, log = (tuple(map(join_samples, zip(*worlds))) for worlds in (rollouts, logs))
    result = WindowEvaluation(name, windows, log, identity)
    if path is not None:
        result.write(path)
    return result


def measure_windows(motion: Motion, scenario: Scenario) -> list[WindowSamples]:
    """Samples of each 10 s of a world; none from that one on in which the ego drives off the map.

    Args:
        motion: Motion of all agents; what is left behind the last 10 s does not count.
        scenario: World with the map and the lights.
    """
    num_windows, num_samples = motion.heading.shape[1] // WINDOW_STEPS, WINDOW_STEPS // STRIDE
    incidents = find_incidents(motion.steps(slice(num_windows * WINDOW_STEPS)), scenario)
    on_map = count_steps_on_map(motion, scenario) // WINDOW_STEPS
    measured = [
        _measure(
            motion.steps(slice(k * WINDOW_STEPS, (k + 1) * WINDOW_STEPS)),
            incidents.samples(slice(k * num_samples, (k + 1) * num_samples)),
        )
        for k in range(min(num_windows, on_map))
    ]
    return measured + [NO_SAMPLES] * (num_windows - len(measured))


def join_samples(samples: Sequence[WindowSamples]) -> WindowSamples:
    """Samples of several worlds, one after the other.

    Args:
        samples: Samples of each world, all of the same window.
    """
    return WindowSamples(*(np.concatenate(values) for values in zip(*(vars(sample).values() for sample in samples))))


def compute_distance(first: Float[np.ndarray, "k"], second: Float[np.ndarray, "m"]) -> float:
    """Wasserstein distance of two samples, in their unit; NaN where one is empty.

    Args:
        first: Sample of any size.
        second: Sample of another size, in the same unit.
    """
    if not len(first) or not len(second):
        return float("nan")
    levels = np.linspace(0.005, 0.995, 199)
    return float(np.abs(np.quantile(first, levels) - np.quantile(second, levels)).mean())


def _measure(motion: Motion, incidents: Incidents) -> WindowSamples:
    velocity = np.diff(motion.position, axis=1) / STEP_S
    sampled = slice(0, velocity.shape[1], STRIDE)
    has_speed = (motion.valid[:, 1:] & motion.valid[:, :-1])[:, sampled]
    speed = np.linalg.norm(velocity, axis=-1)[:, sampled]
    position, heading = motion.position[:, :-1][:, sampled], motion.heading[:, :-1][:, sampled]
    valid = motion.valid[:, :-1][:, sampled]
    others, is_vehicle = np.arange(len(valid)) != motion.ego, motion.is_vehicle[:, None]
    is_nearby = valid & (np.linalg.norm(position - position[motion.ego], axis=-1) < NEAR_M) & others[:, None]
    is_moving = is_nearby & has_speed & (speed > MOVING_MPS)
    begins = find_collisions(position, heading, motion.size, valid)
    gap = measure_gaps(position, heading, is_moving & is_vehicle, valid & is_vehicle)
    appears = motion.valid[:, 1:] & ~motion.valid[:, :-1]
    return WindowSamples(
        density=is_nearby.sum(0).astype(float),
        driving=is_moving.sum(0).astype(float),
        speed=speed[is_moving],
        gap=gap[gap < LONGEST_GAP_M],
        ego_speed=speed[motion.ego],
        collisions=np.array([float(begins.sum())]),
        departures=np.array([float(incidents.leaves_road.sum())]),
        red_lights=np.array([float(incidents.passes_red.sum())]),
        stuck=incidents.is_stuck[incidents.is_on_lane].astype(float),
        entries=np.array([float(appears.sum())]),
        agent_minutes=np.array([motion.valid.sum() * STEP_S / 60]),
    )
