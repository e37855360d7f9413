"""A fork and two goals: after a short fine-tuning the agent goes to its goal."""

import fork
import pytest

import tiny
from rlftsim.goals.types import logged_goals
from rlftsim.rollout.simulate import simulate
from rlftsim.scenario.batch import collate
from rlftsim.training.config import FinetuneConfig, GoalConfig, KlConfig
from rlftsim.training.parallel import start_fabric
from rlftsim.training.reward import prepare, update_policy

CONFIG = FinetuneConfig(
    reward="gcft", goals=GoalConfig(probability=1.0, learning_rate_scale=20.0), batch_size=2, num_rollouts=32,
    rollouts_per_pass=32, learning_rate=5e-4, warmup_updates=1, device=tiny.CPU,
    kl=KlConfig(target=0.2, initial_beta=0.01, condition_reference=False),
)  # fmt: skip


def ends_on_the_left_m(policy, batch, goals, seed=9):
    """Distance to the left, m, at which 64 rollouts of each scenario end. The branches end 16 m to either side."""
    rollouts = simulate(policy, batch, num_rollouts=64, seed=seed, goals=goals)
    return (rollouts.position[..., -1, :] - batch.position[:, None, :, 10])[:, :, 0, 1]


def obeys(policy, batch, goals, seed):
    """Fraction of rollouts on the branch of the goal."""
    left, right = ends_on_the_left_m(policy, batch, goals, seed)
    return float((left.gt(0).float().mean() + right.lt(0).float().mean()) / 2)


@pytest.mark.slow
@pytest.mark.parametrize("goal_encoding", ["concat", "indication"])
def test_the_branch_of_the_goal_is_taken(goal_encoding):
    scenarios, base = fork.fork()
    batch = collate(scenarios)
    goals = logged_goals(batch)  # in the first scenario on the left branch, in the second on the right one
    policy = base.with_goal_conditioning(goal_encoding, logit_bias=False)  # as in the paper
    conditioned, free = ends_on_the_left_m(policy, batch, goals), ends_on_the_left_m(base, batch, None)
    assert conditioned.equal(free)  # it knows nothing of goals yet
    assert 0.2 < free.gt(0).float().mean() < 0.8
    fabric = start_fabric(CONFIG.device)
    learner = prepare(policy, CONFIG, fabric.device)
    for update in range(200):
        values = update_policy(learner, batch, CONFIG, fabric)
        if update % 20 == 19 and obeys(policy, batch, goals, seed=1) > 0.97:
            break
    assert values["goal_passed_rate"] >= values["goal_reached_rate"] > 0.7
    assert obeys(policy, batch, goals, seed=2) >= 0.95
    goal_free = ends_on_the_left_m(policy, batch, None)
    assert (goal_free.abs() > 10).float().mean() > 0.9  # without a goal it still takes one of the branches
    assert ends_on_the_left_m(learner.reference, batch, None).equal(free)
