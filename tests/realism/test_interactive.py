import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from rlftsim.realism.interactive import (
    FAR_M,
    PlanarAgents,
    _compute_box_distance,
    _compute_gaps,
    _list_pairs,
    compute_distance_to_nearest_object,
    compute_time_to_collision,
)


def draw_boxes(rows, *, valid=None):
    """Boxes (x, y, heading, length, width) at one step of one rollout, the first one evaluated."""
    shape = (1, len(rows), 1)
    boxes = [column.reshape(shape) for column in torch.tensor(rows, dtype=torch.float32).T]
    valid = None if valid is None else torch.tensor(valid).view(shape)
    return PlanarAgents(*boxes, torch.tensor([0]), valid)


def draw_crowd(seed, num_agents, num_evaluated, *, with_validity=False):
    """Boxes thrown on a small square at 5 steps of 2 rollouts, far from the origin as in a log."""
    generator = torch.Generator().manual_seed(seed)
    position = 3000 + 40 * torch.rand(2, 2, num_agents, 5, generator=generator)
    heading = 2 * math.pi * torch.rand(2, num_agents, 5, generator=generator) - math.pi
    length, width = (
        1 + 5 * torch.rand(1, num_agents, 1, generator=generator),
        0.5 + torch.rand(1, num_agents, 1, generator=generator),
    )
    valid = torch.rand(2, num_agents, 5, generator=generator) < 0.7 if with_validity else None
    evaluated = torch.randperm(num_agents, generator=generator)[:num_evaluated]
    return PlanarAgents(position[0], position[1], heading, length, width, evaluated, valid)


def list_all_pairs(agents):
    num_rollouts, num_agents, num_steps = agents.x.shape
    mask = torch.ones(num_rollouts, len(agents.evaluated), num_agents, num_steps, dtype=torch.bool)
    mask[:, torch.arange(len(agents.evaluated)), agents.evaluated] = False
    if agents.valid is not None:
        mask &= agents.valid[:, None]
    return _list_pairs(mask, agents)


@pytest.mark.parametrize(
    ("other", "expected"),
    [
        # Boxes 4 x 2: rounding 0.7, cores 2.6 x 0.6. Behind each other: 6 - 4.
        ((6.0, 0.0, 0.0, 4.0, 2.0), 2.0),
        # Corner to corner: cores apart by (6 - 2.6, 4 - 0.6), less twice the rounding.
        ((6.0, 4.0, 0.0, 4.0, 2.0), 3.4 * math.sqrt(2) - 1.4),
        # Concentric: 0.6 to leave the core sideways, 1.4 of rounding.
        ((0.0, 0.0, 0.0, 4.0, 2.0), -2.0),
        # Crosswise in front: 6 - 2 - 1.
        ((6.0, 0.0, math.pi / 2, 4.0, 2.0), 3.0),
    ],
)
def test_distance_between_two_boxes(other, expected):
    agents = draw_boxes([(0.0, 0.0, 0.0, 4.0, 2.0), other])
    assert compute_distance_to_nearest_object(agents).item() == pytest.approx(expected, abs=1e-5)


def test_a_truck_passing_closely_counts_although_its_center_is_farther():
    # Truck 20 m long beside the ego: sides 1 m apart; the car ahead is 2 m away with a nearer center.
    truck, car = (8.0, 3.0, 0.0, 20.0, 2.0), (6.0, 0.0, 0.0, 4.0, 2.0)
    agents = draw_boxes([(0.0, 0.0, 0.0, 4.0, 2.0), car, truck])
    assert compute_distance_to_nearest_object(agents).item() == pytest.approx(1.0, abs=1e-5)


def test_no_other_valid_agent_gives_the_far_distance():
    ego, other = (0.0, 0.0, 0.0, 4.0, 2.0), (6.0, 0.0, 0.0, 4.0, 2.0)
    for agents in (
        draw_boxes([ego]),
        draw_boxes([ego, other], valid=[True, False]),
        draw_boxes([ego, other], valid=[False, True]),
    ):
        assert compute_distance_to_nearest_object(agents).item() == pytest.approx(FAR_M)


@settings(deadline=None)
@given(st.integers(0, 10_000), st.integers(2, 12), st.booleans())
def test_the_bound_on_pairs_changes_no_distance(seed, num_agents, with_validity):
    agents = draw_crowd(seed, num_agents, min(3, num_agents), with_validity=with_validity)
    pairs = list_all_pairs(agents)
    exhaustive = torch.full((2 * len(agents.evaluated) * 5,), FAR_M)
    exhaustive.scatter_reduce_(0, pairs.row, _compute_box_distance(agents, pairs), "amin")
    exhaustive = exhaustive.view(2, -1, 5)
    if agents.valid is not None:
        exhaustive[~agents.valid[:, agents.evaluated]] = FAR_M
    assert torch.equal(compute_distance_to_nearest_object(agents), exhaustive)


@pytest.mark.parametrize(
    ("leader", "leader_speed", "expected"),
    [
        # Gap 24 - 4 = 20 m, closing at 5 m/s.
        ((24.0, 0.0, 0.0, 4.0, 2.0), 5.0, 4.0),
        ((24.0, 0.0, 0.0, 4.0, 2.0), 10.0, 5.0),  # not closing
        ((24.0, 0.0, 0.0, 4.0, 2.0), 9.0, 5.0),  # 20 s: cut at the horizon
        ((-24.0, 0.0, 0.0, 4.0, 2.0), 5.0, 5.0),  # behind
        ((24.0, 1.75, 0.0, 4.0, 2.0), 5.0, 4.0),  # overlaps by 0.25 m only, but parallel
        ((24.0, 2.25, 0.0, 4.0, 2.0), 5.0, 5.0),  # beside
        ((24.0, 0.0, 2 * math.pi, 4.0, 2.0), 5.0, 5.0),  # headings are not wrapped
        ((24.0, 0.0, math.radians(80), 4.0, 2.0), 5.0, 5.0),  # crosses
        ((24.0, 0.0, 0.0, 4.0, 2.0), math.nan, 5.0),  # no speed known
    ],
)
def test_time_to_collision_with_one_agent_ahead(leader, leader_speed, expected):
    agents = draw_boxes([(0.0, 0.0, 0.0, 4.0, 2.0), leader])
    speed = torch.tensor([10.0, leader_speed]).view(1, 2, 1)
    assert compute_time_to_collision(agents, speed).item() == pytest.approx(expected, abs=1e-4)


def test_an_oblique_leader_needs_half_a_meter_of_overlap():
    # 45 degrees, 4 x 2: half extent across (2 + 1)/sqrt(2) = 2.1213, with the ego's half width 3.1213; along the same.
    speed = torch.tensor([10.0, 0.0]).view(1, 2, 1)
    for offset, expected in ((2.6, (24 - 2 - 2.1213) / 10), (2.7, 5.0)):
        agents = draw_boxes([(0.0, 0.0, 0.0, 4.0, 2.0), (24.0, offset, math.pi / 4, 4.0, 2.0)])
        assert compute_time_to_collision(agents, speed).item() == pytest.approx(expected, abs=1e-4)


def test_the_nearest_of_those_ahead_is_followed_even_if_the_next_one_is_slower():
    ego, near, far = (0.0, 0.0, 0.0, 4.0, 2.0), (14.0, 0.0, 0.0, 4.0, 2.0), (24.0, 0.0, 0.0, 4.0, 2.0)
    speed = torch.tensor([10.0, 10.0, 0.0]).view(1, 3, 1)
    assert compute_time_to_collision(draw_boxes([ego, near, far]), speed).item() == 5.0
    # Two at the same distance: the first in order, here the slower one.
    speed = torch.tensor([10.0, 5.0, 8.0]).view(1, 3, 1)
    assert compute_time_to_collision(draw_boxes([ego, near, near]), speed).item() == pytest.approx(2.0, abs=1e-4)


@settings(deadline=None)
@given(st.integers(0, 10_000), st.integers(2, 12), st.booleans())
def test_the_bound_on_pairs_changes_no_time_to_collision(seed, num_agents, with_validity):
    agents = draw_crowd(seed, num_agents, min(3, num_agents), with_validity=with_validity)
    speed = 15 * torch.rand(agents.x.shape, generator=torch.Generator().manual_seed(seed))
    speed[..., -1] = torch.nan
    pairs = list_all_pairs(agents)
    gap, is_followed = _compute_gaps(agents, pairs)
    expected = torch.full((2 * len(agents.evaluated) * 5,), 5.0)
    nearest = torch.full_like(expected, torch.inf)
    for pair in range(len(gap)):  # in track order within a row
        row = pairs.row[pair]
        if is_followed[pair] and gap[pair] < nearest[row]:
            approach = speed.flatten()[pairs.ego[pair]] - speed.flatten()[pairs.neighbor[pair]]
            nearest[row] = gap[pair]
            expected[row] = min(5.0, gap[pair] / approach) if approach > 0 else 5.0
    torch.testing.assert_close(compute_time_to_collision(agents, speed), expected.view(2, -1, 5), atol=1e-5, rtol=0)
