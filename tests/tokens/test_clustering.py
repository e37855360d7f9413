import re
import typing
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import scenes
from rlftsim.errors import ConfigError, DataError
from rlftsim.scenario.types import ObjectType
from rlftsim.tokens.clustering import TokensConfig, build_vocabulary
from rlftsim.tokens.coverage import measure_coverage
from rlftsim.tokens.trajtok import TrajTokConfig
from rlftsim.tokens.vocabulary import Vocabulary

SMALL = TokensConfig(num_tokens=64, num_map_prototypes=24)
LONELY_CELLS_STAY = TrajTokConfig(num_neighbors=0)


def test_token_0_of_every_class_stands_exactly_still(vocabulary):
    assert torch.equal(vocabulary.poses[:, 0], torch.zeros(3, 5, 3))
    assert vocabulary.token_mask[:, 0].all()


def test_every_token_is_nearest_to_a_motion_or_to_its_mirror_image(pack_scenarios, built):
    for coverage in measure_coverage(pack_scenarios, built[0]):
        assert coverage.use[~coverage.is_spare].min() > 0
        assert not coverage.is_dead.any()
        assert not coverage.is_implausible.any()


def test_vehicles_of_every_speed_up_to_45_meters_per_second_have_a_token(pack_scenarios):
    config = replace(SMALL, num_tokens=512)
    for limit_mps, fastest_mps in ((45.0, 44.0), (0.0, 30.0)):
        vocabulary, _ = build_vocabulary(pack_scenarios, replace(config, straight_up_to_mps=limit_mps))
        end = vocabulary.poses[0, :, -1][vocabulary.token_mask[0]]
        ahead = end[(end[:, 1].abs() < 0.2) & (end[:, 2].abs() < 0.05), 0].sort().values
        assert (ahead.max() / 0.5 > fastest_mps) == (limit_mps > 0)
        if limit_mps:
            assert ahead[ahead > -0.5].diff().max() < 1.5  # half of it is the farthest that any speed is from a token


def test_the_wanted_fraction_of_motions_lies_within_a_disk(pack_scenarios, built):
    vocabulary, radii = built
    for coverage, radius in zip(measure_coverage(pack_scenarios, vocabulary), radii):
        assert coverage.single_m.count > 50
        assert coverage.num_tokens <= 64
        assert coverage.single_m.p95 <= radius
        assert coverage.single_m.mean < radius


def test_more_tokens_mean_finer_disks(pack_scenarios, built):
    finer = build_vocabulary(pack_scenarios, replace(SMALL, num_tokens=256))[1]
    for coarse, fine in zip(built[1], finer):
        at_finest = coarse < 0.022  # disks are never smaller than the jitter of logged labels
        assert fine < coarse or at_finest


def test_the_same_data_and_seed_give_the_same_vocabulary(pack_scenarios, vocabulary):
    again = build_vocabulary(pack_scenarios, SMALL)[0]
    assert torch.equal(again.corners, vocabulary.corners)
    assert torch.equal(again.map_prototypes, vocabulary.map_prototypes)
    other = build_vocabulary(pack_scenarios, replace(SMALL, seed=3))[0]
    assert not torch.equal(other.corners, vocabulary.corners)


def test_only_the_sampled_scenarios_are_read(pack_scenarios):
    class Counted(list):
        read: typing.ClassVar = []

        def __getitem__(self, position):
            self.read.append(position)
            return super().__getitem__(position)

    half = replace(SMALL, max_scenarios=3)
    build_vocabulary(Counted(pack_scenarios), half)
    assert len(Counted.read) == 3
    assert sorted(set(Counted.read)) == Counted.read
    first = tuple(Counted.read)
    build_vocabulary(Counted(pack_scenarios), replace(half, seed=5))
    assert first != tuple(Counted.read[3:])  # by the seed, not always the first three


@pytest.mark.parametrize("kind", ["kdisks", "trajtok"])
def test_the_mirror_image_of_every_token_is_a_token(kind):
    only_left = [scenes.build_scenario("left", tuple(
        scenes.Mover(kind, x_m=9.0 * k, speed_mps=3.0 + k, turn_rate_radps=0.1 * k)
        for k, kind in enumerate([ObjectType.VEHICLE, ObjectType.PEDESTRIAN, ObjectType.CYCLIST] * 2)
    ))]  # fmt: skip
    config = replace(SMALL, num_tokens=512, kind=kind, trajtok=LONELY_CELLS_STAY)
    vocabulary = build_vocabulary(only_left, config)[0]
    for coverage in measure_coverage(only_left, vocabulary):
        assert coverage.num_tokens > 1
        assert coverage.asymmetry_m < 1e-6
        assert coverage.poses[:, -1, 1].min() < -0.03
    if kind == "kdisks":
        one_sided = build_vocabulary(only_left, replace(config, mirror=False))[0]
        assert one_sided.poses[:, :, -1, 1][one_sided.token_mask].min() > -1e-3


def test_boxes_of_tokens_have_the_size_of_their_class(vocabulary):
    corners = vocabulary.corners[vocabulary.token_mask]
    length = (corners[..., 0, :] - corners[..., 3, :]).norm(dim=-1)
    width = (corners[..., 0, :] - corners[..., 1, :]).norm(dim=-1)
    classes = vocabulary.token_mask.nonzero()[:, 0]
    for index, (long, wide) in enumerate([(4.8, 2.0), (1.0, 1.0), (2.0, 1.0)]):
        torch.testing.assert_close(length[classes == index], torch.full_like(length[classes == index], long))
        torch.testing.assert_close(width[classes == index], torch.full_like(width[classes == index], wide))


def test_map_prototypes_start_at_the_origin_and_the_first_is_straight(vocabulary):
    prototypes = vocabulary.map_prototypes
    assert 1 <= len(prototypes) <= 24
    torch.testing.assert_close(prototypes[:, 0], torch.zeros(len(prototypes), 2), atol=1e-5, rtol=0)
    torch.testing.assert_close(prototypes[0], torch.stack([torch.arange(11) * 0.5, torch.zeros(11)], -1))


@settings(max_examples=8, deadline=None)
@given(st.integers(2, 40), st.integers(1, 20), st.booleans())
def test_a_vocabulary_of_any_size_can_be_built(num_tokens, num_map_prototypes, mirror):
    config = TokensConfig(num_tokens=num_tokens, num_map_prototypes=num_map_prototypes, mirror=mirror)
    vocabulary, _ = build_vocabulary([scenes.crowd(num_agents=12)], config)
    assert vocabulary.num_tokens == num_tokens
    assert not vocabulary.poses[:, 0].any()
    if mirror:
        classes = measure_coverage([scenes.crowd(num_agents=12)], vocabulary)
        assert max(coverage.asymmetry_m for coverage in classes) < 1e-6
    assert len(vocabulary.map_prototypes) <= num_map_prototypes
    assert np.isfinite(vocabulary.corners.numpy()).all()


def test_data_without_cyclists_gives_cyclists_a_single_token():
    movers = tuple(m for m in scenes.TRAFFIC if m.kind != ObjectType.CYCLIST)
    data = [scenes.build_scenario("no cyclists", movers)]
    for kind in ("kdisks", "trajtok"):
        vocabulary, _ = build_vocabulary(data, replace(SMALL, kind=kind))
        assert vocabulary.token_mask[2].sum() == 1
        cyclists = measure_coverage(data, vocabulary)[2]
        assert (cyclists.single_m.count, cyclists.single_m.mean, cyclists.rolling_m.p95) == (0, 0.0, 0.0)


def test_no_scenario_gives_no_vocabulary():
    with pytest.raises(DataError, match="no scenario to build a vocabulary from"):
        build_vocabulary([], SMALL)


@pytest.mark.parametrize(
    "changes",
    [
        *({"num_tokens": 1}, {"num_map_prototypes": 0}, {"coverage": 0.0}, {"coverage": 1.1}),
        *({"max_segments": 0}, {"max_scenarios": 0}),
    ],
)
def test_impossible_settings_are_refused(changes):
    with pytest.raises(ConfigError):
        TokensConfig(**changes)


# ---- the file ------------------------------------------------------------------------------------


def test_a_vocabulary_comes_back_from_its_file(vocabulary, tmp_path):
    vocabulary.save(tmp_path / "new" / "v.safetensors")
    back = Vocabulary.load(tmp_path / "new" / "v.safetensors")
    assert torch.equal(back.corners, vocabulary.corners)
    assert torch.equal(back.token_mask, vocabulary.token_mask)
    assert torch.equal(back.map_prototypes, vocabulary.map_prototypes)
    assert back.origin == "a test"
    assert [p.name for p in (tmp_path / "new").iterdir()] == ["v.safetensors"]


@pytest.mark.parametrize(
    ("content", "words"),
    [(None, "no such vocabulary"), (b"garbage", "damaged vocabulary"), (b"", "damaged vocabulary")],
)
def test_a_file_that_is_not_a_vocabulary_is_refused(tmp_path, content, words):
    path = tmp_path / "v.safetensors"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(DataError, match=re.escape(str(path)) + f".*{words}.*rlftsim tokens"):
        Vocabulary.load(path)
