"""Rollouts of scenario A against the public code: greedy ones, and the probabilities of drawn ones."""

import numpy as np
import pytest
import torch

from rlftsim.rollout.policy import Sampling
from rlftsim.rollout.simulate import simulate

pytestmark = pytest.mark.official
POSITION_TOLERANCE_M = 1e-3
HEADING_TOLERANCE_RAD = 1e-4
LOG_PROB_TOLERANCE = 1e-4
TOP_K = 48


def turn(a, b):
    """Largest angle between headings."""
    return np.abs(np.remainder(a.astype(np.float64) - b + np.pi, 2 * np.pi) - np.pi).max()


def check_greedy(policy, batch, expected):
    rollouts = simulate(policy, batch, num_rollouts=1, seed=0, sampling=Sampling(temperature=0.0))
    np.testing.assert_array_equal(rollouts.decision[0, 0].numpy(), expected["greedy/idx"][:, 2:])
    assert np.abs(rollouts.position[0, 0].numpy() - expected["greedy/traj_10hz"]).max() < POSITION_TOLERANCE_M
    assert turn(rollouts.heading[0, 0].numpy(), expected["greedy/head_10hz"]) < HEADING_TOLERANCE_RAD
    with torch.no_grad():
        log_prob = policy.score(policy.encode(batch), rollouts).log_prob(rollouts.decision)
    assert np.abs(log_prob[0, 0].numpy() - expected["greedy/logp"]).max() < LOG_PROB_TOLERANCE


def check_forced(policy, batch, expected):
    """Two rollouts whose tokens are given: where they lead and how likely they were, drawn and scored."""
    given = torch.from_numpy(expected["forced/idx"][:, :, 2:]).long()[None]  # [1, 2, A, 16]
    distributions = []

    def choose(distribution, state, sampling, noise):
        distributions.append(distribution)
        return given[..., len(distributions) - 1]

    rollouts = simulate(policy, batch, num_rollouts=2, seed=0, choose=choose)
    assert np.abs(rollouts.position[0].numpy() - expected["forced/traj_10hz"]).max() < POSITION_TOLERANCE_M
    assert turn(rollouts.heading[0].numpy(), expected["forced/head_10hz"]) < HEADING_TOLERANCE_RAD
    assert np.abs(rollouts.log_prob[0].numpy() - expected["forced/logp_full"]).max() < LOG_PROB_TOLERANCE
    top = Sampling(top_k=TOP_K)
    among = torch.stack([d.log_prob(given[..., i], top) for i, d in enumerate(distributions)], -1)
    assert np.abs(among[0].numpy() - expected["forced/logp_top48"]).max() < LOG_PROB_TOLERANCE
    with torch.no_grad():
        scored = policy.score(policy.encode(batch), rollouts)
        full, among = scored.log_prob(given), scored.log_prob(given, top)
    assert np.abs(full[0].numpy() - expected["forced/logp_full"]).max() < LOG_PROB_TOLERANCE
    assert np.abs(among[0].numpy() - expected["forced/logp_top48"]).max() < LOG_PROB_TOLERANCE


@pytest.mark.parametrize("frame", ["centred", "absolute"])
def test_greedy_rollout_of_nano(frame, nano, batch_a, golden):
    check_greedy(nano, batch_a(frame), golden.arrays(f"nano/{frame}_rollouts"))


@pytest.mark.parametrize("frame", ["centred", "absolute"])
def test_forced_rollouts_of_nano(frame, nano, batch_a, golden):
    check_forced(nano, batch_a(frame), golden.arrays(f"nano/{frame}_rollouts"))


@pytest.mark.slow
@pytest.mark.parametrize("frame", ["centred", "absolute"])
def test_rollouts_of_tiny(frame, tiny, batch_a, golden):
    expected = golden.arrays(f"tiny/{frame}_rollouts")
    check_greedy(tiny, batch_a(frame), expected)
    check_forced(tiny, batch_a(frame), expected)
