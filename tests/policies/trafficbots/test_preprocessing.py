"""Map tokens, lights, agents and destinations against the public packing script, and on hard input."""

from dataclasses import replace

import numpy as np
import pytest

import scenes
from rlftsim.policies.trafficbots.map_tokens import cut_line, sides_of_polygon, tokenize_lights, tokenize_map
from rlftsim.policies.trafficbots.scene import (
    CYCLIST,
    NO_DESTINATION,
    VEHICLE,
    DestinationMap,
    _successors,
    agent_motions,
    build_scene,
    destination_labels,
)
from rlftsim.scenario.batch import collate
from rlftsim.scenario.types import HISTORY_STEPS, TOTAL_STEPS, LightStates

both = pytest.mark.parametrize("name", ["A", "B"])
pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")


def packed(golden, name):
    return golden.arrays(f"scenario_{name}/preprocessed")


@pytest.mark.official
@both
def test_map_tokens_are_the_packed_ones(golden, records, name):
    ours, theirs = tokenize_map(records(name)), packed(golden, name)
    assert np.array_equal(ours.node_mask, theirs["map_valid"])
    assert np.array_equal(ours.type, theirs["map_type"])
    assert np.array_equal(ours.feature_id, theirs["map_id"])
    np.testing.assert_allclose(ours.position, theirs["map_pos"], atol=1e-3)
    np.testing.assert_allclose(ours.direction, theirs["map_dir"], atol=1e-3)


@pytest.mark.official
@both
def test_lights_are_the_packed_ones(golden, records, name):
    ours, theirs = tokenize_lights(records(name), of_history=False), packed(golden, name)
    assert np.array_equal(ours.token, theirs["tl_token"])
    assert np.array_equal(ours.observed, theirs["tl_valid"])
    assert np.array_equal(ours.state, np.maximum(theirs["tl_state"], 0))


@pytest.mark.official
@both
@pytest.mark.parametrize("num_steps", [HISTORY_STEPS, TOTAL_STEPS])
def test_agents_are_the_packed_ones(golden, records, name, num_steps):
    scenario, theirs = records(name), packed(golden, name)
    ours, prefix = agent_motions(scenario, num_steps), "hist_" if num_steps == HISTORY_STEPS else ""
    row = {int(id_): k for k, id_ in enumerate(theirs["object_id"])}
    rows = [row[int(id_)] for id_ in scenario.tracks.object_id[scenario.simulated_indices]]
    assert theirs["current"][rows].all()
    assert theirs["current"].sum() == len(rows)
    assert np.array_equal(ours.valid, theirs[f"{prefix}valid"][rows])
    np.testing.assert_allclose(ours.position, theirs[f"{prefix}pos"][rows], atol=1e-3)
    turn = ours.heading - theirs[f"{prefix}heading"][rows]
    np.testing.assert_allclose(np.sin(turn), 0, atol=1e-6)
    for k, (field, tolerance) in enumerate((("speed", 2e-6), ("acceleration", 4e-5), ("yaw_rate", 4e-5))):
        np.testing.assert_allclose(ours.motion[..., k], theirs[prefix + field][rows], atol=tolerance, rtol=1e-6)
    if not prefix:
        np.testing.assert_allclose(ours.size, theirs["size"][rows], atol=1e-5)


@pytest.mark.official
@both
def test_destination_labels_are_the_packed_ones(golden, records, name):
    scenario, theirs = records(name), packed(golden, name)
    row = {int(id_): k for k, id_ in enumerate(theirs["object_id"])}
    rows = [row[int(id_)] for id_ in scenario.tracks.object_id[scenario.simulated_indices]]
    assert np.array_equal(destination_labels(scenario, None), theirs["dest"][rows])


@pytest.mark.official
@both
def test_all_destinations_at_forks_are_those_of_the_public_walk(golden, records, name):
    scenario, theirs = records(name), golden.arrays(f"scenario_{name}/goals")
    places = DestinationMap(tokenize_map(scenario), _successors(scenario))
    starts = theirs["dest_possible_ptr"]
    for k, (goal, kind) in enumerate(zip(theirs["goal"].astype(float), theirs["type"])):
        found = places.destinations(goal, int(kind))
        assert set(found) == set(theirs["dest_possible"][starts[k] : starts[k + 1]].tolist())
        assert sum(found.values()) == pytest.approx(1)


@pytest.mark.official
@both
def test_the_box_of_the_map_is_the_packed_one(golden, records, name):
    scene = build_scene(collate([records(name)]), HISTORY_STEPS, None)
    np.testing.assert_allclose(scene.map_box[0], golden.arrays(f"scenario_{name}/inputs")["mp_boundary"], atol=1e-3)


@pytest.mark.official
def test_lines_are_cut_as_in_the_public_code(golden):
    unit = golden.arrays("unit")
    for k, count in enumerate(unit["cuts/segments"].tolist()):
        theirs = unit["cuts/starts"][unit["cuts/ptr"][k] : unit["cuts/ptr"][k + 1]].tolist()
        pieces = list(cut_line(count))
        assert [int(piece[0]) if len(piece) else 0 for piece in pieces] == theirs
        assert sum(len(piece) for piece in pieces) == count
        assert max(map(len, pieces)) <= 20


@pytest.mark.official
@pytest.mark.parametrize("k", range(4))
def test_polygons_become_their_longer_sides(golden, k):
    unit = golden.arrays("unit")
    lines = sides_of_polygon(unit[f"polygon/{k}/corners"])
    assert len(lines) == 4
    for j, line in enumerate(lines):
        np.testing.assert_allclose(line, unit[f"polygon/{k}/line{j}"], atol=1e-9)


def test_a_log_without_map_has_no_tokens_lights_or_destinations():
    scenario = scenes.without_map()
    assert len(tokenize_map(scenario)) == 0
    assert tokenize_lights(scenario).state.shape == (0, TOTAL_STEPS)
    assert (destination_labels(scenario, None) == NO_DESTINATION).all()


def test_tokens_far_from_the_agents_go_first_where_there_are_too_many():
    scenario = scenes.junction_with_light()
    everything, few = tokenize_map(scenario, None), tokenize_map(scenario, 20)
    assert len(few) == 20 < len(everything)

    def nearest(pieces):
        return np.linalg.norm(pieces.position[:, 0, :2], axis=1)

    assert np.median(nearest(few)) < np.median(nearest(everything))


def test_lights_first_seen_after_the_current_step_are_left_out():
    scenario = scenes.junction_with_light()
    assert tokenize_lights(scenario).observed.all()
    later = scenario.lights.step >= HISTORY_STEPS
    lights = LightStates(**{k: v[later] for k, v in vars(scenario.lights).items()})
    late = replace(scenario, lights=lights)
    assert len(tokenize_lights(late).token) == 0 < len(tokenize_lights(late, of_history=False).token)


def test_gaps_are_filled_and_the_future_is_not_looked_at():
    scenario = scenes.with_gaps()
    whole, past = agent_motions(scenario, TOTAL_STEPS), agent_motions(scenario, HISTORY_STEPS)
    assert whole.valid[1, 25:28].all()
    assert not whole.valid[1, 88:].any()
    assert past.valid.shape[1] == HISTORY_STEPS
    # Agent 1 misses steps 3 and 4, at constant speed: filled from its neighbors.
    np.testing.assert_allclose(np.diff(past.position[1, :, 0]), 0.81, atol=1e-3)
    assert (past.motion[..., 1][~past.valid] == 0).all()


def test_speed_is_negative_where_an_agent_drives_backwards():
    ahead, back = (scenes.build_scenario(f"{v}", (scenes.Mover(speed_mps=v),)) for v in (3.0, -3.0))
    assert agent_motions(ahead, TOTAL_STEPS).motion[0, :, 0] == pytest.approx(3.0, abs=1e-3)
    assert agent_motions(back, TOTAL_STEPS).motion[0, :, 0] == pytest.approx(-3.0, abs=1e-3)


def test_a_vehicle_off_the_road_and_a_cyclist_without_a_lane_go_to_the_nearest_edge():
    scenario = scenes.straight_road()
    places = DestinationMap(tokenize_map(scenario), {})
    last = np.array([0.0, -2.0, 1.5, 0.0])
    (token,) = places.destinations(last, CYCLIST)
    assert places.map_tokens.type[token] == 4
    assert np.abs(places.map_tokens.position[token, 0, :2] - last[:2]).max() < 40
    (token,) = places.destinations(np.array([0.0, 60.0, 0.0, 0.0]), VEHICLE)
    assert places.map_tokens.type[token] == 4
