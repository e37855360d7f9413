"""Mirrored scenarios: left and right exchanged, an augmentation for small data sets."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float32, Int64

from rlftsim.scenario.derived import cached_on_scenario
from rlftsim.scenario.types import ROAD_EDGE_TYPES, MapFeatures, Scenario

_FLIP_Y = np.array([1.0, -1.0, 1.0], np.float32)


@cached_on_scenario
def mirrored(scenario: Scenario) -> Scenario:
    """The scenario seen in a mirror along the x axis: y, headings and turns change their sign.

    Traffic that keeps right keeps left in it. Everything that the metric measures is the same, but for the sign of
    angular speeds.
    """
    tracks, lights = scenario.tracks, scenario.lights
    return replace(
        scenario,
        tracks=replace(
            tracks,
            position=tracks.position * _FLIP_Y,
            heading=-tracks.heading,
            velocity=tracks.velocity * _FLIP_Y[:2],
        ),
        map_features=_mirrored_map(scenario.map_features),
        lights=replace(lights, stop_point=lights.stop_point * _FLIP_Y),
    )


def _mirrored_map(features: MapFeatures) -> MapFeatures:
    # The road lies to the left of its edges, and of their mirror images to the right: they run the other way.
    order = np.arange(len(features.points))
    for index in features.find_indices(ROAD_EDGE_TYPES):
        own = slice(features.offsets[index], features.offsets[index + 1])
        order[own] = order[own][::-1]

    def flipped(points: Float32[np.ndarray, "P 3"]) -> Float32[np.ndarray, "P 3"]:
        return points[order] * _FLIP_Y

    topology, rest = features.topology, features.polygon_rest
    return replace(
        features,
        points=flipped(features.points),
        polygon_rest=None if rest is None else flipped(rest),
        topology=replace(
            topology,
            neighbors=_with_sides_exchanged(topology.neighbors),
            boundaries=_with_sides_exchanged(topology.boundaries),
        ),
    )


def _with_sides_exchanged(rows: Int64[np.ndarray, "n columns"]) -> Int64[np.ndarray, "n columns"]:
    """Rows of a lane's neighbors or boundaries, whose second column is the side: 0 left, 1 right."""
    rows = rows.copy()
    rows[:, 1] = 1 - rows[:, 1]
    return rows
