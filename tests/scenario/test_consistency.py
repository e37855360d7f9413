"""Positions against velocities, headings and times."""

from dataclasses import replace

import numpy as np
import pytest

import scenes
from rlftsim.scenario.consistency import describe_contradictions
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.scenario.inspect import find_problems
from rlftsim.scenario.types import ObjectType
from rlftsim.scenario.womd import read_scenarios


@pytest.fixture
def tracks():
    return scenes.straight_road().tracks


def rotated(velocity):
    return np.stack([-velocity[..., 1], velocity[..., 0]], -1)


@pytest.mark.parametrize(
    "change",
    [rotated, np.zeros_like, lambda v: v * np.float32(3.6), lambda v: -v, lambda v: v / np.float32(10)],
    ids=["across", "zero", "km/h", "backwards", "steps of a second"],
)
def test_velocities_of_another_frame_unit_or_time_base_contradict_positions(tracks, change):
    assert describe_contradictions(tracks) == ""
    assert describe_contradictions(replace(tracks, velocity=change(tracks.velocity))).startswith("velocities ")


def test_the_first_contradictory_track_is_named_with_its_speeds(tracks):
    kept = replace(tracks, position=np.zeros_like(tracks.position), velocity=np.full_like(tracks.velocity, 3.0))
    text = describe_contradictions(kept)
    assert f"track {tracks.object_id[0]} moves at 0.0 m/s, its velocity is 4.2 m/s and 4.2 m/s off" in text


def test_headings_in_degrees_or_from_north_contradict_the_motion(tracks):
    for heading in (np.rad2deg(tracks.heading + np.pi / 2), np.pi / 2 - tracks.heading, tracks.heading + 0.5):
        assert describe_contradictions(replace(tracks, heading=heading.astype(np.float32))).startswith("headings ")


def test_vehicles_that_back_up_slowly_and_pedestrians_face_where_they_like(tracks):
    turned = tracks.heading + np.float32(np.pi)
    slow = replace(tracks, position=tracks.position / np.float32(10), velocity=tracks.velocity / np.float32(10))
    assert describe_contradictions(replace(slow, heading=turned)) == ""
    kinds = np.full_like(tracks.object_type, ObjectType.PEDESTRIAN)
    assert describe_contradictions(replace(tracks, heading=turned, object_type=kinds)) == ""


def test_a_minority_of_tracks_may_be_noisy_and_states_that_are_not_valid_hold_anything(tracks):
    noisy = tracks.velocity.copy()
    noisy[:2] *= -1  # of five that move
    assert describe_contradictions(replace(tracks, velocity=noisy)) == ""
    lost, valid = tracks.position.copy(), tracks.valid.copy()
    valid[:, 30:60], lost[:, 30:60] = False, np.inf
    assert describe_contradictions(replace(tracks, position=lost, valid=valid)) == ""


def test_heights_that_are_none_contradict_the_motion(tracks):
    position = tracks.position.copy()
    position[..., 2] = 2.0 * position[..., 0]
    assert describe_contradictions(replace(tracks, position=position)).startswith("heights contradict the motion of ")
    position[..., 2] = 0.3 * position[..., 0]  # a steep road
    assert describe_contradictions(replace(tracks, position=position)) == ""


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda z: z + 30, "heights (z) contradict the map near 5 of 5 moving tracks: track 100 is at 33.0 m, the m"),
        (lambda z: z - 8, "heights (z) contradict the map near 5 of 5 moving tracks: track 100 is at -5.0 m, the m"),
        (lambda z: z + 4 * (np.arange(91) > 40), "heights (z) jump in 6 of 6 tracks: track 100 climbs or falls by 4"),
    ],
    ids=["above", "below", "jump"],
)
def test_heights_of_another_frame_contradict_the_map_and_none_jumps(tracks, change, text):
    scenario = scenes.straight_road()
    position = tracks.position.copy()
    position[..., 2] = change(position[..., 2])
    moved = replace(tracks, position=position)
    assert describe_contradictions(tracks, scenario.map_features) == ""
    assert text in describe_contradictions(moved, scenario.map_features)
    assert describe_contradictions(moved, scenario.map_features, guessed={"z"}) == ""


def test_a_single_track_whose_height_jumps_is_found_and_does_not_condemn_the_scenario(tracks):
    scenario = scenes.straight_road()
    position = tracks.position.copy()
    position[0, 41:, 2] += 4
    moved = replace(tracks, position=position)
    assert "jump" not in describe_contradictions(moved, None)
    details = [
        finding.detail for finding in find_problems(replace(scenario, tracks=moved)) if finding.problem == "teleport"
    ]
    assert details == [f"track {tracks.object_id[0]} climbs or falls by 4.0 m from step 40 to 41"]


def test_tracks_on_either_level_of_a_bridge_and_far_from_the_map_are_on_its_heights(tracks):
    ground = scenes.straight_road().map_features
    position = tracks.position.copy()
    position[::2, :, 2] += 8
    both = np.concatenate([ground.points, ground.points + np.float32([0, 0, 8])])
    moved = replace(tracks, position=position)
    assert describe_contradictions(moved, replace(ground, points=both)) == ""
    assert describe_contradictions(moved, replace(ground, points=ground.points + np.float32([500, 0, 0]))) == ""


def contradictions(scenario):
    return describe_contradictions(scenario.tracks, scenario.map_features, scenario.guessed)


def test_synthetic_scenarios_do_not_contradict_themselves():
    assert not any(map(contradictions, ScenarioDataset("synthetic", cache_size=0)))


@pytest.mark.official
def test_real_scenarios_do_not_contradict_themselves(shared):
    files = sorted((shared / "data" / "womd").rglob("*.tfrecord"))
    assert not any(contradictions(scenario) for file in files for scenario in read_scenarios(file))
