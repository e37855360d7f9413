"""Records of episodes: motion of all agents of a scene, from the current step of the log to the end."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from rlftsim.envs.contact import Collision
from rlftsim.envs.episode import Episode, EpisodeState
from rlftsim.envs.route import Route, route_of
from rlftsim.envs.scene import Scene
from rlftsim.scenario.types import CURRENT_STEP


@dataclass(frozen=True, eq=False)
class Record:
    """One scene from the current step on: T steps of 0.1 s after it. Map frame."""

    scene: Scene
    agent: int
    """Row of the planner's agent."""
    motion: Float[np.ndarray, "A T1 5"]
    """x, y, heading, vx, vy at T + 1 steps."""
    z: Float[np.ndarray, "A T1"]
    """Height of the centers, that of the current step in scenes without levels."""
    there: Bool[np.ndarray, "A T1"]
    """False = a replayed agent whose log has ended."""
    known: Bool[np.ndarray, "A T1"]
    """False also in the gaps of a replayed agent's log: scores leave these states out."""
    collisions: tuple[Collision, ...]
    """Of the planner's agent."""
    route: Route
    """The one that the planner was given."""
    logged_route: Route
    """The lanes that the logged agent drove, which progress is measured along."""

    @property
    def steps(self) -> int:
        """T."""
        return self.motion.shape[1] - 1

    @property
    def ground(self) -> Float[np.ndarray, "A T1"]:
        """Height of the ground under the agents."""
        return self.z - self.scene.size[:, 2:] / 2

    @property
    def own(self) -> Float[np.ndarray, "T1 5"]:
        """Motion of the planner's agent."""
        return self.motion[self.agent]

    def first(self, steps: int) -> "Record":
        """The first steps alone."""
        return Record(
            self.scene, self.agent, self.motion[:, : steps + 1], self.z[:, : steps + 1], self.there[:, : steps + 1],
            self.known[:, : steps + 1], tuple(one for one in self.collisions if one.step <= steps), self.route,
            self.logged_route,
        )  # fmt: skip


def record_of(episode: Episode, state: EpisodeState, row: int = 0) -> Record:
    """Record of a planner-driven agent's scene so far.

    Args:
        episode: the scenes.
        state: the present one.
        row: of the agent among the planner-driven ones.
    """
    scene_row, agent = (int(index) for index in episode.world.actors[row])
    scene = episode.world.scenes[scene_row]
    count, last = len(scene.object_id), len(state.world.track)
    return Record(
        scene=scene,
        agent=agent,
        motion=np.stack([step[scene_row, :count] for step in state.world.track[CURRENT_STEP:]], 1),
        z=np.stack([z[scene_row, :count] for z in state.world.z[CURRENT_STEP:]], 1),
        there=episode.world.there[scene_row, :count, CURRENT_STEP:last],
        known=episode.world.known[scene_row, :count, CURRENT_STEP:last],
        collisions=state.collisions[row],
        route=episode.atlas.routes[row],
        logged_route=route_of(scene.scenario, agent, "logged"),
    )
