"""Attention along relations and tabulated embeddings against their plain definitions."""

import math
import weakref
from dataclasses import replace

import pytest
import torch
from torch.nn import functional

from rlftsim.policies.smart import attention as module
from rlftsim.policies.smart.attention import (
    EdgeGradients,
    NeighborBlock,
    Neighborhoods,
    RelationAttention,
    build_neighborhoods,
    gather_edges,
)
from rlftsim.policies.smart.embeddings import FourierEmbedding, Grid, TabulatedEmbedding, initialize, normalize
from rlftsim.policies.smart.neighbors import RowGroups

DIM, NUM_HEADS, HEAD_DIM, NUM_ROWS, NUM_SOURCES = 16, 2, 4, 60, 40


@pytest.fixture
def attention():
    torch.manual_seed(0)
    return RelationAttention(DIM, NUM_HEADS, HEAD_DIM, 0.0, separate_source_norm=True).double()


@pytest.fixture
def embedding():
    torch.manual_seed(1)
    embedding = FourierEmbedding(3, DIM, 8).double()
    initialize(embedding, "normal")
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
@pytest.mark.parametrize("padded", [True, False])
def test_messages_and_gradients_are_those_of_plain_attention(
    padded, floats_per_block, sources_are_shared, attention, embedding, scene, monkeypatch
):
    monkeypatch.setitem(module.FLOATS_PER_BLOCK, "cpu", floats_per_block)
    values, neighbors, mask, x, sources = scene
    shared, own = (normalize(sources), None) if sources_are_shared else (None, normalize(sources))
    around = build_neighborhoods(embedding, values, neighbors, mask, dim=DIM, padded=padded, features=shared)
    ours = attention._message(attention.target_norm(x), own, around, attention.fold())
    plain = plain_message(attention, embedding, values, neighbors, mask, x, sources)
    assert (ours - plain).abs().max() < 1e-10
    assert (ours[:3] == 0).all()  # nobody around
    trained = [x, sources, *embedding.parameters(), attention.source_key.weight, attention.relation_value.bias]
    for a, b in zip(*(torch.autograd.grad(m.square().sum(), trained) for m in (ours, plain))):
        assert (a - b).abs().max() < 1e-10


@pytest.mark.parametrize("sources_are_shared", [True, False])
@pytest.mark.parametrize("floats_per_block", [1 << 19, 1 << 10])
def test_rows_that_share_a_list_get_what_lists_of_their_own_give(
    floats_per_block, sources_are_shared, attention, embedding, scene, monkeypatch
):
    monkeypatch.setitem(module.FLOATS_PER_BLOCK, "cpu", floats_per_block)
    values, neighbors, mask, _, sources = scene
    generator = torch.Generator().manual_seed(6)
    sizes = torch.randint(1, 8, (NUM_ROWS,), generator=generator)
    groups = RowGroups(torch.randperm(int(sizes.sum()), generator=generator), sizes.numpy())
    list_of = torch.empty_like(groups.rows)
    list_of[groups.rows] = torch.arange(NUM_ROWS).repeat_interleave(sizes)  # list of each row
    x = torch.randn(len(list_of), DIM, generator=generator, dtype=torch.float64, requires_grad=True)
    shared, own = (normalize(sources), None) if sources_are_shared else (None, normalize(sources))
    together = build_neighborhoods(embedding, values, neighbors, mask, dim=DIM, features=shared, groups=groups)
    alone = build_neighborhoods(embedding, values[list_of], neighbors[list_of], mask[list_of], dim=DIM, features=shared)
    num_lists = [sum(len(block.neighbors) for block in around.blocks) for around in (together, alone)]
    assert num_lists[0] < num_lists[1] / 2
    trained = [x, sources, *embedding.parameters(), attention.source_key.weight, attention.relation_value.bias]
    messages = [attention._message(attention.target_norm(x), own, a, attention.fold()) for a in (together, alone)]
    assert (messages[0] - messages[1]).abs().max() < 1e-10
    for a, b in zip(*(torch.autograd.grad(m.square().sum(), trained, retain_graph=True) for m in messages)):
        assert (a - b).abs().max() < 1e-9
    with torch.no_grad():
        found = attention._message(attention.target_norm(x), own, together, attention.fold())
    assert (found - messages[1]).abs().max() < 1e-10


@pytest.fixture(params=[True, False], ids=["padded", "full"])
def blocks(request, monkeypatch):
    """Neighborhoods of 4 and 3 rows whose edge features are leaves, and features of sources; float64."""
    generator = torch.Generator().manual_seed(3)
    blocks, leaves = [], []
    for num_rows, num_neighbors in ((4, 3), (3, 6)):
        shape = (num_rows, num_neighbors)
        edges = torch.randn(*shape, DIM, generator=generator, dtype=torch.float64, requires_grad=True)
        count = torch.randint(1, num_neighbors + 1, (num_rows, 1), generator=generator)
        is_padding = torch.arange(num_neighbors) >= count if request.param else torch.zeros(shape, dtype=torch.bool)
        bias = torch.zeros(shape, dtype=torch.float64).masked_fill_(is_padding, module.IMPOSSIBLE)
        blocks.append(NeighborBlock(torch.randint(0, 5, shape, generator=generator), bias[:, None], edges))
        leaves.append(edges)
    sources = torch.randn(5, DIM, generator=generator, dtype=torch.float64, requires_grad=True)
    # dropout zeroes the same weights whenever it is called with the same shape
    kept = {(s, NUM_HEADS, k): torch.rand(s, NUM_HEADS, k, generator=generator) >= 0.3 for s, k in ((4, 3), (3, 6))}
    monkeypatch.setattr(module, "draw_dropout", lambda w, probability: kept[tuple(w.shape)] / (1 - probability))
    return tuple(blocks), leaves, sources


def plain_gather(queries, source, around, dropout):
    """`gather_edges` in operations that autograd knows."""
    sums, totals = [], []
    query = torch.cat(queries, -1)
    for block, block_query in zip(around.blocks, query.split(around.sizes)):
        edges = block.edge_features if source is None else torch.cat([block.edge_features, source[block.neighbors]], -1)
        weights = torch.softmax(torch.einsum("rhc,rkc->rhk", block_query, edges) + block.bias, -1)
        weights = weights * module.draw_dropout(weights, dropout) if dropout else weights
        sums.append(torch.einsum("rhk,rkc->rhc", weights, edges))
        totals.append(weights.sum(-1, keepdim=True))
    return torch.cat(sums).split([q.shape[-1] for q in queries], -1), torch.cat(totals)


def draw_queries(sources_are_shared):
    generator = torch.Generator().manual_seed(4)
    count = 1 if sources_are_shared else 2
    return tuple(
        torch.randn(7, NUM_HEADS, DIM, generator=generator, dtype=torch.float64, requires_grad=True)
        for _ in range(count)
    )


@pytest.mark.parametrize("dropout", [0.0, 0.3])
@pytest.mark.parametrize("sources_are_shared", [True, False])
def test_layers_that_share_edges_have_the_gradients_of_plain_attention(sources_are_shared, dropout, blocks):
    around = Neighborhoods(torch.arange(7), blocks[0], EdgeGradients.from_blocks(blocks[0]))
    source = None if sources_are_shared else blocks[2]
    queries = draw_queries(sources_are_shared)
    trained = [*blocks[1], *queries, *([] if source is None else [source])]

    def three_layers(gather):
        """Each layer's sums are the next one's queries."""
        total, current = torch.zeros((), dtype=torch.float64), queries
        for layer in range(1, 4):
            sums, weight = gather(current, source, around, dropout)
            total = total + layer * (sum(part.square().sum() for part in sums) + (weight.square() * layer).sum())
            current = tuple(query + part for query, part in zip(queries, sums))
        return total

    ours, plain = three_layers(gather_edges), three_layers(plain_gather)
    assert (ours - plain).abs() < 1e-9 * plain.abs()
    expected = torch.autograd.grad(plain, trained)
    for _ in range(2):  # sums of gradients begin anew in each backward pass
        for a, b in zip(torch.autograd.grad(ours, trained, retain_graph=True), expected):
            assert (a - b).abs().max() < 1e-10 * b.abs().max()


@pytest.mark.parametrize("sources_are_shared", [True, False])
def test_gradients_of_gathered_edges_are_those_of_finite_differences(sources_are_shared, blocks):
    source = None if sources_are_shared else blocks[2]

    def gather(edges, other_edges, *tensors):
        renewed = tuple(replace(b, edge_features=e) for b, e in zip(blocks[0], (edges, other_edges)))
        around = Neighborhoods(torch.arange(7), renewed, EdgeGradients.from_blocks(renewed))
        queries, own = (tensors, None) if source is None else (tensors[:-1], tensors[-1])
        sums, weight = gather_edges(queries, own, around, 0.3)
        return *sums, weight

    inputs = [*blocks[1], *draw_queries(sources_are_shared), *([] if source is None else [source])]
    assert torch.autograd.gradcheck(gather, inputs, fast_mode=True)


def test_edge_features_go_with_the_backward_pass(blocks):
    edges = blocks[1][0] * 1  # not a leaf: nothing but the graph needs it later
    first = replace(blocks[0][0], edge_features=edges)
    around = Neighborhoods(torch.arange(4), (first,), EdgeGradients.from_blocks([first]))
    memory = weakref.ref(edges.untyped_storage())
    sums, _ = gather_edges(tuple(q[:4] for q in draw_queries(True)), None, around, 0.0)
    loss = sums[0].sum()
    del edges, first, around, sums
    assert memory() is not None
    loss.backward()
    assert memory() is None  # although the loss is still there


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
        return attention._message(attention.target_norm(x), own, around, attention.fold())

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
        message = attention._message(attention.target_norm(x), normalize(sources), around, attention.fold())
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
