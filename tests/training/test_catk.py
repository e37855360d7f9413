"""CAT-K as a training loop: what its rollouts choose, that it learns, and what counts."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import rlftsim as rs
import tiny
from catk_loss import catk_loss
from rlftsim.errors import ConfigError
from rlftsim.rollout.baselines import ConstantVelocity
from rlftsim.rollout.policy import Sampling
from rlftsim.rollout.simulate import simulate
from rlftsim.scenario.batch import collate
from rlftsim.scenario.types import CURRENT_STEP
from rlftsim.training.catk_rollouts import roll_out_closest
from rlftsim.training.config import CatkConfig
from rlftsim.training.run import train_policy
from rlftsim.training.run_folder import read_metrics

ENDS = slice(4, None, 5)
"""Steps of a rollout at which decisions end."""


@pytest.fixture
def policy(vocabulary):
    return tiny.tiny_policy(vocabulary, tiny.WITHOUT_CHANCE).eval()


@pytest.fixture(scope="module")
def batch(drawn_scenarios):
    return collate(drawn_scenarios)


def distance_from_log(batch, rollouts):
    """Mean distance at the ends of decisions, meters, where logged."""
    future = slice(CURRENT_STEP + 1, None)
    off = (rollouts.position[:, 0] - batch.position[:, :, future])[:, :, ENDS].norm(dim=-1)
    return off[batch.valid[:, :, future][:, :, ENDS]].mean()


def test_with_one_candidate_it_is_a_greedy_rollout(policy, batch):
    greedy = simulate(policy, batch, num_rollouts=1, seed=0, sampling=Sampling(temperature=0.0))
    for choice in ("closest", "top_k"):
        targeted = roll_out_closest(policy, batch, num_candidates=1, choice=choice)
        assert torch.equal(targeted.rollouts.decision, greedy.decision)


@pytest.mark.parametrize("name", ["demo-tuned", "demo-fast"])
def test_calibrated_models_and_students_keep_near_the_log(name):
    policy, batch = rs.load_policy(name), collate([rs.load_dataset("synthetic", "validation")[0]])
    near, greedy = (roll_out_closest(policy, batch, num_candidates=count).rollouts for count in (32, 1))
    assert distance_from_log(batch, near) < 0.5 * distance_from_log(batch, greedy)


def test_with_all_candidates_it_decides_as_it_should(policy, batch, vocabulary):
    targeted = roll_out_closest(policy, batch, num_candidates=vocabulary.num_tokens)
    logged = targeted.target_mask
    assert torch.equal(targeted.rollouts.decision[logged], targeted.target[logged])


def test_the_nearest_token_drawn_alone_is_the_target(policy, batch):
    targeted = roll_out_closest(policy, batch, num_candidates=1, choice="trajeglish")
    logged = targeted.target_mask
    assert torch.equal(targeted.rollouts.decision[logged], targeted.target[logged])


def test_more_candidates_keep_nearer_to_the_log_than_chance(policy, batch):
    by_chance = roll_out_closest(policy, batch, num_candidates=24, choice="top_k", seed=1)
    again = roll_out_closest(policy, batch, num_candidates=24, choice="top_k", seed=2)
    assert not torch.equal(by_chance.rollouts.decision, again.rollouts.decision)
    few, many = (roll_out_closest(policy, batch, num_candidates=k) for k in (4, 24))
    drawn_near = roll_out_closest(policy, batch, num_candidates=4, choice="trajeglish", seed=1)
    off = [float(distance_from_log(batch, p.rollouts)) for p in (many, few, by_chance, drawn_near)]
    assert off[0] < off[1] < off[2]
    assert off[3] < off[2]


def test_road_imitates_the_nearest_of_its_own_samples(policy, batch):
    """More samples keep nearer to the log, and what was taken is what is learned."""
    found = {}
    for count in (1, 4, 64):
        targeted = roll_out_closest(policy, batch, num_candidates=count, choice="sampled", targets="taken", seed=3)
        assert torch.equal(targeted.target, targeted.rollouts.decision)
        again = roll_out_closest(policy, batch, num_candidates=count, choice="sampled", targets="taken", seed=3)
        assert torch.equal(again.target, targeted.target)
        found[count] = float(distance_from_log(batch, targeted.rollouts))
    assert found[1] > found[4] > found[64]


def test_samples_of_an_agent_do_not_depend_on_its_batch(policy, batch):
    options = {"num_candidates": 8, "choice": "sampled", "num_rollouts": 2, "seed": 3}
    together = roll_out_closest(policy, batch, **options).rollouts.decision
    assert batch.num_scenarios > 1
    for row, scenario in enumerate(batch.scenarios):
        alone = roll_out_closest(policy, collate([scenario]), **options).rollouts.decision[0]
        assert torch.equal(alone, together[row, :, : alone.shape[1]])


def test_a_single_sample_has_the_policys_probabilities(policy, batch):
    """Without the log's guidance the first tokens of many rollouts are distributed as the policy says."""
    context = policy.encode(batch)
    rollouts = [
        roll_out_closest(policy, batch, num_candidates=1, choice="sampled", seed=seed, context=context).rollouts
        for seed in range(30)
    ]
    agents = batch.agent_mask.flatten()
    first = torch.stack([one.decision[:, 0, :, 0].flatten()[agents] for one in rollouts], 1)  # [agents, 30]
    drawn = simulate(policy, batch, num_rollouts=300, seed=1, context=context).decision
    drawn = drawn[..., 0].movedim(1, 2).flatten(0, 1)[agents]  # [agents, 300]
    common = drawn.mode(-1, keepdim=True).values
    p, q = ((tokens == common).double().mean(-1) for tokens in (first, drawn))
    assert abs(float((p - q).mean())) < 4 * float((q * (1 - q) * (1 / 30 + 1 / 300)).sum().sqrt() / len(q))


def test_what_has_strayed_does_not_count_with_max_distance_lengths(policy, batch):
    targeted = roll_out_closest(policy, batch, num_candidates=4, choice="top_k", seed=3)
    strict = roll_out_closest(policy, batch, num_candidates=4, choice="top_k", seed=3, max_distance_lengths=1.0)
    assert torch.equal(strict.rollouts.decision, targeted.rollouts.decision)
    # by hand: cars of 4.8 m, pedestrians and cyclists of 1 and 2 m, from where they stand before each decision
    length = torch.tensor([0.0, 4.8, 1.0, 2.0, 4.8])[batch.object_type]
    before = torch.cat(
        [batch.position[:, :, None, CURRENT_STEP], targeted.rollouts.position[:, 0, :, ENDS][:, :, :-1]], 2
    )
    steps = range(CURRENT_STEP, 86, 5)
    off = (before - batch.position[:, :, steps]).norm(dim=-1)
    plain = batch.valid[:, :, CURRENT_STEP:].all(-1) & batch.agent_mask  # no gap that would be filled
    near = (off <= length[..., None]) & targeted.target_mask[:, 0]
    clear = plain[..., None] & ((off - length[..., None]).abs() > 0.5)  # history tokens lead beside the log a little
    assert bool((strict.target_mask[:, 0] == near)[clear].all())
    assert 0 < int(strict.target_mask.sum()) < int(targeted.target_mask.sum())


def test_a_few_updates_lower_the_closed_loop_loss(vocabulary, drawn_scenarios, batch, tmp_path):
    policy = tiny.tiny_policy(vocabulary, tiny.WITHOUT_CHANCE)
    trained = batch.agent_mask

    def loss():
        return float(catk_loss(policy, batch, roll_out_closest(policy, batch, num_candidates=8), trained).detach())

    before, frozen = loss(), policy.network.map_encoder.token.state_dict()
    frozen = {name: value.clone() for name, value in frozen.items()}
    train_policy(policy, drawn_scenarios, tmp_path, replace(tiny.CATK, epochs=10.0, batch_size=4, learning_rate=1e-2))
    assert loss() < 0.7 * before
    assert all(
        torch.equal(frozen[name], value) for name, value in policy.network.map_encoder.token.state_dict().items()
    )
    lines = read_metrics(tmp_path)
    assert lines[-1]["learning_rate"] < 0.1e-2  # a cosine to 5 %
    assert lines[0]["loss"] == pytest.approx(before, abs=1e-4)  # the same rollouts and the same agents


@pytest.mark.parametrize("stage", ["pretrain", "catk"])
def test_where_nothing_counts_the_loss_is_zero(stage, vocabulary, drawn_scenarios, tmp_path):
    [scenario] = drawn_scenarios[:1]
    valid = scenario.tracks.valid.copy()
    valid[:, CURRENT_STEP + 1 :] = False  # logged until now, and never again
    alone = replace(scenario, tracks=replace(scenario.tracks, valid=valid))
    policy = tiny.tiny_policy(vocabulary)
    tiny.train(stage, policy, [alone], tmp_path, epochs=1.0)
    [line] = read_metrics(tmp_path)
    assert (line["loss"], line["gradient_norm"], line["predictions"]) == (0.0, 0.0, 0.0)
    assert all(bool(p.isfinite().all()) for p in policy.parameters())


@pytest.mark.parametrize("stage", ["pretrain", "catk"])
def test_half_precision_moves_the_loss_by_less_than_two_percent(stage, vocabulary, drawn_scenarios, tmp_path):
    found = []
    for precision in ("32-true", "bf16-mixed"):
        policy = tiny.tiny_policy(vocabulary, tiny.WITHOUT_CHANCE)
        device = replace(tiny.CPU, precision=precision)
        tiny.train(stage, policy, drawn_scenarios, tmp_path / precision, epochs=1.0, batch_size=4, device=device)
        found.append((read_metrics(tmp_path / precision)[0], tiny.gradients_of(policy)))
    (exact, gradients), (mixed, mixed_gradients) = found
    assert mixed["loss"] != exact["loss"]
    assert mixed["loss"] == pytest.approx(exact["loss"], rel=0.02)
    assert mixed["gradient_norm"] == pytest.approx(exact["gradient_norm"], rel=0.2)
    assert mixed_gradients.keys() == gradients.keys()  # none was lost on the way


def test_what_cannot_be_fine_tuned_is_refused(vocabulary, drawn_scenarios, tmp_path):
    with pytest.raises(ConfigError, match="ConstantVelocity has no weights"):
        train_policy(ConstantVelocity(), drawn_scenarios, tmp_path, tiny.CATK)
    with pytest.raises(ConfigError, match="num_candidates must be positive"):
        CatkConfig(num_candidates=0)
    with pytest.raises(ConfigError, match="max_distance_lengths must be positive"):
        CatkConfig(max_distance_lengths=0.0)


def test_published_numbers_are_the_defaults():
    config = CatkConfig()
    assert (config.learning_rate, config.final_lr_ratio, config.label_smoothing) == (5e-5, 0.05, 0.0)
    assert (config.batch_size, config.num_candidates, config.gradient_clip) == (80, 32, 0.5)
    assert np.isclose(config.weight_decay, 0.01)
