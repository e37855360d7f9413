"""Who is near."""

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from rlftsim.policies.smart.neighbors import within

PLACES = torch.tensor([[[1.0, 0.0], [1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [3.0, 0.0], [torch.inf, torch.inf]]])
HERE = torch.zeros(1, 2)
FIRST = torch.zeros(1, dtype=torch.long)


def test_the_radius_is_strict_and_nobody_is_their_own_neighbor():
    found = within(HERE, FIRST, PLACES, torch.tensor([2]), radius_m=3.0, limit=None)
    assert found.index[found.mask].tolist() == [0, 1, 3]
    assert not within(HERE, FIRST, PLACES, None, radius_m=1.0, limit=None).mask.any()


def test_of_equally_near_ones_the_first_are_kept_whoever_else_looks():
    alone = within(HERE, FIRST, PLACES, None, radius_m=2.0, limit=2)
    others = torch.cat([HERE, torch.tensor([[1.5, 0.0], [40.0, 0.0]])])
    together = within(others, FIRST.repeat(3), PLACES, None, radius_m=2.0, limit=2)
    assert alone.index[0].tolist() == together.index[0].tolist() == [0, 1]
    assert together.mask.tolist() == [[True, True], [True, True], [False, False]]


def test_of_equally_near_ones_the_first_are_kept_however_much_padding_there_is():
    angles = torch.arange(24) * (2 * torch.pi / 4)  # six in each of four places, all 1 m away
    around = torch.stack([angles.cos().round(), angles.sin().round()], -1)
    for padding in (0, 5, 1000, 5000):
        candidates = torch.cat([around, torch.full((padding, 2), torch.inf)])[None]
        found = within(HERE * 0, FIRST, candidates, None, radius_m=2.0, limit=7)
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
    found = within(position, place, candidates, own, radius_m=30.0, limit=limit)
    distance = (candidates[place] - position[:, None]).norm(dim=-1)
    if own is not None:
        distance.scatter_(1, own[:, None], torch.inf)
    for row, (away, p) in enumerate(zip(distance, place)):
        expected = away.argsort(stable=True)[: int((away < 30.0).sum())][:limit] + p * num_candidates
        assert sorted(found.index[row, found.mask[row]].tolist()) == sorted(expected.tolist())
