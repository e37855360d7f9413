"""Records of episodes: motion of all agents of a scene, from the current step of the log to the end."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from rlftsim.envs.contact import Collision
from rlftsim.envs.episode import Episode, EpisodeState, has_left_map
from rlftsim.envs.route import Route, find_route
from rlftsim.envs.scene import Scene
from rlftsim.envs.world import find_lights, find_presence
from rlftsim.scenario.types import CURRENT_STEP, STEP_S


@dataclass(frozen=True, eq=False)
class Record:
    """A scene from the current step on: T further steps of 0.1 s. Map frame."""

    scene: Scene
    """With the lights of the episode, which differ from those of the log where SUMO drives the others."""
    agent: int
    """Row of the planner's agent."""
    motion: Float[np.ndarray, "A T1 5"]
    """x, y, heading, vx, vy at T + 1 steps."""
    z: Float[np.ndarray, "A T1"]
    """Height of the centers, that of the current step in scenes without levels."""
    is_present: Bool[np.ndarray, "A T1"]
    """False = a replayed agent whose log has ended."""
    is_observed: Bool[np.ndarray, "A T1"]
    """False also in the gaps of a replayed agent's log: scores leave these states out."""
    collisions: tuple[Collision, ...]
    """Contacts of the planner's agent."""
    route: Route
    """Route that the planner sees."""
    logged_route: Route
    """Lanes that the logged agent drove, along which progress is measured."""
    has_left_map: bool
    """True = the planner's agent is beyond the end of the map."""
    traffic: str
    """Driver of the other agents: name of the model, or type of traffic."""
    is_open: bool = False
    """True = agents leave and enter."""

    @property
    def steps(self) -> int:
        """T."""
        return self.motion.shape[1] - 1

    @property
    def ground(self) -> Float[np.ndarray, "A T1"]:
        """Height of the ground under the agents."""
        return self.z - self.scene.size[:, 2:] / 2

    @property
    def agent_motion(self) -> Float[np.ndarray, "T1 5"]:
        """Motion of the planner's agent."""
        return self.motion[self.agent]

    def describe_step(self, step: int, score: float | None = None) -> str:
        """Text for a picture: time, speed of the planner's agent, the traffic, and a score.

        Args:
            step: Steps after the current one of the log.
            score: Score of the whole episode in [0, 1]; None = not known yet.
        """
        speed = np.hypot(*self.agent_motion[step, 3:])
        scored = "" if score is None else f"   score {score:.2f}"
        return f"{step * STEP_S:.1f} s   {speed:.1f} m/s\n{self.traffic}{scored}"

    def first(self, num_steps: int) -> "Record":
        """Record of the first steps alone."""
        steps = slice(0, num_steps + 1)
        return replace(
            self,
            motion=self.motion[:, steps],
            z=self.z[:, steps],
            is_present=self.is_present[:, steps],
            is_observed=self.is_observed[:, steps],
            collisions=tuple(collision for collision in self.collisions if collision.step <= num_steps),
        )


def build_record(episode: Episode, state: EpisodeState, row: int = 0) -> Record:
    """Record of a planner-driven agent's scene so far.

    Args:
        episode: Episode that is or was running.
        state: State of the episode at the end of the record.
        row: Index of the agent among the planner-driven agents [M].
    """
    scene_row, agent = (int(index) for index in episode.world.actors[row])
    scene = episode.world.scenes[scene_row]
    count = len(scene.object_id)
    is_present, is_observed = (
        array[CURRENT_STEP:, scene_row, :count].T for array in find_presence(episode.world, state.world)
    )
    motion, z = (values[:, scene_row, :count] for values in state.world.since_start)
    return Record(
        scene=replace(scene, lights=find_lights(episode.world, state.world)[scene_row]),
        agent=agent,
        motion=np.ascontiguousarray(motion.swapaxes(0, 1)),
        z=np.ascontiguousarray(z.T),
        is_present=is_present,
        is_observed=is_observed,
        collisions=state.collisions[row],
        route=episode.atlas.routes[row],
        logged_route=find_route(scene.scenario, agent, "logged", scene.num_steps),
        has_left_map=bool(has_left_map(episode, state.world, np.array([row]))[0]),
        traffic=episode.config.model if episode.config.traffic == "policy" else episode.config.traffic,
        is_open=bool(episode.world.open_worlds),
    )
