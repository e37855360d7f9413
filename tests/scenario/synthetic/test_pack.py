"""The embedded pack: whole, realistic where it can be counted, and fit for what is built on it. Needs no simulator."""

import json
from pathlib import Path

import numpy as np
import pytest

from rlftsim.geometry import clockwise_corners
from rlftsim.scenario.dataset import INDEX, MANIFEST, ScenarioDataset
from rlftsim.scenario.shards import hash_file
from rlftsim.scenario.synthetic import pack_path
from rlftsim.scenario.types import (
    CURRENT_STEP,
    LANE_TYPES,
    ROAD_EDGE_TYPES,
    TOTAL_STEPS,
    MapFeatureType,
    ObjectType,
    Scenario,
)

MAX_PACK_BYTES = 12e6


@pytest.fixture(scope="module")
def pack() -> ScenarioDataset:
    return ScenarioDataset(pack_path())


def signed_distance_to_edges(points: np.ndarray, scenario: Scenario) -> np.ndarray:
    """Distance of points [n, 2] to the nearest road edge, negative to its left."""
    features = scenario.map_features
    edges = [features.polyline(k)[:, :2].astype(float) for k in features.find_indices(ROAD_EDGE_TYPES)]
    start, end = np.concatenate([e[:-1] for e in edges]), np.concatenate([e[1:] for e in edges])
    along = end - start
    share = ((points[:, None] - start) * along).sum(-1) / np.maximum((along**2).sum(-1), 1e-9)
    away = points[:, None] - (start + np.clip(share, 0, 1)[..., None] * along)
    distance = np.linalg.norm(away, axis=-1)
    rows, nearest = np.arange(len(points)), distance.argmin(axis=1)
    side = along[nearest, 0] * away[rows, nearest, 1] - along[nearest, 1] * away[rows, nearest, 0]
    return np.where(side > 0, -1.0, 1.0) * distance[rows, nearest]


def test_checksums_hold_and_the_pack_is_small():
    folder = pack_path()
    manifest = json.loads((folder / MANIFEST).read_text())
    for shard in manifest["shards"]:
        assert hash_file(folder / shard["file"]) == shard["sha256"]
    assert hash_file(folder / INDEX) == manifest["index_sha256"]
    assert sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) < MAX_PACK_BYTES


def test_manifest_tells_how_the_pack_was_made(pack):
    provenance = pack.manifest.provenance
    assert pack.manifest.counts == {"testing": 40, "training": 160, "validation": 40}
    assert provenance["license"] == "CC0-1.0"
    assert provenance["arguments"]["num_scenarios"] == 200
    assert {"seed", "splits"} <= set(provenance["arguments"])
    assert provenance["testing_arguments"]["splits"] == {"testing": 1.0}
    assert provenance["sumo_version"].count(".") == 2


def test_no_two_splits_share_a_network(pack):
    shards = {
        split: set(ScenarioDataset(pack_path(), split).index["shard"].to_pylist()) for split in pack.manifest.counts
    }
    assert len(shards["training"]) == 16
    assert len(shards["validation"]) == 4
    assert len(shards["testing"]) == 40
    seeds = {tuple(network["seed"]) for network in pack.manifest.provenance["networks"]}
    assert len(seeds) == 60


def test_every_ego_is_seen_throughout_and_every_evaluated_agent_now(pack):
    for scenario in pack:
        tracks = scenario.tracks
        assert tracks.valid.shape[1] == TOTAL_STEPS
        assert scenario.ego_index == len(tracks.object_id) - 1
        assert tracks.object_type[scenario.ego_index] == ObjectType.VEHICLE
        assert tracks.valid[scenario.ego_index].all()
        assert tracks.valid[scenario.tracks_to_predict, CURRENT_STEP].all()
        assert 2 <= len(scenario.tracks_to_predict) <= 8
        assert scenario.ego_index not in scenario.tracks_to_predict


def test_what_is_not_valid_is_zero(pack):
    for scenario in pack:
        tracks = scenario.tracks
        hidden = ~tracks.valid
        for values in (tracks.position, tracks.heading, tracks.velocity, tracks.size):
            assert not values[hidden].any()


def test_lights_begin_their_lanes(pack):
    num_with_lights = 0
    for scenario in pack:
        features, lights = scenario.map_features, scenario.lights
        num_with_lights += len(lights.step) > 0
        index = {int(feature_id): k for k, feature_id in enumerate(features.feature_id)}
        for lane_id in np.unique(lights.lane_id):
            lane = index[int(lane_id)]
            assert features.feature_type[lane] in LANE_TYPES
            stop_points = lights.stop_point[lights.lane_id == lane_id]
            assert len(stop_points) == TOTAL_STEPS
            assert (stop_points == features.polyline(lane)[0]).all()
    assert 0.35 < num_with_lights / len(pack) < 0.65


def test_evaluated_vehicles_are_on_the_road_side_of_the_edges(pack):
    off_road = []
    for scenario in pack:
        tracks = scenario.tracks
        for k in scenario.evaluated_indices:
            if tracks.object_type[k] == ObjectType.VEHICLE:
                steps = np.flatnonzero(tracks.valid[k])[::30]
                position = tracks.position[k, steps, :2].astype(float)
                corners = clockwise_corners(position, tracks.heading[k, steps], tracks.size[k, CURRENT_STEP])
                distance = signed_distance_to_edges(corners.reshape(-1, 2), scenario)
                off_road += (distance.reshape(-1, 4).max(axis=1) > 0).tolist()
    assert np.mean(off_road) < 0.01


def test_boxes_stand_on_the_ground(pack):
    for scenario in list(pack)[::10]:
        ground = scenario.map_features.points
        tracks, ego = scenario.tracks, scenario.ego_index
        place = tracks.position[ego, CURRENT_STEP]
        nearest = ground[np.linalg.norm(ground[:, :2] - place[:2], axis=1).argmin()]
        assert place[2] - nearest[2] == pytest.approx(tracks.size[ego, CURRENT_STEP, 2] / 2, abs=0.1)


def test_the_pack_is_as_busy_as_real_scenes(pack):
    agents = [len(scenario.simulated_indices) for scenario in pack]
    assert 25 < np.mean(agents) < 36
    kinds = np.concatenate([s.tracks.object_type[s.simulated_indices] for s in pack])
    assert 0.03 < np.mean(kinds == ObjectType.PEDESTRIAN) < 0.2
    assert (kinds == ObjectType.CYCLIST).any()


def test_links_between_lanes_meet_end_to_start(pack):
    for scenario in list(pack)[::10]:
        features = scenario.map_features
        index = {int(feature_id): k for k, feature_id in enumerate(features.feature_id)}
        for lane, after in features.topology.exit_lanes:
            gap = features.polyline(index[int(lane)])[-1] - features.polyline(index[int(after)])[0]
            kinds = {int(features.feature_type[index[int(k)]]) for k in (lane, after)}
            # Where a bicycle lane ends, bicycles go on at the right of a lane for cars, not in its middle.
            assert np.linalg.norm(gap[:2]) < (1.3 if MapFeatureType.LANE_BIKE in kinds else 0.1)


def test_pack_path_is_inside_the_package():
    assert pack_path().parent == Path(__file__).parents[3] / "src/rlftsim/scenario/synthetic"
