"""What the public code does by accident or habit, decided on purpose here.

The table is in docs/catk.md; other rows' tests stand elsewhere.
"""

import math
from dataclasses import fields, replace

import pytest
import torch
from test_properties import features, smart
from torch import nn

import scenes
from rlftsim.rollout.policy import Prediction
from rlftsim.scenario.batch import collate
from rlftsim.scenario.types import CURRENT_STEP, ObjectType
from rlftsim.tokens.agent_tokens import tokenize_agents
from rlftsim.tokens.clustering import TokensConfig, build_vocabulary
from rlftsim.tokens.map_tokens import tokenize_map
from rlftsim.tokens.vocabulary import CLASS_BOXES_M
from rlftsim.training.catk_rollouts import roll_out_closest
from rlftsim.training.config import DeviceConfig, PretrainConfig
from rlftsim.training.run import train_policy
from rlftsim.training.run_folder import read_metrics

STILL = (0.0, (0.0, 0.0))
NUM_TOKENS = 2048


@pytest.fixture(scope="module")
def vocabulary():
    config = TokensConfig(num_tokens=48, num_map_prototypes=16)
    return build_vocabulary([scenes.bend(), scenes.crowd(num_agents=40)], config)[0]


def near_map_tokens(policy, batch, count):
    """Map tokens that are among the nearest `count` of some agent at some step."""
    tokens = policy._tokenize(batch)
    pieces = tokenize_map(batch, policy.vocabulary.map_prototypes).position[0]
    nearest = torch.cdist(tokens.position[0][tokens.valid[0]], pieces).argsort(-1)[:, :count]
    return nearest.unique()


def test_a_cap_keeps_the_nearest_map_tokens_and_without_one_all_count(vocabulary):
    batch, reach = collate([scenes.bend()]), {"map_radius_m": 0.1, "agent_map_radius_m": 200.0}
    capped = smart(vocabulary, max_agent_map_neighbors=3, **reach).double()
    free = smart(vocabulary, max_agent_map_neighbors=None, **reach).double()
    near = near_map_tokens(capped, batch, 3)
    every = len(tokenize_map(batch, vocabulary.map_prototypes).heading[0])
    assert len(near) < every
    assert (features(capped, batch, *STILL) - features(capped, batch, *STILL, near)).abs().max() < 1e-9
    assert (features(free, batch, *STILL) - features(free, batch, *STILL, near)).abs().max() > 1e-3


def test_a_lorry_moves_in_tokens_of_a_car(vocabulary):
    scenario = scenes.bend()
    cars = scenario.tracks.object_type == ObjectType.VEHICLE
    size = scenario.tracks.size.copy()
    size[cars] = (17.0, 2.6, 3.5)
    lorries = replace(scenario, tracks=replace(scenario.tracks, size=size))
    a, b = (tokenize_agents(collate([s]), vocabulary) for s in (scenario, lorries))
    assert torch.equal(a.token_id, b.token_id)
    assert torch.equal(a.position, b.position)
    assert CLASS_BOXES_M[0] == (4.8, 2.0)


def test_tokenizing_leaves_its_input_as_it_was(vocabulary):
    batch = collate([scenes.with_gaps()])
    before = {f.name: getattr(batch, f.name).clone() for f in fields(batch) if torch.is_tensor(getattr(batch, f.name))}
    for public in (False, True):
        first, second = (
            tokenize_agents(batch, vocabulary, catk_compat=public),
            tokenize_agents(batch, vocabulary, catk_compat=public),
        )
        assert all(torch.equal(getattr(first, f.name), getattr(second, f.name)) for f in fields(first))
    assert all(torch.equal(getattr(batch, name), value) for name, value in before.items())


def test_dropout_is_active_in_closest_among_top_k_of_a_policy_that_trains(vocabulary):
    batch = collate([scenes.bend()])
    policy = smart(vocabulary, dropout=0.5)

    def decisions(seed):
        torch.manual_seed(seed)
        return roll_out_closest(policy, batch, num_candidates=2).rollouts.decision

    policy.train()
    assert not torch.equal(decisions(0), decisions(1))
    policy.eval()
    assert torch.equal(decisions(0), decisions(1))


# ---- losses --------------------------------------------------------------------------------------


class Oracle(nn.Module):
    """Gives the right token a probability, the others the rest."""

    def __init__(self, probability):
        super().__init__()
        self.probability = probability
        self.shift = nn.Parameter(torch.zeros(()))

    def teacher_forced(self, scenarios, trained):
        others = (1 - self.probability) / (NUM_TOKENS - 1)
        logits = torch.full((7, NUM_TOKENS), math.log(others))
        target = torch.arange(7)
        logits[target, target] = math.log(self.probability)
        return Prediction(
            logits + self.shift, target, torch.ones(7, dtype=torch.bool), torch.zeros(7, dtype=torch.int64)
        )

    def save_pretrained(self, folder, *, card=""):
        folder.mkdir()


def first_update(model, folder):
    config = PretrainConfig(epochs=1.0, batch_size=1, device=DeviceConfig(accelerator="cpu", threads=1))
    train_policy(model, [scenes.bend()], folder, config)
    return read_metrics(folder)[0]


def test_with_label_smoothing_the_loss_of_a_perfect_model_is_not_zero(tmp_path):
    # the best answer to a smoothed target is the target: 0.9 + 0.1 / 2048 on the right token; its entropy is 1.09 nats
    perfect = first_update(Oracle(0.9 + 0.1 / NUM_TOKENS), tmp_path / "perfect")
    confident = first_update(Oracle(0.999), tmp_path / "confident")
    assert perfect["loss"] == pytest.approx(1.0874, abs=1e-3)
    assert perfect["accuracy"] == 1.0
    assert confident["loss"] > perfect["loss"]


@pytest.mark.parametrize("catk_compat", [False, True])
def test_a_simulation_of_a_car_that_backs_up_begins_where_its_log_ends(vocabulary, catk_compat):
    batch = collate([scenes.build_scenario("back", (scenes.Mover(), scenes.Mover(x_m=30.0, speed_mps=-5.0)))])
    policy = smart(vocabulary, catk_compat=catk_compat)
    context = policy.encode(batch)
    state = policy.begin(context, 1, None, torch.zeros(1, 1, 2, 0))
    assert torch.equal(state.position[0, 0, 1], batch.position[0, 1, CURRENT_STEP])
    assert torch.equal(state.heading[0, 0, 1], batch.heading[0, 1, CURRENT_STEP])
    torch.testing.assert_close(context.history.motion[0, 0, 1, 1], torch.tensor([-2.5, 0.0]), atol=1e-3, rtol=0)
    # pre-training sees what the public code sees: the car stands where it was at first
    steps = policy._logged_steps(policy._tokenize(batch), slice(0, -1))
    assert (steps.position[0, 0, 1, 1] - batch.position[0, 1, CURRENT_STEP]).norm() > 4
