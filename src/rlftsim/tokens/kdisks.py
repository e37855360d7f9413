"""k-disks: disks of equal radius cover the motions, or map pieces, of the data; a token is the mean of a disk.

The published recipe draws disk centers at random until V tokens exist, at a fixed radius. Here the radius is
searched: the smallest at which V disks cover a given fraction. So a small vocabulary has wide disks instead of holes.
"""

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from jaxtyping import Bool, Float, Float32, Int64
from scipy.spatial import KDTree

from rlftsim.tokens.motions import end_boxes, mirror_poses, straighten_motions, with_mirror_images
from rlftsim.tokens.vocabulary import STEPS_PER_TOKEN

MIN_RADIUS_M = 0.02
"""Finer disks than the jitter of logged positions would only cover noise."""
MAX_RADIUS_M = 2.0
RADIUS_STEPS = 7
"""Bisections of the search, in log space: 2^-7 of the range is 4 %."""
_STILL = np.zeros((1, STEPS_PER_TOKEN + 1, 3), np.float32)


@dataclass(frozen=True, eq=False)
class Cloud:
    """Shapes of k points that disks cover. The distance of two shapes is the mean distance of the points."""

    shapes: Float32[np.ndarray, "n k 2"]
    start: Float32[np.ndarray, "k 2"]
    """Center of the first disk."""
    partner: Int64[np.ndarray, "n"] | None = None
    """Index of each shape's mirror image; None = no mirror images."""
    straight: Float32[np.ndarray, "n k 2"] | None = None
    """Each shape moved onto the axis of the mirror."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "_tree", KDTree(self.shapes.mean(1)))

    def within(self, center: Float32[np.ndarray, "k 2"], radius_m: float) -> Int64[np.ndarray, "m"]:
        """Indices of the shapes within a radius of a shape.

        Args:
            center: Shape in the middle, in the cloud or not.
            radius_m: Greatest distance of a shape from the center, m.
        """
        # The means of two shapes are never farther apart than the shapes: the tree over means finds a superset.
        indices = self._tree.query_ball_point(center.mean(0), radius_m * 1.001)  # type: ignore[attr-defined]
        candidates = np.sort(np.asarray(indices, np.int64))
        return candidates[shape_distance(self.shapes[candidates], center) <= radius_m]


Disk: TypeAlias = tuple[Int64[np.ndarray, "_"], bool]
"""Members of a disk, and True if the mirror image is a disk, too."""


def shape_distance(shapes: Float32[np.ndarray, "n k 2"], center: Float32[np.ndarray, "*k 2"]) -> Float[np.ndarray, "n"]:
    """Mean distance of the points of each shape to the points of a center, m.

    Args:
        shapes: Points of n shapes, m.
        center: Points of a shape, m, the same for all of the n or different for each.
    """
    return np.sqrt(np.square(shapes - center).sum(-1)).mean(-1)


def cluster_motions(
    motions: Float32[np.ndarray, "n 6 3"],
    class_index: int,
    *,
    limit: int,
    coverage: float,
    mirror: bool,
    rng: np.random.Generator,
) -> tuple[Float32[np.ndarray, "V 6 3"], float]:
    """At most `limit` tokens, the first exactly still, and the radius of the disks.

    Args:
        motions: Motions to cover with disks, mirror images not included.
        class_index: Class whose box is compared.
        limit: Greatest number of tokens V.
        coverage: Fraction of the motions that lie within a disk.
        mirror: True = cover mirror images, too, by tokens that come in pairs or are straight.
        rng: Generator of the order in which shapes become centers of disks.
    """
    if not len(motions):
        return _STILL, 0.0
    cloud = _motion_cloud(motions, class_index, mirror)
    motions = with_mirror_images(motions) if mirror else motions
    disks, radius = cover_shapes(cloud, coverage=coverage, limit=limit, rng=rng)
    tokens = [_STILL]
    for members, is_pair in disks[1:]:
        token = mean_motion(motions[members])[None]
        if is_pair:
            tokens += [token, mirror_poses(token)]
        else:
            # With mirror images, a disk that is not one of a pair is its own mirror image.
            tokens.append(straighten_motions(token) if mirror else token)
    return np.concatenate(tokens), radius


def cluster_windows(
    windows: Float32[np.ndarray, "w 11 2"], *, limit: int, coverage: float, rng: np.random.Generator
) -> Float32[np.ndarray, "P 11 2"]:
    """Prototypes of map pieces: a straight piece, and the mean of each disk over the windows.

    Args:
        windows: Pieces of 5 m, a point every 0.5 m, each in the frame of the first point.
        limit: Greatest number of prototypes P.
        coverage: Fraction of the windows that lie within a disk.
        rng: Generator of the order in which windows become centers of disks.
    """
    straight = np.stack([np.arange(11) * 0.5, np.zeros(11)], -1).astype(np.float32)
    if not len(windows):
        return straight[None]
    cloud = Cloud(windows, straight)
    disks, _ = cover_shapes(cloud, coverage=coverage, limit=limit, rng=rng)
    return np.stack([straight, *[windows[members].mean(0) for members, _ in disks[1:]]]).astype(np.float32)


def cover_shapes(cloud: Cloud, *, coverage: float, limit: int, rng: np.random.Generator) -> tuple[list[Disk], float]:
    """Disks of the smallest radius at which they cover a fraction of the shapes, and the radius, to about 4 %, m.

    Args:
        cloud: Shapes to cover, with mirror images if there are any.
        coverage: Fraction of the shapes that lie within a disk.
        limit: Greatest number of tokens; a pair of disks counts twice.
        rng: Generator of the order in which shapes become centers of disks.
    """
    order = rng.permutation(len(cloud.shapes))
    # Bisection of the logarithm: coverage grows with the radius, up to noise from the order.
    low, high = MIN_RADIUS_M, MAX_RADIUS_M
    for _ in range(RADIUS_STEPS):
        middle = float(np.sqrt(low * high))
        is_uncovered = lay_disks(cloud, order, middle, limit)[1]
        low, high = (low, middle) if is_uncovered.mean() <= 1 - coverage else (middle, high)
    return lay_disks(cloud, order, high, limit)[0], high


def lay_disks(
    cloud: Cloud, order: Int64[np.ndarray, "n"], radius_m: float, limit: int
) -> tuple[list[Disk], Bool[np.ndarray, "n"]]:
    """Disks for up to `limit` tokens, and a mask of the shapes outside all disks.

    The first disk is around the cloud's start, each further disk around the first shape in `order` that is still
    outside. If the straightened form of that shape is within the radius, the disk is centered there; else the mirror
    image is a disk, too.

    Args:
        cloud: Shapes to cover, with mirror images if there are any.
        order: Order in which the shapes become centers.
        radius_m: Radius of all disks, m.
        limit: Greatest number of tokens; a pair of disks counts twice.
    """
    is_uncovered = np.ones(len(cloud.shapes), bool)
    disks = [(cloud.within(cloud.start, radius_m), False)]
    is_uncovered[disks[0][0]] = False
    count = 1
    axis_distance = np.inf if cloud.straight is None else shape_distance(cloud.shapes, cloud.straight)
    is_pair = (axis_distance > radius_m) & (cloud.partner is not None) & np.ones(len(is_uncovered), bool)
    for index in order:
        if count == limit:
            break
        # A pair does not fit into the last free token; a straight disk further on may.
        num_tokens = 1 + bool(is_pair[index])
        if not is_uncovered[index] or count + num_tokens > limit:
            continue
        centers = cloud.shapes if is_pair[index] or cloud.straight is None else cloud.straight
        members = cloud.within(centers[index], radius_m)
        members = members[is_uncovered[members]]
        is_uncovered[members] = False
        if cloud.partner is not None:
            is_uncovered[cloud.partner[members]] = False
        disks.append((members, bool(is_pair[index])))
        count += num_tokens
    return disks, is_uncovered


def _motion_cloud(motions: Float32[np.ndarray, "n 6 3"], class_index: int, mirror: bool) -> Cloud:
    """End boxes of motions; with `mirror` each is followed by the mirror image."""
    start = end_boxes(_STILL, class_index)[0].numpy()
    if not mirror:
        return Cloud(end_boxes(motions, class_index).numpy(), start)
    # Motion 2i and its mirror image 2i + 1 are partners: i ^ 1.
    motions = with_mirror_images(motions)
    ends, straight = (end_boxes(poses, class_index).numpy() for poses in (motions, straighten_motions(motions)))
    return Cloud(ends, start, np.arange(len(motions)) ^ 1, straight)


def mean_motion(motions: Float32[np.ndarray, "n 6 3"]) -> Float32[np.ndarray, "6 3"]:
    """Mean motion: mean positions and circular mean of the headings."""
    mean = motions.mean(0)
    mean[:, 2] = np.arctan2(np.sin(motions[..., 2]).mean(0), np.cos(motions[..., 2]).mean(0))
    return mean
