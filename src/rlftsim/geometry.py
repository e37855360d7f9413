"""Angles, rotations and boxes in the plane, as pure functions on tensors; angles on arrays, too.

Meters, radians, counter-clockwise, headings in [-pi, pi).
"""

import math

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor


def wrap_angle(angle: Float[Tensor, "..."]) -> Float[Tensor, "..."]:
    """The same angle in [-pi, pi)."""
    return torch.remainder(angle + math.pi, 2 * math.pi) - math.pi


def wrapped(angle: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """The same angle in [-pi, pi), as `wrap_angle`, for arrays."""
    return np.remainder(angle + np.pi, 2 * np.pi) - np.pi


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
