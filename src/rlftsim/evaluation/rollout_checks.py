"""What rollouts cannot be, judged by the log up to the current step: `score` warns of it, `submit check` lists it.

A wrong frame, unit or order of axes gives a score like that of a bad model.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float32

from rlftsim.evaluation.rollout_files import AXES
from rlftsim.geometry import wrapped
from rlftsim.jobs.progress import log
from rlftsim.realism import SimulatedStates
from rlftsim.scenario.consistency import DRIVING_MPS, MAX_ASKEW_DEG, MIN_COSINE, MIN_STEPS, TYPES_WITH_FRONT
from rlftsim.scenario.types import CURRENT_STEP, STEP_S, TOTAL_STEPS, Scenario

MAX_DISTANCE_M = 480.0
"""From the current position, 60 m/s for 8 seconds."""
MAX_STEP_M, DOUBTFUL_STEP_M = 8.0, 5.0
"""In 0.1 s."""
MAX_HEADING_RAD = 100.0
MAX_FIRST_TURN_RAD = math.radians(MAX_ASKEW_DEG)
"""Between the current heading and that of the first step, of half of the agents: headings of 36 of 11 371 real agents
jump by more, of at most 22 % in a scenario."""
MAX_HEIGHT_CHANGE_M = 20.0
MAX_FIRST_STEP_ERROR_M = 3.0
"""Between the first simulated position and that of constant velocity, or the current one if it is nearer."""
MOVING_MPS = 0.5

Subject = Literal["not finite", "distance", "heading", "turn", "height", "start", "equal", "offset"]
ALLOWED = ("equal", "turn")
"""Subjects that `score` passes over: a policy may be deterministic, and headings of real logs do jump by a turn."""


@dataclass(frozen=True)
class Doubt:
    """Something about rollouts that cannot be, or hardly."""

    subject: Subject
    text: str
    object_id: int | None = None
    """Agent that it shows most in; None = all."""
    rollout: int | None = None
    is_impossible: bool = False
    """True: no road user moves like this. False: hardly one does."""


class PoseChecks:
    """Checks of one scenario's rollouts.

    Args:
        object_ids: Agents of the rollouts in their order, A of them, all simulated in the scenario.
        poses: x, y, z and heading in the world frame, [N, A, 4, 80] float32; [N, A, 4, 91] of generated scenes, which
            are judged by their own first steps.
        scenario: Log up to the current step.
        only_logged: True leaves out the steps at which the log has no state of the agent, which hold anything where
            rollouts are copies of the log.
    """

    def __init__(
        self,
        object_ids: tuple[int, ...],
        poses: Float32[np.ndarray, "N A 4 T"],
        scenario: Scenario,
        *,
        only_logged: bool = False,
    ) -> None:
        tracks = scenario.tracks
        row_of_id = {int(tracks.object_id[row]): row for row in scenario.simulated_indices}
        rows = self.rows = [row_of_id[object_id] for object_id in object_ids]
        self.object_ids = object_ids
        self.poses = poses
        self.position = tracks.position[rows, CURRENT_STEP]  # [A, 3]
        self.heading = tracks.heading[rows, CURRENT_STEP]  # [A]
        self.velocity = tracks.velocity[rows, CURRENT_STEP]  # [A, 2]
        if poses.shape[-1] == TOTAL_STEPS:  # with an axis of rollouts in front
            self.position, self.heading = poses[:, :, :3, 0], poses[:, :, 3, 0]
            self.velocity = (poses[:, :, :2, 1] - poses[:, :, :2, 0]) / np.float32(STEP_S)
        self.has_front = np.isin(tracks.object_type[rows], TYPES_WITH_FRONT)  # [A]
        self.is_judged = np.ones((len(rows), poses.shape[-1]), bool)  # [A, T]
        if only_logged and scenario.has_future:
            self.is_judged = tracks.valid[rows, TOTAL_STEPS - poses.shape[-1] : TOTAL_STEPS]

    @np.errstate(over="ignore")  # infinitely far is far
    def first_step_errors(self) -> Float32[np.ndarray, "N A"]:
        """Meters from each agent's first position to that of constant velocity, or to the current one if nearer."""
        first, start = self.poses[:, :, :2, 0], self.position[..., :2]
        moved, expected = first - start, np.float32(STEP_S) * self.velocity
        error = np.sqrt(np.minimum(*(np.square(v).sum(-1) for v in (moved, moved - expected))))  # [N, A]
        return error * self.is_judged[:, 0]

    def first_step_doubt(self) -> Doubt | None:
        """Doubt that the rollouts begin where the log stops; None if all do."""
        errors = self.first_step_errors()
        worst = _largest(errors[..., None])
        if worst.value <= MAX_FIRST_STEP_ERROR_M:
            return None
        count = int((errors > MAX_FIRST_STEP_ERROR_M).any(0).sum())
        text = (
            f"{count} of {errors.shape[1]} agents do not begin where the log stops (another frame or order of axes, or "
            f"off by steps?), this one {worst.value:.0f} m from there"
        )
        return self._doubt("start", text, worst, is_impossible=True)

    def doubts(self) -> Iterator[Doubt]:
        """Doubts about numbers, distances, headings, heights and equal rollouts; of each the agent with the largest."""
        poses, start, is_judged = self.poses, self.position, self.is_judged
        if not np.isfinite(poses).all():  # nothing else can be said of them
            rollout, agent, axis, step = np.argwhere(~np.isfinite(poses))[0].tolist()
            text = f"{AXES[axis]} is {poses[rollout, agent, axis, step]} at step {step}"
            yield Doubt("not finite", text, self.object_ids[agent], rollout, is_impossible=True)
            return
        x, y, z, turned = (poses[:, :, axis] for axis in range(4))  # each [N, A, T]
        from_start = _square(x - start[..., 0, None], y - start[..., 1, None])
        farthest = _largest(from_start * is_judged).root
        if farthest.value > MAX_DISTANCE_M:
            text = f"{farthest.value:.0f} m from its current position, beyond {MAX_DISTANCE_M:.0f} m,"
            yield self._doubt("distance", text, farthest, is_impossible=True)
        moved = _square(x[..., 1:] - x[..., :-1], y[..., 1:] - y[..., :-1])
        step = _largest(moved * (is_judged[:, 1:] & is_judged[:, :-1])).root
        if step.value > DOUBTFUL_STEP_M:
            text = f"a step of {step.value:.1f} m in 0.1 s"
            yield self._doubt("distance", text, step, is_impossible=step.value > MAX_STEP_M)
        largest = _largest(np.abs(turned) * is_judged)
        # Either all within a turn, where a step through pi jumps by a turn, or turned continuously.
        is_wrapped = (np.abs(turned) <= math.pi + 1e-4).all(-1, keepdims=True)  # [N, A, 1]
        current_heading = np.broadcast_to(self.heading[..., None], (*turned.shape[:2], 1))
        change = _largest(np.abs(np.diff(turned, prepend=current_heading)) * (is_judged & ~is_wrapped))
        if largest.value > MAX_HEADING_RAD:
            yield self._doubt("heading", f"heading of {largest.value:.0f} rad (degrees?)", largest)
        else:
            if change.value > math.pi:
                text = f"heading changes by {change.value:.2f} rad in 0.1 s, over half a turn,"
                yield self._doubt("turn", text, change)
            yield from self._facing_doubts()
        climb = _largest(np.abs(z - start[..., 2, None]) * is_judged)
        if climb.value > MAX_HEIGHT_CHANGE_M:
            yield self._doubt("height", f"z is {climb.value:.0f} m from that of the current step", climb)
        elif not z.any() and start[..., 2].any():
            yield Doubt("height", "z is 0 everywhere, in the log it is not: speed and road edges are 3-D")
        is_moving = np.atleast_2d(np.hypot(self.velocity[..., 0], self.velocity[..., 1]) > MOVING_MPS).any(0)  # [A]
        if is_moving.any() and (poses[:, is_moving, :2] == poses[:1, is_moving, :2]).all():
            yield Doubt("equal", f"all {len(poses)} rollouts are equal: the metric compares distributions")
        if poses.shape[-1] < TOTAL_STEPS and is_moving.any():
            path = poses[:, is_moving, :2]  # [N, a, 2, 80]
            if (path[..., 0] == start[is_moving, :2]).all() and (path[..., 1] != path[..., 0]).any(-1).all():
                text = "all agents that move begin with the log's current position: the first step is 0.1 s later"
                yield Doubt("offset", f"{text} (off by a step?)")

    @np.errstate(over="ignore", invalid="ignore")
    def _facing_doubts(self) -> Iterator[Doubt]:
        """Doubt that most agents face as in the log, or else along their motion; backing up is along it.

        An agent counts where more than half of its rollouts do.
        """
        x, y, _, heading = np.moveaxis(self.poses, 2, 0)  # each [N, A, T]
        is_first = self.is_judged[:, 0]
        turn = np.abs(wrapped(heading[..., 0] - self.heading)) * is_first  # [N, A]
        count = int((np.median(turn, axis=0) > MAX_FIRST_TURN_RAD).sum())
        if 2 * count > is_first.sum():
            worst = _largest(turn[..., None])
            text = (
                f"{count} of {is_first.sum()} agents do not begin with the heading at which the log stops (another "
                f"convention or frame?), this one {math.degrees(worst.value):.0f} degrees from it"
            )
            yield self._doubt("heading", text, worst)
            return
        rows = np.flatnonzero(self.has_front)
        dx, dy, facing = np.diff(x[:, rows]), np.diff(y[:, rows]), heading[:, rows, 1:]
        moved = _square(dx, dy)
        is_driving = (moved > (DRIVING_MPS * STEP_S) ** 2) & self.is_judged[rows, 1:] & self.is_judged[rows, :-1]
        forward = dx * np.cos(facing, dtype=np.float64) + dy * np.sin(facing, dtype=np.float64)  # squares fit
        is_askew = forward**2 < MIN_COSINE**2 * moved
        num_steps = is_driving.sum(-1)  # [N, R]
        drives = num_steps >= MIN_STEPS
        is_contrary = drives & (2 * (is_driving & is_askew).sum(-1) > num_steps)
        is_judged = 2 * drives.sum(0) > len(drives)
        is_doubtful = is_judged & (2 * is_contrary.sum(0) > drives.sum(0))
        if 2 * is_doubtful.sum() > is_judged.sum():
            agent = int(is_doubtful.argmax())
            rollout = int(is_contrary[:, agent].argmax())
            text = (
                f"{is_doubtful.sum()} of {is_judged.sum()} vehicles and cyclists faster than {DRIVING_MPS:g} m/s go "
                f"sideways, more than {MAX_ASKEW_DEG:g} degrees off the heading, as this one does"
            )
            yield Doubt("heading", text, self.object_ids[rows[agent]], rollout)

    def _doubt(self, subject: Subject, text: str, worst: "_Largest", *, is_impossible: bool = False) -> Doubt:
        return Doubt(subject, text, self.object_ids[worst.agent], worst.rollout, is_impossible)


def warn_of_doubts(scenario: Scenario, states: SimulatedStates, source: object = "rollouts") -> None:
    """Log a warning for each doubt about a scenario's rollouts whose subject is not `ALLOWED`.

    Args:
        scenario: Scenario of the rollouts, which hold its simulated agents.
        states: Rollouts that are scored, all values finite.
        source: File or other origin, the first words of the warning.
    """
    poses = torch.stack([getattr(states, axis) for axis in AXES], 2).cpu().numpy()
    checks = PoseChecks(tuple(states.object_id.tolist()), poses, scenario, only_logged=True)
    start = checks.first_step_doubt()
    # What begins elsewhere is far and jumps, too: the cause alone is told.
    for doubt in [start] if start else checks.doubts():
        if doubt.subject not in ALLOWED:
            agent = "" if doubt.object_id is None else f"agent {doubt.object_id}: "
            rollout = "" if doubt.rollout is None else f" in rollout {doubt.rollout}"
            log.warning(f"{source}: scenario {scenario.scenario_id}: {agent}{doubt.text}{rollout}.")


@dataclass(frozen=True)
class _Largest:
    value: float
    rollout: int
    agent: int

    @property
    def root(self) -> "_Largest":
        """With the root of the value: `hypot` of all values would take longer than all other checks."""
        return _Largest(math.sqrt(self.value), self.rollout, self.agent)


@np.errstate(over="ignore")
def _square(dx: Float32[np.ndarray, "N A t"], dy: Float32[np.ndarray, "N A t"]) -> Float32[np.ndarray, "N A t"]:
    return dx * dx + dy * dy


def _largest(values: Float32[np.ndarray, "N A t"]) -> _Largest:
    """The largest value with its rollout and agent; 0 where there are no agents."""
    if not values.size:
        return _Largest(0.0, 0, 0)
    rollout, agent, step = np.unravel_index(int(values.argmax()), values.shape)
    return _Largest(float(values[rollout, agent, step]), int(rollout), int(agent))
