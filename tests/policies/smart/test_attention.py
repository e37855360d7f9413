"""Attention along relations and tabulated embeddings against their plain definitions."""

import math

import pytest
import torch
from torch.nn import functional

from rlftsim.policies.smart import attention as module
from rlftsim.policies.smart.attention import RelationAttention, build_neighborhoods
from rlftsim.policies.smart.embeddings import FourierEmbedding, Grid, TabulatedEmbedding, initialize, normalize

DIM, NUM_HEADS, HEAD_DIM, NUM_ROWS, NUM_SOURCES = 16, 2, 4, 60, 40


@pytest.fixture
def attention():
    torch.manual_seed(0)
    return RelationAttention(DIM, NUM_HEADS, HEAD_DIM, 0.0, separate_source_norm=True).double()


@pytest.fixture
def embedding():
    torch.manual_seed(1)
    embedding = FourierEmbedding(3, DIM, 8).double()
    initialize(embedding)
    return embedding


@pytest.fixture
def scene():
    """Values, neighbors and mask of rows with none to many neighbors, in no order; features of rows and sources."""
    torch.manual_seed(2)
    count = torch.randint(0, NUM_SOURCES, (NUM_ROWS,))
    count[:3] = 0
    mask = torch.arange(NUM_SOURCES) < count[:, None]
    neighbors = torch.rand(NUM_ROWS, NUM_SOURCES).argsort(-1)
    values = torch.rand(NUM_ROWS, NUM_SOURCES, 3, dtype=torch.float64) * torch.tensor([30.0, 2 * math.pi, 2 * math.pi])
    values = values - torch.tensor([0.0, math.pi, math.pi])
    features = (torch.randn(n, DIM, dtype=torch.float64, requires_grad=True) for n in (NUM_ROWS, NUM_SOURCES))
    return values, neighbors, mask, *features


def plain_message(layer, embedding, values, neighbors, mask, x, sources):
    """Every edge projected, one softmax over all padded neighbors."""
    relation = layer.relation_norm(embedding(values.flatten(0, 1)).unflatten(0, mask.shape))
    source = layer.source_norm(sources)[neighbors]
    shape = (*mask.shape, NUM_HEADS, HEAD_DIM)
    query = layer.query(layer.target_norm(x)).view(NUM_ROWS, NUM_HEADS, HEAD_DIM)
    key = (layer.source_key(source) + layer.relation_key(relation)).view(shape)
    value = (layer.source_value(source) + layer.relation_value(relation)).view(shape)
    scores = torch.einsum("rhd,rkhd->rhk", query, key) / math.sqrt(HEAD_DIM)
    weights = functional.softmax(scores.masked_fill(~mask[:, None], -1e9), -1) * mask[:, None]
    return torch.einsum("rhk,rkhd->rhd", weights, value).flatten(1)


@pytest.mark.parametrize("sources_are_shared", [True, False])
@pytest.mark.parametrize("floats_per_block", [1 << 19, 1 << 10])
def test_messages_and_gradients_are_those_of_plain_attention(
    floats_per_block, sources_are_shared, attention, embedding, scene, monkeypatch
):
    monkeypatch.setitem(module.FLOATS_PER_BLOCK, "cpu", floats_per_block)
    values, neighbors, mask, x, sources = scene
    shared, own = (normalize(sources), None) if sources_are_shared else (None, normalize(sources))
    around = build_neighborhoods(embedding, values, neighbors, mask, dim=DIM, features=shared)
    ours = attention._message(attention.target_norm(x), own, around)
    plain = plain_message(attention, embedding, values, neighbors, mask, x, sources)
    assert (ours - plain).abs().max() < 1e-10
    assert (ours[:3] == 0).all()  # nobody around
    trained = [x, sources, *embedding.parameters(), attention.source_key.weight, attention.relation_value.bias]
    for a, b in zip(*(torch.autograd.grad(m.square().sum(), trained) for m in (ours, plain))):
        assert (a - b).abs().max() < 1e-10


@pytest.mark.parametrize("sources_are_shared", [True, False])
@pytest.mark.parametrize("is_tabulated", [True, False])
def test_messages_without_gradient_are_those_with_one(is_tabulated, sources_are_shared, attention, embedding, scene):
    values, neighbors, mask, x, sources = scene
    shared, own = (normalize(sources), None) if sources_are_shared else (None, normalize(sources))
    if is_tabulated:
        angle = Grid(-math.pi, math.pi, 2049)
        embedding = TabulatedEmbedding.build(embedding, (Grid(0.0, math.sqrt(30), 4207, of_roots=True), angle, angle))

    def message():
        around = build_neighborhoods(embedding, values, neighbors, mask, dim=DIM, features=shared)
        return attention._message(attention.target_norm(x), own, around)

    with torch.no_grad():
        found = message()
    assert not found.requires_grad
    assert (found - message()).abs().max() < 1e-10


def test_a_frozen_embedding_may_have_been_tabulated_without_gradient(attention, embedding, scene):
    values, neighbors, mask, x, sources = scene
    angle = Grid(-math.pi, math.pi, 2049)
    with torch.no_grad():
        table = TabulatedEmbedding.build(embedding, (Grid(0.0, math.sqrt(30), 4207, of_roots=True), angle, angle))
    assert not table.is_frozen  # its last map is trained
    gradients = []
    for frozen in (False, True):
        embedding.requires_grad_(not frozen)
        around = build_neighborhoods(table, values, neighbors, mask, dim=DIM)
        assert around.blocks[0].edge_features.requires_grad != frozen
        message = attention._message(attention.target_norm(x), normalize(sources), around)
        gradients.append(torch.autograd.grad(message.square().sum(), (x, sources, attention.query.weight)))
    for a, b in zip(*gradients):
        assert (a - b).abs().max() < 1e-10


def test_rows_are_cut_so_that_little_is_padded(embedding, scene):
    values, neighbors, mask, *_ = scene
    around = build_neighborhoods(embedding, values, neighbors, mask, dim=DIM)
    assert around.rows.sort().values.tolist() == mask.any(-1).nonzero()[:, 0].tolist()
    padded = sum(block.bias.numel() for block in around.blocks)
    assert mask.sum() <= padded < 1.25 * mask.sum()


def test_a_table_is_its_embedding_and_so_are_its_gradients(embedding, scene):
    values = scene[0].flatten(0, 1)
    angle = Grid(-math.pi, math.pi, 2049)
    table = TabulatedEmbedding.build(embedding, (Grid(0.0, math.sqrt(30), 4207, of_roots=True), angle, angle))
    ours, exact = table(values), embedding(values)
    assert (ours - exact).abs().max() < 2e-3 * exact.std()
    trained = list(embedding.parameters())
    for a, b in zip(*(torch.autograd.grad(e.square().sum(), trained) for e in (ours, exact))):
        assert (a - b).norm() < 2e-3 * b.norm()
