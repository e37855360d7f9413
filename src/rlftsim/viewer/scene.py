"""Scenes for pictures and pages: map, lights, boxes and trajectories in the map frame.

Agents are the simulated ones (`Scenario.simulated_indices`), in the order of a batch's axis A. Pages stay small because
`to_payload` rounds to centimeters and hundredths of a radian and stores second differences: smooth motion becomes
mostly zeros.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rlftsim.errors import DataError
from rlftsim.geometry import boxes_overlap, heights_overlap
from rlftsim.rollout.types import Rollouts
from rlftsim.scenario.sources import find_attribution
from rlftsim.scenario.types import (
    CURRENT_STEP,
    HISTORY_STEPS,
    LANE_TYPES,
    POLYGON_TYPES,
    ROAD_EDGE_TYPES,
    LightStates,
    MapFeatureType,
    Scenario,
)


def compute_overlap(
    position: Float[np.ndarray, "N A S 2"],
    heading: Float[np.ndarray, "N A S"],
    length: Float[np.ndarray, "A"],
    width: Float[np.ndarray, "A"],
    valid: Bool[np.ndarray, "N A S"],
    *,
    ignore_from: int | None = None,
    z: Float[np.ndarray, "N A S"] | None = None,
    height: Float[np.ndarray, "A"] | None = None,
) -> Bool[np.ndarray, "N A S"]:
    """True where an agent's box has an inner point in common with a second box.

    Args:
        position: Centers [N, A, S, 2] of the boxes, meters.
        heading: Headings [N, A, S], radians.
        length: Lengths [A] along the heading, meters.
        width: Widths [A] across the heading, meters.
        valid: Mask [N, A, S]; an agent that is not valid overlaps no agent.
        ignore_from: Step at which overlapping pairs are noted, never to be marked; None marks all pairs.
        z: Heights [N, A, S] of the centers, meters; without heights, agents above each other overlap.
        height: Heights [A] of the boxes, meters; needed with `z`.
    """
    overlap = np.zeros(valid.shape, bool)  # [N, A, S]
    size = np.stack([length, width], axis=-1).astype(np.float64)
    radius = np.linalg.norm(size, axis=-1) / 2  # [A], of the circle around a box
    for n in range(len(valid)):
        center = position[n].astype(np.float64)  # [A, S, 2]
        for agent in range(len(size) - 1):
            later_agents = slice(agent + 1, None)
            gap = center[later_agents] - center[agent]  # [A - agent - 1, S, 2]
            # Few pairs are so close that their circles touch; only these need the exact test.
            is_close = (gap**2).sum(-1) < (radius[later_agents, None] + radius[agent]) ** 2
            # k pairs of a later agent and a step
            gap_row, step = np.nonzero(is_close & valid[n, later_agents] & valid[n, agent])
            if not len(gap_row):
                continue
            row = gap_row + agent + 1
            headings = heading[n, agent, step], heading[n, row, step]
            hit = boxes_overlap(gap[gap_row, step], *headings, size[agent], size[row])
            if z is not None and height is not None:
                hit &= heights_overlap(z[n, row, step] - z[n, agent, step], height[agent, None], height[row])
            if ignore_from is not None:
                # A stroller and its pusher overlap from the beginning, which is no collision.
                hit &= ~np.isin(row, row[hit & (step == ignore_from)])
            overlap[n, agent, step[hit]] = True
            overlap[n, row[hit], step[hit]] = True
    return overlap


SIMPLIFY_TOLERANCE_M = 0.1
"""Largest distance of a drawn map line from the logged one."""
MIN_FOCUS_RADIUS_M, MAX_FOCUS_RADIUS_M = 30.0, 80.0
UNSEEN_LIGHT = "-"

MAP_STYLES = {
    **dict.fromkeys(map(MapFeatureType, LANE_TYPES), "lane"),
    MapFeatureType.LANE_BIKE: "bike_lane",
    MapFeatureType.LINE_UNKNOWN: "white",
    MapFeatureType.LINE_BROKEN_SINGLE_WHITE: "white_broken",
    MapFeatureType.LINE_SOLID_SINGLE_WHITE: "white",
    MapFeatureType.LINE_SOLID_DOUBLE_WHITE: "white",
    MapFeatureType.LINE_BROKEN_SINGLE_YELLOW: "yellow_broken",
    MapFeatureType.LINE_BROKEN_DOUBLE_YELLOW: "yellow_broken",
    MapFeatureType.LINE_SOLID_SINGLE_YELLOW: "yellow",
    MapFeatureType.LINE_SOLID_DOUBLE_YELLOW: "yellow",
    MapFeatureType.LINE_PASSING_DOUBLE_YELLOW: "yellow_broken",
    **dict.fromkeys(map(MapFeatureType, ROAD_EDGE_TYPES), "edge"),
    **{feature: feature.name.lower() for feature in (MapFeatureType.STOP_SIGN, *POLYGON_TYPES)},
}
"""Drawing style of each type of map feature."""


@dataclass(frozen=True, eq=False)
class MapLine:
    """Map feature: a polyline, a polygon (crosswalk, speed bump, driveway) or a point (stop sign)."""

    style: str
    """A value of `MAP_STYLES`."""
    points: Float[np.ndarray, "n 2"]
    """Map frame, meters."""


@dataclass(frozen=True, eq=False)
class Light:
    """Traffic light at a stop point."""

    stop_point: Float[np.ndarray, "2"]
    """Map frame, meters."""
    states: str
    """One character a step: WOMD's number of the state, or `UNSEEN_LIGHT`."""


@dataclass(frozen=True, eq=False)
class AgentBoxes:
    """Boxes of the agents in the picture; sizes at the current step, meters."""

    object_id: Int[np.ndarray, "A"]
    object_type: Int[np.ndarray, "A"]
    length: Float[np.ndarray, "A"]
    width: Float[np.ndarray, "A"]
    is_ego: Bool[np.ndarray, "A"]
    evaluated_mask: Bool[np.ndarray, "A"]
    """True = the agent is evaluated by the metric, as is the ego."""

    def __len__(self) -> int:
        return len(self.object_id)


@dataclass(frozen=True, eq=False)
class SceneView:
    """Still part of a scenario, map frame."""

    scenario_id: str
    lines: tuple[MapLine, ...]
    lights: tuple[Light, ...]
    agents: AgentBoxes
    focus: tuple[float, float, float]
    """View at the beginning: x and y of the center and half of the shown width, meters."""
    note: str = ""
    """Small print below every picture: origin and license of the log, and guessed facts."""

    def to_payload(self) -> dict[str, Any]:
        """Lists, numbers and text in the layout that `player.js` reads; centimeters, points as differences."""
        by_style: dict[str, list[list[int]]] = {}
        for line in self.lines:
            # x0, y0, then differences from point to point
            steps = np.diff(_centi(line.points), axis=0, prepend=np.zeros((1, 2), np.int64))
            by_style.setdefault(line.style, []).append(steps.ravel().tolist())
        agents = self.agents
        roles = np.where(agents.is_ego, 2, agents.evaluated_mask.astype(int))
        columns = (agents.object_id, agents.object_type, _centi(agents.length), _centi(agents.width), roles)
        return {
            "id": self.scenario_id,
            "now": CURRENT_STEP,
            "focus": [round(v, 1) for v in self.focus],
            "map": by_style,
            "lights": [[*_centi(light.stop_point).tolist(), light.states] for light in self.lights],
            "agents": [list(row) for row in zip(*(c.tolist() for c in columns))],
        }


@dataclass(frozen=True, eq=False)
class SceneMotion:
    """Motion of the agents over S steps from step 0 on, in N rollouts, map frame. The log has N = 1."""

    position: Float[np.ndarray, "N A S 2"]
    heading: Float[np.ndarray, "N A S"]
    valid: Bool[np.ndarray, "N A S"]
    collides: Bool[np.ndarray, "N A S"] | None = None
    """True = the agent overlaps an agent; None = unknown, no agent is marked."""
    offroad: Bool[np.ndarray, "N A S"] | None = None
    """True = a corner of the agent is off the road; None = unknown, no agent is marked."""

    @property
    def num_rollouts(self) -> int:
        """N."""
        return self.position.shape[0]

    @property
    def num_steps(self) -> int:
        """S."""
        return self.position.shape[2]

    def first(self, num_rollouts: int) -> "SceneMotion":
        """Motion of the first rollouts only."""
        fields = {name: None if values is None else values[:num_rollouts] for name, values in vars(self).items()}
        return replace(self, **fields)

    def with_overlaps(
        self,
        agents: AgentBoxes,
        z: Float[np.ndarray, "N A S"] | None = None,
        height: Float[np.ndarray, "A"] | None = None,
    ) -> "SceneMotion":
        """Motion with `collides` = the boxes overlap, and did not at the current step.

        A logged stroller and pusher overlap from the beginning, which is no collision. Boxes have sharp corners
        here and rounded corners in the metric, so these are not exactly the metric's collisions.

        Args:
            agents: Boxes of the agents, in the same order.
            z: Heights [N, A, S] of the centers, meters; without heights, agents above each other overlap, as in the
                metric.
            height: Heights [A] of the boxes, meters; needed with `z`.
        """
        collides = compute_overlap(
            self.position, self.heading, agents.length, agents.width, self.valid, ignore_from=CURRENT_STEP,
            z=z, height=height,
        )  # fmt: skip
        return replace(self, collides=collides)

    def with_evaluated_flags(
        self,
        scenario: Scenario,
        *,
        collision: Bool[Tensor | np.ndarray, "N E T"] | None = None,
        offroad: Bool[Tensor | np.ndarray, "N E T"] | None = None,
    ) -> "SceneMotion":
        """Motion with the metric's marks, which exist for evaluated agents and future steps.

        Args:
            scenario: Scenario of this motion, which says which agents are evaluated.
            collision: True = the agent collides; rows in the order of `scenario.evaluated_indices`.
            offroad: True = the agent is off the road; rows in the same order.
        """
        rows = np.searchsorted(scenario.simulated_indices, scenario.evaluated_indices)  # [E]
        spread = {}
        for name, values in {"collides": collision, "offroad": offroad}.items():
            if values is not None:
                spread[name] = np.zeros(self.valid.shape, bool)  # [N, A, S]
                # Fewer rollouts or steps may be shown than the metric has marks for.
                flags = np.asarray(values, bool)[: self.num_rollouts, :, : self.num_steps - HISTORY_STEPS]
                spread[name][:, rows, HISTORY_STEPS:] = flags
        return replace(self, **spread)

    def to_payload(self) -> dict[str, Any]:
        """Lists and numbers only, in the layout that `player.js` reads."""
        return {"steps": self.num_steps, "rollouts": [self._encode_rollout(n) for n in range(self.num_rollouts)]}

    def _encode_rollout(self, n: int) -> list[list[list[int]]]:
        """Second differences of x, y (cm) and heading (0.01 rad) of each agent, and valid, colliding and off-road
        steps as intervals."""
        position, heading = _hold(self.position[n], self.valid[n]), _hold(self.heading[n], self.valid[n])
        # Held and unwrapped first: a gap or a jump by a full turn would cost two large differences each.
        channels = _centi(np.stack([position[..., 0], position[..., 1], np.unwrap(heading, axis=-1)], axis=1))
        flags = [self.valid[n]] + [
            np.zeros_like(self.valid[n]) if f is None else f[n] & self.valid[n] for f in (self.collides, self.offroad)
        ]
        return [
            [
                *(_second_differences(channel) for channel in channels[agent]),
                # Half-open runs of True as start, stop, start, stop, ...: places where a flag changes.
                *(np.flatnonzero(np.diff(flag[agent], prepend=False, append=False)).tolist() for flag in flags),
            ]
            for agent in range(len(channels))
        ]


def build_scene(scenario: Scenario) -> SceneView:
    """Still part of a scenario: map (simplified to 10 cm), lights, boxes of the agents."""
    tracks, indices, features = scenario.tracks, scenario.simulated_indices, scenario.map_features
    lines = []
    for index in range(len(features)):
        # Subtracted in float64: world coordinates are kilometers, where float32 rounds to half a millimeter.
        points = features.polyline(index)[:, :2].astype(np.float64) - scenario.origin  # [n, 2]
        points = points[np.isfinite(points).all(-1)]
        if len(points):
            lines.append(MapLine(MAP_STYLES[MapFeatureType(int(features.feature_type[index]))], simplify(points)))
    return SceneView(
        scenario_id=scenario.scenario_id,
        lines=tuple(lines),
        lights=tuple(_build_lights(scenario.lights, scenario.origin, scenario.num_steps)),
        agents=AgentBoxes(
            object_id=tracks.object_id[indices],
            object_type=tracks.object_type[indices].astype(np.int64),
            length=tracks.size[indices, CURRENT_STEP, 0],
            width=tracks.size[indices, CURRENT_STEP, 1],
            is_ego=indices == scenario.ego_index,
            evaluated_mask=np.isin(indices, scenario.evaluated_indices),
        ),
        focus=_focus(scenario),
        note=_note(scenario),
    )


def logged_trajectories(scenario: Scenario) -> SceneMotion:
    """Logged motion of the simulated agents: 91 steps, or 11 where the future is withheld."""
    tracks, indices = scenario.tracks, scenario.simulated_indices
    position = (tracks.position[indices][..., :2] - scenario.origin).astype(np.float32)  # [A, S, 2]
    heading = tracks.heading[indices]
    is_finite = np.isfinite(position).all(-1) & np.isfinite(heading)
    return SceneMotion(position[None], heading[None], (tracks.valid[indices] & is_finite)[None])


def rollout_trajectories(
    scenario: Scenario, rollouts: Rollouts, *, row: int, max_rollouts: int | None = None
) -> SceneMotion:
    """Simulated futures of a scenario of a batch, after the logged history.

    Args:
        scenario: Scenario number `row` of the batch.
        rollouts: Rollouts of the whole batch, in the map frame or the world frame.
        row: Index b of the scenario in the batch.
        max_rollouts: Number of rollouts to take, from the first on; None = all.

    Raises:
        DataError: The rollouts have other agents than the scenario, or fewer: they are of a different scenario.
    """
    provenance = rollouts.provenance
    if provenance is not None:
        provenance.check_same_agents(row, scenario)
    num_agents = len(scenario.simulated_indices)
    if rollouts.position.shape[2] < num_agents:
        raise DataError(
            f"{scenario.scenario_id}: {num_agents} agents, but the rollouts have {rollouts.position.shape[2]}: "
            "hand over the scenario of the same row."
        )
    # [N, A, T, 2] and [N, A, T], without the batch's padding
    future_position, future_heading = (
        values[row, :max_rollouts, :num_agents].detach().to("cpu", torch.float32).numpy()
        for values in (rollouts.position, rollouts.heading)
    )
    if provenance is not None and provenance.frame != "map":
        future_position = (future_position - scenario.origin).astype(np.float32)
    is_there = np.isfinite(future_position).all(-1) & np.isfinite(future_heading)
    if rollouts.valid is not None:
        is_there &= rollouts.valid[row, :max_rollouts, :num_agents].cpu().numpy()
    return continue_log(scenario, future_position, future_heading, is_there)


def continue_log(
    scenario: Scenario,
    position: Float[np.ndarray, "N A T 2"],
    heading: Float[np.ndarray, "N A T"],
    valid: Bool[np.ndarray, "N A T"],
) -> SceneMotion:
    """Simulated futures after the logged history.

    Args:
        scenario: Scenario that was simulated, with A simulated agents.
        position: Positions [N, A, T, 2] after the current step, map frame, meters.
        heading: Headings [N, A, T], radians.
        valid: Mask [N, A, T]; False = the agent is absent.
    """
    log = logged_trajectories(scenario)

    def join(past: np.ndarray, future: np.ndarray) -> np.ndarray:  # along the axis of steps
        # The log has one rollout; its history stands before each simulated future.
        repeated = np.repeat(past[:, :, :HISTORY_STEPS], len(future), axis=0)
        return np.concatenate([repeated, future], axis=2)

    return SceneMotion(join(log.position, position), join(log.heading, heading), join(log.valid, valid))


def simplify(points: Float[np.ndarray, "n 2"], tolerance_m: float = SIMPLIFY_TOLERANCE_M) -> Float[np.ndarray, "m 2"]:
    """Polyline with fewer points, close to the original (Douglas and Peucker, 1973).

    Args:
        points: Polyline [n, 2], meters; the end points stay.
        tolerance_m: Largest distance of a removed point from the result, meters.
    """
    if len(points) < 3:
        return points
    keep = np.zeros(len(points), bool)
    keep[[0, -1]] = True
    spans = [(0, len(points) - 1)]
    # A stack in place of recursion: map lines have thousands of points.
    while spans:
        start, stop = spans.pop()
        if stop - start < 2:
            continue
        inner, segment = points[start + 1 : stop], points[stop] - points[start]
        # Position of the nearest point of the segment, 0 at its start and 1 at its end; a segment may have no length.
        offset = inner - points[start]
        fraction = (offset @ segment / max(float(segment @ segment), 1e-12)).clip(0, 1)
        offset -= fraction[:, None] * segment
        distance = np.sqrt(offset[:, 0] * offset[:, 0] + offset[:, 1] * offset[:, 1])
        farthest = int(distance.argmax())
        if distance[farthest] > tolerance_m:
            middle = start + 1 + farthest
            keep[middle] = True
            spans += [(start, middle), (middle, stop)]
    return points[keep]


def _build_lights(lights: LightStates, origin: np.ndarray, num_steps: int) -> Iterator[Light]:
    """A light per controlled lane; of two entries for a lane and a step the later counts."""
    for lane_id in np.unique(lights.lane_id):
        rows = np.flatnonzero(lights.lane_id == lane_id)
        states = [UNSEEN_LIGHT] * num_steps
        for step, state in zip(lights.step[rows], lights.state[rows]):
            # Lights may be known for longer than the tracks.
            if step < num_steps:
                states[int(step)] = str(int(state))
        stop_point = lights.stop_point[rows[0], :2].astype(np.float64) - origin
        if np.isfinite(stop_point).all():
            yield Light(stop_point, "".join(states))


def _note(scenario: Scenario) -> str:
    """Attribution of the source, and the facts of the scenario that are guessed."""
    guessed = f"Guessed, not logged: {', '.join(sorted(scenario.guessed))}." if scenario.guessed else ""
    return f"{find_attribution(scenario.source)} {guessed}".strip()


def _focus(scenario: Scenario) -> tuple[float, float, float]:
    """Square around the logged paths of the evaluated agents, neither tiny nor so large that boxes become dots."""
    tracks, indices = scenario.tracks, scenario.evaluated_indices
    visited = (tracks.position[indices][tracks.valid[indices]][:, :2] - scenario.origin).astype(float)
    if not len(visited):
        return 0.0, 0.0, MIN_FOCUS_RADIUS_M
    low, high = visited.min(0), visited.max(0)
    radius = float(np.clip((high - low).max() / 2 + 8, MIN_FOCUS_RADIUS_M, MAX_FOCUS_RADIUS_M))
    ego = tracks.position[scenario.ego_index, CURRENT_STEP, :2] - scenario.origin
    # If not everything fits, the ego at the current step stays in the picture.
    center = np.clip((low + high) / 2, ego - 0.8 * radius, ego + 0.8 * radius)
    return float(center[0]), float(center[1]), radius


def _centi(values: np.ndarray) -> Int[np.ndarray, "..."]:
    """Values in hundredths, as whole numbers."""
    return np.rint(np.asarray(values, np.float64) * 100).astype(np.int64)


def _second_differences(values: Int[np.ndarray, "S"]) -> list[int]:
    """First value, first difference, then second differences; zeros at the end are left out."""
    first = np.diff(values, prepend=0)
    second = first.copy()
    second[2:] = np.diff(first[1:])
    return np.trim_zeros(second, "b").tolist()


def _hold(values: np.ndarray, valid: Bool[np.ndarray, "A S"]) -> np.ndarray:
    """Values with gaps filled by the last valid value, at the start by the first: second differences there are zero."""
    steps = np.arange(valid.shape[1])
    last = np.maximum.accumulate(np.where(valid, steps, -1), axis=1)  # [A, S], step of the last valid value or -1
    first = np.where(valid.any(1), valid.argmax(1), 0)
    source = np.where(last < 0, first[:, None], last)
    filled = np.take_along_axis(values, source if values.ndim == 2 else source[..., None], axis=1)
    has_valid_step = valid.any(1).reshape(-1, *[1] * (values.ndim - 1))
    return np.where(has_valid_step, filled, 0)
