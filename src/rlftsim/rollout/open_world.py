"""Worlds that agents leave and enter: whoever is too far from the ego goes, and the row is taken by somebody new.

An agent that is absent waits far outside of the map, where no agent sees it. Policies know nothing of this: an agent is
put elsewhere by imposed states, as `rollout.simulate` lets any caller do, and begins there without a past.

N rollouts, A agents, visitors included. Map frame, meters.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from rlftsim.errors import ConfigError
from rlftsim.rollout.entries import Entrants, EntryModel
from rlftsim.rollout.gates import DECISION_STEPS, STANDING_MPS, GateFinder, Gates, find_region_m
from rlftsim.rollout.noise import derive_seed
from rlftsim.rollout.types import AgentStates
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.scenario.types import CURRENT_STEP, STEP_S, ObjectType, Scenario, Tracks, cached_on_scenario

WAITING_M, WAITING_GAP_M = 20_000.0, 60.0
"""Distance of absent agents from the origin, and from one another."""
VISITORS = {ObjectType.VEHICLE: 40, ObjectType.PEDESTRIAN: 10, ObjectType.CYCLIST: 6}
"""Rows that wait for somebody to enter, beside those of agents that have left."""
VISITOR_SIZE_M = {
    ObjectType.VEHICLE: (4.6, 2.0, 1.6), ObjectType.PEDESTRIAN: (0.9, 0.85, 1.7), ObjectType.CYCLIST: (1.85, 0.85, 1.8),
}  # fmt: skip
BEYOND_BORDER_M = 10.0
"""An agent leaves so far outside of the region, so that nobody flickers at the border."""
AT_END_M = 5.0
"""An agent leaves so near to the end of a lane that goes on nowhere."""
EGO_GAP_M = 40.0
BRAKING_MPS2 = 3.0
STANDSTILL_GAP_M, BESIDE_M, ANYWHERE_M = 6.0, 2.3, 3.0
"""Least distance of centers along and across the way and in any direction; the first is left after braking, too."""
PARKED_M = 1.8
"""A vehicle that enters so far beside the lane's center and stands is parked, and stays."""
OFF_LANES_M, ROADSIDE_M = 2.4, 2.8
"""Least distance of parked vehicles from the center of every lane, so that cars pass, and the usual one."""
MOST_TURNED_AWAY = 5
"""Agents that found no room, and for whom others may enter half a second later."""
CROSSING_S = 2.0
"""Nobody appears whom another agent would meet within this time if both went straight on."""
LANE_HALF_WIDTH_M, LANE_WIDTH_M = 1.8, 3.2
LOOK_M = 80.0
STRAIGHT_M = np.arange(0.0, LOOK_M, 2.0)
"""Points of the way of those that follow no lane."""


@cached_on_scenario
def add_visitors(scenario: Scenario) -> Scenario:
    """The scenario with rows for agents that may enter, which wait outside of the map; a row has one type and size."""
    tracks = scenario.tracks
    types = np.repeat([int(object_type) for object_type in VISITORS], list(VISITORS.values())).astype(np.int8)
    sizes = np.array([VISITOR_SIZE_M[ObjectType(int(object_type))] for object_type in types], np.float32)
    shape = (len(types), scenario.num_steps)
    position = np.zeros((*shape, 3), np.float32)
    position[..., 0] = scenario.origin[0] + WAITING_M + WAITING_GAP_M * np.arange(len(types))[:, None]
    position[..., 1] = scenario.origin[1] + WAITING_M
    position[..., 2] = tracks.position[scenario.ego_index, CURRENT_STEP, 2]
    visitors = Tracks(
        object_id=tracks.object_id.max() + 1 + np.arange(len(types)),
        object_type=types,
        position=position,
        heading=np.zeros(shape, np.float32),
        velocity=np.zeros((*shape, 2), np.float32),
        size=np.repeat(sizes[:, None], shape[1], 1),
        valid=np.broadcast_to(np.arange(shape[1]) == CURRENT_STEP, shape).copy(),
    )
    names = vars(visitors)
    joined = Tracks(**{name: np.concatenate([getattr(tracks, name), names[name]]) for name in names})
    return replace(scenario, tracks=joined)


def check_decisions(steps_per_decision: int) -> None:
    """Check that a policy decides as often as agents enter.

    Args:
        steps_per_decision: Steps of 0.1 s that a decision of the policy lasts.

    Raises:
        ConfigError: It decides more often, or less.
    """
    if steps_per_decision != DECISION_STEPS:
        raise ConfigError(
            f"agents enter every {DECISION_STEPS * STEP_S:g} s, this model decides every "
            f"{steps_per_decision * STEP_S:g} s: take a SMART model, or leave entries out."
        )


@dataclass(frozen=True, eq=False)
class Presence:
    """Who is there in N rollouts of a scenario during half a second."""

    is_present: Bool[np.ndarray, "N A"]
    is_parked: Bool[np.ndarray, "N A"]
    num_turned_away: tuple[int, ...]
    """Agents that found no room, in each rollout."""
    is_imposed: Bool[np.ndarray, "N A"]
    """True = the agent is absent, parked or enters, and the policy does not move it."""
    path: Float[np.ndarray, "N A 5 3"]
    """Poses of the agents that are imposed."""

    def impose(self, device: torch.device) -> AgentStates:
        """The imposed states, of a single scenario."""
        path = torch.from_numpy(self.path[None]).float().to(device)
        valid = torch.from_numpy(self.is_imposed)[None, :, :, None].to(device)
        return AgentStates(path[..., :2], path[..., 2], valid.expand(path.shape[:-1]))


def make_rng(seed: int, scenario_id: str, rollout: int, step: int) -> np.random.Generator:
    """Generator of who enters in half a second of a rollout."""
    return np.random.default_rng(derive_seed(seed, "entries", scenario_id, rollout, step))


class OpenWorld:
    """Decides who is there in rollouts of a scenario; holds nothing that changes.

    Args:
        scenario: Scenario with visitors (`add_visitors`).
        num_agents: Number A of agents, with padding, which comes behind the visitors.
        entries: Model of who enters.
        driven: Rows that stay, and that nobody enters near; None = the ego.
    """

    def __init__(
        self, scenario: Scenario, num_agents: int, entries: EntryModel, driven: Int64[np.ndarray, "M"] | None = None
    ):
        self.scenario_id, self.entries, self.region_m = scenario.scenario_id, entries, find_region_m(scenario)
        self.finder, simulated = GateFinder(scenario), scenario.simulated_indices
        self.ego = int(np.flatnonzero(simulated == scenario.ego_index)[0])
        self.driven = np.array([self.ego]) if driven is None else driven
        self.object_type = np.zeros(num_agents, np.int64)
        self.object_type[: len(simulated)] = scenario.tracks.object_type[simulated]
        self.first_visitor = len(simulated) - sum(VISITORS.values())
        self.waiting = np.zeros((num_agents, 3))
        self.waiting[:, 0] = WAITING_M + WAITING_GAP_M * (np.arange(num_agents) - self.first_visitor)
        self.waiting[:, 1] = WAITING_M

    def begin(self, num_rollouts: int) -> Presence:
        """Presence before the first decision: all agents of the log, and no visitor."""
        is_logged = np.arange(len(self.waiting)) < self.first_visitor
        is_present = np.broadcast_to(is_logged, (num_rollouts, len(self.waiting)))
        path = np.broadcast_to(self.waiting[:, None], (*is_present.shape, DECISION_STEPS, 3))
        return Presence(is_present, np.zeros_like(is_present), (0,) * num_rollouts, ~is_present, path)

    def step(
        self,
        presence: Presence,
        pose: Float[np.ndarray, "N A 3"],
        velocity: Float[np.ndarray, "N A 2"],
        rngs: Sequence[np.random.Generator],
    ) -> Presence:
        """Presence in the half second that begins.

        Args:
            presence: Presence in the half second before.
            pose: Present poses of all agents.
            velocity: Present velocities, m/s.
            rngs: Generators of who enters each rollout, see `make_rng`.
        """
        is_present = presence.is_present & ~self._find_leaving(pose)
        is_parked, num_turned_away = presence.is_parked & is_present, []
        path = np.repeat(np.broadcast_to(self.waiting, pose.shape)[:, :, None], DECISION_STEPS, 2)  # [N, A, 5, 3]
        path[is_parked] = pose[is_parked][:, None]
        is_imposed = ~is_present | is_parked
        for n, rng in enumerate(rngs):
            # who leaves now is away for half a second at least
            entered, num_left_out = self._enter(
                rng, pose[n], velocity[n], is_present[n], ~presence.is_present[n], presence.num_turned_away[n]
            )
            num_turned_away.append(num_left_out)
            for agent, steps, parks in entered:
                path[n, agent], is_imposed[n, agent] = steps, True
                is_present[n, agent], is_parked[n, agent] = True, parks
        return Presence(is_present, is_parked, tuple(num_turned_away), is_imposed, path)

    def _find_leaving(self, pose: Float[np.ndarray, "N A 3"]) -> Bool[np.ndarray, "N A"]:
        """True beyond the border, and at the end of a lane that goes on nowhere."""
        away = np.linalg.norm(pose[..., :2] - pose[:, self.ego, None, :2], axis=-1) > self.region_m + BEYOND_BORDER_M
        if len(self.finder.ends):
            to_end = np.linalg.norm(pose[:, :, None, :2] - self.finder.ends, axis=-1).min(-1)
            away |= (to_end < AT_END_M) & (self.object_type == ObjectType.VEHICLE)
        away[:, self.driven] = False
        return away

    def _enter(
        self,
        rng: np.random.Generator,
        pose: Float[np.ndarray, "A 3"],
        velocity: Float[np.ndarray, "A 2"],
        present: Bool[np.ndarray, "A"],
        is_free: Bool[np.ndarray, "A"],
        num_turned_away: int,
    ) -> tuple[list[tuple[int, Float[np.ndarray, "5 3"], bool]], int]:
        """Row and poses of each agent that enters a rollout, and True for vehicles parked beside the lane; and the
        number of those that found no room.
        """
        gates = self.finder.find(pose[self.ego, :2], velocity[self.ego], self.region_m)
        rate = self.entries.expect(gates)
        rate = rate * (1 + num_turned_away / max(rate.sum(), 1e-6))
        gates = gates.select(np.flatnonzero(rng.random(len(gates)) < 1 - np.exp(-rate)))
        entrants = self.entries.draw(gates, rng)
        free = {int(name): np.flatnonzero(is_free & (self.object_type == name)).tolist() for name in VISITORS}
        others, others_velocity = pose[present, :2], velocity[present]
        entered = []
        for k in range(len(gates)):
            chosen = self._choose_pose(gates, entrants, k)
            if chosen is None:
                continue
            position, heading, is_parked = chosen
            along, wanted_mps = np.array([np.cos(heading), np.sin(heading)]), float(entrants.speed_mps[k])
            route = position + STRAIGHT_M[:, None] * along, STRAIGHT_M
            if entrants.object_type[k] == ObjectType.VEHICLE and not is_parked:
                route = self.finder.follow(int(gates.point[k]), LOOK_M)
            speed = find_safe_speed(position, along, wanted_mps, others, others_velocity, *route)
            rows = free.get(int(entrants.object_type[k]), [])
            to_driven = np.linalg.norm(pose[self.driven, :2] - position, axis=-1)
            if speed is None or not rows or (to_driven < EGO_GAP_M).any():
                continue
            times = STEP_S * np.arange(1, DECISION_STEPS + 1)[:, None]
            path = np.concatenate([position + times * speed * along, np.full((DECISION_STEPS, 1), heading)], -1)
            entered.append((rows.pop(), path, is_parked))
            others, others_velocity = np.vstack([others, position]), np.vstack([others_velocity, speed * along])
        return entered, min(len(gates) - len(entered), MOST_TURNED_AWAY)

    def _choose_pose(
        self, gates: Gates, entrants: Entrants, k: int
    ) -> tuple[Float[np.ndarray, "2"], float, bool] | None:
        """Position and heading of an entrant, and True for one that is parked; None where it would block a lane."""
        lane, left, turn = gates.position[k], float(entrants.left_m[k]), float(entrants.turn_rad[k])
        side = np.array([-np.sin(gates.heading[k]), np.cos(gates.heading[k])])
        is_vehicle = entrants.object_type[k] == ObjectType.VEHICLE
        if is_vehicle and (abs(left) <= PARKED_M or entrants.speed_mps[k] >= STANDING_MPS):
            return lane, float(gates.heading[k]), False
        # a place to park may be on a lane of this road, then it is to the right of the gate's lane or of further ones
        beside = (left, *(-ROADSIDE_M - LANE_WIDTH_M * lanes for lanes in range(3)))
        for offset in beside if is_vehicle else ():
            is_on_lane = np.linalg.norm(self.finder.points - (lane + offset * side), axis=-1) < OFF_LANES_M
            if not is_on_lane.any():  # cars pass it
                return lane + offset * side, float(gates.heading[k]) + turn, True
        return None if is_vehicle else (lane + left * side, float(gates.heading[k]) + turn, False)


class OpenRollouts:
    """Presence along N rollouts of a scenario, for `rollout.simulate`.

    Args:
        batch: A single scenario, with visitors (`add_visitors`).
        rollout_ids: Ids of the rollouts, which with the seed decide who enters.
        seed: Seed of the rollouts.
        steps_per_decision: Steps of a decision of the policy, 5.
        entries: Model of who enters.

    Raises:
        ConfigError: Several scenarios, another frame than the map's, or a policy that does not decide each half second.
    """

    def __init__(
        self, batch: ScenarioBatch, rollout_ids: Sequence[int], seed: int, steps_per_decision: int, entries: EntryModel
    ):
        check_decisions(steps_per_decision)
        if batch.num_scenarios != 1 or batch.frame != "map":
            raise ConfigError(
                f"agents enter one scenario in the map frame, not {batch.num_scenarios} in the {batch.frame} frame: "
                "hand over each in the map frame, or leave entries out."
            )
        shape = (len(rollout_ids), batch.agent_mask.shape[1])
        self.world = OpenWorld(batch.scenarios[0], shape[1], entries)
        self.seed, self.rollout_ids, self.device = seed, rollout_ids, batch.device
        self.presence, self._present = self.world.begin(shape[0]), []
        now = [batch.position[0, :, CURRENT_STEP], batch.heading[0, :, CURRENT_STEP, None]]
        self._start = torch.cat(now, -1).expand(*shape, 3).double().cpu().numpy()  # [N, A, 3]
        self._start_velocity = batch.velocity[0, :, CURRENT_STEP].expand(*shape, 2).double().cpu().numpy()

    @property
    def valid(self) -> Bool[Tensor, "1 N A T"]:
        """True = the agent is there at the simulated step."""
        return torch.from_numpy(np.stack(self._present, -1).repeat(DECISION_STEPS, -1))[None]

    def force(self, state: Any, step: int) -> AgentStates:
        """States of the next half second of agents that are absent or enter.

        Args:
            state: State of the policy before the decision.
            step: First step of the decision.
        """
        pose, velocity = self._start, self._start_velocity
        if state.poses is not None:
            poses = state.poses[0].double().cpu().numpy()  # [N, A, 5, 3]
            pose, velocity = poses[:, :, -1], (poses[:, :, -1, :2] - poses[:, :, -2, :2]) / STEP_S
        rngs = [make_rng(self.seed, self.world.scenario_id, rollout, step) for rollout in self.rollout_ids]
        self.presence = self.world.step(self.presence, pose, velocity, rngs)
        self._present.append(self.presence.is_present)
        return self.presence.impose(self.device)


def find_safe_speed(
    position: Float[np.ndarray, "2"],
    along: Float[np.ndarray, "2"],
    speed_mps: float,
    others: Float[np.ndarray, "k 2"],
    velocity: Float[np.ndarray, "k 2"],
    path: Float[np.ndarray, "p 2"],
    path_m: Float[np.ndarray, "p"],
) -> float | None:
    """Speed to appear at: the wanted one, or less where braking at 3 m/s² from half a second on could not avoid the
    agent ahead.

    None where somebody is too near, or would be within 2 s, or one behind could not brake.

    Args:
        position: Place to appear at.
        along: Direction of travel, a unit vector.
        speed_mps: Wanted speed.
        others: Positions of the agents that are there.
        velocity: Velocities of these, m/s.
        path: Points of the way ahead, with all branches.
        path_m: Distances along the way to these points.
    """
    offset = others - position
    ahead, left = offset @ along, offset @ np.array([-along[1], along[0]])
    is_beside = (np.abs(ahead) < STANDSTILL_GAP_M) & (np.abs(left) < BESIDE_M)
    if is_beside.any() or (np.linalg.norm(offset, axis=-1) < ANYWHERE_M).any():
        return None
    pace = np.maximum(velocity @ along, 0.0)
    before = BRAKING_MPS2 * STEP_S * DECISION_STEPS  # who appears decides half a second later
    to_path = np.linalg.norm(others[:, None] - path, axis=-1)  # [k, p]
    leads, gap_m = to_path.min(-1) < BESIDE_M, path_m[to_path.argmin(-1)]
    room = 2 * BRAKING_MPS2 * np.maximum(gap_m - STANDSTILL_GAP_M, 0.0)  # v² that braking takes away
    speed = min(speed_mps, float(np.sqrt((pace**2 + room)[leads].min(initial=np.inf) + before**2)) - before)
    closing = velocity - speed * along
    time_s = -(offset * closing).sum(-1) / np.maximum((closing * closing).sum(-1), 1e-6)
    nearest = np.linalg.norm(offset + np.clip(time_s, 0.0, CROSSING_S)[:, None] * closing, axis=-1)
    if (nearest < ANYWHERE_M)[~leads].any():
        return None
    follows = (np.abs(left) < LANE_HALF_WIDTH_M) & (ahead <= 0) & (ahead > -LOOK_M)
    room = 2 * BRAKING_MPS2 * np.maximum(-ahead - STANDSTILL_GAP_M, 0.0)
    return None if (pace**2 - room > speed**2)[follows].any() else speed
