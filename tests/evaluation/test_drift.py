"""Drift from the log in scenes drawn by hand: every number is known."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

import scenes
from rlftsim.evaluation.drift import measure_drift
from rlftsim.realism import SimulatedStates
from rlftsim.realism.from_rollouts import logged_states
from rlftsim.scenario.types import MapFeatures, MapFeatureType, ObjectType

LANE = scenes.polylines([(MapFeatureType.LANE_SURFACE_STREET, [(-100.0, 0.0), (200.0, 0.0)])])


def scene(*movers, map_features=LANE):
    return scenes.build_scenario("drift", movers, map_features)


def driven(*movers):
    """One rollout in which agents drive as these movers."""
    tracks = scene(*movers).tracks
    parts = (*np.moveaxis(tracks.position, -1, 0), tracks.heading)
    x, y, z, heading = (torch.from_numpy(part[None, :, 11:].astype(np.float32)) for part in parts)
    return SimulatedStates(tracks.object_id, x, y, z, heading)


@pytest.mark.parametrize("log", [scenes.straight_road(), scenes.bend(), scenes.with_gaps()])
def test_the_log_does_not_drift(log):
    drift = measure_drift(log, logged_states(log, num_rollouts=2))
    assert drift.speed_gap == pytest.approx(0.0, abs=1e-4)
    assert drift.unlogged_stop_rate == 0.0


def test_speeds_are_those_of_agents_that_move_in_the_log():
    log = scene(scenes.Mover(speed_mps=8.0), scenes.Mover(x_m=30.0, speed_mps=0.0))
    drift = measure_drift(log, driven(scenes.Mover(speed_mps=5.0), scenes.Mover(x_m=30.0, speed_mps=2.0)))
    assert drift.speed_gap == pytest.approx(-3.0, abs=1e-3)
    assert (drift.speed_p10, drift.speed_p50, drift.speed_p90) == pytest.approx((5.0, 5.0, 5.0), abs=1e-3)


def test_the_speed_of_agents_that_are_not_evaluated_has_a_column_of_its_own():
    log = scene(scenes.Mover(speed_mps=8.0), scenes.Mover(y_m=5.0, speed_mps=8.0))
    log = replace(log, tracks_to_predict=np.zeros(0, np.int32), difficulty=np.zeros(0, np.int8))  # the ego alone
    drift = measure_drift(log, driven(scenes.Mover(speed_mps=8.0), scenes.Mover(y_m=5.0, speed_mps=6.0)))
    assert (drift.speed_gap, drift.speed_gap_all) == pytest.approx((0.0, -1.0), abs=1e-3)


def test_a_second_without_motion_is_a_stop():
    log = scene(scenes.Mover(speed_mps=8.0))
    states = driven(scenes.Mover(speed_mps=8.0))
    for standing, expected in ((9, 0.0), (10, 1.0)):
        states.x[..., 40 : 40 + standing] = states.x[..., 39:40]
        assert measure_drift(log, states).unlogged_stop_rate == expected
    stopping = scene(scenes.Mover(speed_mps=8.0))
    stopping.tracks.position[0, 50:65] = stopping.tracks.position[0, 50]
    assert math.isnan(measure_drift(stopping, states).unlogged_stop_rate)  # its log stops, too


def test_offset_and_angle_are_to_the_lane_that_is_followed():
    log = scene(scenes.Mover())
    states = driven(scenes.Mover(y_m=-0.6))
    states.heading.fill_(0.1)
    drift = measure_drift(log, states)
    assert (drift.lane_offset_straight, drift.lane_heading_straight) == pytest.approx((0.6, 0.1), abs=1e-4)
    assert math.isnan(drift.lane_offset_curved)
    assert math.isnan(measure_drift(log, driven(scenes.Mover(y_m=4.0))).lane_offset_straight)  # in no lane
    crossing = driven(scenes.Mover(y_m=-0.6))
    crossing.heading.fill_(math.pi / 2)
    assert math.isnan(measure_drift(log, crossing).lane_offset_straight)


def test_lanes_of_a_small_radius_are_curved():
    """A circle of 50 m, driven half a meter outside."""
    angle = np.linspace(0.0, math.pi, 100)
    circle = [(50.0 * math.sin(a), 50.0 - 50.0 * math.cos(a)) for a in angle]
    lane = scenes.polylines([(MapFeatureType.LANE_SURFACE_STREET, circle)])
    mover = scenes.Mover(y_m=-0.5, speed_mps=8.0, turn_rate_radps=8.0 / 50.5)
    drift = measure_drift(scene(mover, map_features=lane), driven(mover))
    assert drift.lane_offset_curved == pytest.approx(0.5, abs=0.02)
    assert drift.lane_heading_curved == pytest.approx(0.0, abs=0.02)
    assert math.isnan(drift.lane_offset_straight)


def test_contacts_have_the_relative_speed_of_the_first_one():
    ego, oncoming = scenes.Mover(speed_mps=5.0), scenes.Mover(x_m=40.0, heading_rad=math.pi, speed_mps=7.0)
    drift = measure_drift(scene(ego, oncoming), driven(ego, oncoming))
    assert drift.contact_speed == pytest.approx(12.0, abs=1e-2)
    apart = measure_drift(scene(ego), driven(ego))
    assert math.isnan(apart.contact_speed)


def test_nothing_to_measure_is_nan():
    """A pedestrian that stands, without a map."""
    alone = scene(scenes.Mover(ObjectType.PEDESTRIAN, speed_mps=0.0), map_features=MapFeatures.of([]))
    assert all(map(math.isnan, measure_drift(alone, logged_states(alone, num_rollouts=1))))
