"""The estimator on toys small enough to enumerate: expectations are sums over everything that can happen.

The parts are those of the package: its distribution, its baselines, its loss and, for proposition 1, its metric.
"""

import math
from dataclasses import dataclass
from itertools import pairwise, product

import pytest
import torch
from torch import Tensor

import scenes
from rlftsim.policies.distributions import TokenDistribution
from rlftsim.realism import SimulatedStates, score
from rlftsim.realism.from_rollouts import states_of_rollouts
from rlftsim.rewards import leave_one_out
from rlftsim.rewards.realism import compute_mloo
from rlftsim.rollout.baselines import ConstantVelocity
from rlftsim.rollout.policy import Sampling
from rlftsim.rollout.simulate import simulate
from rlftsim.scenario.batch import collate
from rlftsim.training.policy_gradient import agent_log_prob, policy_gradient_loss

NUM_TOKENS = 3


def random_logits(*shape, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(shape, generator=generator, dtype=torch.float64).requires_grad_()


class TwoDecisions:
    """One agent decides twice; the second distribution depends on the first decision. Nine rollouts can happen."""

    def __init__(self, seed=0):
        self.first, self.second = (
            random_logits(NUM_TOKENS, seed=seed),
            random_logits(NUM_TOKENS, NUM_TOKENS, seed=9 + seed),
        )
        self.parameters = (self.first, self.second)
        self.rollouts = torch.tensor(list(product(range(NUM_TOKENS), repeat=2)))

    def distribution(self, decisions):
        """At both decisions of rollouts [..., 2]."""
        logits = torch.stack([self.first.expand(*decisions.shape[:-1], -1), self.second[decisions[..., 0]]], -2)
        return TokenDistribution(logits.flatten(0, -2), torch.ones(decisions.shape, dtype=torch.bool))

    def log_prob(self, decisions):
        """Of whole rollouts [B, N, 2], as an update adds it up: [B, N]."""
        by_decision = self.distribution(decisions).log_prob(decisions)[:, :, None]
        return agent_log_prob(by_decision, torch.ones_like(by_decision, dtype=torch.bool), "sum").sum(-1)

    def probability(self):
        """Of each of `rollouts`."""
        return self.log_prob(self.rollouts[None])[0].exp()


def gradient(value: Tensor, parameters) -> Tensor:
    return torch.cat([g.flatten() for g in torch.autograd.grad(value, tuple(parameters), retain_graph=True)])


def groups(num_outcomes, num_rollouts):
    """Every way N rollouts can come out: [outcomes^N, N]."""
    return torch.tensor(list(product(range(num_outcomes), repeat=num_rollouts)))


def expected_estimate(reward, log_prob, probability, parameters):
    """Expected gradient of the loss: over all groups, each weighted by its probability."""
    weight = probability.detach().view(-1, *[1] * (reward.dim() - 1))
    return -gradient(policy_gradient_loss(weight * reward, log_prob, 1), parameters)


TABLE = torch.tensor([0.1, 0.9, 0.3, 0.7, 0.2, 0.0, 0.5, 1.0, 0.4], dtype=torch.float64)
"""What each of nine rollouts is worth."""


def test_the_score_has_mean_zero():
    """sum_d p(d) grad log p(d) = grad sum_d p(d) = 0: a reward that is the same for all pulls nowhere."""
    toy = TwoDecisions()
    for reward, pulls in ((torch.ones_like(TABLE), False), (TABLE, True)):
        found = expected_estimate(
            reward[:, None], toy.log_prob(toy.rollouts[:, None]), toy.probability(), toy.parameters
        )
        assert bool(found.abs().max() > 1e-2) == pulls
        assert pulls or found.abs().max() < 1e-14


def test_the_sampler_draws_what_the_score_takes_it_to_draw():
    """Over noise spread evenly, the mean score of the sampler's own draws is zero up to the grid."""
    logits = random_logits(1, 7)
    noise = ((torch.arange(5000) + 0.5) / 5000)[:, None].double()
    everywhere = TokenDistribution(logits.expand(5000, -1), torch.ones(5000, dtype=torch.bool))
    for sampling, is_biased in ((Sampling(), False), (Sampling(temperature=0.7), True)):
        decisions = everywhere.sample(sampling, noise)
        mean_score = gradient(everywhere.log_prob(decisions).mean(), [logits])
        assert bool(mean_score.abs().max() > 2 / 5000) == is_biased  # only the full softmax is what is scored


@pytest.mark.parametrize("num_rollouts", [2, 3])
def test_the_leave_one_out_baseline_leaves_the_expected_gradient_exact(num_rollouts):
    """E[sum_i (r_i - mean of the others) grad log p_i] = N grad E[r], over all groups of N rollouts."""
    toy = TwoDecisions()
    chosen = groups(9, num_rollouts)
    probability = toy.probability()[chosen].prod(-1)
    found = expected_estimate(
        leave_one_out(TABLE[chosen]), toy.log_prob(toy.rollouts[chosen]), probability, toy.parameters
    )
    expected = num_rollouts * gradient((toy.probability() * TABLE).sum(), toy.parameters)
    torch.testing.assert_close(found, expected, atol=1e-12, rtol=0)
    assert expected.abs().max() > 1e-2


def test_the_leave_one_out_baseline_makes_the_estimate_steadier():
    """Where all rollouts score high and differ little, as under the metric."""
    toy, worth = TwoDecisions(), 0.6 + 0.1 * TABLE
    chosen = groups(9, 3)
    probability = toy.probability().detach()[chosen].prod(-1)
    scores = torch.stack([gradient(toy.log_prob(r[None, None]).sum(), toy.parameters) for r in toy.rollouts])[chosen]
    spread = []
    for reward in (worth[chosen], leave_one_out(worth[chosen])):
        estimate = (reward[..., None] * scores).sum(1)  # [groups, parameters]
        mean = (probability[:, None] * estimate).sum(0)
        spread.append(float((probability[:, None] * (estimate - mean).square()).sum()))
    assert spread[1] < 0.1 * spread[0]


# ---- proposition 1, with the metric itself -------------------------------------------------------------------------


@dataclass(frozen=True)
class Metric:
    """What the realism metric says of groups out of three futures of one scenario."""

    alone: Tensor
    """RMM of each future [3]."""
    of_pairs: Tensor
    """RMM of every two, scored from scratch, in the order of `groups(3, 2)`."""
    mloo: Tensor
    """Rewards of every three, in the order of `groups(3, 3)`: [27, 3]."""

    def expected(self, logits):
        """Of two futures drawn one after the other."""
        return (torch.log_softmax(logits, -1)[groups(3, 2)].sum(-1).exp() * self.of_pairs).sum()

    def estimate(self, logits):
        """Mean of what an update with N = 3 and the reward `mloo` pulls along."""
        log_probs = torch.log_softmax(logits, -1)[groups(3, 3)]
        return expected_estimate(self.mloo, log_probs, log_probs.sum(-1).exp(), [logits])


@pytest.fixture(scope="module")
def metric():
    """Three futures that differ in much that the metric measures: driven on, half as fast, and swerving."""
    batch = collate([scenes.straight_road()])
    driven = states_of_rollouts(batch, simulate(ConstantVelocity(), batch, num_rollouts=1, seed=0))[0]
    slow = [0.5 * (values + values[..., :1]) for values in (driven.x, driven.y)]
    swerve = 3.0 * torch.sin(6 * torch.linspace(0, 1, 80))
    x, y = torch.cat([driven.x, slow[0], driven.x]), torch.cat([driven.y, slow[1], driven.y + swerve])
    futures = (x, y, driven.z.expand_as(x), driven.heading.expand_as(x))

    def score_group(chosen):
        states = SimulatedStates(driven.object_id, *(values[chosen] for values in futures))
        return score(batch.scenarios[0], states)

    return Metric(
        torch.tensor([float(score_group([k]).meta_metric) for k in range(3)]).double(),
        torch.tensor([float(score_group(pair).meta_metric) for pair in groups(3, 2)]).double(),
        compute_mloo(torch.stack([score_group(three).leave_one_out_meta_metric for three in groups(3, 3)])).double(),
    )


def test_mloo_estimates_the_gradient_of_the_expected_metric_of_one_rollout_less(metric):
    """Proposition 1: E[sum_i MLOO_i grad log p_i] = grad E[RMM of N - 1 rollouts], with N = 3, exactly."""
    logits = random_logits(3, seed=5)
    found, expected = metric.estimate(logits), gradient(metric.expected(logits), [logits])
    torch.testing.assert_close(found, expected, atol=1e-7, rtol=0)
    assert expected.abs().max() > 1e-2
    # and it is not the gradient of a single rollout's metric, to which groups mean nothing
    alone = gradient((torch.softmax(logits, -1) * metric.alone).sum(), [logits])
    assert (found - alone).abs().max() > 1e-3


def test_climbing_along_mloo_raises_the_metric_of_a_group(metric):
    logits, values = random_logits(3, seed=5), []
    for _ in range(20):
        values.append(metric.expected(logits).item())
        logits = (logits + 5.0 * metric.estimate(logits)).detach().requires_grad_()
    assert all(later > earlier for earlier, later in pairwise(values))


# ---- credit by agent -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Company:
    """Two agents decide once each, independently; agent a earns worth[a][its token][the other's token]."""

    worth: Tensor

    def estimate_and_truth(self, shared, num_rollouts=2):
        """Mean of the estimate with credit by agent over all groups, N times the gradient of the expected reward, the
        estimate's variance summed over weights."""
        logits = random_logits(2, NUM_TOKENS, seed=2)
        log_probs = torch.log_softmax(logits, -1)
        both = torch.tensor(list(product(range(NUM_TOKENS), repeat=2)))  # [9, agents]
        by_agent = torch.stack([log_probs[0, both[:, 0]], log_probs[1, both[:, 1]]], -1)  # [9, agents]
        probability = by_agent.sum(-1).exp()
        earned = torch.stack([self.worth[0, both[:, 0], both[:, 1]], self.worth[1, both[:, 1], both[:, 0]]], -1)
        chosen = groups(9, num_rollouts)
        own = leave_one_out(earned[chosen])  # [groups, N, agents]
        credit = own + shared * (own.sum(-1, keepdim=True) - own)
        frequency = probability.detach()[chosen].prod(-1)
        mean = expected_estimate(credit, by_agent[chosen], frequency, [logits])
        scores = torch.stack([gradient(by_agent[k, a], [logits]) for k in range(9) for a in range(2)]).view(9, 2, -1)
        each = (credit[..., None] * scores[chosen]).sum((1, 2))
        spread = float((frequency[:, None] * (each - mean).square()).sum())
        alone = [gradient((probability * earned[:, a]).sum(), [logits]).view(2, -1) for a in range(2)]
        return mean.view(2, -1), num_rollouts * torch.stack(alone), spread


def independent_company():
    worth = torch.tensor([[0.2, 1.0, 0.1], [0.9, 0.3, 0.5]], dtype=torch.float64)
    return Company(worth[..., None].expand(-1, -1, NUM_TOKENS))


@pytest.mark.parametrize("shared", [0.0, 0.3, 1.0])
def test_credit_by_agent_is_unbiased_where_agents_do_not_act_on_each_other(shared):
    found, truth, _ = independent_company().estimate_and_truth(shared)
    torch.testing.assert_close(found, truth.sum(0), atol=1e-12, rtol=0)
    assert truth.abs().max() > 1e-2


def test_the_less_is_shared_the_less_the_estimate_scatters():
    spread = [independent_company().estimate_and_truth(shared)[2] for shared in (0.0, 0.3, 1.0)]
    assert spread[0] < spread[1] < spread[2]
    assert spread[0] < 0.7 * spread[2]


@pytest.mark.parametrize("shared", [0.0, 0.3, 1.0])
def test_what_agents_do_to_each_other_counts_as_far_as_it_is_shared(shared):
    generator = torch.Generator().manual_seed(3)
    company = Company(torch.rand(2, NUM_TOKENS, NUM_TOKENS, generator=generator, dtype=torch.float64))
    found, truth, _ = company.estimate_and_truth(shared)  # truth[a, b]: of what a earns, along b's logits
    for b in range(2):
        expected = truth[b, b] + shared * truth[1 - b, b]
        torch.testing.assert_close(found[b], expected, atol=1e-12, rtol=0)
        assert truth[1 - b, b].abs().max() > 1e-3


# ---- KL ------------------------------------------------------------------------------------------------------------


def test_the_kl_of_a_decision_is_the_sum_over_the_vocabulary():
    logits, other = random_logits(1, 5, seed=1), random_logits(1, 5, seed=2)
    present = torch.ones(1, dtype=torch.bool)
    p, q = ([math.exp(x) for x in values[0].tolist()] for values in (logits, other))
    p, q = [x / sum(p) for x in p], [x / sum(q) for x in q]
    expected = sum(a * math.log(a / b) for a, b in zip(p, q))
    found = TokenDistribution(logits, present).kl(TokenDistribution(other, present))
    assert found.item() == pytest.approx(expected, rel=1e-12)
    assert expected > 0.1


def test_the_kl_per_decision_adds_up_to_that_of_whole_rollouts():
    """sum_tau p ln(p / q) = sum_tau p sum_l KL_l(tau): the mean over decisions is the KL of simulations."""
    toy, other = TwoDecisions(seed=0), TwoDecisions(seed=1)
    probability = toy.probability()
    by_decision = toy.distribution(toy.rollouts).kl(other.distribution(toy.rollouts))  # [9, 2]
    whole = (probability * (probability.log() - other.probability().log())).sum()
    assert (probability * by_decision.sum(-1)).sum().item() == pytest.approx(whole.item(), rel=1e-12)
    assert whole > 0.1
