"""Scenarios and rollouts drawn by hand for the tests of the realism metric."""

import numpy as np
import torch

from rlftsim.realism import SimulatedStates
from rlftsim.scenario.types import LightStates, MapFeatures, Scenario, Tracks

NO_LIGHTS = LightStates(
    np.zeros(0, np.int32), np.zeros(0, np.int64), np.zeros(0, np.int8), np.zeros((0, 3), np.float32)
)


def draw_map(polylines, *, first_id=100):
    """Map of (type, [[x, y, z], ...]) pairs with ids first_id, first_id + 1, ..."""
    points = [np.asarray(points, np.float32).reshape(-1, 3) for _, points in polylines]
    return MapFeatures(
        feature_id=np.arange(first_id, first_id + len(polylines)),
        feature_type=np.array([kind for kind, _ in polylines], np.int8),
        points=np.concatenate([*points, np.zeros((0, 3), np.float32)]),
        offsets=np.cumsum([0, *(len(p) for p in points)]),
    )


def draw_street():
    """A street along x, 12 m wide: driving lane at y = -2, oncoming lane at y = 2, the road left of its edges."""
    x = np.arange(-200.0, 201.0, 4.0)
    return draw_map(
        [
            (2, np.stack([x, np.full_like(x, -2), 0 * x], -1)),
            (2, np.stack([x[::-1], np.full_like(x, 2), 0 * x], -1)),
            (15, np.stack([x, np.full_like(x, -6), 0 * x], -1)),
            (15, np.stack([x[::-1], np.full_like(x, 6), 0 * x], -1)),
        ]
    )


def draw_red_light(*, lane_id=100, state=4, at_x=20.0, steps=range(91)):
    """A light on one lane, with its stop point at (at_x, -2)."""
    count = len(steps)
    return LightStates(
        np.array(steps, np.int32),
        np.full(count, lane_id),
        np.full(count, state, np.int8),
        np.tile(np.array([[at_x, -2.0, 0.0]], np.float32), (count, 1)),
    )


def draw_traffic(seed, *, num_agents=6, num_evaluated=3, lights=NO_LIGHTS, map_features=None):
    """Agents on the street at nearly constant speed, wobbling sideways; coordinates are multiples of 1/64 m.

    Ids are shuffled; the last agent is not valid at the current step, so it is not simulated. A few log steps are
    invalid.
    """
    random = np.random.default_rng(seed)
    time = (np.arange(91) - 10) * 0.1
    forward = random.random(num_agents) < 0.7
    speed = random.uniform(0, 12, num_agents) * np.where(forward, 1, -1)
    x = random.uniform(-30, 30, num_agents)[:, None] + speed[:, None] * time
    wobble = random.uniform(0, 2, num_agents)[:, None] * np.sin(0.4 * time + random.uniform(0, 6, num_agents)[:, None])
    y = np.where(forward, -2, 2)[:, None] + wobble
    position = np.round(np.stack([x, y, np.full_like(x, 0.75)], -1) * 64) / 64
    heading = np.where(forward, 0, np.pi)[:, None] + 0.05 * np.cos(0.4 * time)[None]
    size = np.stack(
        [random.uniform(3.5, 6, num_agents), random.uniform(1.6, 2.2, num_agents), np.full(num_agents, 1.5)], -1
    )
    valid = random.random((num_agents, 91)) > 0.03
    valid[:, 10] = True
    valid[-1, 10] = False
    kinds = np.ones(num_agents, np.int8)
    kinds[1] = 2
    return Scenario(
        scenario_id=f"drawn_{seed}",
        timestamps_s=time + 1.0,
        tracks=Tracks(
            object_id=random.permutation(1000)[:num_agents].astype(np.int64),
            object_type=kinds,
            position=position.astype(np.float32),
            heading=heading.astype(np.float32),
            velocity=np.zeros((num_agents, 91, 2), np.float32),
            size=np.repeat(size[:, None], 91, 1).astype(np.float32),
            valid=valid,
        ),
        map_features=draw_street() if map_features is None else map_features,
        lights=lights,
        ego_index=0,
        tracks_to_predict=np.arange(1, num_evaluated, dtype=np.int32),
        difficulty=np.zeros(num_evaluated - 1, np.int8),
        objects_of_interest=np.zeros(0, np.int64),
    )


def draw_rollouts(scenario, num_rollouts, seed, *, spread=2.0):
    """The log with smooth offsets that grow with time, coordinates multiples of 1/64 m."""
    random = np.random.default_rng(seed)
    simulated = scenario.simulated_indices
    ramp = np.linspace(0, 1, 80) ** 2
    offset = random.normal(0, spread, (num_rollouts, len(simulated), 1, 3)) * ramp[:, None] * [1, 0.7, 0.02]
    position = np.round((scenario.tracks.position[simulated, 11:] + offset) * 64) / 64
    heading = scenario.tracks.heading[simulated, 11:] + random.normal(0, 0.1, (num_rollouts, len(simulated), 1)) * ramp
    x, y, z = (torch.from_numpy(position[..., axis].astype(np.float32)) for axis in range(3))
    return SimulatedStates(scenario.tracks.object_id[simulated], x, y, z, torch.from_numpy(heading.astype(np.float32)))


def select_rollouts(states, index):
    """Some of the rollouts, in the given order."""
    return SimulatedStates(states.object_id, *(v[index] for v in (states.x, states.y, states.z, states.heading)))


def draw_scenes(scenario, num_rollouts, seed, *, spread=2.0):
    """Whole scenes: the log with offsets and sizes of their own at every step, coordinates multiples of 1/64 m."""
    random = np.random.default_rng(seed)
    simulated = scenario.simulated_indices
    shape = (num_rollouts, len(simulated), 1)
    offset = random.normal(0, spread, (*shape, 3)) * np.linspace(0.2, 1, 91)[:, None] * [1, 0.7, 0.02]
    position = np.round((scenario.tracks.position[simulated] + offset) * 64) / 64
    heading = scenario.tracks.heading[simulated] + random.normal(0, 0.1, shape)
    size = scenario.tracks.size[simulated] * random.uniform(0.8, 1.2, (*shape, 3)) * np.linspace(1, 1.1, 91)[:, None]
    x, y, z, heading, *size = (
        torch.from_numpy(values.astype(np.float32))
        for values in (*np.moveaxis(position, -1, 0), heading, *np.moveaxis(np.round(size * 64) / 64, -1, 0))
    )
    return SimulatedStates(scenario.tracks.object_id[simulated], x, y, z, heading, size=torch.stack(size, -1))
