import copy
import math
import shutil
from dataclasses import replace
from itertools import pairwise

import pytest
import torch
from safetensors.torch import load_file

import scenes
import tiny
from rlftsim.errors import ConfigError
from rlftsim.policies.smart.policy import SmartPolicy
from rlftsim.rollout.policy import Prediction
from rlftsim.scenario.batch import collate
from rlftsim.tokens.smoothing import neighbor_weights
from rlftsim.training.checkpoint import newest_checkpoint
from rlftsim.training.config import PretrainConfig
from rlftsim.training.data import trained_agents
from rlftsim.training.imitation import learning_rate, summed_loss
from rlftsim.training.run import train_policy
from rlftsim.training.run_folder import read_metrics


def test_a_tiny_model_learns_what_it_sees(vocabulary, drawn_scenarios, tmp_path):
    config = replace(tiny.PRETRAIN, epochs=15.0, batch_size=4, learning_rate=1e-2)
    train_policy(tiny.tiny_policy(vocabulary, tiny.WITHOUT_CHANCE), drawn_scenarios, tmp_path, config)
    lines = read_metrics(tmp_path)
    assert lines[0]["loss"] > math.log(48) / 2  # fresh weights know little about 48 tokens
    assert lines[-1]["loss"] < 0.6 * lines[0]["loss"]
    assert lines[-1]["accuracy"] > lines[0]["accuracy"] + 0.1


def test_gradients_do_not_depend_on_how_many_scenarios_are_in_memory(vocabulary, drawn_scenarios, tmp_path):
    found = []
    for size in (4, 3, 1):
        policy = tiny.tiny_policy(vocabulary, tiny.WITHOUT_CHANCE)
        config = replace(
            tiny.PRETRAIN, epochs=1.0, batch_size=4, micro_batch_size=size, max_trained_agents=None, gradient_clip=1e9
        )
        train_policy(policy, drawn_scenarios, tmp_path / str(size), config)
        found.append(tiny.gradients_of(policy))
    for gradients in found[1:]:
        for name, gradient in found[0].items():
            torch.testing.assert_close(gradients[name], gradient, atol=1e-6, rtol=1e-5, msg=name)


NEAR = {"radius_m": 100.0, "limit": None, "seed": 0}


def test_the_same_agents_are_trained_on_however_a_batch_is_cut(drawn_scenarios):
    few = {**NEAR, "limit": 5}
    whole = trained_agents(collate(drawn_scenarios), 4, **few)
    for row, scenario in enumerate(drawn_scenarios):
        alone = trained_agents(collate([scenario]), 4, **few)[0]
        assert torch.equal(alone, whole[row, : len(alone)]), scenario.scenario_id


def test_evaluated_agents_come_first_and_the_limit_holds():
    batch = collate([scenes.crowd(num_agents=60)])
    chosen = trained_agents(batch, 0, **{**NEAR, "limit": 12})
    assert int(chosen.sum()) == 12
    assert bool((chosen | ~batch.evaluated_mask).all())
    assert int(batch.evaluated_mask.sum()) == 8
    other = trained_agents(batch, 1, **{**NEAR, "limit": 12})
    assert not torch.equal(chosen, other)


def test_without_a_limit_all_agents_near_with_a_future_are_trained_on():
    batch = collate([scenes.with_gaps()])
    assert torch.equal(trained_agents(batch, 0, **NEAR), batch.agent_mask)
    assert torch.equal(trained_agents(batch, 0, **{**NEAR, "radius_m": 0.1}), batch.evaluated_mask)


def test_the_learning_rate_warms_up_and_falls_along_a_cosine():
    config = PretrainConfig(learning_rate=1.0, warmup_updates=4, final_lr_ratio=0.1)
    rates = [learning_rate(u, 24, config) for u in range(24)]
    assert rates[:4] == pytest.approx([0.25, 0.5, 0.75, 1.0])
    assert rates[4] == pytest.approx(1.0)
    assert rates[14] == pytest.approx(0.55)  # half-way: the mean of 1.0 and 0.1
    assert all(a >= b for a, b in pairwise(rates[3:]))
    assert rates[-1] > 0.1


class Weightless:
    """Has the methods of a model and is none."""

    def teacher_forced(self, scenarios, trained):
        raise AssertionError

    def save_pretrained(self, folder, *, card=""):
        raise AssertionError


def test_what_cannot_be_pre_trained_is_refused(drawn_scenarios, vocabulary, tmp_path):
    with pytest.raises(ConfigError, match="Weightless has no weights: there is nothing for pre-training to train"):
        train_policy(Weightless(), drawn_scenarios, tmp_path, tiny.PRETRAIN)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="no scenario to train on"):
        train_policy(tiny.tiny_policy(vocabulary), [], tmp_path, tiny.PRETRAIN)
    with pytest.raises(ConfigError, match="must be positive"):
        PretrainConfig(batch_size=0)


def test_the_loss_of_a_class_with_few_tokens_stays_a_plain_number(vocabulary, drawn_scenarios, tmp_path):
    assert not vocabulary.token_mask.all()  # some class has fewer tokens than the table has rows
    config = replace(tiny.PRETRAIN, epochs=0.25, label_smoothing=0.1)
    train_policy(tiny.tiny_policy(vocabulary), drawn_scenarios, tmp_path, config)
    assert read_metrics(tmp_path)[0]["loss"] < 20.0


def test_smoothing_may_go_to_the_tokens_near_the_target(vocabulary, drawn_scenarios, tmp_path):
    config = replace(tiny.PRETRAIN, epochs=0.25, batch_size=4, label_smoothing=0.3)
    losses = {}
    for kind in ("uniform", "spatial"):
        policy = tiny.tiny_policy(vocabulary, tiny.WITHOUT_CHANCE)
        train_policy(policy, drawn_scenarios, tmp_path / kind, replace(config, label_smoothing_kind=kind))
        losses[kind] = read_metrics(tmp_path / kind)[0]["loss"]
    batch = collate(drawn_scenarios)
    dist = tiny.tiny_policy(vocabulary, tiny.WITHOUT_CHANCE).teacher_forced(batch, batch.agent_mask)
    rows = dist.target_mask
    targets, classes = dist.target[rows], dist.class_id[rows]
    log_probs = dist.logits[rows].log_softmax(-1)
    weights = neighbor_weights(vocabulary, classes, targets)
    near = (weights * log_probs.clamp(min=-100)).sum(-1)
    expected = -(0.7 * log_probs.gather(-1, targets[:, None])[:, 0] + 0.3 * near).sum()
    assert float(summed_loss(dist, 0.3, vocabulary).loss.detach()) == pytest.approx(float(expected.detach()), rel=1e-4)
    assert losses["spatial"] != pytest.approx(losses["uniform"], rel=1e-3)


def test_the_entropy_of_predictions_is_logged(vocabulary, drawn_scenarios, tmp_path):
    policy = tiny.tiny_policy(vocabulary, tiny.WITHOUT_CHANCE)
    batch = collate(drawn_scenarios)
    dist = policy.teacher_forced(batch, batch.agent_mask)
    entropies = torch.distributions.Categorical(logits=dist.logits[dist.target_mask]).entropy()
    summed = summed_loss(dist, 0.0)
    entropy, count = summed.sums["entropy"], summed.count
    assert float(entropy / count) == pytest.approx(float(entropies.mean()), rel=1e-5)
    config = replace(tiny.PRETRAIN, epochs=1.0, batch_size=len(drawn_scenarios))
    train_policy(policy, drawn_scenarios, tmp_path, config)
    assert read_metrics(tmp_path)[0]["entropy"] == pytest.approx(float(entropies.mean()), rel=0.2)


def test_smoothing_among_near_tokens_needs_a_vocabulary(drawn_scenarios, tmp_path):
    class Wordless(torch.nn.Linear):
        def teacher_forced(self, scenarios, trained):
            raise AssertionError

        def save_pretrained(self, folder, *, card=""):
            raise AssertionError

    with pytest.raises(ConfigError, match=r"Wordless has no vocabulary.*label_smoothing_kind=uniform"):
        train_policy(
            Wordless(1, 1),
            drawn_scenarios,
            tmp_path,
            replace(tiny.PRETRAIN, label_smoothing=0.1, label_smoothing_kind="spatial"),
        )
    with pytest.raises(ConfigError, match=r"Wordless has no vocabulary.*still_weight=1"):
        train_policy(Wordless(1, 1), drawn_scenarios, tmp_path, replace(tiny.PRETRAIN, still_weight=0.1))


def test_standing_tokens_count_less(vocabulary, drawn_scenarios):
    batch = collate(drawn_scenarios)
    dist = tiny.tiny_policy(vocabulary, tiny.WITHOUT_CHANCE).teacher_forced(batch, batch.agent_mask)
    logits, target = dist.logits[dist.target_mask], dist.target[dist.target_mask]
    still = target == 0
    assert 0 < int(still.sum()) < len(still)
    for weight in (0.25, 1.0):
        weighed = logits.clone()
        weighed[:, 0] += math.log(weight)
        losses = torch.nn.functional.cross_entropy(weighed, target, reduction="none")
        found = summed_loss(dist, 0.0, still_weight=weight)
        expected = losses[~still].sum() + weight * losses[still].sum()
        assert float(found.loss.detach()) == pytest.approx(float(expected.detach()), rel=1e-5)
        assert float(found.count) == pytest.approx(int((~still).sum()) + weight * int(still.sum()))
        # The metrics are of the model's own probabilities.
        entropies = torch.distributions.Categorical(logits=logits).entropy()
        entropy = entropies[~still].sum() + weight * entropies[still].sum()
        assert float(found.sums["entropy"]) == pytest.approx(float(entropy.detach()), rel=1e-5)


def test_the_weight_of_standing_tokens_leaves_their_learned_probability_alone():
    """Without it a model says 0.15 * 0.9 / (0.15 * 0.9 + 0.1) = 57 % where 90 % of the data stand."""
    target = torch.tensor([0] * 90 + [1] * 7 + [2] * 3)
    counts, class_id = torch.ones(100, dtype=torch.bool), torch.zeros(100, dtype=torch.long)
    logits = torch.zeros(3, requires_grad=True)
    optimizer = torch.optim.LBFGS([logits], max_iter=100)

    def loss():
        optimizer.zero_grad()
        prediction = Prediction(logits.expand(100, 3), target, counts, class_id)
        value = summed_loss(prediction, 0.0, still_weight=0.15).loss
        value.backward()
        return value

    optimizer.step(loss)
    torch.testing.assert_close(logits.softmax(-1), torch.tensor([0.9, 0.07, 0.03]), atol=1e-3, rtol=0)


def test_the_average_of_the_weights_is_saved_and_resumes(vocabulary, drawn_scenarios, tmp_path):
    """Two runs: one in a piece, whose checkpoints are followed by hand, and one that is interrupted."""
    config = replace(tiny.PRETRAIN, ema_decay=0.5, checkpoint_every=1, epochs=1.0)
    weights = []

    class Followed(SmartPolicy):
        def teacher_forced(self, scenarios, trained):
            weights.append({k: v.clone() for k, v in self.network.state_dict().items()})
            return super().teacher_forced(scenarios, trained)

    torch.manual_seed(0)
    policy = Followed(tiny.MODEL, vocabulary)
    start = copy.deepcopy(policy)
    train_policy(policy, drawn_scenarios, tmp_path / "whole", config)
    last = load_file(newest_checkpoint(tmp_path / "whole" / "checkpoints") / "policy.safetensors")
    weights.append({name.removeprefix("network."): value for name, value in last.items()})
    saved = load_file(tmp_path / "whole" / "model" / "model.safetensors")
    assert all(torch.equal(value, policy.network.state_dict()[name]) for name, value in saved.items())
    for name, value in saved.items():
        mean = weights[0][name]
        for update, later in enumerate(weights[1:], start=1):
            decay = min(0.5, (1 + update) / (10 + update))
            mean = decay * mean + (1 - decay) * later[name]
        torch.testing.assert_close(value, mean, atol=1e-6, rtol=1e-5, msg=name)
    # a run that was stopped after its second update ends with the same bits
    shutil.copytree(tmp_path / "whole", tmp_path / "cut")
    shutil.rmtree(tmp_path / "cut" / "model")
    for path in sorted((tmp_path / "cut" / "checkpoints").iterdir())[1:]:
        shutil.rmtree(path)
    train_policy(start, drawn_scenarios, tmp_path / "cut", config)
    again = load_file(tmp_path / "cut" / "model" / "model.safetensors")
    assert all(torch.equal(value, again[name]) for name, value in saved.items())


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"still_weight": 1.5}, "still_weight is a weight"),
        ({"still_weight": 0.0}, "still_weight is a weight"),
        ({"ema_decay": 1.0}, "ema_decay is"),
        ({"mirror_probability": -0.1}, "mirror_probability is a probability"),
    ],
)
def test_impossible_weights_are_refused(setting, message):
    with pytest.raises(ConfigError, match=message):
        PretrainConfig(**setting)
