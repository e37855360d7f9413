"""The network on scenario A against the public code: who looks at whom, every layer, logits."""

from dataclasses import dataclass, field

import numpy as np
import pytest
import torch
from torch import nn

from rlftsim.policies.smart.attention import RelationAttention
from rlftsim.policies.smart.embeddings import normalize

pytestmark = pytest.mark.official
LOGIT_TOLERANCE = 1e-4
RADIUS_TOLERANCE = 1e-6
"""Relative; edges nearer than this to the radius may be on either side."""
NUM_AGENTS, NUM_STEPS = 50, 17


@dataclass
class Seen:
    """What went through each module of a network in one pass, in calling order."""

    inputs: dict[str, list[tuple]] = field(default_factory=dict)
    outputs: dict[str, list[torch.Tensor]] = field(default_factory=dict)


def watch(network: nn.Module, seen: Seen) -> list:
    def keep(name):
        def hook(module, inputs, output):
            seen.inputs.setdefault(name, []).append(inputs)
            seen.outputs.setdefault(name, []).append(output)

        return hook

    kinds = (RelationAttention, type(network.decoder.motion), type(network.decoder.fusion), type(network.map_encoder))
    return [part.register_forward_hook(keep(name)) for name, part in network.named_modules() if isinstance(part, kinds)]


@dataclass(frozen=True)
class Pass:
    """A teacher-forced pass of a policy."""

    logits: np.ndarray
    """[A, 16, V], zeros where invalid."""
    rows: tuple[np.ndarray, np.ndarray]
    """Agent and step of each row of the decoder."""
    seen: Seen


def look(policy, batch) -> Pass:
    seen = Seen()
    hooks = watch(policy.network, seen)
    with torch.no_grad():
        logits = policy.teacher_forced(batch, batch.agent_mask).logits
    for hook in hooks:
        hook.remove()
    valid = policy._tokenize(batch).valid[0, :, :NUM_STEPS]
    placed = torch.zeros(NUM_AGENTS, NUM_STEPS - 1, logits.shape[-1])
    placed[valid[:, 1:]] = logits
    agent, step = valid.numpy().nonzero()
    return Pass(placed.numpy(), (agent, step), seen)


@pytest.fixture(scope="module")
def passes(nano, batch_a):
    return {frame: look(nano, batch_a(frame)) for frame in ("centred", "absolute")}


def check_logits(done: Pass, expected: dict[str, np.ndarray]) -> None:
    valid, agents = expected["valid"], expected["agents"]
    logits = torch.from_numpy(done.logits)
    few = valid[agents]
    assert np.abs(done.logits[agents] - expected["logits"])[few].max() < LOGIT_TOLERANCE
    assert np.abs(logits.logsumexp(-1).numpy() - expected["logsumexp"])[valid].max() < LOGIT_TOLERANCE
    np.testing.assert_array_equal(logits.argmax(-1).numpy()[valid], expected["argmax"][valid])


@pytest.mark.parametrize("frame", ["centred", "absolute"])
def test_logits_of_nano(frame, passes, golden):
    check_logits(passes[frame], golden.arrays(f"nano/{frame}_forward"))


@pytest.mark.parametrize("frame", ["centred", "absolute"])
def test_log_probabilities_of_what_came_next(frame, passes, golden, batch_a, nano):
    expected = golden.arrays(f"nano/{frame}_forward")
    came = nano._tokenize(batch_a(frame)).token_id[0, :, 2:]
    log_prob = torch.from_numpy(passes[frame].logits).log_softmax(-1).gather(-1, came[..., None])[..., 0]
    both = expected["valid"] & golden.arrays(f"scenario_A/tokens_{frame}")["valid_mask"][:, 2:]
    assert np.abs(log_prob.numpy() - expected["logp_gt_idx"])[both].max() < LOGIT_TOLERANCE


@pytest.mark.parametrize("frame", ["centred", "absolute"])
def test_features_before_the_decoder_and_of_the_map(frame, passes, golden):
    expected = golden.arrays(f"nano/{frame}_forward")
    done = passes[frame]
    (of_map,) = done.seen.outputs["map_encoder"]
    assert np.abs(of_map[::8].numpy() - expected["map_features_every8"]).max() < LOGIT_TOLERANCE
    (fused,) = done.seen.outputs["decoder.fusion"]
    compare_rows(fused, done.rows, expected["agents"], expected["agent_features0"])


def compare_rows(ours: torch.Tensor, rows, agents: np.ndarray, expected: np.ndarray) -> None:
    """Rows of the decoder against [n, 18, D]."""
    placed = np.zeros((NUM_AGENTS, NUM_STEPS, ours.shape[-1]), np.float32)
    placed[rows] = ours.numpy()
    is_row = np.zeros((NUM_AGENTS, NUM_STEPS), bool)
    is_row[rows] = True
    assert np.abs(placed[agents] - expected[:, :NUM_STEPS])[is_row[agents]].max() < LOGIT_TOLERANCE


@pytest.mark.parametrize("layer", range(4))
def test_output_of_each_decoder_layer(layer, passes, golden):
    expected, done = golden.arrays("nano/centred_layers"), passes["centred"]
    for kind, name in (("time", "1temporal"), ("map", "2map"), ("agent", "3agent")):
        (ours,) = done.seen.outputs[f"decoder.{kind}_layers.{layer}"]
        compare_rows(ours, done.rows, expected["agents"], expected[f"layer/layer{layer}_{name}"])


@pytest.mark.parametrize("layer", range(2))
def test_output_of_each_map_layer(layer, passes, golden):
    (ours,) = passes["centred"].seen.outputs[f"map_encoder.layers.{layer}"]
    expected = golden.arrays("nano/centred_layers")[f"layer/map_layer{layer}"]
    assert np.abs(ours[::8].numpy() - expected).max() < LOGIT_TOLERANCE


@pytest.mark.parametrize(
    ("kind", "name"),
    [
        ("t", "decoder.time_relation"),
        ("pl2a", "decoder.map_relation"),
        ("a2a", "decoder.agent_relation"),
        ("pt2pt", "map_encoder.relation"),
    ],
)
def test_relation_embeddings(kind, name, nano, golden):
    arrays = golden.arrays("nano/centred_layers")
    with torch.no_grad():
        ours = nano.network.get_submodule(name)(torch.from_numpy(arrays[f"embed/{kind}/in"]))
    assert np.abs(ours.numpy() - arrays[f"embed/{kind}/out"]).max() < LOGIT_TOLERANCE


def test_motion_embedding(nano, golden, batch_a):
    arrays = golden.arrays("nano/centred_layers")
    decoder, batch = nano.network.decoder, batch_a("centred")
    with torch.no_grad():
        of_agents = nano._build_scene(batch).agent_features[0]
        for value, expected in zip(arrays["embed/x_a/in"], arrays["embed/x_a/out"]):
            # the file does not say whose row it is
            ours = decoder.motion(torch.from_numpy(value).expand(NUM_AGENTS, 2), of_agents)
            assert np.abs(ours.numpy() - expected).max(-1).min() < LOGIT_TOLERANCE


def edges_of(done: Pass, name: str) -> list[tuple[np.ndarray, np.ndarray]]:
    """Row and neighbor of each edge of the first layer of a kind."""
    _, _, around, *_ = done.seen.inputs[f"{name}.0"][0]
    rows, neighbors = [], []
    for of_block, block in zip(around.rows.split(around.sizes), around.blocks):
        row, column = (block.bias[:, 0] == 0).nonzero(as_tuple=True)
        rows.append(of_block[row].numpy())
        neighbors.append(block.neighbors[row, column].numpy())
    return np.concatenate(rows), np.concatenate(neighbors)


def check_edges(ours: tuple[np.ndarray, np.ndarray], expected: np.ndarray, size: int) -> set[int]:
    """Differing edges as source * size + target."""
    mine = set((ours[0].astype(np.int64) * size + ours[1]).tolist())
    assert len(mine) == len(ours[0])
    return mine ^ set((expected[0].astype(np.int64) * size + expected[1]).tolist())


def check_all_edges(done: Pass, expected: dict[str, np.ndarray], poses, map_position, radius_m: float) -> None:
    agent, step = done.rows
    size = 1 << 20
    row, other = edges_of(done, "decoder.time_layers")
    theirs = expected["t"][:, expected["t"][1] % 18 < NUM_STEPS]
    ours = (agent[other] * 18 + step[other], agent[row] * 18 + step[row])
    assert check_edges(ours, theirs, size) == set()
    row, other = edges_of(done, "decoder.agent_layers")
    theirs = expected["a2a"][:, expected["a2a"][1] // NUM_AGENTS < NUM_STEPS]
    ours = (step[other] * NUM_AGENTS + agent[other], step[row] * NUM_AGENTS + agent[row])
    assert check_edges(ours, theirs, size) == set()
    row, other = edges_of(done, "decoder.map_layers")
    num_map = len(map_position)
    theirs = expected["pl2a"][:, expected["pl2a"][1] // NUM_AGENTS < NUM_STEPS]
    ours = (step[row] * num_map + other, step[row] * NUM_AGENTS + agent[row])
    for edge in check_edges(ours, theirs, size):
        source, target = divmod(edge, size)
        at = poses[target % NUM_AGENTS, target // NUM_AGENTS]
        distance = np.hypot(*(map_position[source % num_map].astype(np.float64) - at))
        assert abs(distance / radius_m - 1) < RADIUS_TOLERANCE
    if "pt2pt" in expected:
        row, other = edges_of(done, "map_encoder.layers")
        assert check_edges((other, row), expected["pt2pt"], size) == set()


def check_edges_of(policy, done: Pass, batch, expected) -> None:
    tokens = policy._tokenize(batch)
    scene = policy._build_scene(batch)
    positions = tokens.position[0].numpy(), scene.tokens.position[0].numpy()
    check_all_edges(done, expected, *positions, policy.config.agent_map_radius_m)


def test_edges_of_nano(nano, passes, golden, batch_a):
    check_edges_of(nano, passes["centred"], batch_a("centred"), golden.arrays("nano/centred_edges"))


@pytest.mark.slow
@pytest.mark.parametrize("frame", ["centred", "absolute"])
def test_tiny(frame, tiny, golden, batch_a):
    done = look(tiny, batch_a(frame))
    check_logits(done, golden.arrays(f"tiny/{frame}_forward"))
    if frame == "centred":
        check_edges_of(tiny, done, batch_a(frame), golden.arrays("tiny/centred_edges"))


def test_normalized_map_features_are_what_the_decoder_sees(nano, passes, batch_a):
    (of_map,) = passes["centred"].seen.outputs["map_encoder"]
    _, _, around, *_ = passes["centred"].seen.inputs["decoder.map_layers.0"][0]
    for block in around.blocks:
        torch.testing.assert_close(block.edge_features[..., of_map.shape[-1] :], normalize(of_map)[block.neighbors])
