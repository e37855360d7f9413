"""Dropout masks from 16-bit integers."""

import math

import pytest
import torch

from rlftsim.policies.smart.attention import Dropout, draw_dropout


@pytest.mark.parametrize("probability", [0.1, 0.25, 0.5])
def test_the_share_of_zeros_is_the_probability_and_the_mean_is_one(probability):
    torch.manual_seed(0)
    factors = draw_dropout(torch.empty(1000, 1003), probability)
    count = factors.numel()
    dropped = float((factors == 0).double().mean())
    error = math.sqrt(probability * (1 - probability) / count)
    assert abs(dropped - probability) < 4 * error + 0.5 / (1 << 16)
    kept = factors[factors > 0]
    assert (kept == kept[0]).all()
    assert kept[0] == pytest.approx(1 / (1 - probability), rel=2e-5)
    assert abs(float(factors.double().mean()) - 1) < 4 * error / (1 - probability)


def test_zeros_are_independent_of_their_neighbors():
    """Four masks come from one random number."""
    torch.manual_seed(1)
    dropped = (draw_dropout(torch.empty(1 << 20), 0.1) == 0).double() - 0.1
    for lag in range(1, 9):
        correlation = float((dropped[lag:] * dropped[:-lag]).mean()) / 0.09
        assert abs(correlation) < 4 / math.sqrt(len(dropped))


def test_shapes_that_are_no_multiple_of_four_and_other_types():
    for shape in ((), (1,), (3, 1), (0, 5), (2, 3, 7)):
        assert draw_dropout(torch.empty(shape, dtype=torch.float64), 0.5).shape == shape
    assert draw_dropout(torch.empty(5, dtype=torch.bfloat16), 0.5).dtype == torch.bfloat16


def test_a_seed_gives_the_same_mask_again_and_the_gradient_has_it():
    dropout, x = Dropout(0.4), torch.ones(50, requires_grad=True)
    torch.manual_seed(2)
    first = dropout(x)
    torch.manual_seed(2)
    assert torch.equal(first, dropout(x))
    [gradient] = torch.autograd.grad(first.sum(), x)
    assert torch.equal(gradient, first)


def test_evaluation_mode_leaves_everything_as_it_is():
    x = torch.randn(10)
    assert Dropout(0.4).eval()(x) is x
    assert Dropout(0.0)(x) is x
