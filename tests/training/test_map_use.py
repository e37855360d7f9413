"""Map use: loss without the map minus loss with it."""

import math
from dataclasses import replace

import pytest
import torch

import tiny
from rlftsim.rollout.baselines import ConstantVelocity
from rlftsim.scenario.batch import collate
from rlftsim.training.monitoring import describe_map_use, measure_map_use, predicts_tokens


def policy_of(vocabulary, **changes):
    return tiny.tiny_policy(vocabulary, replace(tiny.WITHOUT_CHANCE, **changes)).eval()


def test_a_model_that_cannot_see_the_map_has_no_use_of_it(vocabulary, drawn_scenarios):
    batch = collate(drawn_scenarios)
    blind = describe_map_use(measure_map_use(policy_of(vocabulary, agent_map_radius_m=1e-3), batch))
    assert blind["map_use"] == pytest.approx(0.0, abs=1e-6)
    assert blind["map_use_turning"] == pytest.approx(0.0, abs=1e-5)
    seeing = describe_map_use(measure_map_use(policy_of(vocabulary), batch))
    assert abs(seeing["map_use"]) > 1e-4


def test_the_loss_is_that_of_the_vehicles(vocabulary, drawn_scenarios):
    batch, policy = collate(drawn_scenarios), policy_of(vocabulary)
    found = measure_map_use(policy, batch)
    with torch.no_grad():
        said = policy.teacher_forced(batch, batch.agent_mask)
    rows = said.target_mask & (said.class_id == 0)
    assert int(found[0, 0]) == int(rows.sum())
    loss = torch.nn.functional.cross_entropy(said.logits[rows], said.target[rows])
    assert describe_map_use(found)["loss"] == pytest.approx(float(loss), rel=1e-5)
    # turning tokens: those whose end box is rotated by more than 0.06 rad against the start box
    first, second = vocabulary.end_corners()[0, said.target[rows]][:, :2].unbind(1)
    back, other = vocabulary.corners[0, said.target[rows], 0][:, :2].unbind(1)
    turned = torch.atan2(*(first - second).flip(-1).unbind(-1)) - torch.atan2(*(back - other).flip(-1).unbind(-1))
    assert int(found[1, 0]) == int((torch.remainder(turned + math.pi, 2 * math.pi) - math.pi).abs().gt(0.06).sum())


def test_batches_add_up(vocabulary, drawn_scenarios):
    policy = policy_of(vocabulary)
    whole = measure_map_use(policy, collate(drawn_scenarios))
    parts = torch.zeros(2, 3, dtype=torch.float64)
    for scenario in drawn_scenarios:
        parts += measure_map_use(policy, collate([scenario]))
    torch.testing.assert_close(parts, whole, rtol=1e-4, atol=1e-3)
    assert math.isnan(describe_map_use(torch.zeros(2, 3))["map_use"])


def test_only_policies_that_predict_tokens_can_be_measured(vocabulary):
    assert predicts_tokens(policy_of(vocabulary))
    assert not predicts_tokens(ConstantVelocity())
