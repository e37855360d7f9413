"""Tracks to motion tokens: properties that hold for any vocabulary and any track."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import scenes
from rlftsim.geometry import rotate, wrap_angle
from rlftsim.policies.registry import load_policy
from rlftsim.scenario.batch import collate
from rlftsim.scenario.types import ObjectType
from rlftsim.tokens.agent_tokens import (
    CleanTracks,
    class_boxes,
    clean_tracks,
    place_pose,
    restart_at_log,
    tokenize_agents,
    tokenize_tracks,
)
from rlftsim.tokens.vocabulary import CLASS_BOXES_M, class_of_type

KINDS = (ObjectType.VEHICLE, ObjectType.PEDESTRIAN, ObjectType.CYCLIST)
VEHICLE = torch.tensor([[1]])


def track(positions, headings=None, valid=None) -> CleanTracks:
    """One agent's clean track."""
    position = torch.as_tensor(positions, dtype=torch.float32)[None, None]
    heading = torch.zeros(position.shape[:-1]) if headings is None else torch.as_tensor(headings).float()[None, None]
    valid = torch.ones(position.shape[:-1], dtype=torch.bool) if valid is None else torch.as_tensor(valid)[None, None]
    return CleanTracks(position, heading, torch.zeros_like(position), valid)


@settings(deadline=None)
@given(
    st.sampled_from(KINDS), st.floats(-math.pi, math.pi), st.floats(-80, 80), st.floats(-80, 80)
)  # fmt: skip
def test_standing_agents_take_token_0(vocabulary, kind, heading, x, y):
    still = track(np.tile([x, y], (91, 1)), np.full(91, heading))
    tokens = tokenize_tracks(still, torch.tensor([[int(kind)]]), vocabulary)
    assert tokens.token_id.unique().tolist() == [0]
    torch.testing.assert_close(tokens.position, tokens.logged_position, atol=1e-4, rtol=0)


@settings(max_examples=40, deadline=None)
@given(st.data(), st.sampled_from(KINDS), st.floats(-math.pi, math.pi), st.floats(-50, 50), st.floats(-50, 50))
def test_a_track_made_of_tokens_is_tokenized_back(vocabulary, data, kind, heading, x, y):
    object_type = torch.tensor([[int(kind)]])
    class_id = class_of_type(object_type)
    known = int(vocabulary.token_mask[class_id[0, 0]].sum())
    ids = data.draw(st.lists(st.integers(0, known - 1), min_size=18, max_size=18))
    position, turn = torch.tensor([[[x, y]]]), torch.tensor([[heading]])
    positions, headings = [position], [turn]
    for token in ids:
        position, turn = place_pose(vocabulary, class_id, torch.tensor([[token]]), position, turn)
        positions += [position] * 5  # only every fifth step is looked at
        headings += [turn] * 5
    made = track(torch.cat(positions, 1)[0], torch.cat(headings, 1)[0])
    tokens = tokenize_tracks(made, object_type, vocabulary)
    assert tokens.token_id[0, 0].tolist() == ids
    torch.testing.assert_close(tokens.position, tokens.logged_position, atol=1e-4, rtol=0)


@settings(max_examples=25, deadline=None)
@given(st.floats(-math.pi, math.pi), st.floats(-1, 1))
def test_tokens_do_not_depend_on_where_a_scene_is_or_looks(vocabulary, turn, shift):
    batch = collate([scenes.junction_with_light()])
    tracks = clean_tracks(batch)
    angle, offset = torch.tensor(turn), torch.tensor([400 * shift, -300 * shift])
    moved = replace(
        tracks,
        position=rotate(tracks.position, angle.expand(tracks.heading.shape)) + offset,
        heading=wrap_angle(tracks.heading + angle),
    )
    before = tokenize_tracks(tracks, batch.object_type, vocabulary)
    after = tokenize_tracks(moved, batch.object_type, vocabulary)
    same = before.token_id == after.token_id  # rounding may break a tie the other way, which is no worse
    errors = ((t.position - t.logged_position).norm(dim=-1) for t in (before, after))
    assert same.float().mean() > 0.9
    torch.testing.assert_close(*(e.mean() for e in errors), atol=2e-2, rtol=0)


def test_each_token_corrects_the_error_of_the_last(built, pack_scenarios):
    vocabulary, (radius_m, *_) = built
    tokens = tokenize_agents(collate(pack_scenarios), vocabulary)
    error = (tokens.position - tokens.logged_position).norm(dim=-1)
    by_step = [float(error[..., k][tokens.valid[..., k]].mean()) for k in range(18)]
    assert max(by_step) < radius_m  # 18 errors that added up would be many disks away


def test_the_nearest_token_is_nearest_by_corners(vocabulary):
    motion = track([[0.0, 0.0]] * 5 + [[3.07, 0.04]])
    tokens = tokenize_tracks(motion, VEHICLE, vocabulary)
    ends = vocabulary.end_corners()[0][vocabulary.token_mask[0]]
    half = torch.tensor([[2.4, 1.0], [2.4, -1.0], [-2.4, -1.0], [-2.4, 1.0]])
    distance = (ends - (half + torch.tensor([3.07, 0.04]))).norm(dim=-1).sum(-1)
    assert int(tokens.token_id[0, 0, 0]) == int(distance.argmin())


# ---- where simulations start ---------------------------------------------------------------------


@pytest.fixture(scope="module")
def fine_vocabulary():
    """A vocabulary of many tokens, so that ordinary motions have one nearby."""
    return load_policy("demo-base").vocabulary


BACKING = scenes.Mover(x_m=30.0, y_m=4.0, speed_mps=-5.0)


def test_a_simulation_starts_at_the_log_for_those_whom_no_token_leads(fine_vocabulary):
    fast, late = replace(BACKING, speed_mps=60.0), replace(BACKING, missing=tuple(range(7)))
    batch = collate([scenes.build_scenario("off", (BACKING, fast, late))])
    tokens = tokenize_agents(batch, fine_vocabulary)
    assert ((tokens.position - tokens.logged_position)[0, :, 1].norm(dim=-1) > 2.0).all()
    history = restart_at_log(tokens, batch, fine_vocabulary)
    assert torch.equal(history.position[0], batch.position[0, :, 5:11:5] * history.valid[0, ..., None])
    assert torch.equal(history.heading[0], batch.heading[0, :, 5:11:5] * history.valid[0])


def test_the_history_of_all_others_and_the_tokens_to_learn_from_keep_their_bits(fine_vocabulary):
    batch = collate([scenes.build_scenario("mixed", (*scenes.TRAFFIC, BACKING))])
    tokens = tokenize_agents(batch, fine_vocabulary)
    before = {name: values.clone() for name, values in vars(tokens).items()}
    history = vars(restart_at_log(tokens, batch, fine_vocabulary))
    assert all(torch.equal(values[:, :-1], before[name][:, :-1, :2]) for name, values in history.items())
    assert not torch.equal(history["position"], before["position"][:, :, :2])
    # cached with the scenario
    after = vars(tokenize_agents(batch, fine_vocabulary))
    assert all(torch.equal(values, before[name]) for name, values in after.items())


def test_a_restarted_agent_has_its_logged_heading_where_tokens_hold_the_one_before_a_jump(fine_vocabulary):
    scenario = scenes.build_scenario("turned", (replace(BACKING, speed_mps=6.0),))
    heading = scenario.tracks.heading.copy()
    heading[0, :3] += np.pi
    batch = collate([replace(scenario, tracks=replace(scenario.tracks, heading=heading))])
    tokens = tokenize_agents(batch, fine_vocabulary)
    assert (tokens.heading[0, 0].abs() > 3.0).all()
    history = restart_at_log(tokens, batch, fine_vocabulary)
    assert torch.equal(history.heading[0], batch.heading[0, :, 5:11:5])
    # the token of 3 m ahead
    assert fine_vocabulary.poses[0, history.token_id[0, 0, 1], -1, 0] == pytest.approx(3.0, abs=0.2)


# ---- cleaning ------------------------------------------------------------------------------------


def with_missing(missing, mover=None):
    """Batch of one agent with holes in its log."""
    mover = scenes.Mover(speed_mps=7.0, turn_rate_radps=0.1) if mover is None else mover
    return collate([scenes.build_scenario("gaps", (replace(mover, missing=tuple(missing)),), num_predicted=0)])


@settings(max_examples=30, deadline=None)
@given(st.sets(st.integers(11, 85), max_size=40))
def test_gaps_are_filled_along_a_line(missing):
    batch, whole = with_missing(missing), with_missing(())
    tracks = clean_tracks(batch)
    assert bool(tracks.valid.all())
    seen = batch.valid
    torch.testing.assert_close(tracks.position[seen], batch.position[seen])
    torch.testing.assert_close(tracks.heading[seen], batch.heading[seen])
    away = (tracks.position - whole.position).norm(dim=-1)  # a chord of a circle of 70 m stays near it
    assert away.max() < 0.72 * (longest_gap(missing) / 10) ** 2 * 7 * 0.1 + 1e-3


def longest_gap(missing):
    longest = run = 0
    for step in range(91):
        run = run + 1 if step in missing else 0
        longest = max(longest, run)
    return longest + 1


def test_a_gap_is_filled_half_way_in_the_middle():
    tracks = clean_tracks(with_missing((20,), scenes.Mover(speed_mps=8.0)))
    torch.testing.assert_close(tracks.position[0, 0, 20], tracks.position[0, 0, [19, 21]].mean(0))


def test_nothing_is_made_up_after_the_last_valid_step():
    tracks = clean_tracks(with_missing(range(40, 91)))
    assert tracks.valid[0, 0].tolist() == [True] * 40 + [False] * 51


def test_headings_are_interpolated_the_short_way_round():
    mover = scenes.Mover(heading_rad=math.pi - 0.3, speed_mps=5.0, turn_rate_radps=0.3)  # passes +-pi at step 20
    tracks, whole = clean_tracks(with_missing(range(18, 23), mover)), with_missing((), mover)
    torch.testing.assert_close(wrap_angle(tracks.heading - whole.heading), torch.zeros(1, 1, 91), atol=1e-4, rtol=0)


@pytest.mark.parametrize(
    ("jump", "is_held"), [(1.4, False), (1.6, True), (3.1, True), (-1.6, True), (2 * math.pi - 0.1, False)]
)
def test_a_heading_that_jumps_is_held(jump, is_held):
    scenario = scenes.build_scenario("jump", (scenes.Mover(speed_mps=5.0),), num_predicted=0)
    heading = scenario.tracks.heading.copy()
    heading[0, 30] = np.remainder(jump + np.pi, 2 * np.pi) - np.pi
    batch = collate([replace(scenario, tracks=replace(scenario.tracks, heading=heading))])
    cleaned = clean_tracks(batch).heading[0, 0]
    assert (float(cleaned[30]) == 0.0) is is_held
    assert float(cleaned[31]) == 0.0


@pytest.mark.parametrize(
    ("first", "extra"),
    [(0, 0), (1, 1), (4, 4), (5, 0), (7, 2), (10, 5)],  # back to the last multiple of five; first seen now: to step 5
)
def test_tracks_begin_early_enough_for_their_first_token(first, extra):
    batch = with_missing(range(first), scenes.Mover(speed_mps=8.0))
    tracks = clean_tracks(batch)
    assert tracks.valid[0, 0].tolist() == [False] * (first - extra) + [True] * (91 - first + extra)
    torch.testing.assert_close(  # at constant velocity, 0.8 m a step
        tracks.position[0, 0, first - extra : first + 1, 0],
        batch.position[0, 0, first, 0] - 0.8 * torch.arange(extra, -1, -1.0),
    )


def test_a_log_without_future_has_two_tokens(vocabulary):
    tokens = tokenize_agents(collate([scenes.without_future()]), vocabulary)
    assert tokens.token_id.shape[-1] == 2
    both = tokenize_agents(collate([scenes.without_future(), scenes.straight_road()]), vocabulary)
    assert both.token_id.shape[-1] == 18
    assert not both.valid[0, :, 2:].any()


def test_other_kinds_of_road_users_move_as_vehicles():
    kinds = torch.tensor([int(k) for k in ObjectType])
    assert class_of_type(kinds).tolist() == [0, 0, 1, 2, 0]
    length, width = class_boxes(kinds)
    assert list(zip(length.tolist(), width.tolist())) == [
        pytest.approx(CLASS_BOXES_M[c]) for c in (0, 0, 1, 2, 0)
    ]  # fmt: skip
