"""Statistics of rows without their logits, against torch's own softmax and autograd in float64."""

import pytest
import torch
from torch import nn
from torch.nn import functional

from rlftsim.policies import distributions
from rlftsim.policies.distributions import LazyTokenDistribution, TokenDistribution, TokenRows, compute_row_statistics

NUM_ROWS, WIDTH, NUM_TOKENS = 70, 6, 40


def random_rows(seed, class_id=None, exists=None, dtype=torch.float64):
    torch.manual_seed(seed)
    last = nn.Linear(WIDTH, NUM_TOKENS, dtype=dtype)
    hidden = torch.randn(NUM_ROWS, WIDTH, dtype=dtype, requires_grad=True)
    class_id = torch.randint(3, (NUM_ROWS,)) if class_id is None else class_id
    return TokenRows(
        hidden, last.weight, last.bias, class_id, torch.rand(3, NUM_TOKENS) < 0.8 if exists is None else exists
    )


@pytest.fixture
def rows():
    return random_rows(0)


@pytest.fixture
def reference(rows):
    return random_rows(1, rows.class_id, rows.exists)


@pytest.fixture
def chosen(rows):
    return rows.exists[rows.class_id].double().multinomial(1)[:, 0]


@pytest.fixture(autouse=True)
def small_blocks(monkeypatch):
    """Several blocks, the last of which is not full."""
    monkeypatch.setitem(distributions.ROWS_PER_BLOCK, "cpu", 16)


def inputs(rows):
    return rows.hidden, rows.weight, rows.bias


def by_autograd(rows, reference, chosen):
    """Log-probability, KL and entropy by their definitions, token after token."""
    exists = rows.exists[rows.class_id]
    log_p, log_q = (
        functional.linear(r.hidden, r.weight, r.bias).masked_fill(~exists, -torch.inf).log_softmax(-1)
        for r in (rows, reference)
    )
    p = log_p.exp()
    # what does not exist has probability 0 and no part in a sum
    log_p, log_q = (torch.where(exists, values, 0.0) for values in (log_p, log_q))
    return log_p.gather(-1, chosen[:, None])[:, 0], (p * (log_p - log_q)).sum(-1), -(p * log_p).sum(-1)


def test_the_statistics_are_those_of_the_softmax(rows, reference, chosen):
    found, expected = compute_row_statistics(rows, chosen, reference), by_autograd(rows, reference, chosen)
    for value, other in zip(found, expected, strict=True):
        torch.testing.assert_close(value, other, atol=1e-12, rtol=0)
    assert expected[1].min() > 0.01


@pytest.mark.parametrize("statistic", range(3), ids=["log-probability", "KL", "entropy"])
def test_their_gradients_are_those_of_autograd(rows, reference, chosen, statistic):
    weights = torch.linspace(-1, 1, NUM_ROWS, dtype=torch.float64)
    gradients = [
        torch.autograd.grad((weights * statistics[statistic]).sum(), inputs(rows))
        for statistics in (compute_row_statistics(rows, chosen, reference), by_autograd(rows, reference, chosen))
    ]
    for found, expected in zip(*gradients, strict=True):
        assert expected.abs().max() > 0.1
        torch.testing.assert_close(found, expected, atol=1e-12, rtol=0)


def test_no_gradient_flows_into_the_reference(rows, reference, chosen):
    sum(value.sum() for value in compute_row_statistics(rows, chosen, reference)).backward()
    assert rows.hidden.grad is not None
    assert all(value.grad is None for value in inputs(reference))


def test_gradients_of_float32_are_as_exact_as_those_of_autograd(chosen):
    """Largest error beside float64, relative to the largest gradient."""
    exact, other = random_rows(0), random_rows(1)
    single = [random_rows(seed, exact.class_id, exact.exists, torch.float32) for seed in (0, 1)]
    for rows, doubled in zip(single, (exact, other)):
        with torch.no_grad():
            for value, wanted in zip(inputs(rows), inputs(doubled)):
                value.copy_(wanted)
                wanted.copy_(value)  # the same numbers, rounded
    other = TokenRows(other.hidden, other.weight, other.bias, exact.class_id, exact.exists)
    truth, found, usual = (
        torch.autograd.grad(sum(value.sum() for value in statistics), inputs(rows))
        for rows, statistics in (
            (exact, by_autograd(exact, other, chosen)),
            (single[0], compute_row_statistics(single[0], chosen, single[1])),
            (single[0], by_autograd(*single, chosen)),
        )
    )
    for value, theirs, wanted in zip(found, usual, truth):
        scale = float(wanted.abs().max())
        assert float((value - wanted).abs().max()) / scale < 1e-6
        assert float((theirs - wanted).abs().max()) / scale < 1e-6


def test_a_lazy_distribution_is_the_one_with_its_logits(rows, reference, chosen):
    mask = torch.rand(2, NUM_ROWS, generator=torch.Generator().manual_seed(3)).argsort(-1) < NUM_ROWS // 2
    decision = torch.zeros(mask.shape, dtype=torch.int64).masked_scatter(mask, chosen)
    lazy, other = (LazyTokenDistribution(r, mask) for r in (rows, reference))
    eager, others = (TokenDistribution(dist.logits, mask) for dist in (lazy, other))
    found = lazy.statistics(decision, other)
    torch.testing.assert_close(found.log_prob, eager.log_prob(decision), atol=1e-12, rtol=0)
    torch.testing.assert_close(found.kl, eager.kl(others), atol=1e-12, rtol=0)
    torch.testing.assert_close(found.entropy, eager.entropy(), atol=1e-12, rtol=0)
    torch.testing.assert_close(lazy.log_prob(decision), eager.log_prob(decision), atol=1e-12, rtol=0)
    # beside one whose logits are at hand it falls back to these
    fallback = lazy.statistics(decision, others)
    torch.testing.assert_close(fallback.kl, found.kl, atol=1e-12, rtol=0)
    assert (found.kl[~mask] == 0).all()


def test_the_statistics_hold_no_tensor_of_rows_times_vocabulary(rows, reference, chosen, monkeypatch):
    held = []

    def remember(value):
        held.append(value.numel())
        return value

    with torch.autograd.graph.saved_tensors_hooks(remember, lambda value: value):
        compute_row_statistics(rows, chosen, reference)
    assert max(held) < NUM_ROWS * NUM_TOKENS / 4
