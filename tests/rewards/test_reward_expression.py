"""Rewards as a person writes them."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rlftsim.cli.main import parse
from rlftsim.errors import ConfigError
from rlftsim.rewards import Term, parse_reward, write_reward
from rlftsim.training.finetune_config import FinetuneConfig

NAMES = ["mloo", "rloo", "minade_rloo", "collision_offroad"]


@pytest.mark.parametrize(
    ("text", "weights"),
    [
        ("mloo", {"mloo": 1.0}),
        (" 0.9*mloo+0.1*rloo ", {"mloo": 0.9, "rloo": 0.1}),
        ("mloo + collision_offroad*2", {"mloo": 1.0, "collision_offroad": 2.0}),
        ("0.5*(mloo - 2*rloo)", {"mloo": 0.5, "rloo": -1.0}),
        ("-minade_rloo - -1e-3*mloo", {"minade_rloo": -1.0, "mloo": 1e-3}),
        ("+mloo", {"mloo": 1.0}),
        ("mloo - (rloo - minade_rloo)", {"mloo": 1.0, "rloo": -1.0, "minade_rloo": 1.0}),
        ("0*rloo + mloo", {"rloo": 0.0, "mloo": 1.0}),  # logged, not learned from
    ],
)
def test_sums_are_read_as_arithmetic(text, weights):
    assert {term.name: term.weight for term in parse_reward(text)} == weights


def test_options_have_their_defaults_filled_in():
    assert parse_reward("collision_offroad_ade") == (Term(1.0, "collision_offroad_ade", (("ade_weight", 0.1),)),)
    assert parse_reward("collision_offroad_ade(ade_weight=2)")[0].options == (("ade_weight", 2.0),)


@pytest.mark.parametrize(
    ("text", "written"),
    [
        ("mloo", "mloo"),
        ("1.0*mloo+2*rloo", "mloo + 2*rloo"),
        ("-mloo-.5*rloo", "- mloo - 0.5*rloo"),
        ("mloo+0.1*collision_offroad_ade", "mloo + 0.1*collision_offroad_ade(ade_weight=0.1)"),
    ],
)
def test_every_sum_has_one_spelling(text, written):
    assert write_reward(parse_reward(text)) == written


@given(st.dictionaries(st.sampled_from(NAMES), st.floats(-1e6, 1e6), min_size=1).filter(lambda d: any(d.values())))
def test_what_is_written_is_read_again(weights):
    terms = tuple(Term(weight, name) for name, weight in weights.items())
    assert parse_reward(write_reward(terms)) == terms


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("joy", "unknown reward 'joy': known are collision_offroad, .*mloo"),
        ("mloo + 0.1*joy", "unknown reward 'joy'"),
        ("mloo +", "'mloo \\+' cannot be read: write a sum of rewards, such as 'mloo \\+ 0.1\\*collision_offroad'"),
        ("", "cannot be read"),
        ("0.1", "cannot be read"),
        ("mloo*rloo", "cannot be read"),
        ("mloo/2", "cannot be read"),
        ("1e999*mloo", "cannot be read"),
        ("True*mloo", "cannot be read"),
        ("'a'*mloo", "cannot be read"),
        ("mloo.real", "cannot be read"),
        ("mloo(3)", "cannot be read"),
        ("collision_offroad_ade(ade_weight=1, ade_weight=2)", "cannot be read"),
        ("collision_offroad_ade(**{})", "cannot be read"),
        ("collision_offroad_ade(ade_weight=1e999)", "expected a finite number, got inf"),
        ("collision_offroad_ade(ade_weight=x)", "cannot be read"),
        ("0*mloo", "is always 0: give one of its terms a weight"),
        ("mloo + 0.5*mloo", "has mloo 2 times: name it once"),
        ("mloo(n=3)", "reward mloo has no option 'n': it has none"),
        ("collision_offroad_ade(w=1)", "no option 'w': known are ade_weight"),
        ("collision_offroad_ade(ade_weight='much')", r"ade_weight=\.\.\.\): expected float, got 'much'"),
    ],
)
def test_what_is_no_sum_of_rewards_is_refused_in_words(text, words):
    with pytest.raises(ConfigError, match=words):
        parse_reward(text)


def test_the_command_line_sets_a_sum():
    words = ["finetune", "smart-demo", "--model", "m", "--data", "d", "--out", "o", "--finetune.reward"]
    finetune = parse([*words, "mloo + 0.1*collision_offroad_ade(ade_weight=0.2)"]).values["recipe"].finetune
    assert finetune.reward == "mloo + 0.1*collision_offroad_ade(ade_weight=0.2)"
    with pytest.raises(ConfigError, match="unknown reward 'joy'"):
        parse([*words, "mloo + joy"])


def test_two_spellings_of_a_reward_are_one_configuration():
    assert FinetuneConfig(reward="1*mloo+.1*rloo") == FinetuneConfig(reward="mloo + 0.1 * rloo")
