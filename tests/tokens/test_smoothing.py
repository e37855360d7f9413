"""Label smoothing over near tokens: known probabilities, sums to one, a gradient that is the weights."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from rlftsim.tokens.motions import boxes
from rlftsim.tokens.smoothing import neighbor_weights, summed_log_prob_nearby
from rlftsim.tokens.vocabulary import Vocabulary


def by_hand(*ahead_m: float, alone: bool = False) -> Vocabulary:
    """Straight tokens by their way; `alone`: cyclists have the first one only."""
    poses = np.zeros((len(ahead_m), 6, 3), np.float32)
    poses[..., 0] = np.array(ahead_m)[:, None] * np.linspace(0, 1, 6)
    corners = torch.stack([boxes(poses, index) for index in range(3)])
    mask = torch.ones(corners.shape[:2], dtype=torch.bool)
    mask[2, 1:] = not alone
    return Vocabulary(corners, mask, torch.zeros(1, 11, 2))


def test_the_mass_falls_with_the_square_of_the_distance():
    weights = neighbor_weights(by_hand(0.0, 1.0, 3.0), torch.tensor([0, 0]), torch.tensor([0, 1]))
    first = np.array([0.0, 1 / 1.0001**2, 1 / 3.0001**2])
    second = np.array([1 / 1.0001**2, 0.0, 1 / 2.0001**2])
    np.testing.assert_allclose(weights, [first / first.sum(), second / second.sum()], rtol=1e-4)


def test_tokens_that_do_not_exist_get_nothing_and_a_lonely_one_keeps_its_own():
    weights = neighbor_weights(by_hand(0.0, 1.0, 3.0, alone=True), torch.tensor([2, 1]), torch.tensor([0, 2]))
    assert weights[0].tolist() == [1.0, 0.0, 0.0]
    assert weights[1].sum() == pytest.approx(1.0)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**31), st.integers(1, 50))
def test_the_gradient_is_the_weight_of_each_token(seed, num_rows):
    vocabulary = by_hand(0.0, 0.5, 1.0, 3.0, 9.0, alone=True)
    generator = torch.Generator().manual_seed(seed)
    class_id = torch.randint(0, 2, (num_rows,), generator=generator)
    target = torch.randint(0, 5, (num_rows,), generator=generator)
    log_probs = torch.randn(num_rows, 5, generator=generator).log_softmax(-1).requires_grad_()
    summed = summed_log_prob_nearby(log_probs, target, class_id, vocabulary)
    weights = neighbor_weights(vocabulary, class_id, target)
    torch.testing.assert_close(summed, (weights * log_probs).sum(), rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(torch.autograd.grad(summed, log_probs)[0], weights)


@pytest.mark.official
def test_with_the_published_vehicles_the_nearest_token_gets_9_percent_and_ten_get_38(shared):
    table = torch.from_numpy(np.load(shared / "data" / "tokens" / "agent_vocab_555_s2.npz")["veh"])[None]
    vocabulary = Vocabulary(table, torch.ones(1, 2048, dtype=torch.bool), torch.zeros(1, 11, 2))
    every = torch.arange(2048)
    largest = neighbor_weights(vocabulary, torch.zeros_like(every), every).sort(-1, descending=True).values
    assert largest[:, 0].median() == pytest.approx(0.09, abs=0.005)
    assert largest[:, :10].sum(-1).mean() == pytest.approx(0.38, abs=0.015)
