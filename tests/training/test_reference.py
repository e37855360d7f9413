import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import nn

from rlftsim.errors import ConfigError
from rlftsim.training.config import KlConfig
from rlftsim.training.reward import adapt_beta, sync_reference

CONFIG = KlConfig()  # target 0.01, horizon 5


@pytest.mark.parametrize(
    ("kl", "factor"),
    [
        (0.01, 1.0),  # on target
        (0.011, 1.0 + 0.1 / 5),  # 10 % above: within the clip
        (0.0095, 1.0 - 0.05 / 5),
        (0.5, 1.0 + 0.2 / 5),  # far above: clipped to + 20 %
        (0.0, 1.0 - 0.2 / 5),  # far below: clipped to - 20 %
    ],
)
def test_beta_follows_its_closed_form(kl, factor):
    assert adapt_beta(0.1, kl, CONFIG) == pytest.approx(0.1 * factor)


def test_beta_stays_within_its_bounds():
    assert adapt_beta(1e3, 1.0, CONFIG) == 1e3
    assert adapt_beta(1e-3, 0.0, CONFIG) == 1e-3


def test_many_updates_far_above_the_target_raise_beta_geometrically():
    beta = 0.1
    for _ in range(20):
        beta = adapt_beta(beta, 1.0, CONFIG)
    assert beta == pytest.approx(0.1 * 1.04**20)


@given(st.floats(1e-3, 1e3), st.floats(0, 10))
def test_beta_moves_towards_what_the_kl_asks_for_and_by_at_most_4_percent(beta, kl):
    new = adapt_beta(beta, kl, CONFIG)
    assert CONFIG.min_beta <= new <= CONFIG.max_beta
    assert abs(new / beta - 1) <= 0.04 + 1e-9
    assert (new - beta) * (kl - CONFIG.target) >= 0


@pytest.mark.parametrize(
    "changes", [{"target": 0.0}, {"horizon": -1.0}, {"initial_beta": 1e-4}, {"min_beta": 0.0}, {"max_beta": 0.05}]
)
def test_impossible_settings_are_refused(changes):
    with pytest.raises(ConfigError):
        KlConfig(**changes)


def test_the_reference_moves_a_share_of_the_way():
    policy, reference = nn.Linear(1, 1), nn.Linear(1, 1)
    with torch.no_grad():
        policy.weight.fill_(3.0)
        reference.weight.fill_(1.0)
    reference.requires_grad_(False)
    sync_reference(reference, policy, 0.25)  # 0.25 * 3 + 0.75 * 1
    assert reference.weight.item() == pytest.approx(1.5)
    assert policy.weight.item() == 3.0


def test_a_share_of_zero_or_one_keeps_or_copies():
    policy, reference = nn.Linear(2, 2), nn.Linear(2, 2).requires_grad_(False)
    before = reference.weight.clone()
    sync_reference(reference, policy, 0.0)
    assert torch.equal(reference.weight, before)
    sync_reference(reference, policy, 1.0)
    torch.testing.assert_close(reference.weight, policy.weight.detach())
