"""Agreement of each feature and estimator with the official functions on small synthetic inputs."""

import numpy as np
import pytest
import torch
from realism_drawing import draw_map

from rlftsim.realism import METRIC_2025
from rlftsim.realism.agents import Trajectories
from rlftsim.realism.config import HISTOGRAM_FEATURES
from rlftsim.realism.features import compute_ground_speed, compute_kinematics, shrink_validity
from rlftsim.realism.interactive import PlanarAgents, compute_distance_to_nearest_object, compute_time_to_collision
from rlftsim.realism.likelihood import (
    LogTarget,
    RolloutCounts,
    compute_bin_edges,
    compute_likelihoods,
    compute_log_probabilities,
    count_bins,
    find_bins,
    histogram_table,
)
from rlftsim.realism.map_based import build_road_edges, compute_distance_to_road_edge
from rlftsim.realism.traffic_lights import build_signals, compute_traffic_light_violation
from rlftsim.scenario.types import LightStates, MapFeatures

pytestmark = pytest.mark.official
CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def units(shared):
    archive = np.load(shared / "golden" / "rmm" / "units.npz")
    return {name: archive[name] for name in archive.files}


def read(units, *names):
    return [torch.from_numpy(units[name]) for name in names]


def test_kinematics(units):
    x, y, z, heading, valid = read(units, "kin_x", "kin_y", "kin_z", "kin_heading", "kin_valid")
    for name, values in compute_kinematics((x, y, z), heading).items():
        official = torch.from_numpy(units[f"kin_{name}"])
        torch.testing.assert_close(values, official, atol=1e-6, rtol=1e-6, equal_nan=True)
    assert (shrink_validity(valid).numpy() == units["kin_speed_valid"]).all()
    assert (shrink_validity(shrink_validity(valid)).numpy() == units["kin_acceleration_valid"]).all()


def test_box_distance(units):
    states, valid, official = read(units, "box_states", "box_valid", "box_distance")
    # The 400 columns are steps, with sizes of their own.
    x, y, _, length, width, _, heading = states[None].unbind(-1)
    agents = PlanarAgents(x, y, heading, length, width, torch.tensor([0]), valid[None])
    distance = compute_distance_to_nearest_object(agents)[0, 0]
    torch.testing.assert_close(distance, official, atol=1e-5, rtol=1e-6)


def test_time_to_collision(units):
    x, y, length, width, heading, valid = read(
        units, "ttc_x", "ttc_y", "ttc_length", "ttc_width", "ttc_heading", "ttc_valid"
    )
    boxes = [values[None] for values in (x, y, heading, length, width)]
    agents = PlanarAgents(*boxes, torch.tensor([0, 1]), valid[None])
    seconds = compute_time_to_collision(agents, compute_ground_speed(x, y)[None])[0]
    torch.testing.assert_close(seconds, torch.from_numpy(units["ttc_seconds"]), atol=1e-5, rtol=0)


def cut_polylines(points, lengths):
    return np.split(points, np.cumsum(lengths)[:-1])


def test_road_edge_distance(units):
    polylines = cut_polylines(units["edge_points"], units["edge_lengths"])
    edges = build_road_edges(draw_map([(15, points) for points in polylines]), CPU)
    states = torch.from_numpy(units["edge_states"])
    x, y, z, length, width, height, heading = states.T
    agents = Trajectories(*(values.reshape(1, -1, 1) for values in (x, y, z, heading)))
    size = torch.stack([length, width, height], dim=-1)[:, None]
    distance = compute_distance_to_road_edge(agents, size, edges, max_pairs=1 << 14)
    torch.testing.assert_close(distance.flatten(), torch.from_numpy(units["edge_distance"]), atol=1e-5, rtol=0)


def test_traffic_light_violation(units):
    lanes = draw_map([(2, points) for points in cut_polylines(units["light_lane_points"], units["light_lane_lengths"])])
    lanes = MapFeatures(units["light_lane_ids"], lanes.feature_type, lanes.points, lanes.offsets)
    step, signal = np.nonzero(units["light_signal_present"])
    lights = LightStates(
        step.astype(np.int32),
        units["light_signal_lane"][signal],
        units["light_signal_state"][step, signal].astype(np.int8),
        units["light_signal_stop"][signal].astype(np.float32),
    )
    signals = build_signals(lanes, lights, CPU)
    x, y, valid = read(units, "light_x", "light_y", "light_valid")
    violation = compute_traffic_light_violation(
        x[None], y[None], valid[None, :, 1:], signals, first_step=0, max_pairs=1 << 14
    )[0]
    official = units["light_violation"]
    assert not official[:, 0].any()
    assert (violation.numpy() == official[:, 1:]).all()


@pytest.mark.parametrize("feature", HISTOGRAM_FEATURES)
def test_histogram_estimator_and_edges(units, feature):
    row, table = HISTOGRAM_FEATURES.index(feature), histogram_table(METRIC_2025, CPU)
    assert (compute_bin_edges(getattr(METRIC_2025, feature)) == units[f"est_{feature}_edges"]).all()
    log, sim = read(units, f"est_{feature}_log", f"est_{feature}_sim")
    values = torch.zeros(7, *sim.shape)
    values[row] = sim
    counts = count_bins(values, table).sum(0, keepdim=True)
    log_probability = compute_log_probabilities(counts, torch.tensor([5.0 * 80]), table)[0, row]
    queries = torch.zeros(7, log.numel())
    queries[row] = log.flatten()
    bins = find_bins(queries, table)[row].view(log.shape)
    official = torch.from_numpy(units[f"est_{feature}_loglik"])
    torch.testing.assert_close(log_probability.gather(-1, bins), official, atol=1e-6, rtol=0)


def test_bernoulli_estimator(units):
    log, sim, official = read(units, "est_bernoulli_log", "est_bernoulli_sim", "est_bernoulli_loglik")
    table, steps = histogram_table(METRIC_2025, CPU), torch.zeros(7, 1, 11)
    for agent in range(len(log)):
        agrees = (sim[:, agent] == log[agent]).sum().float()
        counts = RolloutCounts(torch.zeros(1, 7, 1, 11), agrees.expand(1, 3, 1), num_steps=80)
        target = LogTarget(steps, steps.sum((1, 2)), log[agent].expand(3, 1))
        likelihood = compute_likelihoods(counts, torch.tensor([float(len(sim))]), target, table)[0, -1]
        assert likelihood.log().item() == pytest.approx(official[agent].item(), abs=1e-5)
