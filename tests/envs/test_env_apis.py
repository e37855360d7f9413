"""Environments keep the contracts of Gymnasium, PettingZoo and Stable-Baselines3."""

import warnings

import gymnasium
import jaxtyping
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from pettingzoo.test import parallel_api_test, parallel_seed_test

from rlftsim.envs import EgoEnv, EgoVectorEnv, parallel_env
from rlftsim.errors import ConfigError
from scenes import bend, junction_with_light, straight_road, without_future, without_map

KINDS = ("bicycle", "bicycle_discrete", "pose", "trajectory", "token")
OURS = ("normalized space", "No render")  # recommendations of Gymnasium for actions in physical units


@pytest.mark.parametrize("action", KINDS)
@pytest.mark.parametrize("observation", ["dict", "flat"])
def test_gymnasium_finds_nothing_to_complain_about(action, observation):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        env = gymnasium.make(
            "rlftsim.envs:rlftsim/Ego-v0", scenarios=[junction_with_light()], action=action, observation=observation,
            traffic="replay", max_steps=10, render_mode="rgb_array",
        )  # fmt: skip
        check_env(env.unwrapped, skip_render_check=observation == "flat" or action != "bicycle")
    allowed = OURS if action in ("pose", "trajectory") else ()
    found = [str(w.message) for w in caught if issubclass(w.category, UserWarning)]
    assert [text for text in found if not any(part in text for part in allowed)] == []


@pytest.mark.parametrize("action", KINDS)
def test_stable_baselines_finds_nothing_to_complain_about(action):
    sb3 = pytest.importorskip("stable_baselines3.common.env_checker")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        env = EgoEnv(scenarios=[bend()], action=action, observation="flat", traffic="replay", max_steps=10)
        sb3.check_env(env, skip_render_check=True)
    found = [str(w.message) for w in caught if issubclass(w.category, UserWarning)]
    recommended = "symmetric and normalized"
    assert [t for t in found if not (recommended in t and action in ("pose", "trajectory"))] == []


def test_pettingzoo_finds_nothing_to_complain_about():
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        env = parallel_env(scenarios=[straight_road()], controlled="vehicles", traffic="replay", max_steps=20)
        parallel_api_test(env, num_cycles=60)
        parallel_seed_test(
            lambda: parallel_env(scenarios=[straight_road()], controlled=[100, 101], traffic="replay", max_steps=20)
        )


def test_agents_of_a_parallel_env_leave_one_by_one_and_then_stand():
    env = parallel_env(scenarios=[straight_road()], controlled="vehicles", traffic="replay", action="pose")
    env.reset(seed=0)
    assert env.agents == ["100", "101", "102", "105"]
    still, forward = np.zeros(3, np.float32), np.array([3.0, 0, 0], np.float32)
    alive = set()
    for _ in range(12):  # the ego catches up with agent 101, which stands
        _, _, terminated, _, infos = env.step({name: forward if name == "100" else still for name in env.agents})
        alive |= set(env.agents)
        if any(terminated.values()):
            break
    assert sorted(name for name, over in terminated.items() if over) == ["100", "101"]
    assert env.agents == ["102", "105"]
    assert infos["100"]["result"].record.collisions[0].at_fault
    place = env._begun[1].world.motion[0, 0].copy()
    env.step({name: forward for name in env.agents})
    np.testing.assert_array_equal(env._begun[1].world.motion[0, 0, :3], place[:3])


def test_pedestrians_do_not_act_by_bicycle():
    env = parallel_env(scenarios=[straight_road()], controlled="pedestrians", traffic="replay")
    env.reset(seed=0)
    with pytest.raises(ConfigError, match="agent 103 in scenario straight is a pedestrian"):
        env.step({"103": np.zeros(2, np.float32)})


def drive(vector, steps, action):
    found = []
    for _ in range(steps):
        found.append(vector.step(action))
    return found


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_autoreset_gives_what_gymnasium_s_own_vector_gives(mode):
    settings = {"scenarios": [straight_road(), bend()], "traffic": "replay", "max_steps": 6, "action": "bicycle"}
    ours = gymnasium.make_vec("rlftsim.envs:rlftsim/Ego-v0", 3, vectorization_mode="vector_entry_point",
                              autoreset_mode=AutoresetMode(mode), **settings)  # fmt: skip
    theirs = gymnasium.vector.SyncVectorEnv([lambda: EgoEnv(**settings)] * 3, autoreset_mode=AutoresetMode(mode))
    seen = [env.reset(seed=3)[0] for env in (ours, theirs)]
    action = np.tile(np.float32([0.3, 0.05]), (3, 1))
    for _ in range(16):
        assert all(np.array_equal(seen[0][name], seen[1][name]) for name in seen[1])
        (seen[0], *mine), (seen[1], *other) = ours.step(action), theirs.step(action)
        for a, b in zip(mine[:3], other[:3]):
            np.testing.assert_array_equal(a, b)
        assert ("final_obs" in mine[3]) == ("final_obs" in other[3])


def test_a_reset_without_a_seed_names_one_that_gives_the_episode_again():
    settings = {"scenarios": [straight_road(), bend()], "traffic": "replay"}
    theirs = gymnasium.vector.SyncVectorEnv([lambda: EgoEnv(**settings)] * 2)
    for vector in (EgoVectorEnv(2, **settings), theirs):
        seen, info = vector.reset()
        again, other = vector.reset(seed=info["seed"].tolist())
        assert np.array_equal(seen["ego_history"], again["ego_history"])
        assert list(info["scenario"]) == list(other["scenario"])
    env = EgoEnv(**settings)
    _, info = env.reset()
    saved, branch = env.snapshot(), env.fork(1)[0]
    restored = EgoEnv(**settings)
    restored.restore(saved)
    for one in (branch, restored):
        later = one.reset()[1]
        assert (later["seed"], later["rollout"]) == (info["seed"], 1)
    assert parallel_env(**settings).reset()[1]["100"]["seed"] < 2**31


def test_with_autoreset_disabled_a_mask_resets():
    vector = EgoVectorEnv(2, scenarios=[straight_road()], traffic="replay", max_steps=2, autoreset_mode="Disabled")
    vector.reset(seed=0)
    still = np.zeros((2, 2), np.float32)
    drive(vector, 2, still)
    with pytest.raises(ConfigError, match="slot 0 is over"):
        vector.step(still)
    vector.reset(options={"reset_mask": np.array([True, False])})
    with pytest.raises(ConfigError, match="slot 1 is over"):
        vector.step(still)


def test_stable_baselines_trains():
    pytest.importorskip("stable_baselines3")
    from stable_baselines3 import PPO

    from rlftsim.envs.sb3 import SB3VecEnv

    env = SB3VecEnv(2, scenarios=[straight_road(), bend()], traffic="replay", observation="flat", max_steps=20)
    model = PPO("MlpPolicy", env, n_steps=64, batch_size=32, n_epochs=1, seed=0)
    before = [p.detach().clone() for p in model.policy.parameters()]
    model.learn(512)
    assert any(not (p == q).all() for p, q in zip(model.policy.parameters(), before))
    assert env.get_attr("action_space") == [env.action_space] * 2
    env.seed(0)
    env.set_options({"scenario": "bend"})
    env.reset()
    assert [info["scenario"] for info in env.reset_infos] == ["bend", "bend"]
    for _ in range(20):
        _, _, over, infos = env.step(np.zeros((2, 2), np.float32))
    assert over.all()
    assert {"terminal_observation", "TimeLimit.truncated", "result"} <= set(infos[0])


def test_a_scenario_without_a_map_or_future_can_be_driven():
    for scenario in (without_map(), without_future()):
        env = EgoEnv(scenarios=[scenario], traffic="constant_velocity", max_steps=12, stop_on=())
        _, info = env.reset(seed=0)
        for _ in range(12):
            _, _, _, over, info = env.step(np.zeros(2, np.float32))
        assert over
        result = info["result"]
        assert "progress" in result.missing
        assert np.isnan(result.planner.progress)
        assert np.isfinite(result.planner.nuplan_style)
    assert "withheld" in result.missing["progress"]


@pytest.fixture
def unchecked():
    """Calls as users make them: without the type checks of the test run."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


@pytest.mark.parametrize(
    ("settings", "action", "message"),
    [
        ({}, [np.nan, 0.0], "agent 100 in scenario straight at entry 0 is nan"),
        ({}, [0.0], "shape"),
        ({}, "left", "must be numbers"),
        ({}, {"steer": 1}, "must be numbers"),
        ({}, [[0.0], [0.0, 1.0]], "must be numbers"),
        ({"action": "bicycle_discrete"}, 91, "below 91"),
        ({"action": "bicycle_discrete"}, 2.9, "is 2.9, it must be a whole number"),
        ({"action": "bicycle_discrete"}, np.nan, "is nan"),
        ({"action": "token", "model": "constant_velocity"}, 0, "motion tokens"),
        ({"action": "fly"}, 0, "action must be one of bicycle"),
        ({"action": "trajectory", "horizon": 3}, 0, "5 to 80 poses"),
        ({"traffic": "rl"}, 0, "traffic must be one of"),
        ({"drivers": {9: "idm"}}, [0.0, 0.0], "no such agents"),
        ({"drivers": {"ego": "robot"}}, [0.0, 0.0], "driver 'robot'"),
        ({"reward": "speed"}, 0, "no term 'speed'"),
        ({"reward": "progress 5"}, 0, "cannot be read"),
        ({"route": "left_uturn"}, [0.0, 0.0], "allow"),
        ({"route": (99,)}, [0.0, 0.0], "no lane 99"),
        ({"route": [1, 99]}, [0.0, 0.0], "no lane 99"),
        ({"stop_on": ("rain",)}, 0, "stop_on must be one of"),
        ({"stop_on": "collision"}, 0, "stop_on must be one of .* in a list, got .collision."),
        ({"policy": "demo-base"}, 0, "not a policy: name a stored one as `model`"),
        ({"max_steps": 0}, 0, "max_steps"),
        ({"colour": 1}, 0, "no setting 'colour'"),
    ],
)  # fmt: skip
def test_bad_input_is_one_line(settings, action, message, unchecked):
    with pytest.raises(ConfigError, match=message) as caught:  # noqa: PT012
        env = EgoEnv(scenarios=[straight_road()], **{"traffic": "replay", **settings})
        env.reset(seed=0)
        env.step(action)
    assert "\n" not in str(caught.value)


def test_bad_input_of_several_environments_is_one_line(unchecked):
    log = {"scenarios": [straight_road()], "traffic": "replay"}
    for controlled, message in ((None, "must be a group"), ([], "is empty"), ([1.5], "object ids"), ("x", "no such")):
        with pytest.raises(ConfigError, match=message):
            parallel_env(controlled=controlled, **log)
    env = parallel_env(controlled=["100", np.int64(100)], max_steps=1, **log)
    assert env.possible_agents == ["100"]
    env.reset(seed=0)
    for actions, message in ((None, "agent: action"), ({}, "no action"), ({"100": "left"}, "agent 100 .* numbers")):
        with pytest.raises(ConfigError, match=message):
            env.step(actions)
    env.step({"100": np.zeros(2)})
    with pytest.raises(ConfigError, match="is over"):
        env.step({})
    for number, mode, message in (("2", "NextStep", "num_envs"), (-1, "NextStep", "num_envs"), (2, "never", "autores")):
        with pytest.raises(ConfigError, match=message):
            EgoVectorEnv(number, autoreset_mode=mode, **log)
    vector = EgoVectorEnv(2, **log)
    with pytest.raises(ConfigError, match="begins an episode in every slot"):
        vector.reset(options={"reset_mask": np.array([True, False])})
    for settings, message in (
        ({"seed": [1]}, "seed has 1 numbers"),
        ({"seed": (1, "a")}, "seed must be"),
        ({"options": {"reset_mask": np.ones(3, bool)}}, "2 truth values"),
        ({"options": [{}, {}]}, "options is one dictionary for all slots, .* with reset_mask"),
    ):
        with pytest.raises(ConfigError, match=message):
            vector.reset(**settings)
    vector.reset(seed=(1, 2))
    with pytest.raises(ConfigError, match="slot 1, agent 100 in scenario straight at entry 0 is nan"):
        vector.step(np.array([[0.0, 0.0], [np.nan, 0.0]]))
    with pytest.raises(
        ConfigError, match=r"^actions have shape \(3, 2\), they must have \(2, 2\): one for each of 2\.$"
    ):
        vector.step(np.zeros((3, 2)))
    with pytest.raises(ConfigError, match=r"slot 0.* has shape \(3,\), it must have \(2,\)"):
        vector.step(np.zeros((2, 3)))
    ego = EgoEnv(**log)
    ego.reset(seed=0)
    with pytest.raises(ConfigError, match="noise must be one of"):
        ego.fork(1, noise="other")


def test_mistakes_in_the_order_of_calls_are_named():
    env = EgoEnv(scenarios=[straight_road()], traffic="replay", max_steps=1)
    with pytest.raises(ConfigError, match=r"call reset\(\) first"):
        env.step(np.zeros(2))
    with pytest.raises(ConfigError, match="no scenario 'x'"):
        env.reset(options={"scenario": "x"})
    with pytest.raises(ConfigError, match="no option 'speed'"):
        env.reset(options={"speed": 1})
    env.reset(seed=0)
    env.step(np.zeros(2))
    with pytest.raises(ConfigError, match="is over"):
        env.step(np.zeros(2))
