"""Boxes on arrays: corners and overlap, drawn by hand, against the functions on tensors and against shapely."""

import numpy as np
import pytest
import torch

from rlftsim.geometry import box_corners, boxes_overlap, clockwise_corners

CAR = np.array([4.0, 2.0, 1.5])


def test_corners_go_clockwise_from_the_front_left_as_those_of_tensors():
    corners = clockwise_corners(np.zeros((1, 2)), np.array([np.pi / 2]), CAR)[0]
    np.testing.assert_allclose(corners, [[-1, 2], [1, 2], [1, -2], [-1, -2]], atol=1e-12)
    position, heading = np.array([[3.0, -2.0]]), np.array([0.7])
    length, width = (torch.tensor([side], dtype=torch.float64) for side in CAR[:2])
    tensors = box_corners(torch.from_numpy(position), torch.from_numpy(heading), length, width)
    np.testing.assert_allclose(clockwise_corners(position, heading, CAR), tensors.numpy(), atol=1e-12)


@pytest.mark.parametrize(
    ("offset", "heading", "expected"),
    [
        ((3.9, 0.0), 0.0, True),
        ((4.0, 0.0), 0.0, False),
        ((4.1, 0.0), 0.0, False),
        # Turned by 45 degrees, a 4 x 2 m box reaches (4 + 2) / 2 / sqrt(2) = 2.12 m to the side; the other one 1 m.
        ((0.0, 3.0), np.pi / 4, True),
        ((0.0, 3.2), np.pi / 4, False),
    ],
    ids=["bumpers meet", "bumpers touch", "bumpers apart", "corner inside", "corner outside"],
)
def test_boxes_overlap(offset, heading, expected):
    found = boxes_overlap(np.array([offset]), np.zeros(1), np.array([heading]), CAR, CAR)
    assert bool(found[0]) is expected


def test_boxes_overlap_as_shapely_says():
    shapely = pytest.importorskip("shapely")
    affinity = pytest.importorskip("shapely.affinity")
    random = np.random.default_rng(3)
    pose = random.uniform((-3, -3, -3.1), (3, 3, 3.1), (200, 2, 3))
    size = random.uniform(0.5, 5.0, (200, 2, 2))
    gap = pose[:, 1, :2] - pose[:, 0, :2]
    ours = boxes_overlap(gap, pose[:, 0, 2], pose[:, 1, 2], size[:, 0], size[:, 1])

    def polygon(pose, size):
        box = shapely.box(-size[0] / 2, -size[1] / 2, size[0] / 2, size[1] / 2)
        turned = affinity.rotate(box, pose[2], origin=(0, 0), use_radians=True)
        return affinity.translate(turned, *pose[:2])

    theirs = [polygon(pose[k, 0], size[k, 0]).intersects(polygon(pose[k, 1], size[k, 1])) for k in range(200)]
    assert 20 < sum(theirs) < 180
    assert ours.tolist() == theirs
