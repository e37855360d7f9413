"""Updates and rollouts of SMART on awkward scenes: nobody else, nothing to drive on, too many, only one kind."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.nn.functional import cross_entropy

import scenes
from catk_loss import catk_loss
from rlftsim.policies.smart.config import SmartConfig
from rlftsim.policies.smart.policy import SmartPolicy
from rlftsim.rollout.edge_scenes import edge_scenes
from rlftsim.rollout.simulate import simulate
from rlftsim.scenario.batch import collate
from rlftsim.scenario.types import ObjectType
from rlftsim.tokens.clustering import TokensConfig, build_vocabulary
from rlftsim.training.catk_rollouts import roll_out_closest
from rlftsim.training.data import trained_agents

SMALL = SmartConfig(
    dim=16, num_heads=2, head_dim=8, num_map_layers=1, num_decoder_layers=1, num_frequencies=4, max_agent_neighbors=12
)


def only_pedestrians(scenario):
    kinds = np.full_like(scenario.tracks.object_type, ObjectType.PEDESTRIAN)
    return replace(scenario, tracks=replace(scenario.tracks, object_type=kinds))


AWKWARD = edge_scenes(scenes.bend()) | {"only pedestrians": only_pedestrians(scenes.bend())}
SEEN_LATE = [name for name in AWKWARD if "first seen" in name]
"""Where the public code's quirks make a difference of kilometres, not of rounding."""
modes = pytest.mark.parametrize(
    ("name", "public"), [*((name, False) for name in AWKWARD), *((name, True) for name in SEEN_LATE)]
)


@pytest.fixture(scope="module")
def vocabulary():
    return build_vocabulary([scenes.bend()], TokensConfig(num_tokens=32, num_map_prototypes=8))[0]


def fresh(vocabulary, public):
    torch.manual_seed(5)
    return SmartPolicy(replace(SMALL, catk_compat=public), vocabulary)


def update(policy, loss):
    """One step of the optimizer; how many weights it moved."""
    before = {name: p.detach().clone() for name, p in policy.named_parameters()}
    assert loss.isfinite()
    assert loss > 0
    loss.backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in policy.parameters())
    torch.optim.AdamW((p for p in policy.parameters() if p.grad is not None), lr=1e-3).step()
    assert all(p.isfinite().all() for p in policy.parameters())
    return sum(not torch.equal(p, before[name]) for name, p in policy.named_parameters())


@modes
def test_a_pre_training_update(name, public, vocabulary):
    policy, batch = fresh(vocabulary, public).train(), collate([AWKWARD[name]])
    prediction = policy.teacher_forced(batch, trained_agents(batch, 0, radius_m=100.0, limit=32, seed=0))
    assert prediction.target_mask.any()
    moved = update(
        policy, cross_entropy(prediction.logits[prediction.target_mask], prediction.target[prediction.target_mask])
    )
    assert moved > 20


@modes
def test_a_closed_loop_update_and_rollouts_after_it(name, public, vocabulary):
    policy, batch = fresh(vocabulary, public).train(), collate([AWKWARD[name]])
    targeted = roll_out_closest(policy, batch, num_candidates=8, catk_compat=public)
    assert targeted.rollouts.decision_mask.sum() == 16 * batch.agent_mask.sum()
    moved = update(
        policy, catk_loss(policy, batch, targeted, trained_agents(batch, 0, radius_m=100.0, limit=32, seed=0))
    )
    assert moved > 20
    rollouts = simulate(policy.eval(), batch, num_rollouts=2, seed=0)
    assert rollouts.position.isfinite().all()
    assert (rollouts.log_prob[rollouts.decision_mask] < 0).all()
