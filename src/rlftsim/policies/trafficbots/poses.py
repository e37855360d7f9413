"""Relative poses, embeddings of poses, and the nearest neighbors of tokens.

A pose is x, y (m) and heading (rad). S sources, M targets, K neighbors, E width of an embedding; `*g` are leading axes.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from rlftsim.geometry import rotate


@dataclass(frozen=True, eq=False)
class Neighbors:
    """The nearest targets of each source, in no particular order."""

    index: Int64[Tensor, "*g S K"]
    valid: Bool[Tensor, "*g S K"]
    """False = beyond the radius, or no valid target."""
    embedding: Float[Tensor, "*g S K E"]
    """Embedding of the targets' poses in the frames of the sources."""

    def over_time(self, num_steps: int) -> "Neighbors":
        """The same neighbors at several steps [B, T, S, K], for tokens [B, S] that do not move."""
        tensors = (self.index, self.valid, self.embedding)
        return Neighbors(*(v[:, None].expand(-1, num_steps, *v.shape[1:]) for v in tensors))


def relative_pose(pose: Float[Tensor, "*#g 3"], frame: Float[Tensor, "*#g 3"]) -> Float[Tensor, "*g 3"]:
    """Poses in the frames of other poses; headings are not wrapped.

    Args:
        pose: Poses in any frame.
        frame: Poses of the new frames, given in the frame of `pose`.
    """
    position = rotate(pose[..., :2] - frame[..., :2], -frame[..., 2])
    return torch.cat([position, (pose[..., 2] - frame[..., 2])[..., None]], -1)


def pose_embedding(pose: Float[Tensor, "*g 3"], size: int) -> Float[Tensor, "*g E"]:
    """Sines and cosines of poses: a quarter of the numbers for x, a quarter for y, half for the heading.

    Args:
        pose: Relative poses, m and rad.
        size: Width E of the embedding, a multiple of 8.
    """
    step = torch.arange(size // 8, device=pose.device, dtype=pose.dtype)
    frequency = 1.0 / 1000.0 ** (2 * step / (size // 4))  # from 1 rad/m down to about 1 rad/km
    harmonic = torch.arange(1, size // 4 + 1, device=pose.device, dtype=pose.dtype)
    x, y = pose[..., 0, None] * frequency, pose[..., 1, None] * frequency
    heading = pose[..., 2, None] * harmonic
    return torch.cat([x.cos(), x.sin(), y.cos(), y.sin(), heading.cos(), heading.sin()], -1)


@torch.no_grad()
def find_neighbors(
    source: Float[Tensor, "*g S 3"],
    target: Float[Tensor, "*h M 3"],
    target_mask: Bool[Tensor, "*h M"],
    *,
    count: int,
    radius_m: float,
    size: int,
) -> Neighbors:
    """The K nearest targets of each source, fewer where there are fewer targets.

    Args:
        source: Poses that look for neighbors.
        target: Poses of the candidates; the leading axes are the first axes of the sources.
        target_mask: True = the candidate exists.
        count: Number K of neighbors.
        radius_m: Distance beyond which a neighbor is not valid.
        size: Width E of the embedding, a multiple of 8.
    """
    # Targets of [B, M, 3] serve sources of [B, T, N, S, 3].
    extra = source.dim() - target.dim()
    lead = target.shape[:-2]
    target = target.view(*lead, *[1] * extra, *target.shape[-2:])
    mask = target_mask.view(*lead, *[1] * extra, target_mask.shape[-1])
    offset = target[..., None, :, :2] - source[..., :, None, :2]  # [*g, S, M, 2]
    distance = offset.square().sum(-1).sqrt().masked_fill(~mask[..., None, :], torch.inf)
    nearest = distance.topk(min(count, distance.shape[-1]), dim=-1, largest=False, sorted=False)
    index = nearest.indices  # [*g, S, K]
    expanded = target[..., None, :, :].expand(*distance.shape, 3)
    pose = expanded.gather(-2, index[..., None].expand(*index.shape, 3))  # [*g, S, K, 3]
    embedding = pose_embedding(relative_pose(pose, source[..., None, :]), size)
    return Neighbors(index, nearest.values <= radius_m, embedding)
