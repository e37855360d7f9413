"""Street plans: connected, within bounds, the same for the same seed."""

import numpy as np
import pytest

from rlftsim.scenario.synthetic.street_plan import MAX_RADIUS_M, StreetPlan, draw_city_plan, draw_freeway_plan
from rlftsim.scenario.synthetic.sumo import draw_types


def draw(kind: str, seed: int) -> StreetPlan:
    rng = np.random.default_rng(seed)
    return draw_freeway_plan(rng) if kind == "freeway" else draw_city_plan(rng, quiet=kind == "quiet")


@pytest.mark.parametrize("kind", ["city", "quiet", "freeway"])
@pytest.mark.parametrize("seed", range(5))
def test_streets_join_their_nodes(kind, seed):
    plan = draw(kind, seed)
    places = {node.node_id: node.position for node in plan.nodes}
    for street in plan.streets:
        # A street's shape is its left border: beside a median, or on a ramp, that is some meters off the node.
        for end, node in ((0, street.from_node), (-1, street.to_node)):
            assert np.linalg.norm(street.points[end] - places[node]) < 25.0
        assert np.abs(street.points).max() < MAX_RADIUS_M + 25.0


def test_a_quiet_quarter_has_few_lights():
    lights = [sum(node.control == "traffic_light" for node in draw("quiet", seed).nodes) for seed in range(10)]
    busy = [sum(node.control == "traffic_light" for node in draw("city", seed).nodes) for seed in range(10)]
    assert sum(lights) < 0.3 * sum(busy)


def test_the_same_seed_draws_the_same_plan():
    first, second = draw("city", 4), draw("city", 4)
    for a, b in zip(first.streets, second.streets, strict=True):
        assert a.street_id == b.street_id
        np.testing.assert_array_equal(a.points, b.points)


def test_gutters_vary_between_streets_within_two_meters():
    plan = draw("city", 2)
    gutters = {lane.width_m for street in plan.streets for lane in street.lanes if lane.lane_type == "gutter"}
    assert len(gutters) > 5
    assert min(gutters) >= 0.3
    assert max(gutters) <= 2.0


def test_vehicle_sizes_are_those_of_real_boxes():
    rng = np.random.default_rng(0)
    cars = [kind for _ in range(40) for kind in draw_types(rng) if kind.vehicle_class == "passenger"]
    assert 4.5 < np.median([car.length_m for car in cars]) < 4.8
    assert 2.0 < np.median([car.width_m for car in cars]) < 2.15
