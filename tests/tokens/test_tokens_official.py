"""Tokens of a real scenario against those of the public SMART code, with the published tables."""

import numpy as np
import pytest
import torch

from rlftsim.scenario.batch import collate
from rlftsim.scenario.womd import read_scenarios
from rlftsim.tokens.agent_tokens import clean_tracks, tokenize_agents
from rlftsim.tokens.map_tokens import split_map, tokenize_map
from rlftsim.tokens.vocabulary import Vocabulary

pytestmark = pytest.mark.official


@pytest.fixture(scope="module")
def batch(shared):
    [scenario] = read_scenarios(shared / "data" / "womd" / "motion_data_one_scenario.tfrecord")
    return collate([scenario])


@pytest.fixture(scope="module")
def vocabulary(shared):
    agents = np.load(shared / "data" / "tokens" / "agent_vocab_555_s2.npz")
    corners = torch.stack([torch.from_numpy(agents[name]) for name in ("veh", "ped", "cyc")])
    pieces = np.load(shared / "data" / "tokens" / "map_traj_token5.npz")["traj_src"].astype(np.float32)
    return Vocabulary(corners, torch.ones(corners.shape[:2], dtype=torch.bool), torch.from_numpy(pieces))


@pytest.fixture(scope="module")
def preprocessed(shared):
    return np.load(shared / "golden" / "smart" / "scenario_A" / "preprocessed.npz")


@pytest.fixture(scope="module")
def golden(shared):
    return np.load(shared / "golden" / "smart" / "scenario_A" / "tokens_centred.npz")


def test_the_same_agents_are_simulated(batch, preprocessed):
    np.testing.assert_array_equal(batch.object_id[0], preprocessed["id"])


def test_cleaned_tracks_agree_at_every_token_step(batch, golden):
    tracks = clean_tracks(batch)
    at = slice(5, None, 5)
    valid = golden["gt_valid_raw"]
    np.testing.assert_array_equal(tracks.valid[0, :, at], valid)
    np.testing.assert_allclose(tracks.position[0, :, at].numpy()[valid], golden["gt_pos_raw"][valid], atol=1e-3)
    turn = np.remainder(tracks.heading[0, :, at].numpy() - golden["gt_head_raw"] + np.pi, 2 * np.pi) - np.pi
    assert np.abs(turn[valid]).max() < 1e-4


def test_agent_tokens_are_exactly_the_same(batch, vocabulary, golden):
    tokens = tokenize_agents(batch, vocabulary)
    valid = golden["valid_mask"]
    np.testing.assert_array_equal(tokens.valid[0], valid)
    assert valid.sum() > 600
    np.testing.assert_array_equal(tokens.token_id[0].numpy()[valid], golden["gt_idx"][valid])
    np.testing.assert_allclose(tokens.position[0].numpy()[valid], golden["gt_pos"][valid], atol=1e-3)
    turn = np.remainder(tokens.heading[0].numpy() - golden["gt_heading"] + np.pi, 2 * np.pi) - np.pi
    assert np.abs(turn[valid]).max() < 1e-4


def test_map_pieces_lie_where_the_public_code_puts_them(batch, preprocessed):
    pieces = split_map(batch.scenarios[0])
    assert len(pieces.heading) == 2121
    np.testing.assert_allclose(pieces.points, preprocessed["map_traj_pos"], atol=5e-4, rtol=0)
    turn = np.remainder(pieces.heading - preprocessed["map_traj_theta"] + np.pi, 2 * np.pi) - np.pi
    assert np.quantile(np.abs(turn), 0.99) < 1e-3  # headings of 0.5 m of float32 world coordinates


def test_kinds_types_and_lights_of_map_pieces_are_exactly_the_same(batch, preprocessed):
    pieces = split_map(batch.scenarios[0])
    np.testing.assert_array_equal(pieces.type, preprocessed["map_type"])
    np.testing.assert_array_equal(pieces.family, preprocessed["map_pl_type"])
    np.testing.assert_array_equal(pieces.light, preprocessed["map_light_type"])


def test_map_tokens_are_the_same(batch, vocabulary, golden):
    tokens = tokenize_map(batch, vocabulary.map_prototypes)
    same = tokens.token_id[0].numpy() == golden["map_token_idx"]
    assert same.mean() > 0.995, f"{(~same).sum()} of {same.size} map tokens differ"
