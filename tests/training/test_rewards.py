"""Rewards: hand-made numbers, and what every leave-one-out reward has in common."""

import sys
from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from rlftsim.errors import ConfigError
from rlftsim.realism import METRIC_2025, score_batch
from rlftsim.realism.from_rollouts import states_of_rollouts
from rlftsim.recipes.configure import configure
from rlftsim.recipes.smart import smart_demo_rlftsim
from rlftsim.training.rewards import leave_one_out, register_reward, reward_by_name
from rlftsim.training.rewards.base import _REWARDS
from rlftsim.training.rewards.mloo import compute_mloo

values = st.integers(2, 8).flatmap(
    lambda n: st.lists(st.lists(st.floats(0, 1, width=32), min_size=n, max_size=n), min_size=1, max_size=3)
)


def test_mloo_of_hand_made_numbers():
    # without the first the other two reach 0.6, and so on; their mean is 0.7
    without_each = torch.tensor([[0.6, 0.7, 0.8]])
    torch.testing.assert_close(compute_mloo(without_each), torch.tensor([[0.1, 0.0, -0.1]]))


def test_the_rollout_that_the_group_misses_most_is_rewarded_most():
    assert compute_mloo(torch.tensor([[0.50, 0.71, 0.70, 0.69]])).argmax() == 0


def test_leave_one_out_of_hand_made_numbers():
    # 1 - mean(2, 6), 2 - mean(1, 6), 6 - mean(1, 2)
    torch.testing.assert_close(leave_one_out(torch.tensor([[1.0, 2.0, 6.0]])), torch.tensor([[-3.0, -1.5, 4.5]]))


@given(values)
def test_leave_one_out_rewards_sum_to_zero(rows):
    x = torch.tensor(rows)
    for reward in (compute_mloo(x), leave_one_out(x)):
        assert reward.shape == x.shape
        torch.testing.assert_close(reward.sum(-1), torch.zeros(len(x)), atol=1e-5, rtol=0)


@given(values, st.floats(-1, 1))
def test_what_all_rollouts_share_is_no_reward(rows, shift):
    x = torch.tensor(rows)
    torch.testing.assert_close(leave_one_out(x + shift), leave_one_out(x), atol=1e-5, rtol=0)


@pytest.mark.parametrize("reward", [compute_mloo, leave_one_out])
def test_a_single_rollout_cannot_be_left_out(reward):
    with pytest.raises(ConfigError, match=r"at least 2 rollouts per scenario, got 1: set finetune\.num_rollouts"):
        reward(torch.zeros(3, 1))


@pytest.mark.parametrize("name", sorted(_REWARDS))
def test_every_reward_is_one_finite_number_per_rollout_that_sums_to_zero(name, simulated):
    reward = reward_by_name(name)(*simulated)
    assert reward.shape == (2, 4)
    assert reward.isfinite().all()
    assert reward.abs().max() > 0
    torch.testing.assert_close(reward.sum(-1), torch.zeros(2), atol=1e-5, rtol=0)


def test_mloo_is_made_of_the_metric_without_each_rollout(simulated):
    """The metric of the other three, computed from scratch, gives the reward."""
    _, rollouts, batch = simulated
    rows = []
    for left_out in range(4):
        others = [i for i in range(4) if i != left_out]
        kept = rollouts.position[:, others], rollouts.heading[:, others]
        some = type(rollouts)(
            *kept, *(getattr(rollouts, n)[:, others] for n in ("decision", "decision_mask", "log_prob"))
        )
        rows.append(score_batch(batch.scenarios, states_of_rollouts(batch, some), METRIC_2025).meta_metric)
    without_each = torch.stack(rows, -1)
    expected = without_each.mean(-1, keepdim=True) - without_each
    torch.testing.assert_close(reward_by_name("mloo")(*simulated), expected, atol=1e-6, rtol=0)


def with_rates(simulated, **values):
    """The call of a reward with hand-made numbers in the scores."""
    scores, rollouts, batch = simulated
    made = {f"rollout_{name}": torch.tensor(rows) for name, rows in values.items()}
    return replace(scores, **made), rollouts, batch


def test_the_displacement_reward_is_in_metres_against_the_mean_of_the_others(simulated):
    call = with_rates(simulated, displacement_error=[[1.0, 2.0, 3.0, 6.0], [1.0, 1.0, 1.0, 1.0]])
    # -1 + (2 + 3 + 6) / 3, -2 + (1 + 3 + 6) / 3, -3 + (1 + 2 + 6) / 3, -6 + (1 + 2 + 3) / 3
    expected = torch.tensor([[8 / 3, 4 / 3, 0.0, -4.0], [0.0] * 4])
    torch.testing.assert_close(reward_by_name("minade_rloo")(*call), expected)


def test_collisions_and_leaving_the_road_count_alike(simulated):
    call = with_rates(
        simulated,
        collision_rate=[[0.5, 0.0, 0.0, 0.0], [0.0] * 4],
        offroad_rate=[[0.0, 0.5, 0.0, 0.0], [0.25, 0.25, 0.25, 1.0]],
        displacement_error=[[10.0, 10.0, 10.0, 10.0], [0.0, 0.0, 0.0, 4.0]],
    )
    # -0.5 + (0.5 + 0 + 0) / 3 twice, 0 + (0.5 + 0.5 + 0) / 3 twice; -0.25 + (0.25 + 0.25 + 1) / 3, -1 + 0.25
    expected = torch.tensor([[-1 / 3, -1 / 3, 1 / 3, 1 / 3], [0.25, 0.25, 0.25, -0.75]])
    torch.testing.assert_close(reward_by_name("collision_offroad")(*call), expected)
    # a tenth of a metre's worth: nothing where all are 10 m off, 4 m / 10 of the last one against nobody's
    way = 0.1 * torch.tensor([[0.0] * 4, [4 / 3, 4 / 3, 4 / 3, -4.0]])
    torch.testing.assert_close(reward_by_name("collision_offroad_ade")(*call), expected + way)
    torch.testing.assert_close(reward_by_name("collision_offroad_ade")(*call, ade_weight=0.5), expected + 5 * way)


def test_rates_of_a_rollout_are_those_of_its_evaluated_agents(measured):
    """What the heuristic rewards are made of, counted by hand from the features."""
    scores, _, batch, agents = measured
    for b, item in enumerate(agents.measured):
        log_valid = torch.from_numpy(batch.scenarios[b].tracks.valid[batch.scenarios[b].evaluated_indices, 11:])
        order = batch.scenarios[b].tracks.object_id[batch.scenarios[b].evaluated_indices].argsort()
        for n in range(4):
            collided = sum(bool((item.features.collision[n, e] & log_valid[k]).any()) for e, k in enumerate(order))
            left = sum(bool((item.features.offroad[n, e] & log_valid[k]).any()) for e, k in enumerate(order))
            assert float(scores.rollout_collision_rate[b, n]) == pytest.approx(collided / len(order))
            assert float(scores.rollout_offroad_rate[b, n]) == pytest.approx(left / len(order))


def test_a_reward_from_outside_is_found_by_name(simulated):
    @register_reward("test_quiet")
    def quiet(scores, rollouts, batch):
        return leave_one_out(-scores.rollout_collision_rate)

    try:
        assert reward_by_name("test_quiet") is quiet
        assert reward_by_name("test_quiet")(*simulated).shape == (2, 4)
        with pytest.raises(ConfigError, match="'test_quiet' is registered already"):
            register_reward("test_quiet")(quiet)
    finally:
        del _REWARDS["test_quiet"]


def test_an_unknown_reward_is_refused_with_the_known_ones():
    with pytest.raises(ConfigError, match=r"unknown reward 'joy': known are .*mloo, .*rloo"):
        reward_by_name("joy")


@pytest.mark.parametrize("name", ["on-the-road", "two words", "", "0.5"])
def test_a_name_that_no_sum_can_be_written_with_is_refused(name):
    with pytest.raises(ConfigError, match="a name is letters, digits and underscores, such as on_the_road"):
        register_reward(name)


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """Install a package made of one module that a test writes; its rewards are forgotten after the test."""
    known = set(_REWARDS)

    def install(source):
        (tmp_path / "test_kindness.py").write_text(source)
        about = tmp_path / "test_kindness-1.0.dist-info"
        about.mkdir()
        (about / "METADATA").write_text("Metadata-Version: 2.1\nName: test-kindness\nVersion: 1.0\n")
        (about / "entry_points.txt").write_text("[rlftsim.rewards]\nkindness = test_kindness\n")
        monkeypatch.syspath_prepend(tmp_path)

    yield install
    sys.modules.pop("test_kindness", None)
    for name in set(_REWARDS) - known:
        del _REWARDS[name]


def test_a_reward_of_an_installed_package_is_found_where_only_its_name_is_given(simulated, installed):
    installed(
        "from rlftsim.training.rewards import leave_one_out, register_reward\n"
        "@register_reward('kindness')\n"
        "def kindness(scores, rollouts, batch, *, scale: float = 1.0):\n"
        "    return leave_one_out(-scale * scores.rollout_collision_rate)\n"
    )
    config = configure(smart_demo_rlftsim(), ["finetune.reward=mloo + 0.1*kindness(scale=3)"]).finetune
    assert config.reward == "mloo + 0.1*kindness(scale=3.0)"
    assert reward_by_name("kindness")(*simulated).shape == (2, 4)


def test_a_package_whose_rewards_are_broken_is_named(installed):
    installed("import a_module_that_is_not_there\n")
    with pytest.raises(ConfigError, match=r"rewards of test_kindness cannot be imported .*a_module_that_is_not_there"):
        reward_by_name("kindness")
