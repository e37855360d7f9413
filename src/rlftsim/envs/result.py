"""Results of episodes: scores, missing scores, pictures and films."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from functools import cached_property
from os import PathLike

import numpy as np

from rlftsim.envs.episode import Episode, EpisodeState
from rlftsim.envs.planner_scores import PlannerScores, TrafficScores, missing_scores, score_planner, score_traffic
from rlftsim.envs.record import Record, build_record
from rlftsim.scenario.types import CURRENT_STEP, HISTORY_STEPS
from rlftsim.viewer.film import to_film
from rlftsim.viewer.page import Animation, Panel, animation_html, page_html
from rlftsim.viewer.scene import AgentBoxes, SceneMotion, build_scene, logged_trajectories

SCORE_NAMES = tuple(field.name for scores in (PlannerScores, TrafficScores) for field in fields(scores))
"""Names of all scores of an episode."""


@dataclass(frozen=True, eq=False)
class Result:
    """Outcome of an episode; scores are computed when first read."""

    record: Record

    @cached_property
    def planner(self) -> PlannerScores:
        """Scores of the planner."""
        return score_planner(self.record)

    @cached_property
    def traffic(self) -> TrafficScores:
        """Scores of the traffic around the planner."""
        return score_traffic(self.record, self.planner.least_ttc_s)

    @property
    def scores(self) -> dict[str, float]:
        """All scores by `SCORE_NAMES`."""
        return {**asdict(self.planner), **asdict(self.traffic)}

    @cached_property
    def missing(self) -> dict[str, str]:
        """Scores that this scenario cannot give, and why."""
        return missing_scores(self.record)

    def film(self, path: str | PathLike[str], *, title: str = "planner") -> None:
        """Write a film with time, speed, traffic and score, .mp4 or .webp.

        Args:
            path: File to write; the ending .mp4 or .webp decides the format.
            title: Title above the picture, such as the planner's name.
        """
        to_film(path, build_animation({title: self.record}, [self.planner.nuplan_style]))

    def __repr__(self) -> str:
        scores = self.planner
        return (
            f"Result({self.record.scene.scenario.scenario_id}, {self.record.steps} steps: nuPlan-style "
            f"{scores.nuplan_style:.2f}, PDMS-style {scores.pdms_style:.2f}, {len(self.record.collisions)} contacts)"
        )


def build_result(episode: Episode, state: EpisodeState, row: int = 0) -> Result:
    """What happened up to a state of an episode, and the scores of it.

    Args:
        episode: Episode that the planner drives in.
        state: State up to which steps count.
        row: Index of the agent among the planner-driven agents [M].
    """
    return Result(build_record(episode, state, row))


def to_scene_motion(record: Record, agents: AgentBoxes) -> SceneMotion:
    """Motion of all agents of a record, after the logged history; agents that overlap are marked.

    Args:
        record: Record of an episode, from the current step on.
        agents: Boxes of the same agents, for marks of overlaps.
    """
    log = logged_trajectories(record.scene.scenario)

    def join(past: np.ndarray, values: np.ndarray) -> np.ndarray:
        """[1, A, S, ...], with absent rows where other records have agents that enter."""
        joined = np.concatenate([past, values], 1)
        return np.pad(joined, ((0, len(agents) - len(joined)), *((0, 0),) * (joined.ndim - 1)))[None]

    position = join(log.position[0, :, :HISTORY_STEPS], record.motion[:, 1:, :2]).astype(np.float32)
    heading = join(log.heading[0, :, :HISTORY_STEPS], record.motion[:, 1:, 2]).astype(np.float32)
    motion = SceneMotion(position, heading, join(log.valid[0, :, :CURRENT_STEP], record.is_present))
    if record.scene.levels is None:
        return motion.with_overlaps(agents)
    height = np.pad(record.scene.size[:, 2], (0, len(agents) - len(record.z)))
    return motion.with_overlaps(agents, join(record.scene.logged_z[:, :HISTORY_STEPS], record.z[:, 1:]), height)


def build_animation(records: Mapping[str, Record], scores: Sequence[float] | None = None) -> Animation:
    """Records of one scenario side by side, by title; agents that overlap are marked.

    Args:
        records: Title to record, at least one, all of the same scenario.
        scores: Score of each record in [0, 1], which films show with time, speed and traffic; None = no such text.
    """
    # where agents enter, a scenario has further rows
    scenario = max((record.scene.scenario for record in records.values()), key=lambda s: len(s.simulated_indices))
    scene = build_scene(scenario)
    panels = []
    for index, (title, record) in enumerate(records.items()):
        notes = [""] * CURRENT_STEP
        if scores is not None:
            notes += [record.describe_step(step, scores[index]) for step in range(record.steps + 1)]
        panels.append(Panel(title, to_scene_motion(record, scene.agents), notes if scores is not None else ()))
    return Animation(f"scenario {scenario.scenario_id}", scene, panels)


def build_page(records: Mapping[str, Record]) -> str:
    """A page that plays records of one scenario side by side.

    Args:
        records: Title to record, at least one, all of the same scenario.
    """
    animation = build_animation(records)
    return page_html(animation.title, animation_html(animation))
