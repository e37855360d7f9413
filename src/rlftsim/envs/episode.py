"""Episodes: a world with agents that are driven by actions, with events, rewards and ends.

B scenes in step, M planner-driven agents over all scenes. An `Episode` does not change, an `EpisodeState` is a value.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64

from rlftsim.envs.actions import Actors, Controls, validate_actions
from rlftsim.envs.config import EnvConfig
from rlftsim.envs.contact import Collision, classify_collision
from rlftsim.envs.observations import FAR_M, Atlas, Observation, build_atlas, observe
from rlftsim.envs.rewards import WeightedTerm, parse_terms
from rlftsim.envs.road import MAX_PAIRS, nearest_edges, road_edges
from rlftsim.envs.route import SPACING_M, find_route
from rlftsim.envs.world import Dice, World, WorldState, begin, find_presence, step_world, with_dice
from rlftsim.geometry import boxes_overlap, clockwise_corners, heights_overlap, wrapped
from rlftsim.goals.types import PointById
from rlftsim.realism.map_based import OUTSIDE_M, RoadEdges, compute_point_distance_to_road_edge, join_road_edges
from rlftsim.scenario.types import FUTURE_STEPS
from rlftsim.viewer.scene import SIMPLIFY_TOLERANCE_M

AT_GOAL_M = 2.0
SIMPLIFIED_M = 2 * SIMPLIFY_TOLERANCE_M
"""The edges of the observations are nearer to the logged ones than this."""
MAP_END_M = 30.0
"""The map has ended where no lane and no road edge is as near as this."""
ScenarioGoals = Mapping[str, PointById]
"""Scenario id -> object id -> (x, y), world frame, m."""


@dataclass(frozen=True, eq=False)
class Episode:
    """The part of an episode that does not change."""

    world: World
    atlas: Atlas
    controls: Controls
    terms: tuple[WeightedTerm, ...]
    config: EnvConfig
    edges: RoadEdges | None
    goals: ScenarioGoals | None
    """Of agents that follow the policy."""

    @property
    def num_agents(self) -> int:
        """M."""
        return len(self.world.actors)

    @cached_property
    def size(self) -> Float[np.ndarray, "M 2"]:
        """Length and width of the planner-driven agents, m."""
        return self.world.size[tuple(self.world.actors.T)]

    @cached_property
    def object_type(self) -> Int64[np.ndarray, "M"]:
        """Types of the planner-driven agents."""
        return self.world.object_type[tuple(self.world.actors.T)]

    @cached_property
    def reach_m(self) -> Float[np.ndarray, "M A"]:
        """Distance beyond which boxes cannot overlap, half of both diagonals; negative for an agent itself."""
        diagonal = np.hypot(self.world.size[..., 0], self.world.size[..., 1])
        scene, agent = self.world.actors.T
        reach = (diagonal[scene] + diagonal[scene, agent][:, None]) / 2 + 1e-6
        reach[np.arange(self.num_agents), agent] = -1.0
        return reach

    @cached_property
    def last_light_step(self) -> Int64[np.ndarray, "M"]:
        """Last step with an observed light around each agent; -1 = there is none."""
        return np.array([self.world.scenes[scene].lights.last_observed for scene, _ in self.world.actors], np.int64)

    def agent_name(self, row: int) -> str:
        """Scenario and object id of a planner-driven agent."""
        scene, agent = self.world.actors[row]
        view = self.world.scenes[scene]
        return f"agent {view.object_id[agent]} in scenario {view.scenario.scenario_id}"


@dataclass(frozen=True, eq=False)
class EpisodeState:
    """A moment of an episode."""

    world: WorldState
    touched: Bool[np.ndarray, "M A"]
    """Tracks that have been in contact: each counts once. Those that overlap at the start never count."""
    collisions: tuple[tuple[Collision, ...], ...]
    """Of each planner-driven agent."""
    outside: Bool[np.ndarray, "M"]
    """True = has left the road."""
    at_goal: Bool[np.ndarray, "M"]
    clear_m: Float[np.ndarray, "M"]
    """Distance that no corner can be off the road before it has moved by, as a distance changes no faster than that."""
    progress: Float[np.ndarray, "M"]
    """Along the route, m."""
    ended: Bool[np.ndarray, "M"]
    """True = the agent's own episode is over; it stands where it was."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """Reward and ends after an action."""

    reward: Float[np.ndarray, "M"]
    terms: dict[str, Float[np.ndarray, "M"]]
    """Every term of `rewards.TERMS`, unweighted."""
    terminated: Bool[np.ndarray, "M"]
    truncated: Bool[np.ndarray, "M"]
    is_clipped: Bool[np.ndarray, "M"]


def build_episode(world: World, controls: Controls, config: EnvConfig, goals: ScenarioGoals | None = None) -> Episode:
    """Episode in a world.

    Args:
        world: Scenes that step together, with the drivers of all agents.
        controls: Controls that turn actions into motion.
        config: Settings of reward, route, ends and observations.
        goals: Goals that the world was built with, for snapshots.
    """
    routes = []
    for row, agent in world.actors:
        scene = world.scenes[row]
        choice = config.route if agent == scene.ego else "logged"
        routes.append(find_route(scene.scenario, int(agent), choice, scene.num_steps))
    edges = join_road_edges([road_edges(scene.scenario) for scene in world.scenes])
    return Episode(world, build_atlas(world, tuple(routes)), controls, parse_terms(config.reward), config, edges, goals)


def start(episode: Episode, dice: tuple[Dice, ...]) -> EpisodeState:
    """The first state.

    Args:
        episode: Episode with the constant world, map and settings.
        dice: Randomness of the traffic, per scene.
    """
    world = begin(episode.world, dice)
    motion = own_motion(episode, world)
    never = np.zeros(episode.num_agents, bool)
    off = off_road_m(episode, world, np.arange(episode.num_agents))
    return EpisodeState(
        world=world,
        touched=_contacts(episode, world, motion),
        collisions=((),) * episode.num_agents,
        outside=off >= OUTSIDE_M,
        clear_m=OUTSIDE_M - off,
        at_goal=never,
        progress=_progress(episode, motion),
        ended=never,
    )


def advance(
    episode: Episode, state: EpisodeState, action: Any, imposed: Float[np.ndarray, "M h 5"] | None = None
) -> tuple[EpisodeState, Outcome]:
    """State and outcome after an action of every planner-driven agent.

    Args:
        episode: Episode with the constant world, map and settings.
        state: State before the action; not changed.
        action: Planner actions [M, *shape]; actions of agents whose episode is over are ignored.
        imposed: Motion of some agents in place of their actions, at each step that an action lasts; NaN = the agent
            acts.

    Raises:
        ConfigError: no numbers, a NaN, a wrong shape, or an action that an agent cannot take.
    """
    motion = own_motion(episode, state.world)
    actors = Actors(episode.agent_name, motion, episode.size, episode.object_type)
    action = validate_actions(action, episode.controls, episode.agent_name, episode.num_agents)
    moves = episode.controls.move(action, actors)
    motions = moves.motion if imposed is None else np.where(np.isnan(imposed), moves.motion, imposed)
    terms = {}
    for step in range(episode.controls.steps):
        moved = motions[:, step].copy()
        # an agent whose episode is over stands still
        moved[state.ended, :3], moved[state.ended, 3:] = motion[state.ended, :3], 0.0
        state, step_terms = _step(episode, state, moved)
        terms = {name: terms.get(name, 0.0) + value for name, value in step_terms.items()}
    following, stopped = _with_ends(episode, state)
    ends = following.ended & ~state.ended
    terminated = ends & stopped
    reward = sum((term.weight * terms[term.name] for term in episode.terms), np.zeros(episode.num_agents))
    reward, truncated = np.where(state.ended, 0.0, reward), ends & ~terminated
    return following, Outcome(reward, terms, terminated, truncated, moves.is_clipped)


def repeat(
    episode: Episode, state: EpisodeState, motion: Float[np.ndarray, "T M 5"], dice: Sequence[tuple[Dice, ...]]
) -> EpisodeState:
    """The state after steps of given motion.

    Args:
        episode: Episode with the constant world, map and settings.
        state: First state of the episode.
        motion: Motion of the planner-driven agents after each step.
        dice: Dice of each scene at each decision of the traffic; the last entry is for decisions to come.
    """
    policy = episode.world.policy
    for step, moved in enumerate(motion):
        if policy is not None and step % policy.steps_per_decision == 0:
            state = _with_dice(episode, state, dice[step // policy.steps_per_decision])
        state, _ = _step(episode, state, moved)
        if (step + 1) % episode.controls.steps == 0:
            state, _ = _with_ends(episode, state)
    return _with_dice(episode, state, dice[-1])


def _with_dice(episode: Episode, state: EpisodeState, dice: tuple[Dice, ...]) -> EpisodeState:
    if state.world.dice[-1] == dice:
        return state
    return replace(state, world=with_dice(episode.world, state.world, dice))


def _stopped(episode: Episode, state: EpisodeState) -> Bool[np.ndarray, "M"]:
    """True = an event of `stop_on` has happened to the agent."""
    stopped = np.zeros(episode.num_agents, bool)
    for name in episode.config.stop_on:
        if name == "collision":
            stopped |= [bool(collisions) for collisions in state.collisions]
        else:
            stopped |= state.outside if name == "offroad" else state.at_goal
    return stopped


def _with_ends(episode: Episode, state: EpisodeState) -> tuple[EpisodeState, Bool[np.ndarray, "M"]]:
    """The same state, with marks for the agents whose episode ends here, and True for those that an event stops."""
    is_over, stopped = state.world.step >= episode.config.max_steps, _stopped(episode, state)
    if state.world.step > FUTURE_STEPS:
        is_over |= has_left_map(episode, state.world)
    return replace(state, ended=state.ended | stopped | is_over), stopped


def _step(
    episode: Episode, state: EpisodeState, moved: Float[np.ndarray, "M 5"]
) -> tuple[EpisodeState, dict[str, Float[np.ndarray, "M"]]]:
    """State 0.1 s later, and the terms of this step."""
    previous = own_motion(episode, state.world)
    world = step_world(episode.world, state.world, moved)
    # 1. contacts with tracks that have not been touched
    touched = state.touched
    if world.has_left:  # others take the rows of those that have left
        touched = touched & ~world.has_left[-1][episode.world.actors[:, 0]]
    contacts = _contacts(episode, world, moved) & ~touched
    collisions, (new_collisions, at_fault) = list(state.collisions), np.zeros((2, episode.num_agents))
    for row, agent in np.argwhere(contacts & ~state.ended[:, None]):
        scene, _ = episode.world.actors[row]
        collision = classify_collision(
            episode.world.scenes[scene], world.step, int(agent), moved[row], episode.size[row],
            _ground(episode, world, np.array([row])), world.motion[scene, agent], episode.world.size[scene, agent],
        )  # fmt: skip
        collisions[row] = (*collisions[row], collision)
        new_collisions[row] += 1.0
        at_fault[row] += collision.at_fault
    # 2. road and route
    step = moved - previous
    half_diagonal = np.hypot(episode.size[:, 0], episode.size[:, 1]) / 2
    clear = state.clear_m - np.hypot(step[:, 0], step[:, 1]) - np.abs(wrapped(step[:, 2])) * half_diagonal
    unclear = np.flatnonzero((clear <= 0) & ~state.outside)
    if len(unclear):
        clear[unclear] = _free_way_m(episode, world, unclear)
    outside = state.outside.copy()
    outside[unclear] = clear[unclear] <= 0
    progress = _progress(episode, moved)
    gained = progress - state.progress
    routeless = episode.atlas.route_length == 0
    forward = np.cos(moved[:, 2]) * step[:, 0] + np.sin(moved[:, 2]) * step[:, 1]
    near_end = np.abs(moved[:, 0] + 1j * moved[:, 1] - episode.atlas.route_end) <= AT_GOAL_M
    at_goal = state.at_goal | (near_end & ~routeless)
    terms = {
        "progress": np.where(routeless, forward, gained) / 10.0,
        "collision": new_collisions,
        "at_fault": at_fault,
        "offroad": (outside & ~state.outside).astype(float),
        "goal": (at_goal & ~state.at_goal).astype(float),
    }
    following = EpisodeState(
        world, touched | contacts, tuple(collisions), outside, at_goal, clear, progress, state.ended
    )
    return following, terms


def own_motion(episode: Episode, world: WorldState) -> Float[np.ndarray, "M 5"]:
    """Present motion of the planner-driven agents.

    Args:
        episode: Episode with the constant world, map and settings.
        world: State of the episode's scenes, at any step.
    """
    scene, agent = episode.world.actors.T
    return world.motion[scene, agent]


def look(episode: Episode, state: EpisodeState) -> Observation:
    """Observations of all planner-driven agents.

    Args:
        episode: Episode with the constant world, map and settings.
        state: Present state of the episode.
    """
    config = episode.config
    return observe(episode.world, episode.atlas, state.world, frame=config.frame, steps=config.max_steps)


def has_left_map(episode: Episode, world: WorldState) -> Bool[np.ndarray, "M"]:
    """True where a planner-driven agent is beyond the end of the map, where no score means anything.

    Args:
        episode: Episode with the constant world, map and settings.
        world: State of the episode's scenes, at any step.
    """
    atlas, motion = episode.atlas, own_motion(episode, world)
    columns = np.r_[atlas.columns["lanes"], atlas.columns["edges"]]
    nearest = np.hypot(atlas.x[:, columns] - motion[:, :1], atlas.y[:, columns] - motion[:, 1:2]).min(1)
    return (nearest > MAP_END_M) & (nearest < FAR_M / 2)  # without a map there is only padding


def _ground(episode: Episode, world: WorldState, rows: Int64[np.ndarray, "m"]) -> Float[np.ndarray, "m"]:
    """Height of the ground under planner-driven agents: the undersides of the boxes."""
    scene, agent = episode.world.actors[rows].T
    return world.z[-1][scene, agent] - episode.world.height[scene, agent] / 2


def off_road_m(episode: Episode, world: WorldState, rows: Int64[np.ndarray, "m"]) -> Float[np.ndarray, "m"]:
    """Signed distance of the corner farthest off the road, negative on the road, as in the official metric.

    Args:
        episode: Episode with the constant world, map and settings.
        world: State of the episode's scenes, at any step.
        rows: Rows of the planner-driven agents to measure.
    """
    scene, agent = episode.world.actors[rows].T
    if episode.edges is None or not len(rows):
        return np.full(len(rows), -np.inf)
    motion = world.motion[scene, agent]
    corners = clockwise_corners(motion[:, :2], motion[:, 2], episode.world.size[scene, agent])
    origin = np.stack([episode.world.scenes[b].scenario.origin for b in scene])
    z = np.repeat(_ground(episode, world, rows)[:, None, None], 4, 1)
    groups = torch.from_numpy(np.concatenate([corners + origin[:, None], z], -1)).float()
    of_scene = torch.from_numpy(scene) if len(episode.world.scenes) > 1 else None
    distance = compute_point_distance_to_road_edge(groups, episode.edges, max_pairs=MAX_PAIRS, scenario=of_scene)
    farthest = distance.amax(-1).double().numpy()
    if episode.edges.has_edges is None:
        return farthest
    return np.where(episode.edges.has_edges.numpy()[scene], farthest, -np.inf)


def _free_way_m(episode: Episode, world: WorldState, rows: Int64[np.ndarray, "m"]) -> Float[np.ndarray, "m"]:
    """Distance that agents may move by before a corner can be 0.3 m off the road; at most 0 where a corner is.

    The search for the official distance is slow. Where all corners are clearly to the left of the simplified edges of
    the observations, these decide, unless edges lie above each other.
    """
    scene, agent = episode.world.actors[rows].T
    motion = world.motion[scene, agent]
    corners = clockwise_corners(motion[:, :2], motion[:, 2], episode.world.size[scene, agent])  # [m, 4, 2]
    distance, side, is_alongside = nearest_edges(corners, episode.atlas.edges[rows])
    free = distance.min(1) - SIMPLIFIED_M
    unclear = np.flatnonzero((free <= 0) | ~((side > 0) & is_alongside).all(1) | episode.world.has_levels[scene])
    free += OUTSIDE_M
    if len(unclear):
        free[unclear] = OUTSIDE_M - off_road_m(episode, world, rows[unclear])
    return free


def _contacts(episode: Episode, world: WorldState, motion: Float[np.ndarray, "M 5"]) -> Bool[np.ndarray, "M A"]:
    """Tracks that each planner-driven agent overlaps now."""
    tracks = world.motion[episode.world.actors[:, 0]]  # [M, A, 5]
    gap = tracks[..., :2] - motion[:, None, :2]
    # few boxes are in reach of each other
    meets = find_presence(episode.world, world, 1)[1][episode.world.actors[:, 0], :, 0]
    meets &= np.hypot(gap[..., 0], gap[..., 1]) <= episode.reach_m
    row, other = np.nonzero(meets)
    if not len(row):
        return meets
    scene, agent = episode.world.actors[row].T
    size = episode.world.size[scene, other]
    meets[row, other] = boxes_overlap(gap[row, other], motion[row, 2], tracks[row, other, 2], episode.size[row], size)
    if episode.world.has_levels.any():
        z, height = world.z[-1], episode.world.height
        rise = z[scene, other] - z[scene, agent]
        is_same_level = heights_overlap(rise, height[scene, agent], height[scene, other])
        meets[row, other] &= is_same_level | ~episode.world.has_levels[scene]
    return meets


def _progress(episode: Episode, motion: Float[np.ndarray, "M 5"]) -> Float[np.ndarray, "M"]:
    """Distance of each agent along the route, as `Route.progress`, for all at once."""
    atlas, row = episode.atlas, np.arange(len(motion))
    columns = atlas.columns["route"]
    dx, dy = motion[:, :1] - atlas.x[:, columns], motion[:, 1:2] - atlas.y[:, columns]  # [M, r]; padding is far away
    nearest = (dx * dx + dy * dy).argmin(1)
    heading = atlas.route_heading[row, nearest]
    forward = np.cos(heading) * dx[row, nearest] + np.sin(heading) * dy[row, nearest]
    return np.where(atlas.route_length > 0, SPACING_M * nearest + forward, 0.0)
