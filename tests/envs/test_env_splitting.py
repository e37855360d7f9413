"""Adaptive multilevel splitting on a chain whose probability is known: intervals cover it, the mean is right."""

import numpy as np
import pytest

from rlftsim.envs import splitting
from rlftsim.envs.splitting import estimate_interval, split

BLOCKS, UP = 60, 1 / 3
INTERVALS, REPEATS, PARTICLES = 400, 10, 64


class Ruin:
    """A gambler with one coin, who wins the next with probability 1/3: does he have `goal` coins before none?"""

    def __init__(self, goal: int, seed: int):
        self.goal, self.random = goal, np.random.default_rng(seed)

    def start(self, numbers):
        return self.branch(np.ones((len(numbers), BLOCKS + 1), np.int8), np.zeros(len(numbers), int), numbers)

    def branch(self, parents, blocks, numbers):
        steps = np.where(self.random.random((len(parents), BLOCKS), np.float32) < UP, 1, -1).astype(np.int8)
        steps = np.where(np.arange(1, BLOCKS + 1) > blocks[:, None], steps, np.diff(parents, axis=1))
        coins = np.cumsum(np.concatenate([parents[:, :1], steps], 1), axis=1, dtype=np.int8)
        is_over = np.logical_or.accumulate(coins <= 0, axis=1)
        coins[is_over] = 0
        return coins, coins.astype(np.float64) - self.goal

    @property
    def probability(self) -> float:
        """Exact, step by step."""
        state = np.eye(self.goal + 1)[1]
        for _ in range(BLOCKS):
            following = np.zeros_like(state)
            following[[0, -1]] = state[[0, -1]]
            following[2:] += UP * state[1:-1]
            following[:-2] += (1 - UP) * state[1:-1]
            state = following
        return float(state[-1])


def errors_and_coverage(goal: int, seed: int = 1) -> tuple[float, float]:
    """Mean estimate less the probability, in standard errors, and the fraction of intervals that hold it."""
    chain = Ruin(goal, seed)
    estimates = split(chain, particles=PARTICLES, repeats=INTERVALS * REPEATS, seed=seed).probability
    error = (estimates.mean() - chain.probability) / (estimates.std() / np.sqrt(estimates.size))
    rows = estimates.reshape(INTERVALS, REPEATS)
    low, high = np.array([estimate_interval(row, PARTICLES * REPEATS) for row in rows]).T
    return float(error), float(np.mean((low <= chain.probability) & (chain.probability <= high)))


def holds(goal: int) -> bool:
    error, coverage = errors_and_coverage(goal)
    return abs(error) <= 3 and 0.92 <= coverage <= 0.98


@pytest.mark.parametrize("goal", [7, 13, 20, 26])  # 8e-3, 1e-4, 7e-7, 6e-9
def test_the_mean_is_exact_and_intervals_cover_the_known_probability(goal):
    error, coverage = errors_and_coverage(goal)
    assert abs(error) <= 3
    assert 0.92 <= coverage <= 0.98


def test_a_branch_before_the_end_of_the_block_that_passes_the_level_would_be_seen(monkeypatch):
    # one block late is no error: it is a stopping time, too, so only the variance grows
    find = splitting.find_branch_blocks
    monkeypatch.setattr(splitting, "find_branch_blocks", lambda running, level: np.maximum(find(running, level) - 1, 0))
    assert not holds(13)


def test_ties_that_survive_would_be_seen(monkeypatch):
    def kill_quarter(top, level):
        return np.argsort(np.argsort(top, axis=1), axis=1) < splitting.KILLED * PARTICLES

    monkeypatch.setattr(splitting, "find_killed", kill_quarter)
    assert not holds(13)


def test_without_an_event_the_bound_is_that_of_undisturbed_paths():
    low, high = estimate_interval(np.zeros(10), 640)
    assert low == 0.0
    assert (1 - high) ** 640 == pytest.approx(0.05)
    low, high = estimate_interval(np.ones(10), 640)
    assert low**640 == pytest.approx(0.05)
    assert high == 1.0


def test_one_repeat_has_no_interval():
    assert np.isnan(estimate_interval(np.array([0.01]), 64)).all()


def test_without_branches_it_is_monte_carlo():
    result = split(Ruin(3, 0), particles=4000, is_branching=False)
    assert result.probability[0] == (result.danger >= 0).mean()
    assert abs(result.probability[0] - Ruin(3, 0).probability) < 0.03
    assert result.num_runs[0] == 4000


def test_particles_that_all_tie_end_with_probability_zero():
    result = split(Ruin(100, 0), particles=8, repeats=3)
    assert (result.probability == 0).all()
    assert (result.num_runs >= 8).all()
