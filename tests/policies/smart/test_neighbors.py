"""Who is near."""

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pretend_device import DEVICE, PretendDevice
from rlftsim.policies.smart.neighbors import Poses, bound_neighbors, find_neighbors, group_rows

PLACES = torch.tensor([[[1.0, 0.0], [1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [3.0, 0.0], [torch.inf, torch.inf]]])
HERE = torch.zeros(1, 2)
FIRST = torch.zeros(1, dtype=torch.long)


def test_the_radius_is_strict_and_nobody_is_their_own_neighbor():
    found = find_neighbors(HERE, FIRST, PLACES, torch.tensor([2]), radius_m=3.0, limit=None)
    assert found.index[found.mask].tolist() == [0, 1, 3]
    assert not find_neighbors(HERE, FIRST, PLACES, None, radius_m=1.0, limit=None).mask.any()


def test_of_equally_near_ones_the_first_are_kept_whoever_else_looks():
    alone = find_neighbors(HERE, FIRST, PLACES, None, radius_m=2.0, limit=2)
    others = torch.cat([HERE, torch.tensor([[1.5, 0.0], [40.0, 0.0]])])
    together = find_neighbors(others, FIRST.repeat(3), PLACES, None, radius_m=2.0, limit=2)
    assert alone.index[0].tolist() == together.index[0].tolist() == [0, 1]
    assert together.mask.tolist() == [[True, True], [True, True], [False, False]]


def test_of_equally_near_ones_the_first_are_kept_however_much_padding_there_is():
    angles = torch.arange(24) * (2 * torch.pi / 4)  # six in each of four places, all 1 m away
    around = torch.stack([angles.cos().round(), angles.sin().round()], -1)
    for padding in (0, 5, 1000, 5000):
        candidates = torch.cat([around, torch.full((padding, 2), torch.inf)])[None]
        found = find_neighbors(HERE * 0, FIRST, candidates, None, radius_m=2.0, limit=7)
        assert found.index.tolist() == [[0, 1, 2, 3, 4, 5, 6]], padding


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 10_000), st.sampled_from([None, 7]), st.integers(1, 900), st.booleans())
def test_the_same_are_found_however_many_there_are_to_choose_among(seed, limit, num_candidates, knows_itself):
    draw = torch.Generator().manual_seed(seed)
    candidates = torch.rand(3, num_candidates, 2, generator=draw) * 200 - 100
    candidates[:, 700:] = torch.inf
    place = torch.randint(0, 3, (150,), generator=draw)
    own = torch.randint(0, num_candidates, (150,), generator=draw) if knows_itself else None
    position = torch.rand(150, 2, generator=draw) * 250 - 125
    found = find_neighbors(position, place, candidates, own, radius_m=30.0, limit=limit)
    distance = (candidates[place] - position[:, None]).norm(dim=-1)
    if own is not None:
        distance.scatter_(1, own[:, None], torch.inf)
    for row, (away, p) in enumerate(zip(distance, place)):
        expected = away.argsort(stable=True)[: int((away < 30.0).sum())][:limit] + p * num_candidates
        assert sorted(found.index[row, found.mask[row]].tolist()) == sorted(expected.tolist())


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 10_000), st.sampled_from([None, 7]), st.integers(1, 400), st.booleans())
def test_off_the_cpu_the_same_are_found_in_lists_of_a_fixed_width(seed, limit, num_candidates, knows_itself):
    draw = torch.Generator().manual_seed(seed)
    candidates = torch.rand(3, num_candidates, 2, generator=draw) * 200 - 100
    candidates[:, 300:] = torch.inf
    place = torch.randint(0, 3, (60,), generator=draw)
    own = torch.randint(0, num_candidates, (60,), generator=draw) if knows_itself else None
    position = torch.rand(60, 2, generator=draw) * 250 - 125
    expected = find_neighbors(position, place, candidates, own, radius_m=30.0, limit=limit)
    max_neighbors = bound_neighbors(candidates, 30.0)
    with PretendDevice() as device, device.count() as counts:
        there = (position.to(DEVICE), place.to(DEVICE), candidates.to(DEVICE), None if own is None else own.to(DEVICE))
        found = find_neighbors(*there, radius_m=30.0, limit=limit, max_neighbors=max_neighbors)
        index, mask = found.index.cpu(), found.mask.cpu()
    assert counts.waits.total() == 2, "the copies of index and mask at the end"
    assert mask.shape[1] % 8 == 0
    for row, kept, expected_row, expected_mask in zip(index, mask, expected.index, expected.mask):
        assert row[kept].tolist() == expected_row[expected_mask].tolist()


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 10_000), st.sampled_from([3.0, 10.0, 30.0]), st.sampled_from([0.3, 20.0, 300.0, 9000.0]))
def test_no_point_has_more_candidates_near_than_the_bound(seed, radius_m, size_m):
    draw = torch.Generator().manual_seed(seed)
    candidates = torch.rand(2, 200, 2, generator=draw) * size_m - size_m / 2
    candidates[1, 150:] = torch.inf
    points = torch.cat([candidates[0], torch.rand(300, 2, generator=draw) * size_m - size_m / 2])
    near = (points[:, None, None] - candidates).norm(dim=-1) < radius_m  # [points, 2, 200]
    assert near.sum(-1).max() <= bound_neighbors(candidates, radius_m)


def test_the_bound_is_not_far_above_what_is_near():
    side = torch.arange(-100.0, 100.0, 2.5)
    candidates = torch.stack(torch.meshgrid(side, side, indexing="ij"), -1).view(1, -1, 2)
    near = (candidates[0].norm(dim=-1) < 30.0).sum().item()
    assert near <= bound_neighbors(candidates, 30.0) <= 1.5 * near
    street = torch.stack([side, torch.zeros_like(side)], -1)[None]
    assert bound_neighbors(street, 30.0) <= 30


def test_rows_share_a_list_if_place_and_pose_are_equal_to_the_last_bit():
    place = torch.tensor([1, 0, 1, 1, 0, 1])
    position = torch.tensor([[3.0, 4.0]]).repeat(6, 1)
    heading = torch.tensor([0.5, 0.5, 0.5, 0.5 + 2.0**-24, 0.5, 0.5])
    position[5, 0] = torch.nextafter(position[5, 0], torch.tensor(9.0))
    groups = group_rows(place, Poses(position, heading))
    found = [rows.tolist() for rows in groups.rows.split(groups.sizes.tolist())]
    assert sorted(found) == [[0, 2], [1, 4], [3], [5]]
    assert groups.first.tolist() == [rows[0] for rows in found]
    nothing = group_rows(place[:0], Poses(position[:0], heading[:0]))
    assert len(nothing.rows) == len(nothing.sizes) == 0
