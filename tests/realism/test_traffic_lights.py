import numpy as np
import torch
from realism_drawing import NO_LIGHTS, draw_map, draw_red_light, draw_street

from rlftsim.realism.traffic_lights import build_signals, compute_traffic_light_violation
from rlftsim.scenario.types import LightStates

CPU = torch.device("cpu")


def drive(lights, *, x=None, y=-2.0, map_features=None):
    """Steps at which an agent violates that drives along x = 0, 1, 2, ... 40 (or as given) at the given y."""
    signals = build_signals(map_features or draw_street(), lights, CPU)
    x = (torch.arange(41.0) if x is None else x)[None, None]
    valid = torch.ones(1, 1, 40, dtype=torch.bool)
    if signals is None:
        return []
    violation = compute_traffic_light_violation(
        x, torch.full_like(x, y), valid, signals, first_step=0, max_pairs=1 << 14
    )
    return (violation[0, 0].nonzero().squeeze(1) + 1).tolist()


def test_passing_the_stop_point_of_a_red_light_is_a_violation_at_that_step():
    assert drive(draw_red_light(at_x=20.5)) == [21]
    assert drive(draw_red_light(at_x=20.5, state=1)) == [21]  # a red arrow
    # Exactly on the stop point a step does not count as before nor as behind: it is never crossed.
    assert drive(draw_red_light(at_x=20.0)) == []


def test_other_states_other_lanes_and_unknown_lanes_forbid_nothing():
    assert drive(draw_red_light(at_x=20.5, state=6)) == []
    assert drive(draw_red_light(at_x=20.5, state=7)) == []  # flashing
    assert drive(draw_red_light(at_x=20.5), y=2.0) == []  # on the oncoming lane
    assert drive(draw_red_light(at_x=20.5, lane_id=999)) == []
    assert drive(NO_LIGHTS) == []


def test_the_lights_state_at_the_step_after_the_crossing_counts():
    assert drive(draw_red_light(at_x=20.5, steps=range(21, 91))) == []  # no stop point yet at step 20
    green_then_red = np.where(np.arange(91) >= 21, 4, 6).astype(np.int8)
    lights = draw_red_light(at_x=20.5)
    lights = LightStates(lights.step, lights.lane_id, green_then_red, lights.stop_point)
    assert drive(lights) == [21]


def test_a_light_listed_twice_at_a_step_has_the_last_listed_state():
    red, green = draw_red_light(at_x=20.5), draw_red_light(at_x=20.5, state=6)
    both = [
        np.stack(pair, 1).reshape(182, *pair[0].shape[1:]) for pair in zip(vars(red).values(), vars(green).values())
    ]
    assert drive(LightStates(*both)) == []


def test_a_shorter_lane_owns_a_segment_to_the_worlds_origin():
    # Stop point (30.5, -2), just beyond the lane's last point (30, -2). By the official rule (40.5 "away" from both of
    # the lane's segments) the first one serves as the stop segment: passing it forwards violates, backwards does not.
    lane, other_3, other_4 = (
        [[0.0, -2, 0], [10, -2, 0], [30, -2, 0]],
        [[x, 50.0, 0] for x in (0, 10, 20)],
        [[x, 50.0, 0] for x in (0, 10, 20, 30)],
    )
    lights, forwards = draw_red_light(at_x=30.5), torch.arange(41.0)
    longest = draw_map([(2, lane), (2, other_3)])
    assert drive(lights, map_features=longest) == [31]
    assert drive(lights, map_features=longest, x=forwards.flip(0)) == []
    # Next to a longer lane it gets a segment from (30, -2) to (0, 0), 0.5 m away and heading back: the other way round.
    shorter = draw_map([(2, lane), (2, other_4)])
    assert drive(lights, map_features=shorter) == []
    assert drive(lights, map_features=shorter, x=forwards.flip(0)) == [10]
