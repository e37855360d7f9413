"""Preprocessing and tokens of scenario A against the public code."""

from dataclasses import replace

import numpy as np
import pytest

from rlftsim.scenario.batch import collate
from rlftsim.scenario.shards import ShardReader, ShardWriter
from rlftsim.scenario.types import CURRENT_STEP
from rlftsim.tokens.agent_tokens import clean_tracks, tokenize_agents
from rlftsim.tokens.catk_compat import fill_gaps_in_world
from rlftsim.tokens.map_tokens import split_map, tokenize_map
from rlftsim.tokens.vocabulary import class_of_type

pytestmark = pytest.mark.official
FRAME_STEP_M = 2**-11
"""One float32 step at the coordinates of scenario A."""


def turn(a, b):
    """Angle between headings."""
    return np.abs(np.remainder(a.astype(np.float64) - b + np.pi, 2 * np.pi) - np.pi)


@pytest.fixture(scope="module")
def preprocessed(golden):
    return golden.arrays("scenario_A/preprocessed")


def test_agents_are_those_of_the_public_code(scenario_a, preprocessed):
    batch = collate([scenario_a])
    chosen = scenario_a.simulated_indices
    tracks = scenario_a.tracks
    np.testing.assert_array_equal(batch.object_id[0], preprocessed["id"])
    np.testing.assert_array_equal(class_of_type(batch.object_type)[0], preprocessed["type"])
    ego, interest, predict = preprocessed["role"].T
    np.testing.assert_array_equal(ego, chosen == scenario_a.ego_index)
    np.testing.assert_array_equal(interest, np.isin(tracks.object_id[chosen], scenario_a.objects_of_interest))
    np.testing.assert_array_equal(predict, np.isin(chosen, scenario_a.tracks_to_predict))
    mean = np.stack([tracks.size[i][tracks.valid[i]].mean(0) for i in chosen])
    np.testing.assert_array_equal(mean, preprocessed["shape"])
    # a model here sees the size at the current step: the mean would look into the future
    assert np.abs(mean - tracks.size[chosen, CURRENT_STEP]).max() > 0.05


def test_gaps_are_filled_to_the_last_bit(scenario_a, preprocessed):
    batch = collate([scenario_a], frame="world")
    position, velocity, valid = fill_gaps_in_world(batch)
    seen = preprocessed["valid_mask"]
    assert (seen & ~batch.valid[0].numpy()).sum() > 0  # there are gaps
    np.testing.assert_array_equal(valid[0], seen)
    np.testing.assert_array_equal(position[0][seen], preprocessed["position"][..., :2][seen])
    np.testing.assert_array_equal(velocity[0][seen], preprocessed["velocity"][seen])


def test_filled_gaps_differ_by_rounding_only(scenario_a, preprocessed):
    tracks = clean_tracks(collate([scenario_a], frame="world"))
    seen = preprocessed["valid_mask"]
    assert np.abs(tracks.position[0].numpy() - preprocessed["position"][..., :2])[seen].max() <= FRAME_STEP_M
    # no heading of scenario A jumps; the public code unwraps before it interpolates
    assert turn(tracks.heading[0].numpy(), preprocessed["heading"])[seen].max() < 1e-6


def test_map_pieces_are_those_of_the_public_code(scenario_a, preprocessed):
    pieces = split_map(scenario_a)
    np.testing.assert_array_equal(pieces.points, preprocessed["map_traj_pos"])
    np.testing.assert_array_equal(pieces.heading, preprocessed["map_traj_theta"])
    np.testing.assert_array_equal(pieces.type, preprocessed["map_type"])
    np.testing.assert_array_equal(pieces.family, preprocessed["map_pl_type"])
    np.testing.assert_array_equal(pieces.light, preprocessed["map_light_type"])


def test_without_the_rest_of_doubles_polygons_are_cut_one_float32_step_elsewhere(
    scenario_a, golden, preprocessed, nano
):
    features = replace(scenario_a.map_features, polygon_rest=None)
    scenario = replace(scenario_a, map_features=features)
    pieces = split_map(scenario)
    off = np.abs(pieces.points - preprocessed["map_traj_pos"]).max((1, 2))
    assert off.max() <= FRAME_STEP_M
    assert (pieces.type[off > 0] == 9).all()
    tokens = tokenize_map(collate([scenario]), nano.vocabulary.map_prototypes)
    differs = tokens.token_id[0].numpy() != golden.arrays("scenario_A/tokens_centred")["map_token_idx"]
    assert (off > 0).sum() == 82
    assert differs.sum() == 7


def test_map_pieces_come_back_from_a_data_set(scenario_a, preprocessed, tmp_path):
    writer = ShardWriter(tmp_path / "a.arrow")
    writer.add(scenario_a, "training")
    writer.close()
    pieces = split_map(ShardReader(tmp_path / "a.arrow").read(0))
    np.testing.assert_array_equal(pieces.points, preprocessed["map_traj_pos"])


@pytest.mark.parametrize("frame", ["centred", "absolute"])
def test_map_tokens_are_those_of_the_public_code(frame, batch_a, golden, nano):
    tokens = tokenize_map(batch_a(frame), nano.vocabulary.map_prototypes)
    np.testing.assert_array_equal(tokens.token_id[0], golden.arrays(f"scenario_A/tokens_{frame}")["map_token_idx"])


@pytest.mark.parametrize("frame", ["centred", "absolute"])
def test_agent_tokens_are_those_of_the_public_code_to_the_last_bit(frame, batch_a, golden, nano):
    expected = golden.arrays(f"scenario_A/tokens_{frame}")
    tokens = tokenize_agents(batch_a(frame), nano.vocabulary, catk_compat=True)
    valid = expected["valid_mask"]
    np.testing.assert_array_equal(tokens.valid[0], valid)
    np.testing.assert_array_equal(tokens.token_id[0][valid], expected["gt_idx"][valid])
    np.testing.assert_array_equal(tokens.position[0][valid], expected["gt_pos"][valid])
    np.testing.assert_array_equal(tokens.heading[0][valid], expected["gt_heading"][valid])
    logged = expected["gt_valid_raw"]
    np.testing.assert_array_equal(tokens.logged_valid[0], logged)
    np.testing.assert_array_equal(tokens.logged_position[0][logged], expected["gt_pos_raw"][logged])
    assert turn(tokens.logged_heading[0].numpy(), expected["gt_head_raw"])[logged].max() < 1e-6


def test_our_own_order_of_operations_finds_the_same_tokens_in_the_map_frame(batch_a, golden, nano):
    expected = golden.arrays("scenario_A/tokens_centred")
    tokens = tokenize_agents(batch_a("centred"), nano.vocabulary)
    valid = expected["valid_mask"]
    np.testing.assert_array_equal(tokens.token_id[0][valid], expected["gt_idx"][valid])
    assert np.abs(tokens.position[0].numpy() - expected["gt_pos"])[valid].max() < 2e-4


def test_the_world_frame_changes_one_token_in_twenty(golden):
    centered, absolute = (golden.arrays(f"scenario_A/tokens_{frame}") for frame in ("centred", "absolute"))
    valid = centered["valid_mask"]
    assert (centered["gt_idx"] != absolute["gt_idx"])[valid].sum() == 35
    assert valid.sum() == 692
