"""Overlap of boxes by the separating axis theorem."""

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
    """True where an agent's box has an inner point in common with another one.

    Args:
        position: centers, meters.
        heading: radians.
        length: along the heading, meters.
        width: meters.
        valid: an agent that is not valid overlaps no other.
        ignore_from: a step; two agents that overlap there are never marked for overlapping each other.
    """
    overlap = np.zeros(valid.shape, bool)  # [N, A, S]
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
    """Mark one rollout's overlaps in `overlap`."""
    radius = np.linalg.norm(half, axis=-1)  # [A], of the circle around a box
    for agent in range(len(valid) - 1):
        others = slice(agent + 1, None)
        gap = position[others] - position[agent]  # [A - agent - 1, S, 2]
        # Few pairs are so close that their circles touch; only these need the exact test.
        near = (gap**2).sum(-1) < (radius[others, None] + radius[agent]) ** 2
        # k pairs of another agent and a step
        other, step = np.nonzero(near & valid[others] & valid[agent])
        if not len(other):
            continue
        row = other + agent + 1
        hit = boxes_overlap(gap[other, step], heading[agent, step], heading[row, step], half[agent], half[row])
        if ignore_from is not None:
            # A stroller and its pusher overlap from the beginning, which is no collision.
            hit &= ~np.isin(row, row[hit & (step == ignore_from)])
        overlap[agent, step[hit]] = True
        overlap[row[hit], step[hit]] = True


def boxes_overlap(
    gap: Float[np.ndarray, "k 2"],
    heading: Float[np.ndarray, "k"],
    other_heading: Float[np.ndarray, "k"],
    half: Float[np.ndarray, "2"],
    other_half: Float[np.ndarray, "k 2"],
) -> Bool[np.ndarray, "k"]:
    """True where no side of either of two boxes separates them.

    Args:
        gap: from the center of the first box to that of the other, meters.
        heading: of the first box, radians.
        other_heading: of the other.
        half: half the length and half the width of the first box, meters.
        other_half: of the other.
    """
    # Two convex boxes are apart exactly if one of their four side directions separates them. Along each direction the
    # distance of the centers is compared with the sum of both half extents.
    turn = other_heading - heading
    cos, sin = np.abs(np.cos(turn)), np.abs(np.sin(turn))
    own, other = _along_axes(gap, heading), _along_axes(gap, other_heading)
    reach_own = np.stack(
        [cos * other_half[:, 0] + sin * other_half[:, 1], sin * other_half[:, 0] + cos * other_half[:, 1]], -1
    )
    reach_other = np.stack([cos * half[0] + sin * half[1], sin * half[0] + cos * half[1]], -1)
    return np.all((own < half + reach_own) & (other < other_half + reach_other), axis=-1)


def _along_axes(vector: Float[np.ndarray, "k 2"], heading: Float[np.ndarray, "k"]) -> Float[np.ndarray, "k 2"]:
    """Lengths of a vector's components along and across a heading."""
    cos, sin = np.cos(heading), np.sin(heading)
    return np.abs(np.stack([cos * vector[:, 0] + sin * vector[:, 1], cos * vector[:, 1] - sin * vector[:, 0]], -1))
