"""k-disks: disks of one radius laid over what agents and maps really do; a token is the mean of a disk.

The published recipe draws disk centres at random until V tokens exist, at a fixed radius. Here the radius is searched: the
smallest at which V disks cover a wanted share. So a small vocabulary has wide disks instead of holes.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int64
from scipy.spatial import KDTree

from rlftsim.tokens.motions import end_boxes, mirrored, straightened, with_mirror_images
from rlftsim.tokens.vocabulary import STEPS_PER_TOKEN

MIN_RADIUS_M = 0.02
"""Finer disks than the jitter of recorded labels would tell noise from noise."""
MAX_RADIUS_M = 2.0
RADIUS_STEPS = 7
_STILL = np.zeros((1, STEPS_PER_TOKEN + 1, 3), np.float32)


@dataclass(frozen=True, eq=False)
class Cloud:
    """Shapes of k points that disks are laid over. Their distance is the mean distance of their points."""

    shapes: Float32[np.ndarray, "n k 2"]
    start: Float32[np.ndarray, "k 2"]
    """Centre of the first disk."""
    partner: Int64[np.ndarray, "n"] | None = None
    """Where each shape's mirror image is; None = left and right are not paired."""
    straight: Float32[np.ndarray, "n k 2"] | None = None
    """Each shape moved onto the axis of the mirror."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "_tree", KDTree(self.shapes.mean(1)))

    def within(self, centre: Float32[np.ndarray, "k 2"], radius_m: float) -> Int64[np.ndarray, "m"]:
        """Shapes within a radius of a shape. (The means of two shapes are never farther apart than the shapes.)"""
        near = np.asarray(self._tree.query_ball_point(centre.mean(0), radius_m * 1.001), np.int64)  # type: ignore[attr-defined]
        near.sort()
        return near[shape_distance(self.shapes[near], centre) <= radius_m]


@dataclass(frozen=True, eq=False)
class Disk:
    """Members of a disk; `is_pair` says that its mirror image is a disk, too."""

    members: Int64[np.ndarray, "m"]
    is_pair: bool


def shape_distance(shapes: Float32[np.ndarray, "n k 2"], centre: Float32[np.ndarray, "*k 2"]) -> Float[np.ndarray, "n"]:
    """Mean distance of the points of each shape to those of another one."""
    return np.sqrt(np.square(shapes - centre).sum(-1)).mean(-1)


def cluster_motions(
    motions: Float32[np.ndarray, "n 6 3"],
    class_index: int,
    *,
    limit: int,
    coverage: float,
    mirror: bool,
    rng: np.random.Generator,
) -> tuple[Float32[np.ndarray, "V 6 3"], float]:
    """At most `limit` tokens, the first exactly still, and the radius of their disks.

    Args:
        motions: what is to be covered.
        class_index: whose box is compared.
        limit: V.
        coverage: share of the motions that lie within a disk.
        mirror: motions are covered together with their mirror images, by tokens that come in pairs or are straight.
        rng: in which order disks are laid.
    """
    if not len(motions):
        return _STILL, 0.0
    cloud = _motion_cloud(motions, class_index, mirror)
    every = with_mirror_images(motions) if mirror else motions
    order = rng.permutation(len(every))
    radius = smallest_radius(cloud, order, coverage=coverage, limit=limit)
    disks, _ = lay_disks(cloud, order, radius, limit)
    return np.concatenate([_STILL, *[_tokens_of(disk, every, mirror) for disk in disks[1:]]]), radius


def cluster_windows(
    windows: Float32[np.ndarray, "w 11 2"], *, limit: int, coverage: float, rng: np.random.Generator
) -> Float32[np.ndarray, "P 11 2"]:
    """Prototypes of map pieces: a straight one, and the mean of each disk over the windows."""
    straight = np.stack([np.arange(11) * 0.5, np.zeros(11)], -1).astype(np.float32)
    if not len(windows):
        return straight[None]
    cloud = Cloud(windows, straight)
    order = rng.permutation(len(windows))
    radius = smallest_radius(cloud, order, coverage=coverage, limit=limit)
    disks, _ = lay_disks(cloud, order, radius, limit)
    return np.stack([straight, *[windows[disk.members].mean(0) for disk in disks[1:]]]).astype(np.float32)


def smallest_radius(cloud: Cloud, order: Int64[np.ndarray, "n"], *, coverage: float, limit: int) -> float:
    """Radius at which `limit` disks cover the wanted share of shapes, to about 4 %."""
    low, high = MIN_RADIUS_M, MAX_RADIUS_M
    for _ in range(RADIUS_STEPS):
        middle = float(np.sqrt(low * high))
        left = lay_disks(cloud, order, middle, limit)[1]
        low, high = (low, middle) if left.mean() <= 1 - coverage else (middle, high)
    return high


def lay_disks(
    cloud: Cloud, order: Int64[np.ndarray, "n"], radius_m: float, limit: int
) -> tuple[list[Disk], Bool[np.ndarray, "n"]]:
    """Disks for up to `limit` tokens, and which shapes are left outside.

    The first disk is around the cloud's start, each further one around the first shape in `order` that is left. If that shape is
    within the radius of its own straightened form, the disk is laid around that; else the mirror image is a disk, too.
    """
    left = np.ones(len(cloud.shapes), bool)
    disks = [Disk(cloud.within(cloud.start, radius_m), is_pair=False)]
    left[disks[0].members] = False
    count = 1
    off_axis = np.inf if cloud.straight is None else shape_distance(cloud.shapes, cloud.straight)
    is_pair = (off_axis > radius_m) & (cloud.partner is not None) & np.ones(len(left), bool)
    for centre in order:
        if count == limit:
            break
        pair = bool(is_pair[centre])
        if not left[centre] or count + 1 + pair > limit:
            continue
        around = cloud.shapes if pair or cloud.straight is None else cloud.straight
        members = cloud.within(around[centre], radius_m)
        members = members[left[members]]
        left[members] = False
        if cloud.partner is not None:
            left[cloud.partner[members]] = False
        disks.append(Disk(members, pair))
        count += 1 + pair
    return disks, left


def _motion_cloud(motions: Float32[np.ndarray, "n 6 3"], class_index: int, mirror: bool) -> Cloud:
    """End boxes of motions, each followed by its mirror image if asked for."""
    start = end_boxes(_STILL, class_index)[0].numpy()
    if not mirror:
        return Cloud(end_boxes(motions, class_index).numpy(), start)
    both = with_mirror_images(motions)
    ends, on_axis = (end_boxes(m, class_index).numpy() for m in (both, straightened(both)))
    return Cloud(ends, start, np.arange(len(both)) ^ 1, on_axis)


def _tokens_of(disk: Disk, motions: Float32[np.ndarray, "n 6 3"], mirror: bool) -> Float32[np.ndarray, "t 6 3"]:
    """The mean motion of a disk, and its mirror image; straight where the disk is its own mirror image."""
    token = mean_motion(motions[disk.members])[None]
    if disk.is_pair:
        return np.concatenate([token, mirrored(token)])
    return straightened(token) if mirror else token


def mean_motion(motions: Float32[np.ndarray, "n 6 3"]) -> Float32[np.ndarray, "6 3"]:
    """Mean of positions; of headings, the circular mean."""
    mean = motions.mean(0)
    mean[:, 2] = np.arctan2(np.sin(motions[..., 2]).mean(0), np.cos(motions[..., 2]).mean(0))
    return mean
