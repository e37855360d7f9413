"""REINFORCE as arithmetic: numbers small enough to redo on paper."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from rlftsim.training.policy_gradient import agent_log_prob, masked_sum, policy_gradient_loss

# one scenario, two rollouts, one agent, three decisions; the last decision of the second rollout does not count
LOG_PROB = torch.tensor([[[[-1.0, -2.0, -3.0]], [[-4.0, -6.0, -100.0]]]])
MASK = torch.tensor([[[[True, True, True]], [[True, True, False]]]])


# The mean divides by three decisions in both: dividing by two would let the outcome of a rollout weigh its gradient.
@pytest.mark.parametrize(("reduction", "expected"), [("mean", [-2.0, pytest.approx(-10 / 3)]), ("sum", [-6.0, -10.0])])
def test_a_rollouts_log_prob_is_over_the_decisions_that_count(reduction, expected):
    assert agent_log_prob(LOG_PROB, MASK, reduction).sum(-1).tolist() == [expected]


def test_a_rollout_in_which_nothing_counts_has_log_prob_zero():
    assert agent_log_prob(LOG_PROB, torch.zeros_like(MASK), "mean").tolist() == [[[0.0], [0.0]]]


def test_what_does_not_count_may_be_infinite():
    log_prob = torch.where(MASK, LOG_PROB, -torch.inf).requires_grad_()
    agent_log_prob(log_prob, MASK, "mean").sum().backward()
    assert log_prob.grad is not None
    assert log_prob.grad.isfinite().all()
    assert masked_sum(log_prob.detach(), MASK) == -16.0


def test_the_loss_is_minus_reward_times_log_prob_over_scenarios():
    reward = torch.tensor([[0.5, -0.5]])
    # -(0.5 * -2 + -0.5 * -5) / 1 = -1.5; with two scenarios in all, half of it
    assert float(policy_gradient_loss(reward, torch.tensor([[-2.0, -5.0]]), 1)) == -1.5
    assert float(policy_gradient_loss(reward, torch.tensor([[-2.0, -5.0]]), 2)) == -0.75


def test_no_gradient_flows_through_the_reward():
    reward = torch.tensor([[0.5, -0.5]], requires_grad=True)
    log_prob = torch.tensor([[-2.0, -5.0]], requires_grad=True)
    policy_gradient_loss(reward, log_prob, 1).backward()
    assert reward.grad is None
    assert log_prob.grad is not None
    assert log_prob.grad.tolist() == [[-0.5, 0.5]]


@given(st.lists(st.floats(-2, 2), min_size=2, max_size=2), st.floats(-3, 3))
def test_the_estimate_agrees_with_the_analytic_gradient_of_a_bandit(rewards, logit):
    """Two decisions with probabilities p and 1 - p: d/dlogit of the expected reward is p (1 - p) (r1 - r0)."""
    p = 1 / (1 + math.exp(-logit))
    theta = torch.tensor(logit, dtype=torch.float64, requires_grad=True)
    log_probs = torch.stack([torch.nn.functional.logsigmoid(-theta), torch.nn.functional.logsigmoid(theta)])
    # the expectation over draws, exactly: each decision's term weighted by how often it is drawn
    weights = torch.tensor([[1 - p, p]], dtype=torch.float64)
    loss = policy_gradient_loss(weights * torch.tensor([rewards], dtype=torch.float64), log_probs[None], 1)
    loss.backward()
    assert theta.grad is not None
    assert float(-theta.grad) == pytest.approx(p * (1 - p) * (rewards[1] - rewards[0]), abs=1e-9)
