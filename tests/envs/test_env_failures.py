"""Failures of a planner in a scenario: unbiased against brute force, run again bit for bit, planners copied."""

import threading
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from rlftsim.envs import EgoEnv, estimate_failures
from rlftsim.envs.dangers import EVENTS, StepView, find_event
from rlftsim.envs.failure_run import _drive_pilot
from rlftsim.envs.failure_study import StudyConfig
from rlftsim.envs.failures import Failure, FailureChain, choose_failures, make_source
from rlftsim.envs.planners.pdm import PdmPlanner
from rlftsim.envs.planners.registry import PlannerFailure, load_planner
from rlftsim.envs.record import build_record
from rlftsim.envs.result import Result
from rlftsim.errors import ConfigError, DataError
from rlftsim.policies.registry import load_policy
from scenes import Mover, build_scenario, junction_with_light, straight_road

STEPS = 20


@pytest.fixture(scope="module")
def model():
    return load_policy("demo-base")


class Advance:
    """The second agent gains on its distance at constant speed by some meters: random by the traffic alone."""

    def __init__(self, gain_m: float):
        self.gain_m = gain_m

    def danger(self, view: StepView) -> float:
        log, motion = view.episode.world.logged[view.index[0], 1, 10], view.state.world.motion[view.index[0], 1]
        return float(motion[0] - log[0] - log[3] * 0.1 * view.step) - self.gain_m


class Ever:
    """Happens at the first step."""

    def danger(self, view: StepView) -> float:
        return view.step - 1.0


class Counting:
    """Brakes more at every step: a planner with memory."""

    def __init__(self):
        self.count = 0

    def reset(self, info):
        self.count = 0

    def act(self, observation):
        self.count += 1
        return np.array([-0.01 * self.count, 0.0], np.float32)


class Locked(Counting):
    """Holds what cannot be copied."""

    def __init__(self):
        super().__init__()
        self.lock = threading.Lock()


class Random(Counting):
    """Draws its actions, from the seed that it is given."""

    def seed(self, number):
        self.random = np.random.default_rng(number)

    def act(self, observation):
        return self.random.uniform(-1, 1, 2).astype(np.float32) * [1.0, 0.1]


class Noting(PdmPlanner):
    """Counts its actions, which is no declared memory: every agent acts alone."""

    def __init__(self):
        super().__init__()
        self.count = 0

    def act_batch(self, observe):
        self.count += 1
        return super().act_batch(observe)


def chain_of(model, event, planner="idm", **settings):
    planner = load_planner(planner) if isinstance(planner, str) else planner
    source = make_source(planner, straight_road(), model, **settings)
    return FailureChain(source, planner, source.scenario_ids[0], find_event(event), seed=3)


def test_estimates_agree_with_brute_force(model):
    chain = chain_of(model, Advance(2.0), max_steps=STEPS)
    paths, _ = chain.start(np.arange(256))
    rate = np.mean([path.danger.max() >= 0 for path in paths])
    assert 0.005 < rate < 0.3
    found = estimate_failures(
        "idm", straight_road(), event=Advance(2.0), particles=16, repeats=6, policy=model, max_steps=STEPS
    )
    low, high = found.interval
    error = 2 * np.sqrt(rate * (1 - rate) / 256)
    assert low - error < rate < high + error
    assert f"{found.probability:.2g}" in repr(found)
    assert sum(f.probability for f in found.failures) / 6 == pytest.approx(found.probability)


@pytest.mark.parametrize("planner", [Counting(), Random()], ids=["memory", "dice of its own"])
def test_a_failure_runs_again_bit_for_bit(model, planner):
    found = estimate_failures(
        planner, straight_road(), event=Advance(2.0), particles=16, repeats=2, policy=model, max_steps=STEPS
    )
    assert found.failures
    branched = [failure for failure in found.failures if len(set(failure.dice)) > 1]
    assert branched
    for failure in (branched[0], branched[-1]):
        record = found.run_again(failure).record
        motion = record.motion[1]
        gain = motion[:, 0] - motion[0, 0] - motion[0, 3] * 0.1 * np.arange(STEPS + 1)
        assert int(np.argmax(gain >= 2.0)) == failure.step
    with pytest.raises(DataError, match="drives otherwise"):
        found.run_again(replace(branched[0], digest="0"))
    with pytest.raises(DataError, match=r"a failure at step 999 .*: estimate again"):
        found.run_again(replace(branched[0], step=999))


def test_planners_that_act_together_drive_as_each_would_alone(model):
    numbers, blocks = np.arange(3), np.array([1, 3, 2])
    driven = []
    for planner in (PdmPlanner(), Noting()):
        chain = chain_of(model, "collision", planner, max_steps=STEPS)
        parents, _ = chain.start(numbers)
        driven.append([*parents, *chain.branch(parents, blocks, numbers + 3)[0]])
    assert all(np.array_equal(a.motion, b.motion) for a, b in zip(*driven))
    assert {path.planners[-1].count for path in driven[1]} == {STEPS - 5}


def test_an_undisturbed_episode_is_that_of_the_environment(model):
    chain = chain_of(model, "collision", Counting())
    paths, _ = chain.start(np.arange(3))
    env = EgoEnv(source=chain.source)
    observation, info = env.reset(seed=3, options={"rollout": 2})
    planner = Counting()
    planner.reset(info)
    while not env.state.ended[0]:
        observation, *_ = env.step(planner.act(observation))
    ego = env.episode.world.scenes[0].ego
    assert np.array_equal(paths[2].motion, np.stack([step[0, ego] for step in env.state.world.track[11:]]))


def test_what_cannot_be_estimated_is_refused_before_anything_is_driven(model):
    with pytest.raises(ConfigError, match=r"Locked cannot be copied .*copy\(\)"):
        estimate_failures(Locked(), straight_road(), policy=model)
    with pytest.raises(DataError, match="has happened at the start"):
        estimate_failures("idm", straight_road(), event=Advance(-1.0), policy=model)
    with pytest.raises(ConfigError, match="at_fault_collision, collision"):
        estimate_failures("idm", straight_road(), event="crash", policy=model)


def test_without_an_event_there_is_a_bound_and_one_repeat_says_that_it_has_no_interval(model):
    settings = {"particles": 4, "policy": model, "max_steps": 5}
    none = estimate_failures("idm", straight_road(), event=Advance(100.0), repeats=2, **settings)
    assert none.probability == 0
    assert "none in 8 undisturbed episodes" in repr(none)
    with pytest.raises(DataError, match="no failure to show"):
        none.films("crash.mp4")
    single = estimate_failures("idm", straight_road(), event=Ever(), repeats=1, **settings)
    assert "one repeat" in repr(single)


def test_a_collision_is_a_danger_that_grows_until_it_happens(model, tmp_path):
    # a car that stands across the lane, and a planner that does not look
    movers = [Mover(speed_mps=9.3), Mover(x_m=40.0, y_m=0.3, heading_rad=1.5, speed_mps=0.0)]
    scenario = build_scenario("blocked", movers)
    found = estimate_failures("constant_velocity", scenario, particles=2, repeats=2, policy=model)
    assert found.probability == 1.0
    failure = found.failures[0]
    assert failure.at_fault
    assert failure.contact in ("stopped_track", "active_front")
    danger = found.chain.run(np.array([failure.dice]))[0][0].danger
    assert (danger[: failure.step] < 0).all()
    assert danger[failure.step] == 0
    ends = danger[: failure.step : found.chain.block_steps][-3:]  # between them only the contact itself is measured
    assert np.isfinite(ends).all()
    assert (np.diff(ends) >= 0).all()
    assert [path.name for path in found.films(tmp_path / "crash.webp", limit=2)] == ["crash.webp", "crash-2.webp"]


def test_what_is_not_measured_between_branching_points_changes_no_estimate(model):
    class EveryStep:
        """The event without `has_happened`, so that its danger is asked for at each step."""

        def danger(self, view):
            return EVENTS["collision"].danger(view)

    scenario = build_scenario("near", [Mover(speed_mps=9.3), Mover(x_m=30.0, y_m=1.0, heading_rad=0.1, speed_mps=4.0)])
    found = [
        estimate_failures("idm", scenario, event=event, particles=4, repeats=2, policy=model).repeats
        for event in ("collision", EveryStep())
    ]
    assert found[0] == found[1]
    assert any(repeat.num_levels for repeat in found[0])


@pytest.mark.parametrize("event", ["off_road", "red_light", "hard_braking"])
def test_an_event_has_happened_exactly_where_the_scores_say_so(model, event):
    scenario = junction_with_light()
    planner = load_planner("constant_velocity") if event != "hard_braking" else load_planner("replay")
    source = make_source(planner, scenario, model)
    chain = FailureChain(source, planner, scenario.scenario_id, EVENTS[event], seed=0)
    [path], episode, state = chain.run(np.zeros((1, chain.num_blocks), np.int64))
    scores = Result(build_record(episode, state)).planner
    happened = bool((path.danger >= 0).any())
    expected = {
        "off_road": scores.drivable_area == 0,
        "red_light": scores.red_light_rate == 1,
        "hard_braking": False,
    }
    assert happened == expected[event]


def test_films_are_of_different_beginnings_first(model):
    found = estimate_failures("idm", straight_road(), event=Ever(), particles=4, repeats=2, policy=model, max_steps=10)
    assert len({f.dice[0] for f in choose_failures(found.failures, 8)}) == 8


def test_hard_braking_is_seen_in_every_step_of_a_planners_action():
    # the speeds of an action of five steps: the planner brakes with 7 m/s² in the second one alone
    speeds = np.array([10.0, 10.0, 9.3, 9.3, 9.3, 9.3])
    track = [np.zeros((1, 1, 5)) for _ in speeds]
    for motion, speed in zip(track, speeds):
        motion[0, 0, 3] = speed
    world = SimpleNamespace(track=track, step=5)
    episode = SimpleNamespace(world=SimpleNamespace(actors=np.zeros((1, 2), int)), controls=SimpleNamespace(steps=5))
    view = object.__new__(StepView)
    for name, value in (("episode", episode), ("state", SimpleNamespace(world=world)), ("row", 0)):
        object.__setattr__(view, name, value)
    assert view.acceleration == pytest.approx(-7.0)
    assert EVENTS["hard_braking"].danger(view) == pytest.approx(1.0)


@pytest.mark.parametrize("method", ["reset", "seed", "act"])
def test_a_planner_that_fails_is_named_with_its_scenario(model, method):
    class Failing:
        def reset(self, info):
            self.fail("reset")

        def seed(self, number):
            self.fail("seed")

        def act(self, observation):
            self.fail("act")

        def fail(self, name):
            if name == method:
                raise IndexError("no lane")
            return np.zeros(2)

    with pytest.raises(
        PlannerFailure, match="planner Failing fails at step 0 of scenario straight: IndexError: no lane"
    ):
        estimate_failures(Failing(), straight_road(), policy=model, particles=2, repeats=1, max_steps=10)


def test_a_pilot_explains_a_failing_planner_and_hands_on_what_is_not_its_fault(monkeypatch):
    def run(chain, numbers):
        raise error

    monkeypatch.setattr(FailureChain, "start", run)
    config = StudyConfig("idm", pilot=2)
    error = PlannerFailure("planner Idm fails")
    assert _drive_pilot(config, config.scenario_ids(), 0)["problem"] == "planner Idm fails"
    error = DataError("a damaged shard")
    with pytest.raises(DataError, match="a damaged shard"):
        _drive_pilot(config, config.scenario_ids(), 0)


def test_a_contact_is_of_a_type():
    with pytest.raises(ConfigError, match=r"a contact is stopped_ego, .* or empty, got 'rear'"):
        Failure("a", 0.1, (0,), 1, "", contact="rear")
