"""Mirrored scenarios: the metric sees no difference, and a mirror twice is none."""

from dataclasses import fields, is_dataclass

import numpy as np
import pytest

import scenes
from rlftsim.realism import scenario_log
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.scenario.mirror import mirror_scenario
from rlftsim.scenario.synthetic import pack_path


@pytest.fixture(scope="module", params=["bend", "pack"])
def scenario(request):
    return scenes.bend() if request.param == "bend" else ScenarioDataset(pack_path(), "validation")[0]


def assert_equal(one, other):
    if is_dataclass(one):
        for field in fields(one):
            assert_equal(getattr(one, field.name), getattr(other, field.name))
    else:
        np.testing.assert_array_equal(one, other)


def test_a_mirror_twice_is_none(scenario):
    assert_equal(mirror_scenario(mirror_scenario(scenario)), scenario)


def test_the_metric_measures_the_same_but_for_the_sign_of_turns(scenario):
    ours, seen = scenario_log(scenario).features, scenario_log(mirror_scenario(scenario)).features
    signs = {"angular_speed": -1, "angular_acceleration": -1}
    for field in fields(ours):
        value, other = getattr(ours, field.name), getattr(seen, field.name)
        if field.name != "repeat":
            np.testing.assert_allclose(other, signs.get(field.name, 1) * value, atol=2e-3, err_msg=field.name)
    assert (ours.distance_to_road_edge < 0).any()


def test_left_turns_become_right_turns_and_left_neighbors_right_ones(scenario):
    seen = mirror_scenario(scenario)
    assert np.array_equal(seen.tracks.heading, -scenario.tracks.heading)
    for name in ("neighbors", "boundaries"):
        ours, theirs = (getattr(one.map_features.topology, name) for one in (scenario, seen))
        assert np.array_equal(theirs[:, 1], 1 - ours[:, 1])
        assert np.array_equal(np.delete(theirs, 1, 1), np.delete(ours, 1, 1))
