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
from rlftsim.recipes.smart import smart_demo_rlftsim
from rlftsim.rewards import (
    REWARDS,
    leave_one_out,
    parse_reward,
    register_agent_rewards,
    register_reward,
    register_sum,
    reward_by_name,
)
from rlftsim.rewards.base import agent_rewards_by_name
from rlftsim.rewards.realism import compute_mloo
from rlftsim.training.config import FinetuneConfig

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
def test_a_value_common_to_all_rollouts_is_no_reward(rows, shift):
    x = torch.tensor(rows)
    torch.testing.assert_close(leave_one_out(x + shift), leave_one_out(x), atol=1e-5, rtol=0)


@pytest.mark.parametrize("reward", [compute_mloo, leave_one_out])
def test_a_single_rollout_cannot_be_left_out(reward):
    with pytest.raises(ConfigError, match=r"at least 2 rollouts per scenario, got 1: set finetune\.num_rollouts"):
        reward(torch.zeros(3, 1))


@pytest.mark.parametrize("name", ["collision_offroad", "collision_offroad_ade", "goal", "minade_rloo", "mloo", "rloo"])
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
    # a tenth of a metre's worth: nothing where all are 10 m off, 4 m / 10 of the last one against the others' 0
    way = 0.1 * torch.tensor([[0.0] * 4, [4 / 3, 4 / 3, 4 / 3, -4.0]])
    torch.testing.assert_close(reward_by_name("collision_offroad_ade")(*call), expected + way)
    torch.testing.assert_close(reward_by_name("collision_offroad_ade")(*call, ade_weight=0.5), expected + 5 * way)


def test_rates_of_a_rollout_are_those_of_its_evaluated_agents(measured):
    """The parts of the heuristic rewards, counted by hand from the features."""
    scores, _, batch, agents = measured
    for b, item in enumerate(agents.features):
        log_valid = torch.from_numpy(batch.scenarios[b].tracks.valid[batch.scenarios[b].evaluated_indices, 11:])
        order = batch.scenarios[b].tracks.object_id[batch.scenarios[b].evaluated_indices].argsort()
        for n in range(4):
            collided = sum(bool((item.features.collision[n, e] & log_valid[k]).any()) for e, k in enumerate(order))
            left = sum(bool((item.features.offroad[n, e] & log_valid[k]).any()) for e, k in enumerate(order))
            assert float(scores.rollout_collision_rate[b, n]) == pytest.approx(collided / len(order))
            assert float(scores.rollout_offroad_rate[b, n]) == pytest.approx(left / len(order))


@pytest.fixture
def outside():
    """Name of a reward that a test registers, forgotten after it."""
    yield "test_quiet"
    REWARDS.remove("test_quiet")


def quiet(realism, rollouts, batch):
    return leave_one_out(-realism.rollout_collision_rate)


def test_a_reward_from_outside_is_found_by_name(simulated, outside):
    register_reward(outside)(quiet)
    assert reward_by_name(outside) is quiet
    assert reward_by_name(outside)(*simulated).shape == (2, 4)


def test_a_reward_that_is_registered_again_replaces_the_earlier_one_and_its_split(outside):
    """As when the cell of a notebook runs twice."""
    register_reward(outside)(quiet)
    register_agent_rewards(outside)(lambda agents, rollouts, batch: leave_one_out(-agents.collision))
    assert agent_rewards_by_name(outside) is not None
    register_reward(outside)(quiet)  # the same function: nothing changes, no warning
    assert agent_rewards_by_name(outside) is not None
    with pytest.warns(UserWarning, match="reward 'test_quiet' is registered again and replaces the earlier one"):

        @register_reward(outside)
        def louder(realism, rollouts, batch):
            return leave_one_out(-2 * realism.rollout_collision_rate)

    assert reward_by_name(outside) is louder
    assert agent_rewards_by_name(outside) is None  # that of the other reward would be wrong here
    register_agent_rewards(outside)(lambda agents, rollouts, batch: leave_one_out(-2 * agents.collision))
    with pytest.warns(UserWarning, match="split of reward 'test_quiet' is registered again"):
        register_agent_rewards(outside)(lambda agents, rollouts, batch: leave_one_out(-2.0 * agents.collision))


def test_a_sum_may_replace_a_reward_and_a_reward_a_sum(outside):
    register_reward(outside)(quiet)
    with pytest.warns(UserWarning, match="registered again"):
        register_sum(outside)(lambda *, weight=0.5: f"mloo + {weight}*rloo")
    assert [term.name for term in parse_reward(outside)] == ["mloo", "rloo"]
    with pytest.raises(ConfigError, match="stands for a sum of rewards"):
        reward_by_name(outside)
    with pytest.warns(UserWarning, match="registered again"):
        register_reward(outside)(quiet)
    assert [term.name for term in parse_reward(outside)] == [outside]


@pytest.mark.parametrize("register", [register_reward, register_sum, register_agent_rewards])
@pytest.mark.parametrize("name", ["mloo", "goal"])
def test_the_name_of_a_shipped_reward_is_refused(register, name):
    before = reward_by_name(name), agent_rewards_by_name(name)
    with pytest.raises(ConfigError, match=f"reward '{name}' ships with rlftsim: choose another name"):
        register(name)(quiet)
    assert (reward_by_name(name), agent_rewards_by_name(name)) == before


def test_a_split_without_a_reward_is_refused():
    with pytest.raises(ConfigError, match="unknown reward 'test_nothing'"):
        register_agent_rewards("test_nothing")


def test_a_reward_defined_in_a_script_or_notebook_counts_as_outside(outside):
    namespace = {"__name__": "__main__"}
    cell = (
        "import rlftsim.rewards as rs\n"
        f"@rs.register_reward({outside!r})\n"
        "def on_the_road(scores, rollouts, batch):\n"
        "    return rs.leave_one_out(-scores.rollout_offroad_rate)\n"
    )
    exec(cell, namespace)
    with pytest.warns(UserWarning, match="registered again"):
        exec(cell, namespace)
    assert FinetuneConfig(reward=f"mloo + 0.1*{outside}", epochs=0.05).reward == f"mloo + 0.1*{outside}"


def test_an_unknown_reward_is_refused_with_the_known_ones():
    with pytest.raises(ConfigError, match=r"unknown reward 'joy': known are .*mloo, .*rloo"):
        reward_by_name("joy")
    with pytest.raises(ConfigError, match=r"unknown reward 'mlo': did you mean 'mloo'\?"):
        reward_by_name("mlo")


@pytest.mark.parametrize("name", ["on-the-road", "two words", "", "0.5"])
def test_a_name_that_no_sum_can_be_written_with_is_refused(name):
    with pytest.raises(ConfigError, match="a name is letters, digits and underscores, such as on_the_road"):
        register_reward(name)


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """Install a package made of one module that a test writes; its rewards are forgotten after the test."""

    def install(source):
        (tmp_path / "test_kindness.py").write_text(source)
        about = tmp_path / "test_kindness-1.0.dist-info"
        about.mkdir()
        (about / "METADATA").write_text("Metadata-Version: 2.1\nName: test-kindness\nVersion: 1.0\n")
        (about / "entry_points.txt").write_text("[rlftsim.rewards]\nkindness = test_kindness\n")
        monkeypatch.syspath_prepend(tmp_path)

    yield install
    sys.modules.pop("test_kindness", None)
    REWARDS.remove("kindness")


def test_a_reward_of_an_installed_package_is_found_where_only_its_name_is_given(simulated, installed):
    installed(
        "from rlftsim.rewards import REWARDS, leave_one_out, register_reward\n"
        "@register_reward('kindness')\n"
        "def kindness(scores, rollouts, batch, *, scale: float = 1.0):\n"
        "    return leave_one_out(-scale * scores.rollout_collision_rate)\n"
    )
    config = replace(smart_demo_rlftsim().finetune, reward="mloo + 0.1*kindness(scale=3)")
    assert config.reward == "mloo + 0.1*kindness(scale=3.0)"
    assert reward_by_name("kindness")(*simulated).shape == (2, 4)


def test_a_package_whose_rewards_are_broken_is_named(installed):
    installed("import a_module_that_is_not_there\n")
    with pytest.raises(
        ConfigError,
        match=r"reward 'kindness' of package \S+ \S+ \(test_kindness\) cannot .*a_module_that_is_not_there",
    ):
        reward_by_name("kindness")
