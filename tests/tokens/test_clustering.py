import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import scenes
from rlftsim.errors import ConfigError, DataError
from rlftsim.scenario.types import ObjectType
from rlftsim.tokens.clustering import TokensConfig, build_vocabulary, reconstruction_error
from rlftsim.tokens.vocabulary import Vocabulary

SMALL = TokensConfig(num_tokens=64, num_map_prototypes=24)


def test_token_0_of_every_class_stands_exactly_still(vocabulary):
    assert torch.equal(vocabulary.poses()[:, 0], torch.zeros(3, 5, 3))
    assert vocabulary.token_mask[:, 0].all()


def test_no_token_is_unused(built):
    _, reports = built
    assert [(r.class_name, r.unused_tokens) for r in reports] == [("vehicle", 0), ("pedestrian", 0), ("cyclist", 0)]


def test_the_wanted_share_of_motions_lies_within_a_disk(built):
    _, reports = built
    for report in reports:
        assert report.num_segments > 50
        assert report.num_tokens <= 64
        assert report.p95_error_m <= report.radius_m
        assert report.mean_error_m < report.radius_m


def test_more_tokens_mean_finer_disks(pack_scenarios, built):
    finer = build_vocabulary(pack_scenarios, replace(SMALL, num_tokens=256))[1]
    for coarse, fine in zip(built[1], finer):
        at_finest = coarse.radius_m < 0.022  # disks are never smaller than the jitter of recorded labels
        assert fine.radius_m < coarse.radius_m or (at_finest and fine == coarse)
    assert finer[0].mean_error_m < built[1][0].mean_error_m  # vehicles are far from that


def test_the_same_data_and_seed_give_the_same_vocabulary(pack_scenarios, vocabulary):
    again = build_vocabulary(pack_scenarios, SMALL)[0]
    assert torch.equal(again.corners, vocabulary.corners)
    assert torch.equal(again.map_prototypes, vocabulary.map_prototypes)
    other = build_vocabulary(pack_scenarios, replace(SMALL, seed=3))[0]
    assert not torch.equal(other.corners, vocabulary.corners)


def test_with_mirror_images_left_and_right_are_covered_alike():
    only_left = [scenes.build_scenario("left", tuple(
        scenes.Mover(kind, x_m=9.0 * k, speed_mps=3.0 + k, turn_rate_radps=0.1 * k)
        for k, kind in enumerate([ObjectType.VEHICLE, ObjectType.PEDESTRIAN, ObjectType.CYCLIST] * 2)
    ))]  # fmt: skip
    ends = {}
    for mirror in (True, False):
        vocabulary = build_vocabulary(only_left, replace(SMALL, num_tokens=512, mirror=mirror))[0]
        ends[mirror] = vocabulary.poses()[:, :, -1, 1][vocabulary.token_mask]
    assert ends[False].min() > -1e-3
    assert ends[True].min() < -0.03
    assert float(ends[True].min()) == pytest.approx(-float(ends[True].max()), rel=0.2)


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


def test_a_vocabulary_says_how_well_it_retells_the_data(pack_scenarios, vocabulary, built):
    errors = reconstruction_error(pack_scenarios, vocabulary)
    assert [name for name, *_ in errors] == ["vehicle", "pedestrian", "cyclist"]
    for (_, count, mean, p95), report in zip(errors, built[1]):
        assert count > 50
        assert 0 < mean < p95 < 3 * report.radius_m


@settings(max_examples=8, deadline=None)
@given(st.integers(2, 40), st.integers(1, 20), st.booleans())
def test_a_vocabulary_of_any_size_can_be_built(num_tokens, num_map_prototypes, mirror):
    config = TokensConfig(num_tokens=num_tokens, num_map_prototypes=num_map_prototypes, mirror=mirror)
    vocabulary, reports = build_vocabulary([scenes.crowd(num_agents=12)], config)
    assert vocabulary.num_tokens == num_tokens
    assert [int(row.sum()) for row in vocabulary.token_mask] == [r.num_tokens for r in reports]
    assert len(vocabulary.map_prototypes) <= num_map_prototypes
    assert np.isfinite(vocabulary.corners.numpy()).all()


@pytest.mark.xfail(strict=True, reason="a class without any motion ends in a numpy error about reshaping")
def test_data_without_cyclists_gives_cyclists_a_single_token():
    movers = tuple(m for m in scenes.TRAFFIC if m.kind != ObjectType.CYCLIST)
    vocabulary, reports = build_vocabulary([scenes.build_scenario("no cyclists", movers)], SMALL)
    assert vocabulary.token_mask[2].sum() == 1
    assert reports[2].num_segments == 0


def test_no_scenario_gives_no_vocabulary():
    with pytest.raises(DataError, match="no scenario to build a vocabulary from"):
        build_vocabulary([], SMALL)


@pytest.mark.parametrize("changes", [{"num_tokens": 1}, {"num_map_prototypes": 0}, {"coverage": 0.0}, {"coverage": 1.1}])  # fmt: skip
def test_impossible_settings_are_refused(changes):
    with pytest.raises(ConfigError):
        TokensConfig(**changes)


# ---- the file ---------------------------------------------------------------------------------------------------------


def test_a_vocabulary_comes_back_from_its_file(vocabulary, tmp_path):
    vocabulary.save(tmp_path / "new" / "v.safetensors")
    back = Vocabulary.load(tmp_path / "new" / "v.safetensors")
    assert torch.equal(back.corners, vocabulary.corners)
    assert torch.equal(back.token_mask, vocabulary.token_mask)
    assert torch.equal(back.map_prototypes, vocabulary.map_prototypes)
    assert back.origin == "a test"
    assert [p.name for p in (tmp_path / "new").iterdir()] == ["v.safetensors"]


@pytest.mark.parametrize(("content", "words"), [(None, "no such vocabulary"), (b"garbage", "damaged vocabulary"), (b"", "damaged vocabulary")])  # fmt: skip
def test_a_file_that_is_no_vocabulary_is_refused(tmp_path, content, words):
    path = tmp_path / "v.safetensors"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(DataError, match=re.escape(str(path)) + f".*{words}.*rlftsim tokens"):
        Vocabulary.load(path)
