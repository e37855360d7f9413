"""The score function estimator on a toy whose gradient is known: two decisions of three categories each."""

from itertools import pairwise, product

import torch

NUM_CATEGORIES = 3


class Toy(torch.nn.Module):
    """Two decisions; the second one's distribution depends on the first decision."""

    def __init__(self):
        super().__init__()
        generator = torch.Generator().manual_seed(0)
        draw = torch.randn(1 + NUM_CATEGORIES, NUM_CATEGORIES, generator=generator, dtype=torch.float64)
        self.first = torch.nn.Parameter(draw[0])
        self.second = torch.nn.Parameter(draw[1:])

    def log_prob(self, decision):
        """Of decisions [n, 2]: [n, 2], as a policy scores a rollout."""
        first = torch.log_softmax(self.first, -1)[decision[:, 0]]
        second = torch.log_softmax(self.second, -1)[decision[:, 0], decision[:, 1]]
        return torch.stack([first, second], -1)


def every_rollout():
    return torch.tensor(list(product(range(NUM_CATEGORIES), repeat=2)))


def reward_of(decision):
    table = torch.tensor([[0.1, 0.9, 0.3], [0.7, 0.2, 0.0], [0.5, 1.0, 0.4]], dtype=torch.float64)
    return table[decision[:, 0], decision[:, 1]]


def gradient(module, value):
    return torch.cat([g.flatten() for g in torch.autograd.grad(value, tuple(module.parameters()))])


def expected_reward_gradient(toy):
    rollouts = every_rollout()
    return gradient(toy, (toy.log_prob(rollouts).sum(-1).exp() * reward_of(rollouts)).sum())


def sample(toy, groups, num_rollouts):
    """Decisions [groups, N, 2]."""
    rollouts = every_rollout()
    probability = toy.log_prob(rollouts).sum(-1).exp().detach()
    generator = torch.Generator().manual_seed(1)
    drawn = torch.multinomial(probability, groups * num_rollouts, replacement=True, generator=generator)
    return rollouts[drawn].view(groups, num_rollouts, 2)


def leave_one_out(reward):
    """Each reward minus the mean of the others of its group [groups, N]."""
    count = reward.shape[1]
    return reward - (reward.sum(1, keepdim=True) - reward) / (count - 1)


def per_sample_gradients(toy, decision, weight):
    """Gradient of weight times log-probability for every kind of rollout, gathered: [n, parameters]."""
    rollouts = every_rollout()
    table = torch.stack([gradient(toy, toy.log_prob(r[None]).sum()) for r in rollouts])
    index = decision[..., 0] * NUM_CATEGORIES + decision[..., 1]
    return table[index] * weight[..., None]


def test_the_estimator_is_exact_when_every_rollout_is_enumerated():
    # sum_d p(d) r(d) grad log p(d) = grad sum_d p(d) r(d)
    toy = Toy()
    rollouts = every_rollout()
    log_prob = toy.log_prob(rollouts).sum(-1)
    estimate = gradient(toy, (log_prob.detach().exp() * reward_of(rollouts) * log_prob).sum())
    torch.testing.assert_close(estimate, expected_reward_gradient(toy))


def test_a_constant_baseline_changes_nothing_in_the_mean():
    toy = Toy()
    rollouts = every_rollout()
    log_prob = toy.log_prob(rollouts).sum(-1)
    shifted = gradient(toy, (log_prob.detach().exp() * (reward_of(rollouts) - 0.4) * log_prob).sum())
    torch.testing.assert_close(shifted, expected_reward_gradient(toy))


def test_sampled_rollouts_with_a_leave_one_out_baseline_agree_with_the_exact_gradient():
    toy = Toy()
    decision = sample(toy, groups=4000, num_rollouts=4)
    weight = leave_one_out(reward_of(decision.view(-1, 2)).view(4000, 4))
    groups = per_sample_gradients(toy, decision, weight).mean(1)  # [groups, parameters]
    error = groups.std(0) / len(groups) ** 0.5
    gap = (groups.mean(0) - expected_reward_gradient(toy)).abs() / error
    assert gap.max() < 4.0  # standard errors


def test_the_leave_one_out_baseline_makes_the_estimate_steadier():
    toy = Toy()
    decision = sample(toy, groups=2000, num_rollouts=4)
    reward = reward_of(decision.view(-1, 2)).view(2000, 4)
    spread = [per_sample_gradients(toy, decision, w).mean(1).var(0).sum() for w in (reward, leave_one_out(reward))]
    assert spread[1] < 0.8 * spread[0]


def test_a_step_along_the_estimate_raises_the_expected_reward():
    toy = Toy()
    rollouts = every_rollout()
    rewards = []
    for _ in range(50):
        log_prob = toy.log_prob(rollouts).sum(-1)
        rewards.append(float((log_prob.exp() * reward_of(rollouts)).sum().detach()))
        ascent = torch.autograd.grad((log_prob.detach().exp() * reward_of(rollouts) * log_prob).sum(), toy.parameters())
        with torch.no_grad():
            for weight, step in zip(toy.parameters(), ascent):
                weight.add_(step)
    assert all(later > earlier for earlier, later in pairwise(rewards))
    assert rewards[-1] > rewards[0] + 0.2
