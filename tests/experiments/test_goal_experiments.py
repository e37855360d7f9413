"""Controllability: goals of the ego, their attainment, and summaries of made-up rates."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import scenes
from made_up import TINY, row
from rlftsim.errors import ConfigError, DataError
from rlftsim.evaluation.evaluate import EvaluateConfig, evaluate
from rlftsim.evaluation.goal_attainment import Attained
from rlftsim.experiments.model_specs import BASE, Baseline, FineTuned, GoalTraining, Guided, finetune_config
from rlftsim.experiments.paper import (
    controllability,
    goal_conditioning,
    kinematic_controllability,
    maneuver_controllability,
)
from rlftsim.experiments.suite import ExperimentSuite
from rlftsim.goals.goals_file import GoalEntry, GoalsFile, read_goals, write_goals
from rlftsim.policies.smart.policy import SmartPolicy
from rlftsim.rollout.baselines import ConstantVelocity
from rlftsim.scenario.dataset import write_dataset

QUICK = EvaluateConfig(num_rollouts=2)
ROWS = ("base", goal_conditioning.START, *goal_conditioning.GUIDED)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """One scenario to train on, three with an ego that goes straight, turns left, and stands."""
    folder = tmp_path_factory.mktemp("goals") / "data"
    standing = replace(scenes.straight_road("standing"), ego_index=5)
    held_out = [scenes.straight_road("straight"), scenes.bend("bend"), standing]
    write_dataset(
        [scenes.straight_road("a"), *held_out],
        folder,
        split=lambda s: "training" if s.scenario_id == "a" else "validation",
    )
    return folder


@pytest.fixture(scope="module")
def suite(data, tmp_path_factory):
    return ExperimentSuite(TINY, data, tmp_path_factory.mktemp("suite"), QUICK)


# ---- specs --------------------------------------------------------------------------------------------------------


def test_variants_start_from_the_realism_aligned_model(suite):
    config = finetune_config(goal_conditioning.VARIANTS["indication, hard"], TINY.finetune)
    assert (config.reward, config.goals.probability, config.goals.hindsight) == (
        "0.98*mloo + 0.02*goal(kind='hard', partial=False)",
        1.0,
        1.0,
    )
    assert config.credit == "agent"
    assert (
        finetune_config(
            FineTuned("mloo"), replace(TINY.finetune, goals=replace(config.goals, hindsight=0.0))
        ).goals.probability
        == 0.0
    )
    variant = goal_conditioning.VARIANTS["concatenation, soft"]
    relabelled = "gcsl-concat-from-mloo-seed0-seed0"
    assert variant.name == f"gcft-concat-soft-agent-from-{relabelled}-seed0"
    lineage = [one.name for one in suite._lineage(variant)]
    assert lineage == ["base", "mloo-seed0", relabelled, variant.name]


def test_goals_are_refused_for_models_that_see_none(data, tmp_path):
    config = EvaluateConfig(num_rollouts=1, goals="logged")
    with pytest.raises(ConfigError, match="goals=logged has no effect: cv is not goal-conditioned"):
        evaluate(ConstantVelocity(), data, tmp_path, config, name="cv")
    assert "goals" not in QUICK.what_counts()  # evaluations of before are still what they were
    assert config.what_counts()["goals"] == "logged"


# ---- attainment -----------------------------------------------------------------------------------------------------


class Seeker(ConstantVelocity):
    """Drives the straight line to its goal."""

    is_goal_conditioned = True

    def begin(self, context, num_rollouts, goals, noise):
        state = super().begin(context, num_rollouts, goals, noise)
        if goals is None:
            return state
        way = (goals.position - state.position) / 8.0
        return replace(state, velocity=way.where(goals.goal_mask[..., None], state.velocity))


def test_every_goal_is_given_alone_and_measured_once(suite, monkeypatch):
    policies = {"constant_velocity": ConstantVelocity(), "oracle": Seeker()}
    monkeypatch.setattr(controllability, "load_policy", lambda name, device: policies[name])
    straight_on = 1000.0 + 9.3 * 8
    goals = [
        GoalEntry("straight", 100, straight_on, -200.0),
        GoalEntry("straight", 100, 1020.0, -200.0),  # come by, driven past
        GoalEntry("straight", 100, 1040.0, -180.0),
        GoalEntry("bend", 100, 1030.0, -190.0),
    ]
    rows = {"straight on": Baseline("constant_velocity"), "seeker": Baseline("oracle")}
    found = controllability.measure_attainment(suite, rows, goals, name="test")
    assert [(a.reached, a.passed) for a in found["straight on"]] == [(1, 1), (0, 1), (0, 0), (0, 0)]
    assert [(a.reached, a.passed) for a in found["seeker"]] == [(1, 1)] * 4
    assert [a.entry for a in found["seeker"]] == goals
    files = {p: p.stat().st_mtime_ns for p in (suite.out / "attainment").rglob("*.json")}
    assert len(files) == 4
    # an edited goal is measured anew, the other scenario is not
    edited = [*goals[:3], replace(goals[3], x=1031.0)]
    controllability.measure_attainment(suite, rows, edited, name="test")
    changed = {p.stem for p, stamp in files.items() if p.stat().st_mtime_ns != stamp}
    assert changed == {"bend"}


def test_another_model_of_the_same_name_is_measured_anew(suite, monkeypatch):
    goal = GoalEntry("straight", 100, 1020.0, -200.0)
    rows = {"one": Baseline("constant_velocity")}
    for policy, reached in ((ConstantVelocity(), 0.0), (Seeker(), 1.0), (ConstantVelocity(), 0.0)):
        monkeypatch.setattr(controllability, "load_policy", lambda name, device, policy=policy: policy)
        assert controllability.measure_attainment(suite, rows, [goal], name="again")["one"][0].reached == reached


def test_two_processes_measure_what_one_does(data, tmp_path, suite):
    goals = [GoalEntry("straight", 100, 1020.0, -200.0), GoalEntry("bend", 100, 1030.0, -190.0)]
    rows = {"straight on": Baseline("constant_velocity")}
    spread = ExperimentSuite(TINY, data, tmp_path, replace(QUICK, jobs=2))
    found = [controllability.measure_attainment(one, rows, goals, name="spread") for one in (suite, spread)]
    assert found[0] == found[1]
    assert len(list(tmp_path.rglob("attainment/spread/**/*.json"))) == 2


# ---- kinematic ------------------------------------------------------------------------------------------------------


def test_goals_lie_on_the_logged_way_and_its_continuation():
    straight = scenes.straight_road()  # 9.3 m/s along x from (1000, -200)
    for offset in (-3, 0, 2):
        goal = kinematic_controllability.find_goal(straight, offset)
        assert goal is not None
        assert (goal.x, goal.y) == pytest.approx((1000 + 9.3 * (8 + offset), -200), abs=0.01)
    # an arc goes on as the same arc: what the mover itself does three seconds later
    mover = scenes.Mover(speed_mps=9.3, turn_rate_radps=0.103)
    time, rate = 11.0, mover.turn_rate_radps
    radius = mover.speed_mps / rate
    expected = (1000 + radius * np.sin(rate * time), -200 + radius * (1 - np.cos(rate * time)))
    goal = kinematic_controllability.find_goal(scenes.bend(), 3)
    assert goal is not None
    assert (goal.x, goal.y) == pytest.approx(expected, abs=0.02)
    assert kinematic_controllability.find_goal(scenes.without_future(), 0) is None


def made_up_rates(labels, rates):
    """Attained goals of rows: scenario k has the labels in turn."""
    return {
        row: tuple(
            Attained(GoalEntry(f"s{k}", 1, 0.0, 0.0, label), reached=values[k][n] / 2, passed=values[k][n])
            for k in range(len(values))
            for n, label in enumerate(labels)
        )
        for row, values in rates.items()
    }


def test_offsets_are_compared_scenario_by_scenario(suite):
    offsets = kinematic_controllability.OFFSETS_S
    labels = [f"{h:+d} s" for h in offsets]
    rows = list(ROWS)
    low, high = [[0.2] * 7, [0.4] * 7, [0.6] * 7], [[0.3] * 7, [0.5] * 7, [0.7] * 7]
    rates = {name: high if name == "indication, soft, guided" else low for name in rows}
    measured = made_up_rates(labels, rates)
    found = kinematic_controllability.summarize(measured, suite)
    assert found.tables[0].rows[0][1] == "40.0 ± 11.5"  # of 20, 40, 60: 20 over the root of 3
    verdict = next(v for v in found.verdicts if v.startswith("indication, soft, guided against goal-free, passed"))
    assert "difference, for the better: +10.0 points" in verdict
    assert "no difference: +0.0" in next(v for v in found.verdicts if v.startswith("indication, hard, guided"))
    assert found.numbers["passed"]["base"][0]["scenarios"] == 3
    assert found.figure is not None


def test_the_ego_has_a_goal_for_every_offset(suite, monkeypatch):
    given = {}
    monkeypatch.setattr(controllability, "measure_attainment", lambda *_, name: given.update({name: _[-1]}) or {})
    kinematic_controllability.run(suite)
    goals = given[kinematic_controllability.NAME]
    assert [goal.label for goal in goals] == ["-3 s", "-2 s", "-1 s", "+0 s", "+1 s", "+2 s", "+3 s"] * 3
    assert [(goal.scenario_id, goal.agent_id) for goal in goals[::7]] == [
        ("straight", 100),
        ("bend", 100),
        ("standing", 105),
    ]
    monkeypatch.setattr(kinematic_controllability, "find_goal", lambda scenario, offset_s: None)
    with pytest.raises(DataError, match="not one of 3 scenarios is logged to the end"):
        kinematic_controllability.run(suite)


# ---- maneuvers ------------------------------------------------------------------------------------------------------


def test_conditions_are_means_over_scenarios(suite):
    labels = ["straight (logged)", "left", "right"]
    rows = list(ROWS)
    base, better = [[1.0, 0.0, 0.2], [0.8, 0.2, 0.2]], [[1.0, 0.4, 0.6], [0.8, 0.5, 0.5]]
    rates = {name: better if name == "concatenation, soft, guided" else base for name in rows}
    measured = made_up_rates(labels, rates)
    found = maneuver_controllability.summarize(measured, suite)
    overall = found.numbers["conditions"]["passed"]
    assert [overall["goal-free"][c]["mean"] for c in maneuver_controllability.CONDITIONS] == pytest.approx(
        [0.9, 0.525, 0.15]
    )
    assert overall["concatenation, soft, guided"]["alternative only"]["mean"] == pytest.approx(0.5)
    assert found.numbers["conditions"]["reached"]["base"]["mixed"]["mean"] == pytest.approx(0.2625)
    # whole goals: the first scenario's left is never passed, all the others sometimes
    assert found.numbers["conditions"]["passed_once"]["base"]["alternative only"]["mean"] == pytest.approx(0.75)
    lefts = found.numbers["maneuvers"]["passed"]["concatenation, soft, guided"]["alternative only"]["left"]
    assert (lefts["mean"], lefts["count"]) == (pytest.approx(0.45), 2)
    verdict = next(v for v in found.verdicts if v.startswith("concatenation, soft, guided against goal-free, passed"))
    assert "alternatives only (3.33 times)" in verdict
    assert found.tables[-1].title.startswith("The paper")


def test_the_goals_are_written_for_a_person_to_edit(suite, monkeypatch):
    given = []
    monkeypatch.setattr(controllability, "measure_attainment", lambda *_, name: given.append(_[-1]) or {})
    monkeypatch.setattr(maneuver_controllability, "propose", made_up_proposals)
    maneuver_controllability.run(suite)
    path = maneuver_controllability.goals_path(suite)
    file = read_goals(path)
    assert [goal.label for goal in file.goals] == ["straight (logged)"]  # only where there is a choice
    assert [goal.label for goal in file.alternatives] == ["left"]
    path.write_text(path.read_text().replace('"left"', '"right"'))
    maneuver_controllability.run(suite)
    assert [goal.label for goal in given[1]] == ["straight (logged)", "right"]
    path.write_text(path.read_text().replace('"right"', '"somewhere"'))
    with pytest.raises(DataError, match=r"alternatives\[0\]: label 'somewhere' names no maneuver: known are straight"):
        maneuver_controllability.run(suite)
    path.unlink()


@pytest.mark.parametrize(
    ("goals", "message"),
    [
        ([("straight", 105, "left")], "agent 105 is not the ego of scenario straight, .*: write agent 100"),
        ([("straight", 999, "left")], "has no agent 999"),
        ([("straight", 100, "straight (logged)"), ("elsewhere", 7, "left")], "has an alternative maneuver: take more"),
    ],
)  # fmt: skip
def test_an_edited_goal_is_refused_before_anything_is_trained(goals, message, suite):
    path = maneuver_controllability.goals_path(suite)
    entries = [GoalEntry(scenario_id, agent, 1040.0, -200.0, label) for scenario_id, agent, label in goals]
    write_goals(path, GoalsFile(tuple(entries[:1]), tuple(entries[1:])))
    with pytest.raises(DataError, match=message):
        maneuver_controllability.run(suite)
    assert not (suite.out / "runs").exists()
    path.unlink()


def made_up_proposals(scenario, track):
    from rlftsim.goals.proposals import Proposal
    from rlftsim.scenario.maneuver import Maneuver

    way = scenario.tracks.position[track, 10:, :].astype(np.float64)
    agent = int(scenario.tracks.object_id[track])
    found = {"straight": [Maneuver.STRAIGHT, Maneuver.LEFT], "bend": [Maneuver.LEFT], "standing": []}
    kinds = found[scenario.scenario_id]
    return tuple(Proposal(agent, kind, way[-1, :2], way, is_logged=n == 0) for n, kind in enumerate(kinds))


# ---- goal conditioning ----------------------------------------------------------------------------------------------


def test_variants_are_evaluated_with_and_without_goals_for_every_seed(suite, monkeypatch):
    calls = []

    def evaluate_rows(self, rows, goals="none"):
        calls.append((goals, {name: len(seeds) for name, seeds in rows.items()}))
        return {name: row(name, [0.5]) for name in rows}

    monkeypatch.setattr(ExperimentSuite, "evaluate", evaluate_rows)
    rows = goal_conditioning.run(replace(suite, num_seeds=2))
    twice = dict.fromkeys(goal_conditioning.VARIANTS, 2)
    relabelled = dict.fromkeys(goal_conditioning.RELABELLED, 1)
    guided = dict.fromkeys(goal_conditioning.GUIDED, 2)
    assert calls == [
        ("none", {"goal-free": 1}), ("logged", relabelled), ("logged", twice), ("logged", guided), ("none", twice),
    ]  # fmt: skip
    assert list(rows.variants) == list(rows.without_goals) == list(goal_conditioning.VARIANTS)


def test_fewer_missed_goals_are_listed_with_their_cost(suite):
    def rows_of(names, meta_metric, misses):
        return {name: row(name, meta_metric, passing_miss_rate=misses) for name in names}

    rows = goal_conditioning.GoalRows(
        start=row("goal-free", [0.60, 0.70], passing_miss_rate=[0.2, 0.4]),
        relabelled=rows_of(goal_conditioning.RELABELLED, [0.59, 0.70], [0.2, 0.2]),
        variants=rows_of(goal_conditioning.VARIANTS, [0.59, 0.70], [0.1, 0.2]),
        guided=rows_of(goal_conditioning.GUIDED, [0.60, 0.70], [0.1, 0.1]),
        without_goals=rows_of(goal_conditioning.VARIANTS, [0.60, 0.70], [0.2, 0.4]),
    )
    found = goal_conditioning.summarize(rows, suite)
    relabelled, _, soft, *_ = found.verdicts
    assert relabelled == "concatenation, relabelled: passing misses 30.00% → 20.00%, -33% relative, at -0.0050 RMM."
    assert soft == "concatenation, soft: passing misses 30.00% → 15.00%, -50% relative, at -0.0050 RMM."
    assert found.tables[0].rows[0][1] == "30.00 ± 10.00"
    assert found.tables[1].rows[1][0] == "concatenation, soft, without goals"
    assert "Tab. 3" in found.tables[2].title
    assert json.dumps(found.numbers)


@pytest.mark.slow
def test_the_experiments_run_with_tiny_models(suite):
    relabelled = FineTuned("gcsl", base=FineTuned("mloo"), goals=GoalTraining("indication"))
    variant = FineTuned("gcft", base=relabelled, goals=GoalTraining("indication", "soft"))
    evaluated = suite.evaluate({"soft": (variant,)}, goals="logged")["soft"].mean
    assert len(evaluated) == 3
    assert suite.evaluation_name(variant, "logged") == (
        "gcft-indication-soft-from-gcsl-indication-from-mloo-seed0-seed0-seed0-0.5-epochs-logged-goals"
    )
    assert (suite.out / "evaluations" / f"{suite.evaluation_name(variant, 'logged')}.parquet").exists()
    goals = [GoalEntry("straight", 100, 1080.0, -200.0)]
    rows = {"base": BASE, "soft": variant, "guided": Guided(variant, 1e3)}
    found = controllability.measure_attainment(suite, rows, goals, name="tiny")
    guided = SmartPolicy.from_pretrained(Path(suite.models([rows["guided"]])[rows["guided"]]))
    plain = SmartPolicy.from_pretrained(Path(suite.models([variant])[variant]))
    assert guided.network.decoder.aim.weight.equal(1e3 * plain.network.decoder.aim.weight)
    assert suite.evaluation_name(rows["guided"]) == f"{suite.evaluation_name(variant)}-guided-1000"
    assert all(0 <= a.reached <= a.passed <= 1 for attained in found.values() for a in attained)
