"""Episodes: a world with agents that are driven by actions, with events, rewards and ends.

B scenes in step, M planner-driven agents over all scenes. An `Episode` does not change, an `EpisodeState` is a value.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int64

from rlftsim.envs.actions import Actors, Controls, validate_actions
from rlftsim.envs.config import EnvConfig
from rlftsim.envs.contact import Collision, classify_collision
from rlftsim.envs.observations import FAR_M, Atlas, Observation, build_atlas, observe
from rlftsim.envs.rewards import WeightedTerm, parse_terms
from rlftsim.envs.road import EdgeArrays, measure_road_edge, road_edges
from rlftsim.envs.route import find_route
from rlftsim.envs.step_measures import measure_steps
from rlftsim.envs.world import Dice, World, WorldState, begin, find_presence, step_world, with_dice
from rlftsim.geometry import boxes_overlap, clockwise_corners, heights_overlap
from rlftsim.goals.types import PointById
from rlftsim.realism.map_based import MAP_END_M, OUTSIDE_M, join_road_edges
from rlftsim.scenario.types import FUTURE_STEPS

AT_GOAL_M = 2.0
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
    edges: EdgeArrays | None
    """None = no scene has any, or nobody asks who is on the road."""
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
    def half_diagonal(self) -> Float[np.ndarray, "M"]:
        """Half of the diagonals of the planner-driven agents' boxes, m."""
        return np.hypot(self.size[:, 0], self.size[:, 1]) / 2

    @cached_property
    def origin(self) -> Float[np.ndarray, "M 2"]:
        """Origins of the map frames of the planner-driven agents, world frame, m."""
        return np.stack([self.world.scenes[scene].scenario.origin for scene, _ in self.world.actors])

    @cached_property
    def has_edges(self) -> Bool[np.ndarray, "B"]:
        """True = the map of the scene has road edges."""
        return np.array([road_edges(scene.scenario) is not None for scene in self.world.scenes])

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
    joined = join_road_edges([road_edges(scene.scenario) for scene in world.scenes])
    edges = None if joined is None else EdgeArrays.from_edges(joined)
    return Episode(world, build_atlas(world, tuple(routes)), controls, parse_terms(config.reward), config, edges, goals)


def start(episode: Episode, dice: tuple[Dice, ...]) -> EpisodeState:
    """The first state.

    Args:
        episode: Episode with the constant world, map and settings.
        dice: Randomness of the traffic, per scene.
    """
    world = begin(episode.world, dice)
    motion = own_motion(episode, world)
    in_reach, measures = _measure(episode, world, motion, motion)
    never = np.zeros(episode.num_agents, bool)
    off = off_road_m(episode, world, np.arange(episode.num_agents))
    return EpisodeState(
        world=world,
        touched=_contacts(episode, world, motion, in_reach),
        collisions=((),) * episode.num_agents,
        outside=off >= OUTSIDE_M,
        clear_m=OUTSIDE_M - off,
        at_goal=never,
        progress=measures[:, 1],
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
        is_over |= has_left_map(episode, state.world, np.arange(episode.num_agents))
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
    in_reach, measures = _measure(episode, world, previous, moved)
    contacts = _contacts(episode, world, moved, in_reach & ~touched)
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
    swept_m, progress, forward, to_end_m = measures.T
    clear = state.clear_m - swept_m
    unclear = np.flatnonzero((clear <= 0) & ~state.outside)
    if len(unclear):
        clear[unclear] = OUTSIDE_M - off_road_m(episode, world, unclear)
    outside = state.outside.copy()
    outside[unclear] = clear[unclear] <= 0
    routeless = episode.atlas.route_arrays.length == 0
    at_goal = state.at_goal | ((to_end_m <= AT_GOAL_M) & ~routeless)
    terms = {
        "progress": np.where(routeless, forward, progress - state.progress) / 10.0,
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


def has_left_map(episode: Episode, world: WorldState, rows: Int64[np.ndarray, "m"]) -> Bool[np.ndarray, "m"]:
    """True where a planner-driven agent is beyond the end of the map, where no score means anything.

    Args:
        episode: Episode with the constant world, map and settings.
        world: State of the episode's scenes, at any step.
        rows: Rows of the planner-driven agents to look at.
    """
    maps, (scene, agent) = episode.atlas.maps, episode.world.actors[rows].T
    scene_map, columns = maps.of_scene[scene], slice(maps.lanes.shape[1] + maps.edges.shape[1])
    x, y = world.motion[scene, agent, :2].T[..., None]
    nearest = np.hypot(maps.x[scene_map, columns] - x, maps.y[scene_map, columns] - y).min(1)
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
    if episode.edges is None:
        return np.full(len(rows), -np.inf)
    motion = world.motion[scene, agent]
    points = np.empty((len(rows), 4, 3), np.float32)
    corners = clockwise_corners(motion[:, :2], motion[:, 2], episode.world.size[scene, agent])
    points[..., :2] = corners + episode.origin[rows, None]
    points[..., 2] = _ground(episode, world, rows)[:, None]
    distances = np.empty((len(rows), 4), np.float32)
    measure_road_edge(points.reshape(-1, 3), np.repeat(scene, 4), episode.edges, distances.reshape(-1))
    return np.where(episode.has_edges[scene], distances.max(1), -np.inf)


def _measure(
    episode: Episode, world: WorldState, previous: Float[np.ndarray, "M 5"], moved: Float[np.ndarray, "M 5"]
) -> tuple[Bool[np.ndarray, "M A"], Float[np.ndarray, "M 4"]]:
    """Boxes in reach of each planner-driven agent after a step, and numbers as `measure_steps` has them."""
    in_reach, measures = np.empty(episode.reach_m.shape, bool), np.empty((episode.num_agents, 4))
    measure_steps(
        previous, moved, episode.half_diagonal, episode.world.actors, world.motion,
        find_presence(episode.world, world, 1)[1][0], episode.reach_m, episode.atlas.route_arrays, in_reach, measures,
    )  # fmt: skip
    return in_reach, measures


def _contacts(
    episode: Episode, world: WorldState, motion: Float[np.ndarray, "M 5"], in_reach: Bool[np.ndarray, "M A"]
) -> Bool[np.ndarray, "M A"]:
    """Tracks that each planner-driven agent overlaps now, among those in reach."""
    row, other = in_reach.nonzero()  # few boxes are
    if not len(row):
        return in_reach
    scene, agent = episode.world.actors[row].T
    track, size = world.motion[scene, other], episode.world.size[scene, other]
    gap = track[:, :2] - motion[row, :2]
    meets = boxes_overlap(gap, motion[row, 2], track[:, 2], episode.size[row], size)
    if episode.world.has_levels.any():
        z, height = world.z[-1], episode.world.height
        rise = z[scene, other] - z[scene, agent]
        is_same_level = heights_overlap(rise, height[scene, agent], height[scene, other])
        meets &= is_same_level | ~episode.world.has_levels[scene]
    contacts = np.zeros(in_reach.shape, bool)
    contacts[row, other] = meets
    return contacts
