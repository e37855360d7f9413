"""Goals: points that agents are conditioned on, such as the last logged position of each agent.

Goals that programs write, such as the augmented goals of a whole data set, are stored in a folder of Parquet files:
scenario_id, object_id, x, y. Frame: world, m. Goals written by hand are JSON (`goals.goals_file`).

Source: RLFTSim, section 4.2.
"""

import hashlib
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import cast

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from rlftsim.errors import ConfigError, DataError
from rlftsim.jobs.files import write_atomically
from rlftsim.jobs.tables import check_columns, read_parquet
from rlftsim.scenario.batch import Frame, ScenarioBatch, compute_origin
from rlftsim.scenario.shards import hash_file
from rlftsim.scenario.types import CURRENT_STEP, FUTURE_STEPS, STEP_S, Scenario

Points = tuple[Int64[np.ndarray, "n"], Float[np.ndarray, "n 2"]]
"""Distinct object ids, and a point for each. Frame: world, m, float64."""

PointById = Mapping[int | np.integer, Sequence[float | int] | np.ndarray]
"""Object id -> (x, y). Frame: world, m."""

MAX_LISTED_IDS = 12
"""Object ids that an error message lists at most."""
MAX_COORDINATE_M = 1e7
"""Farthest coordinate of a goal, meters in the world frame; UTM coordinates stay within."""
SCHEMA = pa.schema([("scenario_id", pa.string()), ("object_id", pa.int64()), ("x", pa.float64()), ("y", pa.float64())])


@dataclass(frozen=True, eq=False)
class Goals:
    """A point for some of the agents of each rollout. Frame: that of the batch, map (centered) by default.

    `goal_mask` is True where an agent has a goal. Elsewhere `position` is undefined and must not be read.
    """

    position: Float[Tensor, "B N A 2"]
    goal_mask: Bool[Tensor, "B N A"]
    frame: Frame = "map"

    @classmethod
    def of_scenarios(
        cls, position: Float[Tensor, "B A 2"], goal_mask: Bool[Tensor, "B A"], frame: Frame = "map"
    ) -> "Goals":
        """Goals of a single rollout (N = 1); `repeat` expands them to N.

        Args:
            position: Goal of each agent, m.
            goal_mask: True = the agent has a goal.
            frame: Frame of the positions, that of the batch.
        """
        return cls(position[:, None], goal_mask[:, None], frame)

    @classmethod
    def from_points(cls, batch: ScenarioBatch, points: Mapping[str, PointById] | PointById) -> "Goals":
        """Goals of agents addressed by object id, for a single rollout.

        Args:
            batch: Scenarios of the agents; agents that are not named have no goal.
            points: `{scenario_id: {object_id: (x, y)}}`, or `{object_id: (x, y)}` for a batch of a single scenario.
                World frame, m.

        Raises:
            ConfigError: Object ids without a scenario id for several scenarios, or a scenario that is not in the batch.
            DataError: An agent that the scenario lacks or does not simulate, or a point that is not two finite numbers.
        """
        ids = [scenario.scenario_id for scenario in batch.scenarios]
        by_scenario: dict[str, PointById] = {str(k): v for k, v in points.items() if isinstance(v, Mapping)}
        if len(by_scenario) != len(points):
            if len(ids) != 1 or by_scenario:
                raise ConfigError(
                    f"goals by object id alone need a batch of one scenario, this one has {len(ids)}: write "
                    "{scenario_id: {object_id: (x, y)}}."
                )
            by_scenario = {ids[0]: cast(PointById, points)}
        missing_ids = [key for key in by_scenario if key not in ids]
        if missing_ids:
            raise ConfigError(
                f"goals name scenario {missing_ids[0]!r}, which is not in the batch: it has {_join_ids(ids)}."
            )
        arrays: dict[str, Points] = {}
        for scenario in batch.scenarios:
            point_by_id = by_scenario.get(scenario.scenario_id, {})
            for object_id, point in point_by_id.items():
                simulated_track(scenario, object_id, "goals")
                _check_point(point, f"goal of agent {object_id} in scenario {scenario.scenario_id}")
            positions = np.array([tuple(point) for point in point_by_id.values()], np.float64).reshape(-1, 2)
            arrays[scenario.scenario_id] = np.array(list(point_by_id), np.int64), positions
        return goals_at(arrays, batch)

    @property
    def num_rollouts(self) -> int:
        """N."""
        return self.goal_mask.shape[1]

    @property
    def any(self) -> bool:
        """True if at least one agent has a goal."""
        return bool(self.goal_mask.any())

    def rollouts(self, selected: slice) -> "Goals":
        """The goals of the selected rollouts."""
        return self._apply(lambda values: values[:, selected])

    def select_scenario(self, row: int, num_agents: int) -> "Goals":
        """The goals of the first agents of a scenario.

        Args:
            row: Index of the scenario on axis B.
            num_agents: Number of agents that stay.
        """
        return self._apply(lambda values: values[row : row + 1, :, :num_agents])

    def repeat(self, num_rollouts: int) -> "Goals":
        """The goals of a single rollout expanded to N, without copies; goals of N rollouts unchanged.

        Raises:
            ConfigError: The number of rollouts is neither 1 nor N.
        """
        if self.num_rollouts not in (1, num_rollouts):
            raise ConfigError(
                f"goals of {self.num_rollouts} rollouts do not fit {num_rollouts} rollouts: give goals of one rollout "
                "or of as many."
            )
        return self._apply(lambda values: values.expand(-1, num_rollouts, *values.shape[2:]))

    def only(self, mask: Bool[Tensor, "B #N A"]) -> "Goals":
        """The same goals for the masked agents alone; the goals of all other agents are dropped."""
        return replace(self, goal_mask=self.goal_mask & mask)

    def where(self, condition: Bool[Tensor, "B N A"], other: "Goals") -> "Goals":
        """These goals where a condition is True, the goals of `other` elsewhere, like `torch.where`.

        Args:
            condition: True = keep the goal, or the lack of a goal.
            other: Goals of the same shape, in the same frame.
        """
        return replace(
            self,
            position=torch.where(condition[..., None], self.position, other.position),
            goal_mask=torch.where(condition, self.goal_mask, other.goal_mask),
        )

    def to(self, device: torch.device | str) -> "Goals":
        """The same goals on a device."""
        return self._apply(lambda values: values.to(device))

    def _apply(self, function: Callable[[Tensor], Tensor]) -> "Goals":
        return replace(self, position=function(self.position), goal_mask=function(self.goal_mask))

    def __repr__(self) -> str:
        num_scenarios, num_rollouts, num_agents = self.goal_mask.shape
        count = int(self.goal_mask.any(1).sum())
        agents, scenarios, rollouts = (
            f"{number} {word}{'' if number == 1 else 's'}"
            for number, word in ((count, "agent"), (num_scenarios, "scenario"), (num_rollouts, "rollout"))
        )
        return f"Goals({agents} of {scenarios} × {num_agents}, in {rollouts})"


def goals_at(points: Mapping[str, Points], batch: ScenarioBatch) -> Goals:
    """World-frame points as goals of a batch, for a single rollout, in the batch's frame.

    Args:
        points: Object ids and points by scenario id; agents that are not simulated are left out silently
            (`Goals.from_points` raises instead).
        batch: Scenarios of the agents; scenarios and agents without a point have no goal.
    """
    mask = np.zeros(batch.agent_mask.shape, bool)  # [B, A]
    position = np.zeros((*mask.shape, 2), np.float32)  # [B, A, 2]
    for row, scenario in enumerate(batch.scenarios):
        if scenario.scenario_id in points:
            ids, world_points = points[scenario.scenario_id]
            simulated_ids = scenario.tracks.object_id[scenario.simulated_indices]
            _, agents, entries = np.intersect1d(simulated_ids, ids, return_indices=True)
            mask[row, agents] = True
            # The origin is subtracted in float64: float32 has steps of 0.5 mm at world coordinates of kilometers.
            position[row, agents] = world_points[entries] - compute_origin(scenario, batch.frame)
    return Goals.of_scenarios(torch.from_numpy(position), torch.from_numpy(mask), batch.frame).to(batch.device)


def shown_id(object_id: object) -> str:
    """An object id for an error message; an id that is not a whole number, such as the text "9", is marked."""
    return str(object_id) if isinstance(object_id, int | np.integer) else f"{object_id!r} (ids are whole numbers)"


def simulated_track(scenario: Scenario, object_id: object, location: str) -> int:
    """Index of the track of a simulated agent.

    Args:
        scenario: Scenario of the agent.
        object_id: Id of the agent in the log.
        location: Start of the error message, such as a file and an entry.

    Raises:
        DataError: No such agent, or an agent that is not simulated.
    """
    tracks, simulated = scenario.tracks, scenario.simulated_indices
    rows = np.flatnonzero(tracks.object_id == object_id)
    if not len(rows):
        ids = sorted(tracks.object_id[simulated].tolist())
        raise DataError(
            f"{location}: scenario {scenario.scenario_id} has no agent {shown_id(object_id)}: it simulates {len(ids)} "
            f"agents: {_join_ids(ids)}."
        )
    if rows[0] not in simulated:
        raise DataError(
            f"{location}: agent {object_id} is not there at the current step of scenario {scenario.scenario_id}, so it "
            "is not simulated: choose another one."
        )
    return int(rows[0])


def _check_point(point: object, location: str) -> None:
    try:
        x, y = point  # type: ignore[misc]
        is_finite = math.isfinite(x) and math.isfinite(y)
    except (TypeError, ValueError):
        is_finite = False
    if not is_finite:
        raise DataError(
            f"{location}: {point!r} is not a point: give (x, y), finite, in m, in the world frame of the log."
        )


def _join_ids(ids: list[str] | list[int]) -> str:
    return ", ".join(str(i) for i in ids[:MAX_LISTED_IDS]) + (", ..." if len(ids) > MAX_LISTED_IDS else "")


@dataclass(frozen=True, eq=False)
class LoggedEndpoints:
    """Each agent's last logged future state, undefined where `mask` is False. Frame: that of the batch."""

    position: Float[Tensor, "B A 2"]
    heading: Float[Tensor, "B A"]
    horizon_s: Float[Tensor, "B A"]
    """Time from the current step to the endpoint."""
    mask: Bool[Tensor, "B A"]
    """True = a simulated agent that is logged at some future step."""


def logged_endpoints(batch: ScenarioBatch) -> LoggedEndpoints:
    """Last logged states of the agents of a batch; without logged futures `mask` is False everywhere."""
    valid = batch.valid[:, :, CURRENT_STEP : CURRENT_STEP + 1 + FUTURE_STEPS]  # [B, A, 81] or shorter
    # [B, A], steps after the current one; 0 = never logged in the future
    num_steps = (valid * torch.arange(valid.shape[2], device=valid.device)).amax(-1)
    step = CURRENT_STEP + num_steps
    return LoggedEndpoints(
        position=_select_step(batch.position, step),
        heading=_select_step(batch.heading[..., None], step)[..., 0],
        horizon_s=num_steps * STEP_S,
        mask=batch.agent_mask & (num_steps > 0),
    )


def logged_goals(batch: ScenarioBatch, agent_mask: Bool[Tensor, "B A"] | None = None) -> Goals:
    """Each agent's last logged position as a goal, for a single rollout (`Goals.repeat` expands the goals to N).

    Args:
        batch: Scenarios with logged futures; agents without a future get no goal.
        agent_mask: True = the agent gets a goal; None = every agent with a logged future does.
    """
    ends = logged_endpoints(batch)
    return Goals.of_scenarios(ends.position, ends.mask if agent_mask is None else ends.mask & agent_mask, batch.frame)


def _select_step(values: Float[Tensor, "B A S k"], step: Int64[Tensor, "B A"]) -> Float[Tensor, "B A k"]:
    index = step[..., None, None].expand(-1, -1, 1, values.shape[-1])  # [B, A, 1, k]
    return values.gather(2, index)[:, :, 0]


def write_goal_file(path: Path, goals: Mapping[str, Points]) -> None:
    """Write a file of such a folder, atomically.

    Args:
        path: File to write; the files of a folder are read in the order of names.
        goals: Object ids and points by scenario id, world frame, m.
    """
    scenario_ids = np.repeat(list(goals), [len(ids) for ids, _ in goals.values()])
    object_ids, points = (np.concatenate(values) for values in zip(*goals.values()))
    columns = zip((scenario_ids, object_ids, *points.T), SCHEMA)
    table = pa.table([pa.array(values, column.type) for values, column in columns], schema=SCHEMA)
    write_atomically(path, lambda temporary: pq.write_table(table, temporary))


def read_goal_file(file: Path) -> pa.Table:
    """Table of a file that `write_goal_file` wrote.

    Raises:
        DataError: The file is damaged, or a row is not a goal.
    """
    way_out = f"remove {file.parent} and write its goals again by `rlftsim augment`"
    table = read_parquet(file, way_out)
    try:
        check_columns(table, SCHEMA)
        points = np.abs([table["x"].to_numpy(), table["y"].to_numpy()])
        if not (points <= MAX_COORDINATE_M).all():  # false for NaN, too
            raise DataError(f"a point is not within {MAX_COORDINATE_M:g} m of the origin")
    except DataError as error:
        raise DataError(f"{file}: holds rows that are not goals ({error}): {way_out}.") from None
    return table.replace_schema_metadata(None)


class StoredGoals:
    """The goals of a folder, by scenario id.

    Raises:
        DataError: The folder has no goals, a file is damaged, or a row is not a goal.
    """

    def __init__(self, folder: Path):
        self._files = sorted(folder.glob("*.parquet"))
        if not self._files:
            raise DataError(f"{folder}: holds no goals: write them by `rlftsim augment`.")
        tables = [read_goal_file(file) for file in self._files]
        self._table = pa.concat_tables([table.select(SCHEMA.names) for table in tables]).combine_chunks()

    @cached_property
    def _rows(self) -> dict[str, slice]:
        """Rows of each scenario."""
        ids = self._table["scenario_id"].to_numpy()
        # A scenario's rows are contiguous, so it begins wherever the id changes.
        starts = np.flatnonzero(np.append(True, ids[1:] != ids[:-1])) if len(ids) else np.zeros(0, np.int64)
        return {ids[a]: slice(a, b) for a, b in zip(starts.tolist(), [*starts[1:].tolist(), len(ids)])}

    def __contains__(self, scenario_id: str) -> bool:
        return scenario_id in self._rows

    def __len__(self) -> int:
        """Number of scenarios that have goals."""
        return len(self._rows)

    @cached_property
    def fingerprint(self) -> str:
        """Hash of the files' bytes, in the order of names."""
        return hashlib.sha256("".join(map(hash_file, self._files)).encode()).hexdigest()

    def count_among(self, scenario_ids: Iterable[str]) -> int:
        """Number of the listed scenarios that have goals here; 0 for scenarios of a different data set."""
        return sum(scenario_id in self for scenario_id in scenario_ids)

    def of_scenario(self, scenario_id: str) -> Points:
        """Object ids and goals of a scenario that has goals."""
        rows = self._rows[scenario_id]
        table = self._table.slice(rows.start, rows.stop - rows.start)
        ids, x, y = (table[name].to_numpy() for name in ("object_id", "x", "y"))
        return ids, np.stack([x, y], -1)

    def of_batch(self, batch: ScenarioBatch) -> Goals:
        """Goals of a batch, for a single rollout, in the batch's frame; scenarios outside the folder have no goals."""
        ids = [scenario.scenario_id for scenario in batch.scenarios if scenario.scenario_id in self]
        return goals_at({scenario_id: self.of_scenario(scenario_id) for scenario_id in ids}, batch)
