"""Warnings of rollouts that cannot be."""

import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from rollout_drawing import draw_arrays, write_npz

import rlftsim as rs
import scenes
from rlftsim.evaluation.rollout_checks import warn_of_doubts
from rlftsim.evaluation.score_files import ScoreConfig, score_rollouts
from rlftsim.realism import SimulatedStates
from rlftsim.realism.from_rollouts import logged_states
from rlftsim.scenario.dataset import write_dataset

SCENARIO = scenes.straight_road()


@pytest.fixture
def warnings_of(capsys):
    def warnings(states, scenario=SCENARIO):
        warn_of_doubts(scenario, states, "x.npz")
        return capsys.readouterr().err.splitlines()

    return warnings


def states_of(arrays):
    return SimulatedStates(arrays["object_ids"], *(torch.from_numpy(arrays[a]) for a in ("x", "y", "z", "heading")))


def test_rollouts_that_go_on_from_the_log_are_taken_without_a_word(warnings_of):
    for scenario in (SCENARIO, scenes.with_gaps(), scenes.crowd(num_agents=9), scenes.lone_agent()):
        assert warnings_of(states_of(draw_arrays(scenario)), scenario) == []
        assert warnings_of(logged_states(scenario, num_rollouts=4), scenario) == []


def test_vehicles_that_back_up_are_taken_without_a_word(warnings_of):
    back = [scenes.Mover(y_m=4.0 * row, speed_mps=-5.0) for row in range(3)]
    scenario = scenes.build_scenario("back", back)
    assert warnings_of(logged_states(scenario, num_rollouts=2), scenario) == []


def test_steps_that_the_log_lacks_may_hold_anything(warnings_of):
    scenario = scenes.with_gaps()
    states, valid = logged_states(scenario, num_rollouts=1), scenario.tracks.valid[scenario.simulated_indices, 11:]
    assert not valid.all()
    lost = torch.where(torch.from_numpy(valid), states.x, torch.tensor(-9e3))
    assert warnings_of(replace(states, x=lost), scenario) == []


def test_another_frame_is_told_by_scenario_agent_and_distance(warnings_of):
    states = logged_states(SCENARIO, num_rollouts=1)
    (line,) = warnings_of(replace(states, x=states.x + 6000))
    assert line.startswith(f"x.npz: scenario straight: agent {states.object_id[0]}: ")
    count = len(states.object_id)
    assert f"{count} of {count} agents do not begin where the log stops" in line
    assert "this one 6000 m from there in rollout 0." in line


def test_steps_that_begin_with_the_current_one_are_told(warnings_of):
    tracks = SCENARIO.tracks
    late = {
        axis: torch.from_numpy(values[SCENARIO.simulated_indices, 10:90])[None]
        for axis, values in zip(("x", "y", "z", "heading"), (*np.moveaxis(tracks.position, -1, 0), tracks.heading))
    }
    (line,) = warnings_of(replace(logged_states(SCENARIO, num_rollouts=1), **late))
    assert "all agents that move begin with the log's current position" in line


@pytest.mark.filterwarnings("error")
def test_positions_whose_squares_no_number_holds_are_far(warnings_of):
    states = logged_states(SCENARIO, num_rollouts=1)
    assert "agents do not begin where the log stops" in warnings_of(replace(states, x=states.x + 3e38))[0]
    later = torch.cat([states.x[..., :40], states.x[..., 40:] + 1e30], -1)
    assert any("m in 0.1 s in rollout 0" in line for line in warnings_of(replace(states, x=later)))


@pytest.mark.parametrize(
    ("axis", "change", "text"),
    [
        ("x", lambda v: torch.cat([v[..., :40], v[..., 40:] + 9], -1), "a step of 9.[0-9] m in 0.1 s in rollout 0"),
        ("x", lambda v: v + 7 * torch.arange(80.0), "from its current position, beyond 480 m, in rollout 0"),
        ("z", lambda v: v + 30, "z is 30 m from that of the current step"),
        ("heading", lambda v: torch.rad2deg(v + 3), r"heading of \d{3} rad \(degrees\?\)"),
        (
            "heading",
            lambda v: v + np.pi / 2,
            "6 of 6 agents do not begin with the heading .* 90 degrees from it in r",
        ),
        ("heading", lambda v: v + np.radians(30), "6 of 6 agents do not begin with the heading .* 30 degrees from it"),
        ("heading", lambda v: v + np.pi, "6 of 6 agents do not begin with the heading .* 180 degrees from it in r"),
        ("heading", lambda v: v + torch.arange(80.0).clip(max=8) / 5, "4 of 4 .* faster than 3 m/s go sideways"),
        (
            "heading",
            lambda v: v + torch.arange(80.0).clip(max=8) / 15,
            "4 of 4 .* more than 20 degrees off the heading",
        ),
    ],
)
def test_what_no_road_user_does_is_told(warnings_of, axis, change, text):
    states = logged_states(SCENARIO, num_rollouts=1)
    lines = "\n".join(warnings_of(replace(states, **{axis: change(getattr(states, axis))})))
    assert re.search(text, lines), lines


@pytest.mark.parametrize("change", [torch.full((80,), 1.5), torch.arange(80.0).clip(max=8) / 5])
def test_headings_of_a_minority_of_rollouts_are_no_doubt_about_the_scenario(warnings_of, change):
    log = logged_states(SCENARIO, num_rollouts=1)
    x, y, z, heading = (values.repeat(8, 1, 1) for values in (log.x, log.y, log.z, log.heading))
    for count, is_told in ((3, False), (5, True)):
        turned = heading + (torch.arange(8) < count)[:, None, None] * change
        assert bool(warnings_of(SimulatedStates(log.object_id, x, y, z, turned))) == is_told


def test_files_with_agents_and_rollouts_exchanged_are_scored_with_a_warning(tmp_path, capsys):
    arrays = draw_arrays(SCENARIO, num_rollouts=len(SCENARIO.simulated_indices))
    swapped = {a: v.swapaxes(0, 1).copy() if v.ndim == 3 else v for a, v in arrays.items()}
    write_dataset(SCENARIO, tmp_path / "data")
    for name, values in (("right", arrays), ("swapped", swapped)):
        file = write_npz(tmp_path / f"{name}.npz", values)
        score_rollouts(file, tmp_path / "data", None, ScoreConfig(jobs=1), show_progress=False)
        assert ("m from there in rollout" in capsys.readouterr().err) == (name == "swapped")


def test_rollouts_in_python_are_warned_of_too(capsys):
    rollouts = rs.simulate("constant_velocity", SCENARIO, num_rollouts=2)
    rs.score(SCENARIO, rollouts)
    assert capsys.readouterr().err == ""
    rs.score(SCENARIO, replace(rollouts, position=rollouts.position + 50))
    assert "agents do not begin where the log stops" in capsys.readouterr().err
