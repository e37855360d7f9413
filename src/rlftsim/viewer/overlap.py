"""Which boxes overlap, by the separating axis theorem."""

import numpy as np
from jaxtyping import Bool, Float


def compute_overlap(
    position: Float[np.ndarray, "N A S 2"],
    heading: Float[np.ndarray, "N A S"],
    length: Float[np.ndarray, "A"],
    width: Float[np.ndarray, "A"],
    valid: Bool[np.ndarray, "N A S"],
    *,
    ignore_from: int | None = None,
) -> Bool[np.ndarray, "N A S"]:
    """Whether an agent's box and another one's have an inner point in common.

    Args:
        position: centres, metres.
        heading: radians.
        length: along the heading, metres.
        width: metres.
        valid: an agent that is not valid overlaps nobody.
        ignore_from: a step; two agents that overlap there are never marked for overlapping each other.
    """
    overlap = np.zeros(valid.shape, bool)
    half = np.stack([length, width], axis=-1).astype(np.float64) / 2
    for n in range(len(valid)):
        _mark_rollout(overlap[n], position[n].astype(np.float64), heading[n], half, valid[n], ignore_from)
    return overlap


def _mark_rollout(
    overlap: Bool[np.ndarray, "A S"],
    position: Float[np.ndarray, "A S 2"],
    heading: Float[np.ndarray, "A S"],
    half: Float[np.ndarray, "A 2"],
    valid: Bool[np.ndarray, "A S"],
    ignore_from: int | None,
) -> None:
    """Write one rollout's overlaps into `overlap`; only pairs whose circles touch are looked at closely."""
    radius = np.linalg.norm(half, axis=-1)
    for agent in range(len(valid) - 1):
        others = slice(agent + 1, None)
        gap = position[others] - position[agent]
        near = (gap**2).sum(-1) < (radius[others, None] + radius[agent]) ** 2
        other, step = np.nonzero(near & valid[others] & valid[agent])
        if not len(other):
            continue
        row = other + agent + 1
        hit = _boxes_overlap(gap[other, step], heading[agent, step], heading[row, step], half[agent], half[row])
        if ignore_from is not None:
            hit &= ~np.isin(row, row[hit & (step == ignore_from)])
        overlap[agent, step[hit]] = True
        overlap[row[hit], step[hit]] = True


def _boxes_overlap(
    gap: Float[np.ndarray, "k 2"],
    heading: Float[np.ndarray, "k"],
    other_heading: Float[np.ndarray, "k"],
    half: Float[np.ndarray, "2"],
    other_half: Float[np.ndarray, "k 2"],
) -> Bool[np.ndarray, "k"]:
    """Whether no side of either box separates the two. `gap` leads from one centre to the other."""
    turn = other_heading - heading
    cos, sin = np.abs(np.cos(turn)), np.abs(np.sin(turn))
    own, other = _along_axes(gap, heading), _along_axes(gap, other_heading)
    reach_own = np.stack(
        [cos * other_half[:, 0] + sin * other_half[:, 1], sin * other_half[:, 0] + cos * other_half[:, 1]], -1
    )
    reach_other = np.stack([cos * half[0] + sin * half[1], sin * half[0] + cos * half[1]], -1)
    return np.all((own < half + reach_own) & (other < other_half + reach_other), axis=-1)


def _along_axes(vector: Float[np.ndarray, "k 2"], heading: Float[np.ndarray, "k"]) -> Float[np.ndarray, "k 2"]:
    """Sizes of a vector's parts along and across a heading."""
    cos, sin = np.cos(heading), np.sin(heading)
    return np.abs(np.stack([cos * vector[:, 0] + sin * vector[:, 1], cos * vector[:, 1] - sin * vector[:, 0]], -1))
