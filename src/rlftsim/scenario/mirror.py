"""Mirrored scenarios: left and right exchanged, an augmentation for small data sets."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float32, Int64

from rlftsim.scenario.types import ROAD_EDGE_TYPES, MapFeatures, Scenario, cached_on_scenario

_FLIP_Y = np.array([1.0, -1.0, 1.0], np.float32)


@cached_on_scenario
def mirror_scenario(scenario: Scenario) -> Scenario:
    """The scenario seen in a mirror along the x axis: y, headings and turns change sign.

    Traffic that keeps right keeps left in the mirror. The metric measures the same, but for the sign of angular speeds.
    """
    tracks, lights = scenario.tracks, scenario.lights
    return replace(
        scenario,
        tracks=replace(
            tracks, position=tracks.position * _FLIP_Y, heading=-tracks.heading, velocity=tracks.velocity * _FLIP_Y[:2]
        ),
        map_features=_mirror_map(scenario.map_features),
        lights=replace(lights, stop_point=lights.stop_point * _FLIP_Y),
    )


def _mirror_map(features: MapFeatures) -> MapFeatures:
    # The road lies to the left of its edges, and to the right of the mirror images: these are reversed.
    order = np.arange(len(features.points))
    for index in features.find_indices(ROAD_EDGE_TYPES):
        span = slice(features.offsets[index], features.offsets[index + 1])
        order[span] = order[span][::-1]

    def flip(points: Float32[np.ndarray, "P 3"]) -> Float32[np.ndarray, "P 3"]:
        return points[order] * _FLIP_Y

    topology, residual = features.topology, features.polygon_rest
    return replace(
        features,
        points=flip(features.points),
        polygon_rest=None if residual is None else flip(residual),
        topology=replace(
            topology, neighbors=_swap_sides(topology.neighbors), boundaries=_swap_sides(topology.boundaries)
        ),
    )


def _swap_sides(rows: Int64[np.ndarray, "n columns"]) -> Int64[np.ndarray, "n columns"]:
    """Rows of a lane's neighbors or boundaries, whose second column is the side: 0 left, 1 right."""
    rows = rows.copy()
    rows[:, 1] = 1 - rows[:, 1]
    return rows
