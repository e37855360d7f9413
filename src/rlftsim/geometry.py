"""Angles, rotations and boxes in the plane, as pure functions on tensors; at the end those on arrays.

Meters, radians, counter-clockwise, headings in [-pi, pi).
"""

import math

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor


def wrap_angle(angle: Float[Tensor, "..."]) -> Float[Tensor, "..."]:
    """The same angle in [-pi, pi)."""
    return torch.remainder(angle + math.pi, 2 * math.pi) - math.pi


def heading_vector(heading: Float[Tensor, "..."]) -> Float[Tensor, "... 2"]:
    """Unit vector that points along a heading."""
    return torch.stack([heading.cos(), heading.sin()], dim=-1)


def rotate(vector: Float[Tensor, "... 2"], angle: Float[Tensor, "..."]) -> Float[Tensor, "... 2"]:
    """Vectors turned counter-clockwise.

    Args:
        vector: x and y.
        angle: one per vector, rad; broadcast against the leading axes.
    """
    cos, sin = angle.cos(), angle.sin()
    x, y = vector[..., 0], vector[..., 1]
    return torch.stack([cos * x - sin * y, sin * x + cos * y], dim=-1)


def square_norm(vector: Float[Tensor, "... 2"]) -> Float[Tensor, "..."]:
    """Squared length of vectors; the sum along an axis of two takes three times as long."""
    x, y = vector.unbind(-1)
    return x.square() + y.square()


def angle_between(first: Float[Tensor, "... 2"], second: Float[Tensor, "... 2"]) -> Float[Tensor, "..."]:
    """Signed angle from one vector to another, counter-clockwise; 0 where one of them is the zero vector.

    Args:
        first: vector that the angle starts at.
        second: vector that the angle ends at.
    """
    # |a| |b| sin and |a| |b| cos of the angle: atan2 needs neither to be normalized
    cross = first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0]
    dot = (first * second).sum(-1)
    return torch.atan2(cross, dot)


def box_corners(
    position: Float[Tensor, "*shape 2"],
    heading: Float[Tensor, "*shape"],
    length: Float[Tensor, "*#shape"],
    width: Float[Tensor, "*#shape"],
) -> Float[Tensor, "*shape 4 2"]:
    """Corners of boxes, clockwise: left-front, right-front, right-back, left-back.

    Args:
        position: centers, m.
        heading: direction of the front, rad.
        length: along the heading, m.
        width: across it, m.
    """
    along = torch.stack([length, length, -length, -length], dim=-1) / 2
    across = torch.stack([width, -width, -width, width], dim=-1) / 2
    corners = torch.stack([along, across], dim=-1)  # [..., 4, 2] in the frame of the box
    return rotate(corners, heading[..., None]) + position[..., None, :]


def pose_of_corners(corners: Float[Tensor, "... 4 2"]) -> tuple[Float[Tensor, "... 2"], Float[Tensor, "..."]]:
    """Position (mean of the corners) and heading (left-back to left-front) of boxes made by `box_corners`."""
    along = corners[..., 0, :] - corners[..., 3, :]  # [..., 2] left side, from back to front
    return corners.mean(-2), torch.atan2(along[..., 1], along[..., 0])


def wrapped(angle: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """The same angle in [-pi, pi), as `wrap_angle`, for arrays."""
    return np.remainder(angle + np.pi, 2 * np.pi) - np.pi


def clockwise_corners(
    position: Float[np.ndarray, "*shape 2"], heading: Float[np.ndarray, "*shape"], size: Float[np.ndarray, "*#shape _"]
) -> Float[np.ndarray, "*shape 4 2"]:
    """Corners of boxes, as `box_corners`, for arrays.

    Args:
        position: centers, m.
        heading: direction of the front, rad.
        size: length and width, m, of each box or of all; a height is ignored.
    """
    forward = np.stack([np.cos(heading), np.sin(heading)], axis=-1) * size[..., :1] / 2
    left = np.stack([-np.sin(heading), np.cos(heading)], axis=-1) * size[..., 1:2] / 2
    signs = ((1, 1), (1, -1), (-1, -1), (-1, 1))
    return np.stack([position + a * forward + b * left for a, b in signs], axis=-2)


def heights_overlap(
    rise: Float[np.ndarray, "*shape"],
    height: Float[np.ndarray, "*#shape"],
    other_height: Float[np.ndarray, "*#shape"],
) -> Bool[np.ndarray, "*shape"]:
    """True where the heights of two boxes overlap; boxes above each other never meet.

    Args:
        rise: Difference of the heights of both centers, m.
        height: Height of the first box, m.
        other_height: Height of the other one, m.
    """
    return np.abs(rise) <= (height + other_height) / 2


def boxes_overlap(
    gap: Float[np.ndarray, "*shape 2"],
    heading: Float[np.ndarray, "*#shape"],
    other_heading: Float[np.ndarray, "*#shape"],
    size: Float[np.ndarray, "*#shape _"],
    other_size: Float[np.ndarray, "*#shape _"],
) -> Bool[np.ndarray, "*shape"]:
    """True where two boxes have an inner point in common, for arrays.

    Args:
        gap: from the center of the first box to that of the other, m.
        heading: of the first box, rad.
        other_heading: of the other.
        size: length and width of the first box, m; a height is ignored.
        other_size: of the other.
    """
    # Two convex boxes are apart exactly if one of their four side directions separates them. Along each direction the
    # distance of the centers is compared with the sum of both half extents.
    turn = other_heading - heading
    cos, sin = np.abs(np.cos(turn)), np.abs(np.sin(turn))
    half, other_half = size / 2, other_size / 2
    overlap = np.ones(gap.shape[:-1], bool)
    for angle, own, other in ((heading, half, other_half), (other_heading, other_half, half)):
        c, s = np.cos(angle), np.sin(angle)
        along = np.abs(c * gap[..., 0] + s * gap[..., 1])
        across = np.abs(c * gap[..., 1] - s * gap[..., 0])
        overlap &= along < own[..., 0] + (cos * other[..., 0] + sin * other[..., 1])
        overlap &= across < own[..., 1] + (sin * other[..., 0] + cos * other[..., 1])
    return overlap
