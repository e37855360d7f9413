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
    """True where an agent's box has an inner point in common with a second box.

    Args:
        position: Centers [N, A, S, 2] of the boxes, meters.
        heading: Headings [N, A, S], radians.
        length: Lengths [A] along the heading, meters.
        width: Widths [A] across the heading, meters.
        valid: Mask [N, A, S]; an agent that is not valid overlaps no agent.
        ignore_from: Step at which overlapping pairs are noted, never to be marked; None marks all pairs.
        z: Heights [N, A, S] of the centers, meters; without heights, agents above each other overlap.
        height: Heights [A] of the boxes, meters; needed with `z`.
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
        later_agents = slice(agent + 1, None)
        gap = position[later_agents] - position[agent]  # [A - agent - 1, S, 2]
        # Few pairs are so close that their circles touch; only these need the exact test.
        is_close = (gap**2).sum(-1) < (radius[later_agents, None] + radius[agent]) ** 2
        # k pairs of a later agent and a step
        gap_row, step = np.nonzero(is_close & valid[later_agents] & valid[agent])
        if not len(gap_row):
            continue
        row = gap_row + agent + 1
        hit = boxes_overlap(gap[gap_row, step], heading[agent, step], heading[row, step], size[agent], size[row])
        if heights is not None:
            z, height = heights
            hit &= heights_overlap(z[row, step] - z[agent, step], height[agent, None], height[row])
        if ignore_from is not None:
            # A stroller and its pusher overlap from the beginning, which is no collision.
            hit &= ~np.isin(row, row[hit & (step == ignore_from)])
        overlap[agent, step[hit]] = True
        overlap[row[hit], step[hit]] = True
