"""What a policy returns is checked where it arises: in simulations and in the environments."""

from dataclasses import dataclass

import pytest
import torch

from rlftsim.envs import EgoEnv
from rlftsim.errors import DataError
from rlftsim.policies.distributions import TokenDistribution
from rlftsim.rollout import baselines
from rlftsim.rollout.baselines import ConstantVelocity
from rlftsim.rollout.simulate import simulate
from rlftsim.scenario.batch import collate
from rlftsim.scenario.open import to_scenarios


@pytest.fixture(scope="module")
def scenario():
    return to_scenarios("synthetic", "validation")[0]


@dataclass(frozen=True, eq=False)
class Uncertain(baselines.PointMass):
    def log_prob(self, decision, sampling=baselines.Sampling()):  # noqa: B008
        return super().log_prob(decision) * torch.nan


@dataclass(frozen=True, eq=False)
class PerAxis(baselines.PointMass):
    def log_prob(self, decision, sampling=baselines.Sampling()):  # noqa: B008
        return torch.zeros_like(decision)


class Faulty(ConstantVelocity):
    def __init__(self, fault):
        self.fault = fault

    def decide(self, context, state):
        kinds = {"nan probability": Uncertain, "probability per axis": PerAxis}
        return kinds.get(self.fault, baselines.PointMass)(state.velocity)

    def advance(self, context, state, decision, forced=None):
        after = super().advance(context, state, decision, forced)
        poses = {
            "no poses": lambda poses: None,
            "a list": lambda poses: poses.tolist(),
            "two steps": lambda poses: poses.expand(-1, -1, -1, 2, -1),
            "double": lambda poses: poses.double(),
            "nan": lambda poses: poses * torch.nan,
            "far": lambda poses: poses + 1e8,
        }
        object.__setattr__(after, "poses", poses.get(self.fault, lambda poses: poses)(after.poses))
        return after


FAULTS = {
    "no poses": r"Faulty.advance gives a State without poses: return a state with `poses`",
    "a list": r"Faulty.advance gives a list as poses",
    "two steps": r"gives float32 \[1, 1, \d+, 2, 3\] as poses: .* = \[1, 1, \d+, 1, 3\]",
    "double": r"gives float64 .* as poses",
    "nan": r"Faulty moves agent \d+ of scenario \w+ in rollout 0 at step 0 to x nan m",
    "far": r"Faulty moves agent \d+ of scenario \w+ in rollout 0 at step 0 to x 1e\+08 m",
    "nan probability": r"Faulty decides with probabilities that are NaN in scenario",
    "probability per axis": r"Faulty.decide gives a distribution whose log_prob is \[1, 1, \d+, 2\]",
}


@pytest.mark.parametrize("fault", FAULTS)
def test_what_no_agent_can_do_is_told_of_the_policy(scenario, fault):
    with pytest.raises(DataError, match=FAULTS[fault]):
        simulate(Faulty(fault), collate([scenario]), num_rollouts=1, seed=0)
    env = EgoEnv(scenarios=[scenario], traffic="policy", policy=Faulty(fault), stop_on=())
    env.reset(seed=0)
    with pytest.raises(DataError, match=FAULTS[fault]):
        env.step(env.action_space.sample())


def test_a_policy_without_a_fault_is_simulated_and_driven(scenario):
    assert simulate(Faulty(""), collate([scenario]), num_rollouts=1, seed=0).position.isfinite().all()
    env = EgoEnv(scenarios=[scenario], traffic="policy", policy=Faulty(""), stop_on=())
    env.reset(seed=0)
    env.step(env.action_space.sample())


def test_logits_have_a_row_for_each_agent_that_decides():
    mask = torch.ones(1, 2, 3, dtype=torch.bool)
    mask[0, 1, 2] = False
    TokenDistribution(torch.zeros(5, 4), mask)
    with pytest.raises(DataError, match=r"the mask \[1, 2, 3\] is True for 5 agents: logits are \[R, V\]"):
        TokenDistribution(torch.zeros(4, 4), mask)
