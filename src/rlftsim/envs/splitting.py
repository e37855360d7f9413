"""Probability of rare events of a Markov chain by adaptive multilevel splitting, unbiased for any number of particles.

N particles run to the end. The least dangerous ones are killed and replaced by branches of the others, until most have
met the event; p = Π (1 - killed / N) · (events / N). Cérou and Guyader (2007); Bréhier et al. (2016) prove that the
mean is exact if all ties are killed and a branch leaves its parent at the first end of a block above the level.

R repeats of N particles, T blocks. The danger of a path is at least 0 exactly where the event has happened.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int64, Shaped
from scipy import stats

from rlftsim.statistics import mean_interval

KILLED = 0.25
"""Fraction of the particles that a level kills at least."""
NEGLIGIBLE = 1e-15
"""A repeat whose particles stand for less ends without the event."""


@runtime_checkable
class Chain(Protocol):
    """A Markov chain of T blocks, many paths at a time. Paths are an array, along the first axis."""

    def start(self, numbers: Int64[np.ndarray, "n"]) -> tuple[Shaped[np.ndarray, "n ..."], Float[np.ndarray, "n T1"]]:
        """Whole paths, and the largest danger at the start and in each block.

        Args:
            numbers: Number of each path's dice; no number is used twice.
        """
        ...

    def branch(
        self, parents: Shaped[np.ndarray, "m ..."], blocks: Int64[np.ndarray, "m"], numbers: Int64[np.ndarray, "m"]
    ) -> tuple[Shaped[np.ndarray, "m ..."], Float[np.ndarray, "m T1"]]:
        """Paths that equal their parents up to the end of a block and go on with new dice, as `start` returns them.

        Args:
            parents: Paths to branch from.
            blocks: Blocks that each path shares with its parent, 0 to T.
            numbers: Number of the dice after the branch.
        """
        ...


@dataclass(frozen=True, eq=False)
class Splits:
    """Independent estimates of the same probability."""

    probability: Float[np.ndarray, "R"]
    weight: Float[np.ndarray, "R"]
    """Probability that each final path stands for."""
    num_levels: Int64[np.ndarray, "R"]
    num_runs: Int64[np.ndarray, "R"]
    """Paths that were run, branches included."""
    paths: Shaped[np.ndarray, "R N ..."]
    danger: Float[np.ndarray, "R N"]
    """Largest danger of each final path."""


def split(
    chain: Chain, *, particles: int, repeats: int = 1, seed: int | Sequence[int] = 0, is_branching: bool = True
) -> Splits:
    """Estimates of the probability that the danger of a path reaches 0.

    Args:
        chain: Chain of blocks.
        particles: Number N of paths in each repeat.
        repeats: Number R of independent estimates, which run side by side.
        seed: Seed of the choice of parents.
        is_branching: False = plain Monte Carlo with the undisturbed paths alone.
    """
    random, num_killed = np.random.default_rng(seed), max(1, round(KILLED * particles))
    next_number = repeats * particles
    paths, danger = chain.start(np.arange(next_number))
    running = np.maximum.accumulate(danger, axis=1)  # [R N, T + 1]
    num_runs = np.full(repeats, particles)
    num_levels, survival, is_active = np.zeros(repeats, np.int64), np.ones(repeats), np.full(repeats, is_branching)
    while True:
        # 1. the level of each repeat, and all particles that are not above it
        top = running[:, -1].reshape(repeats, particles)
        level = np.partition(top, num_killed - 1, axis=1)[:, num_killed - 1]
        is_active &= level < 0
        is_killed = find_killed(top, level) & is_active[:, None]
        num_alive = particles - is_killed.sum(1)
        survival *= num_alive / particles
        survival[survival < NEGLIGIBLE] = 0.0
        num_levels += is_active
        is_active &= survival > 0
        rows = np.flatnonzero(is_killed & is_active[:, None])
        if not len(rows):
            probability, weight = survival * (top >= 0).mean(1), survival / particles
            final_paths = paths.reshape(repeats, particles, *paths.shape[1:])
            return Splits(probability, weight, num_levels, num_runs, final_paths, top)
        # 2. each killed one becomes a branch of a survivor
        repeat = rows // particles
        survivors = np.argsort(is_killed, axis=1, kind="stable")  # first in each row
        choice = (random.random(len(rows)) * num_alive[repeat]).astype(np.int64)
        parents = survivors[repeat, choice] + repeat * particles
        blocks = find_branch_blocks(running[parents], level[repeat])
        numbers = next_number + np.arange(len(rows))
        next_number += len(rows)
        paths[rows], danger = chain.branch(paths[parents], blocks, numbers)
        running[rows] = np.maximum.accumulate(danger, axis=1)
        num_runs += np.bincount(repeat, minlength=repeats)


def find_killed(top: Float[np.ndarray, "R N"], level: Float[np.ndarray, "R"]) -> Bool[np.ndarray, "R N"]:
    """True = the largest danger of a path is not above the level of its repeat."""
    return top <= level[:, None]


def find_branch_blocks(running: Float[np.ndarray, "m T1"], level: Float[np.ndarray, "m"]) -> Int64[np.ndarray, "m"]:
    """First block at whose end the largest danger so far is above a level, for paths that get there."""
    return (running > level[:, None]).argmax(1)


def estimate_interval(estimates: Float[np.ndarray, "R"], num_undisturbed: int) -> tuple[float, float]:
    """95 % interval of a probability by independent unbiased estimates.

    Student's interval of the mean, on the log scale where all estimates are positive. Without any event the upper end
    is the exact one-sided bound of undisturbed paths, and likewise the lower end where all of them meet the event. A
    single estimate between has no interval (NaN).

    Args:
        estimates: Unbiased estimates, a number per repeat.
        num_undisturbed: Number of independent paths that began the repeats.
    """
    if not estimates.any():
        return 0.0, 1 - 0.05 ** (1 / num_undisturbed)
    if (estimates == 1).all():
        return 0.05 ** (1 / num_undisturbed), 1.0
    if len(estimates) < 2 or not estimates.all():
        low, high = mean_interval(estimates).interval
        return max(low, 0.0) if math.isfinite(low) else low, min(high, 1.0) if math.isfinite(high) else high
    # of nearly lognormal estimates, the mean is above the median by half the variance of the logarithm (Cox)
    logs = np.log(estimates)
    variance, count = float(logs.var(ddof=1)), len(logs)
    center = float(logs.mean()) + variance / 2
    half = float(stats.t.ppf(0.975, count - 1)) * math.sqrt(variance / count + variance**2 / (2 * (count - 1)))
    return math.exp(center - half), min(math.exp(center + half), 1.0)
