"""Agents of simulated or logged motion that overlap."""

import numpy as np
from jaxtyping import Bool, Float

from rlftsim.geometry import boxes_overlap, heights_overlap


def compute_overlap(
    position: Float[np.ndarray, "N A S 2"],
    heading: Float[np.ndarray, "N A S"],
    length: Float[np.ndarray, "A"],
    width: Float[np.ndarray, "A"],
    valid: Bool[np.ndarray, "N A S"],
    *,
    ignore_from: int | None = None,
    z: Float[np.ndarray, "N A S"] | None = None,
    height: Float[np.ndarray, "A"] | None = None,
) -> Bool[np.ndarray, "N A S"]:
    """True where an agent's box has an inner point in common with another one.

    Args:
        position: centers, meters.
        heading: radians.
        length: along the heading, meters.
        width: meters.
        valid: an agent that is not valid overlaps no other.
        ignore_from: a step; two agents that overlap there are never marked for overlapping each other.
        z: Heights of the centers, meters; without them agents above each other overlap.
        height: Heights of the boxes, meters; needed with `z`.
    """
    overlap = np.zeros(valid.shape, bool)  # [N, A, S]
    size = np.stack([length, width], axis=-1).astype(np.float64)
    for n in range(len(valid)):
        heights = None if z is None or height is None else (z[n], height)
        _mark_rollout(overlap[n], position[n].astype(np.float64), heading[n], size, valid[n], ignore_from, heights)
    return overlap


def _mark_rollout(
    overlap: Bool[np.ndarray, "A S"],
    position: Float[np.ndarray, "A S 2"],
    heading: Float[np.ndarray, "A S"],
    size: Float[np.ndarray, "A 2"],
    valid: Bool[np.ndarray, "A S"],
    ignore_from: int | None,
    heights: tuple[Float[np.ndarray, "A S"], Float[np.ndarray, "A"]] | None,
) -> None:
    """Mark one rollout's overlaps in `overlap`."""
    radius = np.linalg.norm(size, axis=-1) / 2  # [A], of the circle around a box
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
        hit = boxes_overlap(gap[other, step], heading[agent, step], heading[row, step], size[agent], size[row])
        if heights is not None:
            z, height = heights
            hit &= heights_overlap(z[row, step] - z[agent, step], height[agent, None], height[row])
        if ignore_from is not None:
            # A stroller and its pusher overlap from the beginning, which is no collision.
            hit &= ~np.isin(row, row[hit & (step == ignore_from)])
        overlap[agent, step[hit]] = True
        overlap[row[hit], step[hit]] = True
