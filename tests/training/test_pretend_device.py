"""The whole package on a device that is not the CPU: equal results, no tensor left behind, and how often it waits.

There is no GPU here, see `pretend_device`.
"""

import copy
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace

import pytest
import torch

import scenes
import tiny
from pretend_device import DEVICE, PretendDevice
from rlftsim.evaluation.evaluate import evaluate
from rlftsim.evaluation.results import SCORE_COLUMNS, EvaluateConfig
from rlftsim.goals.types import Goals, logged_goals
from rlftsim.policies.smart.config import smart_demo, smart_tiny
from rlftsim.realism import score_batch
from rlftsim.realism.from_rollouts import states_of_rollouts
from rlftsim.rollout import simulate as simulate_module
from rlftsim.rollout.fingerprint import fingerprint_policy
from rlftsim.rollout.policy import Sampling
from rlftsim.rollout.simulate import simulate
from rlftsim.scenario.batch import collate
from rlftsim.scenario.dataset import write_dataset
from rlftsim.training import processes, reward
from rlftsim.training.catk_rollouts import roll_out_closest
from rlftsim.training.config import GoalConfig, ValidationConfig
from rlftsim.training.run_folder import read_metrics

TIMES = ("seconds", "time")
"""Metrics of an update that are times."""


class PretendFabric:
    """One process on the pretend device."""

    device, world_size, global_rank = DEVICE, 1, 0

    def autocast(self):
        return nullcontext()

    def backward(self, tensor):
        tensor.backward()

    def all_reduce(self, data, *, reduce_op):
        raise AssertionError("a single process has nothing to reduce")


@contextmanager
def on_device() -> Iterator[PretendDevice]:
    """A block in which training takes place on the pretend device."""
    with pytest.MonkeyPatch.context() as patch, PretendDevice() as device:
        patch.setattr(processes, "start_fabric", lambda config: PretendFabric())
        yield device


@pytest.fixture
def policy(vocabulary):
    return tiny.tiny_policy(vocabulary, tiny.WITHOUT_CHANCE).eval().requires_grad_(False)


@pytest.fixture
def batch(drawn_scenarios):
    return collate(drawn_scenarios[:2])


# ---- the device itself ---------------------------------------------------------------------------------------------


def test_the_device_refuses_what_cuda_refuses():
    host = torch.ones(3, 2)
    with PretendDevice():
        there = host.to(DEVICE)
        with pytest.raises(RuntimeError, match="same device"):
            there + host
        with pytest.raises(RuntimeError, match="same device"):
            host[torch.zeros(3, dtype=torch.int64, device=DEVICE)]
        with pytest.raises(RuntimeError, match="numpy"):
            there.numpy()
        assert (there + host.sum()).sum().item() == 42.0, "a single number of the host is no tensor of it"


def test_the_device_counts_launches_waits_and_copies():
    host = torch.arange(6.0).view(3, 2)
    with PretendDevice() as device, device.count() as counts:
        there = host.to(DEVICE)  # a copy
        assert there.device == DEVICE
        assert counts.totals == (1, 0, 1)
        there.view(2, 3)[:1].unsqueeze(0)
        assert counts.totals == (1, 0, 1), "views are free"
        there[[0, 2]]  # its index is copied
        torch.tensor([1.0, 2.0], device=DEVICE)
        assert counts.copies.total() == 3
        there[there > 1]  # the result's shape
        there.nonzero()
        assert counts.waits.total() == 2
        assert there.sum().item() == 15
        assert there.tolist() == host.tolist()
        assert there.cpu().equal(host)
        assert counts.waits.total() == 5
        there[there > 1] = 0.0  # shapes stay
        assert counts.waits.total() == 5


def test_the_device_has_the_gradients_of_the_cpu():
    layer = torch.nn.Sequential(torch.nn.Linear(3, 4), torch.nn.LayerNorm(4), torch.nn.Linear(4, 1))
    inputs = torch.randn(5, 3, generator=torch.Generator().manual_seed(0))
    layer(inputs).square().sum().backward()
    with PretendDevice():
        there = copy.deepcopy(layer).to(DEVICE)
        there.zero_grad()
        there(inputs.to(DEVICE)).square().sum().backward()
        for own, expected in zip(there.parameters(), layer.parameters()):
            assert own.grad.device == DEVICE
            torch.testing.assert_close(own.grad.cpu(), expected.grad)


# ---- planted mistakes ----------------------------------------------------------------------------------------------


def test_a_table_that_stays_on_the_host_is_found(policy, batch, monkeypatch):
    table = torch.tensor([0, 0, 1, 2, 0])
    monkeypatch.setattr("rlftsim.policies.smart.network.class_of_type", lambda object_type: table[object_type])
    with on_device(), pytest.raises(RuntimeError, match=r"same device.*index"):
        policy.to(DEVICE).encode(batch.to(DEVICE))


def test_noise_that_stays_on_the_host_is_found(policy, batch, monkeypatch):
    draw = simulate_module.draw_noise
    monkeypatch.setattr(simulate_module, "draw_noise", lambda *args, **named: draw(*args, **named).cpu())
    with on_device(), pytest.raises(RuntimeError, match=r"same device.*distributions.py"):
        simulate(policy.to(DEVICE), batch.to(DEVICE), num_rollouts=1, seed=0)


def test_a_missing_copy_to_the_host_is_found(policy, monkeypatch):
    monkeypatch.setattr(torch.Tensor, "cpu", lambda self: self)
    with on_device(), pytest.raises(RuntimeError, match="numpy"):
        fingerprint_policy(policy.to(DEVICE))


# ---- the same results as on the CPU --------------------------------------------------------------------------------


MODELS = {
    "goal-free": tiny.WITHOUT_CHANCE,
    "all neighbors, a head per class": replace(
        tiny.WITHOUT_CHANCE, head_per_class=True,
        max_map_neighbors=None, max_agent_map_neighbors=None, max_agent_neighbors=None,
    ),
    "concat": replace(tiny.WITHOUT_CHANCE, goal="concat", goal_logit_bias=True),
    "indication": replace(tiny.WITHOUT_CHANCE, goal="indication", goal_logit_bias=True),
}  # fmt: skip


@pytest.mark.parametrize("model", MODELS)
def test_rollouts_are_those_of_the_cpu(vocabulary, drawn_scenarios, model):
    policy = tiny.tiny_policy(vocabulary, MODELS[model]).eval().requires_grad_(False)
    for part in policy.goal_modules():
        for weight in part.parameters():
            weight.add_(0.1)  # else goals would have no effect
    # scenarios with more and fewer agents, without a map, with an agent that nobody is near
    batch = collate([drawn_scenarios[1], scenes.lone_agent(), scenes.without_map(), drawn_scenarios[2]])
    goals = logged_goals(batch).only(batch.object_id[:, None] % 2 == 0) if policy.is_goal_conditioned else None
    expected = simulate(policy, batch, num_rollouts=2, seed=1, goals=goals)
    with on_device():
        there = None if goals is None else Goals(goals.position.to(DEVICE), goals.goal_mask.to(DEVICE))
        found = simulate(policy.to(DEVICE), batch.to(DEVICE), num_rollouts=2, seed=1, goals=there)
        assert found.position.device == DEVICE
        assert found.decision.cpu().equal(expected.decision)
        torch.testing.assert_close(found.position.cpu(), expected.position)
        torch.testing.assert_close(found.log_prob.cpu(), expected.log_prob, atol=1e-5, rtol=0)


TRAINING = {
    "pretrain": {},
    "pretrain, spatial smoothing": {"label_smoothing": 0.1, "label_smoothing_kind": "spatial"},
    "catk": {"validation": ValidationConfig(every=1, num_scenarios=1, num_rollouts=2)},
    "everything, concat": {},
    "everything, indication": {},
}


@pytest.mark.parametrize("name", TRAINING)
def test_an_update_is_that_of_the_cpu(vocabulary, drawn_scenarios, tmp_path, name):
    stage, _, variant = name.partition(", ")
    # a small step: Adam's first one has the size of the learning rate wherever a gradient is not exactly zero
    changes = {"epochs": 0.5, "batch_size": 2, "learning_rate": 1e-7, **TRAINING[name]}
    policy = tiny.tiny_policy(vocabulary, tiny.WITHOUT_CHANCE)
    if stage == "everything":
        policy = policy.with_goal_conditioning(variant)
        changes |= {
            "reward": tiny.OF_EVERYTHING.reward + " + 0.1*goal", "goals": GoalConfig(probability=1.0, hindsight=1.0),
        }  # fmt: skip
    held_out = drawn_scenarios[2:] if "validation" in changes else None
    with on_device():
        there = copy.deepcopy(policy)
        tiny.train(stage, there, drawn_scenarios[:2], tmp_path / "device", held_out, **changes)
        assert next(there.parameters()).device == DEVICE
    tiny.train(stage, policy, drawn_scenarios[:2], tmp_path / "cpu", held_out, **changes)
    (found,), (expected,) = (read_metrics(tmp_path / folder) for folder in ("device", "cpu"))
    assert found.keys() == expected.keys()
    for key in found:
        if not key.startswith(TIMES):
            assert found[key] == pytest.approx(expected[key], rel=1e-3, abs=1e-5, nan_ok=True), key


CHOICES = {
    "top_k": {"choice": "top_k"},
    "trajeglish": {"choice": "trajeglish", "max_distance_lengths": 1.0},
    "road": {"choice": "sampled", "targets": "taken"},
}


@pytest.mark.parametrize("name", CHOICES)
def test_rollouts_near_the_log_are_those_of_the_cpu(policy, batch, name):
    expected = roll_out_closest(policy, batch, num_candidates=8, **CHOICES[name])
    with on_device():
        found = roll_out_closest(policy.to(DEVICE), batch.to(DEVICE), num_candidates=8, **CHOICES[name])
        assert found.target.device == DEVICE
        assert found.target.cpu().equal(expected.target)
        assert found.target_mask.cpu().equal(expected.target_mask)
        torch.testing.assert_close(found.rollouts.position.cpu(), expected.rollouts.position)


def test_scores_are_those_of_the_cpu(policy, drawn_scenarios, tmp_path):
    write_dataset(drawn_scenarios[:1], tmp_path / "data")
    config = EvaluateConfig(num_rollouts=2, top_k=8, split=None)
    expected = evaluate(policy, tmp_path / "data", config=config, show_progress=False).table
    with on_device():
        found = evaluate(policy.to(DEVICE), tmp_path / "data", config=config, show_progress=False).table
    for column in SCORE_COLUMNS:
        assert found[column].to_pylist() == pytest.approx(expected[column].to_pylist(), abs=1e-6, nan_ok=True), column


# ---- what the host waits for ---------------------------------------------------------------------------------------

LAUNCHES = {"demo": (smart_demo(), 700), "tiny": (smart_tiny(), 1300)}
"""Models and upper bounds of the launches of a decision."""


@pytest.mark.parametrize("name", LAUNCHES)
def test_decisions_never_wait_and_are_all_alike(vocabulary, batch, name):
    config, most = LAUNCHES[name]
    policy = tiny.tiny_policy(vocabulary, config).eval().requires_grad_(False)
    decisions = []
    with torch.no_grad(), on_device() as device:
        policy, batch = policy.to(DEVICE), batch.to(DEVICE)
        noise = torch.rand(2, 3, batch.agent_mask.shape[1], 1, device=DEVICE)
        context = policy.encode(batch)
        state = policy.begin(context, 3, None, noise[..., :0])
        for _ in range(4):
            with device.count() as counts:
                dist = policy.decide(context, state)
                decision = dist.sample(Sampling(), noise)
                dist.log_prob(decision)
                state = policy.advance(context, state, decision)
            decisions.append(counts)
    for counts in decisions:
        assert not counts.waits
        assert not counts.copies
        assert counts.launches.total() <= most
    # the first decision is in the context, the second one begins a past of fixed size
    assert decisions[2].operations == decisions[3].operations


def test_counts_of_larger_pieces_are_bounded(vocabulary, batch):
    """Whatever the number of rollouts; each bound is some percent above what was counted."""
    config = replace(tiny.FINETUNE, num_rollouts=4)
    with on_device() as device:
        learner = reward.prepare(tiny.tiny_policy(vocabulary, smart_demo()), config, DEVICE)
        policy, batch = learner.policy, batch.to(DEVICE)
        with torch.no_grad():
            context = policy.encode(batch)
        with device.count() as counts:
            targeted = roll_out_closest(policy, batch, context=context)
        assert_below(counts, launches=12_500, waits=0, copies=12)
        states = states_of_rollouts(batch, targeted.rollouts)
        score_batch(batch.scenarios, states)  # the logs are computed once
        with device.count() as counts:
            score_batch(batch.scenarios, states)
        assert_below(counts, launches=1_350, waits=10, copies=10)
        with device.count() as counts:
            reward.update_policy(learner, batch, config, PretendFabric())
        assert_below(counts, launches=20_000, waits=60, copies=115)
        held = replace(config, constraints=("speed", "stops"), num_scored=1)
        reward.update_policy(reward.prepare(policy, held, DEVICE), batch, held, PretendFabric())


def assert_below(counts, launches, waits, copies):
    assert counts.launches.total() <= launches
    assert counts.waits.total() <= waits, counts.waits
    assert counts.copies.total() <= copies, counts.copies
