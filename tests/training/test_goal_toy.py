"""A fork and two goals: after a short fine-tuning the agent goes where it is asked."""

import fork
import pytest
import tiny

from rlftsim.goals.recorded import recorded_goals
from rlftsim.rollout.simulate import simulate
from rlftsim.scenario.batch import collate
from rlftsim.training.finetune import FinetuneConfig, prepare, update_policy
from rlftsim.training.goals import GoalConfig
from rlftsim.training.parallel import start_fabric
from rlftsim.training.reference import KlConfig

CONFIG = FinetuneConfig(
    reward="gcft", goals=GoalConfig(share=1.0, learning_rate_scale=20.0), batch_size=2, num_rollouts=32,
    rollouts_per_pass=32, learning_rate=5e-4, warmup_updates=1, device=tiny.CPU,
    kl=KlConfig(target=0.2, initial_beta=0.01),
)  # fmt: skip


def ends_on_the_left_m(policy, batch, goals, seed=9):
    """How far to the left of where they started 64 rollouts of each scenario end. The branches end 16 m to either side."""
    rollouts = simulate(policy, batch, num_rollouts=64, seed=seed, goals=goals)
    return (rollouts.position[..., -1, :] - batch.position[:, None, :, 10])[:, :, 0, 1]


def obeys(policy, batch, goals, seed):
    """Share of rollouts on the asked branch."""
    left, right = ends_on_the_left_m(policy, batch, goals, seed)
    return float((left.gt(0).float().mean() + right.lt(0).float().mean()) / 2)


@pytest.mark.slow
@pytest.mark.parametrize("sight", ["concat", "indication"])
def test_the_asked_branch_is_taken(sight):
    scenarios, base = fork.fork()
    batch = collate(scenarios)
    goals = recorded_goals(batch)  # in the first scenario on the left branch, in the second on the right one
    policy = base.with_goal_sight(sight, aim=False)  # as in the paper
    asked, free = ends_on_the_left_m(policy, batch, goals), ends_on_the_left_m(base, batch, None)
    assert asked.equal(free)  # it cannot tell yet
    assert 0.2 < free.gt(0).float().mean() < 0.8
    fabric = start_fabric(CONFIG.device)
    learner = prepare(policy, CONFIG, fabric.device)
    for update in range(200):
        values = update_policy(learner, batch, CONFIG, fabric)
        if update % 20 == 19 and obeys(policy, batch, goals, seed=1) > 0.97:
            break
    assert values["goal_passed_rate"] >= values["goal_reached_rate"] > 0.7
    assert obeys(policy, batch, goals, seed=2) >= 0.95
    unasked = ends_on_the_left_m(policy, batch, None)
    assert (unasked.abs() > 10).float().mean() > 0.75  # asked nothing it mostly still takes one of the branches
    assert ends_on_the_left_m(learner.reference, batch, None).equal(free)
