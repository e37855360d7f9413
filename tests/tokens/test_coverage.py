"""Coverage of a vocabulary: counts, errors and flags of made-up and real tokens."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import scenes
from rlftsim.geometry import box_corners
from rlftsim.scenario.types import ObjectType
from rlftsim.tokens.agent_tokens import nearest_rows
from rlftsim.tokens.coverage import Spread, measure_coverage
from rlftsim.tokens.motions import boxes
from rlftsim.tokens.vocabulary import Vocabulary


def by_hand(*speeds_mps: float, turn: float = 0.0) -> Vocabulary:
    """The same even straight tokens for every class; the last one turns within one step."""
    poses = np.zeros((len(speeds_mps), 6, 3), np.float32)
    poses[..., 0] = np.array(speeds_mps)[:, None] * 0.1 * np.arange(6)
    poses[-1, 3:, 2] = turn
    corners = torch.stack([boxes(poses, index) for index in range(3)])
    return Vocabulary(corners, torch.ones(corners.shape[:2], dtype=torch.bool), torch.zeros(1, 11, 2))


def one_vehicle(speed_mps: float):
    return scenes.build_scenario("one", (scenes.Mover(ObjectType.VEHICLE, speed_mps=speed_mps),))


def test_errors_speeds_and_use_of_a_drive_at_constant_speed():
    # 8.2 m/s against tokens of 0 and 8 m/s: 10 cm a motion; along the track the error grows by 10 cm a token, 18 times
    vehicle, pedestrian, _ = measure_coverage([one_vehicle(8.2)], by_hand(0.0, 8.0, 20.0), radii_m=(0.07, None, None))
    assert (vehicle.single_m.count, vehicle.use.tolist()) == (18, [0, 36, 0])
    assert vehicle.single_m.mean == pytest.approx(0.1, abs=1e-3)
    assert vehicle.rolling_m.max == pytest.approx(1.8, abs=5e-3)
    assert vehicle.rolling_m.mean == pytest.approx(0.95, abs=5e-3)
    assert vehicle.heading_rad.max < 1e-3
    assert vehicle.speed_mps.max == pytest.approx(8.2, abs=1e-2)
    assert vehicle.token_speed_mps.tolist() == pytest.approx([0, 8, 20])
    assert vehicle.is_spare.tolist() == [False, False, True]
    assert vehicle.is_dead.tolist() == [True, False, False]
    assert vehicle.stands_still
    assert vehicle.radius_m == 0.07
    assert (pedestrian.single_m.count, pedestrian.rolling_m.p95) == (0, 0.0)


def test_one_sided_and_impossible_tokens_are_seen():
    vehicle, pedestrian, cyclist = measure_coverage([one_vehicle(8.0)], by_hand(0.0, 8.0, 20.0, turn=0.6))
    assert vehicle.is_implausible.tolist() == [False, False, True]  # 34 degrees within a step
    assert pedestrian.is_implausible.tolist() == [False, False, True]
    assert cyclist.is_implausible.tolist() == [False, False, True]
    assert vehicle.asymmetry_m == pytest.approx(
        2 * 2.6 * np.sin(0.6), rel=0.01
    )  # corners 2.6 m from the center, 1.2 rad apart


@settings(max_examples=30, deadline=None)
@given(st.lists(st.floats(1e-4, 100), min_size=1, max_size=300), st.floats(0.01, 1.0))
def test_quantiles_of_a_stream_are_within_half_a_percent(values, fraction):
    spread = Spread()
    for part in torch.tensor(values).split(7):
        spread.add(part)
    exact = np.quantile(np.array(values, np.float32), fraction, method="inverted_cdf")
    assert spread.quantile(fraction) == pytest.approx(exact, rel=0.006)
    assert spread.mean == pytest.approx(np.mean(values), rel=1e-5)
    assert spread.max == pytest.approx(max(values), rel=1e-6)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**31), st.sampled_from([1, 130, 700]))
def test_the_nearest_token_is_found_without_comparing_all(seed, num_tokens):
    generator = torch.Generator().manual_seed(seed)

    def drawn(count: int) -> torch.Tensor:
        x, y, heading = torch.randn(3, count, generator=generator) * torch.tensor([[3.0], [0.3], [0.8]])
        return box_corners(torch.stack([x, y], -1), heading, torch.tensor(4.8), torch.tensor(2.0))

    table, wanted = drawn(num_tokens), drawn(60)
    table[num_tokens // 2 :: 3] = table[0].clone()  # ties: the lowest wins
    every = (wanted[:, None] - table).norm(dim=-1).sum(-1)
    found = nearest_rows(wanted, table)
    torch.testing.assert_close(every.gather(1, found[:, None])[:, 0], every.min(1).values)
    assert not torch.isin(found, torch.arange(num_tokens // 2, num_tokens, 3)).any() or num_tokens == 1
