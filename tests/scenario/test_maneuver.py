import numpy as np
import pytest

from rlftsim.scenario.maneuver import classify_ego_maneuver
from rlftsim.scenario.shards import compute_index_row
from rlftsim.scenario.womd import scenario_from_bytes


def drive(message, turn_rad, speed_mps=8.0):
    """Let the ego drive at constant speed and turn evenly by `turn_rad` from step 10 on."""
    x, y = 0.0, 0.0
    for step, state in enumerate(message.tracks[message.sdc_track_index].states):
        heading = 3.0 + turn_rad * max(step - 10, 0) / 80  # starts near pi, so it wraps
        state.center_x, state.center_y = x, y
        state.heading = (heading + np.pi) % (2 * np.pi) - np.pi
        state.velocity_x, state.velocity_y = speed_mps * np.cos(heading), speed_mps * np.sin(heading)
        x, y = x + 0.1 * state.velocity_x, y + 0.1 * state.velocity_y
    return scenario_from_bytes(message.SerializeToString())


@pytest.mark.parametrize(
    ("turn_rad", "speed_mps", "expected"),
    [
        (0.0, 8.0, "straight"),
        (0.4, 8.0, "straight"),
        (1.6, 8.0, "left"),
        (-1.6, 8.0, "right"),
        (3.1, 8.0, "uturn"),
        (-3.1, 8.0, "uturn"),
        (0.0, 0.1, "stationary"),
    ],
)
def test_the_maneuver_of_the_ego_follows_from_its_turn(make_message, turn_rad, speed_mps, expected):
    assert classify_ego_maneuver(drive(make_message(), turn_rad, speed_mps)) == expected


def test_without_a_future_the_maneuver_is_unknown(make_message):
    assert classify_ego_maneuver(drive(make_message(num_steps=11), 0.0)) == "unknown"


def test_the_index_row_counts_what_is_there_at_the_current_step(make_message):
    message = make_message(num_tracks=5)  # types 1 2 3 1 2
    message.tracks[3].states[10].valid = False
    message.tracks[1].object_type = 4
    row = compute_index_row(scenario_from_bytes(message.SerializeToString()), "training")
    assert (row["scenario_id"], row["split"], row["num_steps"]) == ("0a1b", "training", 91)
    assert (row["num_vehicles"], row["num_pedestrians"], row["num_cyclists"], row["num_others"]) == (1, 1, 1, 1)
    assert (row["num_evaluated"], row["num_map_features"], row["num_map_points"], row["num_light_states"]) == (
        2,
        2,
        32,
        91,
    )
