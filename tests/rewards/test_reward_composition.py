"""Sums of rewards, and their credit assignment."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from rlftsim.errors import ConfigError
from rlftsim.realism import AgentScores, compute_credit, meta_metric
from rlftsim.rewards import (
    REWARDS,
    compute_rewards,
    leave_one_out,
    parse_reward,
    register_agent_rewards,
    register_reward,
    reward_by_name,
)
from rlftsim.rewards.base import agent_rewards_by_name
from rlftsim.training.config import FinetuneConfig
from rlftsim.training.experience import compute_reward

EVERYTHING = "mloo + 0.5*rloo - 0.01*minade_rloo + 0.1*collision_offroad + 2*collision_offroad_ade"


@pytest.fixture
def outside():
    """Names of rewards that a test registers, forgotten after it."""
    names = ["test_one", "test_two"]
    yield names
    for name in names:
        REWARDS.remove(name)


def rewards_of(text, measured, **options):
    realism, rollouts, scenarios, _ = measured
    return compute_rewards(parse_reward(text), realism, rollouts, scenarios, **options)


def test_a_sum_is_the_weighted_sum_of_its_terms(measured):
    rewards = rewards_of(EVERYTHING, measured)
    expected = sum(t.weight * reward_by_name(t.name)(*measured[:3]) for t in rewards.terms)
    torch.testing.assert_close(rewards.total, expected)
    torch.testing.assert_close(rewards.by_term[2], reward_by_name("minade_rloo")(*measured[:3]))
    torch.testing.assert_close(rewards.by_agent, rewards.total[..., None].expand_as(rewards.by_agent))


def test_a_term_that_is_no_number_in_a_scenario_is_left_out_there(measured):
    realism, *rest = measured
    broken = realism.leave_one_out_meta_metric.clone()
    broken[1, 2] = torch.nan
    found = rewards_of("mloo + rloo", (replace(realism, leave_one_out_meta_metric=broken), *rest))
    alone = [rewards_of(name, measured).total for name in ("mloo", "rloo")]
    torch.testing.assert_close(found.total, torch.stack([alone[0][0] + alone[1][0], alone[1][1]]))
    assert found.is_missing.tolist() == [[False, True], [False, False]]


@pytest.mark.parametrize("name", ["collision_offroad", "collision_offroad_ade", "goal", "minade_rloo", "mloo", "rloo"])
def test_the_agents_rewards_add_up_to_the_reward_and_to_zero_over_rollouts(name, measured):
    realism, rollouts, scenarios, agents = measured
    split = agent_rewards_by_name(name)
    assert split is not None
    own = split(agents, rollouts, scenarios)
    reward = reward_by_name(name)(realism, rollouts, scenarios)
    assert own.shape == (2, 4, scenarios.agent_mask.shape[1])
    torch.testing.assert_close(own.sum(-1).float(), reward, atol=1e-6, rtol=1e-5)
    torch.testing.assert_close(own.sum(1), torch.zeros_like(own.sum(1)), atol=1e-5, rtol=0)
    assert not own[~scenarios.evaluated_mask[:, None].expand_as(own)].any()
    assert int((own.abs().amax(1) > 0).sum()) >= 2  # a split: more than one agent has a reward


def test_agent_rewards_stand_at_their_agents(measured):
    """The batch's agents come in track order, the metric's by object id."""
    _, _, scenarios, agents = measured
    for b, item in enumerate(agents.features):
        credit = compute_credit(item.log, item.features).mloo.sum(-1)
        ids = item.log.agents.evaluated_object_id.tolist()
        for place in scenarios.evaluated_mask[b].nonzero()[:, 0].tolist():
            expected = credit[:, ids.index(int(scenarios.object_id[b, place]))]
            torch.testing.assert_close(agents.leave_one_out[b, :, place], expected)


@pytest.mark.parametrize("credit_mixing", [0.0, 0.25, 1.0])
def test_an_agent_earns_its_own_reward_and_part_of_the_others(credit_mixing, measured):
    realism, rollouts, scenarios, agents = measured
    found = rewards_of("mloo", measured, agents=agents, credit_mixing=credit_mixing)
    own = agents.leave_one_out.float()
    evaluated = scenarios.evaluated_mask[:, None].expand_as(own)
    whole = found.total[..., None].expand_as(own)
    torch.testing.assert_close(found.by_agent[evaluated], (own + credit_mixing * (whole - own))[evaluated])
    torch.testing.assert_close(
        found.by_agent[~evaluated], credit_mixing * whole[~evaluated]
    )  # the others have no reward of their own
    torch.testing.assert_close(found.total, reward_by_name("mloo")(realism, rollouts, scenarios))


def test_with_full_mixing_credit_by_agent_is_credit_by_rollout(measured):
    by_rollout = rewards_of(EVERYTHING, measured)
    by_agent = rewards_of(EVERYTHING, measured, agents=measured[3], credit_mixing=1.0)
    torch.testing.assert_close(by_agent.by_agent, by_rollout.by_agent)
    assert not torch.allclose(
        rewards_of(EVERYTHING, measured, agents=measured[3], credit_mixing=0.5).by_agent, by_rollout.by_agent
    )


def test_a_reward_from_outside_is_credited_to_all_agents_until_it_has_a_split(measured, outside):
    one, two = outside

    @register_reward(one)
    def quiet(realism, rollouts, batch, *, scale: float = 1.0):
        return leave_one_out(-scale * realism.rollout_displacement_error)

    register_reward(two)(quiet)

    @register_agent_rewards(two)
    def quiet_by_agent(agents, rollouts, batch, *, scale: float = 1.0):
        return leave_one_out(-scale * agents.displacement_error)

    whole = rewards_of(f"{one}(scale=3)", measured, agents=measured[3], credit_mixing=0.0)
    torch.testing.assert_close(whole.by_agent, whole.total[..., None].expand_as(whole.by_agent))
    split = rewards_of(f"{two}(scale=3)", measured, agents=measured[3], credit_mixing=0.0)
    torch.testing.assert_close(split.total, whole.total)
    torch.testing.assert_close(split.by_agent.sum(-1), split.total, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(split.total, 3 * rewards_of("minade_rloo", measured).total)


def test_a_reward_of_the_wrong_shape_is_refused(measured, outside):
    register_reward(outside[0])(lambda realism, rollouts, batch: realism.meta_metric)
    with pytest.raises(ConfigError, match=r"reward test_one: .* gives shape \[2\], expected \[2, 4\]"):
        rewards_of(outside[0], measured)


@pytest.mark.parametrize(("value", "found"), [(None, "a NoneType"), (np.zeros((2, 4)), "a ndarray"), (0.5, "a float")])
def test_a_reward_that_gives_no_tensor_is_refused_by_name(value, found, measured, outside):
    register_reward(outside[0])(lambda realism, rollouts, batch: value)
    with pytest.raises(ConfigError, match=rf"reward test_one: .* gives {found}, expected \[2, 4\]: a tensor"):
        rewards_of(outside[0], measured)
    register_reward(outside[1])(lambda realism, rollouts, batch: realism.single_meta_metric)
    register_agent_rewards(outside[1])(lambda agents, rollouts, batch: value)
    with pytest.raises(ConfigError, match=rf"reward test_two: .* gives {found}, expected .*: a tensor"):
        rewards_of(outside[1], measured, agents=measured[3])


def test_a_split_that_is_no_number_counts_as_missing(measured, outside):
    register_reward(outside[0])(lambda realism, rollouts, batch: realism.single_meta_metric)
    register_agent_rewards(outside[0])(lambda agents, rollouts, batch: agents.displacement_error * torch.inf)
    found = rewards_of(outside[0], measured, agents=measured[3])
    assert found.is_missing.all()
    assert not found.by_agent.any()
    assert not found.total.any()


@pytest.mark.parametrize(
    ("function", "cause"),
    [
        (lambda x: x, "too many positional arguments"),
        (lambda scores, rollouts, batch, scale: scale, "missing a required argument: 'scale'"),
        (lambda scores, rollouts, batch, *, scale: scale, "missing a required .*'scale'"),
    ],
)
def test_a_function_that_takes_other_arguments_than_a_reward_is_refused(function, cause, outside):
    message = rf"reward test_one: .* cannot be called with realism, rollouts and batch \({cause}\): take these three"
    with pytest.raises(ConfigError, match=message):
        register_reward(outside[0])(function)
    REWARDS.add(outside[0], function)  # as an entry point does
    with pytest.raises(ConfigError, match=message):
        FinetuneConfig(reward=f"mloo + 0.1*{outside[0]}")


def test_a_split_that_takes_other_arguments_is_refused(outside):
    register_reward(outside[0])(lambda realism, rollouts, batch: realism.single_meta_metric)
    with pytest.raises(ConfigError, match=r"reward test_one: .* cannot be called with"):
        register_agent_rewards(outside[0])(lambda agents: agents)


@pytest.mark.parametrize("credit", ["rollout", "agent"])
def test_all_rewards_together_measure_a_rollout_once(credit, measured, monkeypatch):
    _, rollouts, scenarios, _ = measured
    original, calls = meta_metric.compute_features, []

    def counted(*args, **options):
        calls.append(1)
        return original(*args, **options)

    monkeypatch.setattr(meta_metric, "compute_features", counted)
    config = FinetuneConfig(reward=EVERYTHING, credit=credit)
    realism, rewards, _ = compute_reward(scenarios, rollouts, config)
    assert len(calls) == scenarios.num_scenarios
    assert rewards.by_agent.shape == scenarios.agent_mask[:, None].expand(-1, 4, -1).shape
    torch.testing.assert_close(realism.meta_metric, measured[0].meta_metric)


def test_agent_scores_are_not_computed_where_credit_goes_to_rollouts(measured, monkeypatch):
    def refuse(*_):
        raise AssertionError("realism by agent without need")

    monkeypatch.setattr(AgentScores, "_scatter", refuse)
    _, rollouts, scenarios, _ = measured
    assert compute_reward(scenarios, rollouts, FinetuneConfig(reward=EVERYTHING))[1].total.isfinite().all()


def test_a_credit_mixing_of_more_than_one_is_refused():
    with pytest.raises(ConfigError, match=r"credit_mixing is a weight in \[0, 1\], got 1.5"):
        FinetuneConfig(credit_mixing=1.5)


def test_scores_by_agent_are_computed_on_first_use(measured):
    agents = AgentScores(measured[3].features, measured[3].config, measured[3].num_agents)
    assert "leave_one_out" not in vars(agents)
    _ = agents.collision
    assert "collision" in vars(agents)
    assert "leave_one_out" not in vars(agents)
