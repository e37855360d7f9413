import io
import json
import multiprocessing
from dataclasses import replace

import jaxtyping
import numpy as np
import pytest
from rich.console import Console
from rollout_drawing import draw_arrays, write_npz, write_submission

import scenes
from rlftsim.errors import ConfigError, DataError
from rlftsim.evaluation import score_files as module
from rlftsim.evaluation.compare import compare
from rlftsim.evaluation.evaluate import EvaluateConfig, evaluate
from rlftsim.evaluation.results import SCORE_COLUMNS, Evaluation
from rlftsim.evaluation.scenario_source import open_scenarios
from rlftsim.evaluation.score_files import ScoreConfig, format_scores, score_rollouts, to_json
from rlftsim.jobs.runner import Inline, Share, Unfinished
from rlftsim.rollout.baselines import ConstantVelocity
from rlftsim.rollout.simulate import simulate
from rlftsim.rollout.types import write_rollouts
from rlftsim.scenario import womd_pb2
from rlftsim.scenario.batch import collate
from rlftsim.scenario.dataset import write_dataset
from rlftsim.scenario.tfrecord import write_records

CONFIG = ScoreConfig(jobs=1)
SCENARIOS = [
    scenes.straight_road(),
    scenes.junction_with_light(),
    scenes.lone_agent(),
    scenes.with_gaps(),
    scenes.straight_road("again"),
    scenes.crowd(num_agents=9),
]


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("score") / "data"
    write_dataset([*SCENARIOS, scenes.without_road_edges()], folder, split="validation")
    return folder


@pytest.fixture(scope="module")
def rollouts(tmp_path_factory):
    folder = tmp_path_factory.mktemp("score") / "rollouts"
    folder.mkdir()
    for number, scenario in enumerate(SCENARIOS):
        write_npz(folder / f"{number}.npz", draw_arrays(scenario, seed=number))
    return folder


def same(a: Evaluation, b: Evaluation) -> bool:
    # By text, in which NaN is NaN: no evaluated agent of a scenario may stay on the road in the log.
    return repr(a.table.to_pylist()) == repr(b.table.to_pylist()) and a.skipped == b.skipped


def test_every_scenario_with_rollouts_is_scored_in_the_order_of_the_files(data, rollouts, tmp_path):
    result = score_rollouts(str(rollouts), str(data), str(tmp_path), CONFIG)
    assert result.scenario_ids == [scenario.scenario_id for scenario in SCENARIOS]
    assert result.config.num_rollouts == 4
    assert same(Evaluation.read(tmp_path / "rollouts.parquet"), result)


def test_a_submission_and_npz_of_the_same_rollouts_score_the_same(data, rollouts, tmp_path):
    arrays = [draw_arrays(scenario, seed=number) for number, scenario in enumerate(SCENARIOS)]
    path = write_submission(tmp_path / "all.binproto", *arrays)
    from_npz = to_json(score_rollouts(rollouts, data, None, CONFIG))
    assert to_json(score_rollouts(path, data, None, CONFIG)) == from_npz


def test_the_number_of_processes_changes_no_number(data, rollouts, tmp_path):
    once = score_rollouts(rollouts, data, None, CONFIG)
    assert same(score_rollouts(rollouts, data, None, ScoreConfig(jobs=2)), once)
    assert not multiprocessing.active_children()


def test_an_interrupted_run_goes_on_with_what_is_missing(data, rollouts, tmp_path, monkeypatch):
    whole = score_rollouts(rollouts, data, None, CONFIG)
    original, seen = module._score_entry, []

    def interrupt_at_the_sixth(*work):
        if len(seen) == 5:
            raise KeyboardInterrupt
        seen.append(work[-1])
        return original(*work)

    monkeypatch.setattr(module, "_score_entry", interrupt_at_the_sixth)
    with pytest.raises(KeyboardInterrupt):
        score_rollouts(rollouts, data, tmp_path, CONFIG)
    rest = []

    def note(entries, *work):
        rest.append(entries[work[-1]].scenario_id)
        return original(entries, *work)

    monkeypatch.setattr(module, "_score_entry", note)
    assert same(score_rollouts(rollouts, data, tmp_path, CONFIG), whole)
    assert rest == ["again", "crowd"]
    rest.clear()
    assert same(score_rollouts(rollouts, data, tmp_path, CONFIG), whole)
    assert rest == []


def test_a_quick_look_keeps_what_a_longer_scoring_has_done(data, rollouts, tmp_path):
    with pytest.raises(Unfinished):
        score_rollouts(rollouts, data, tmp_path, CONFIG, runner=Share(1, 2, Inline()))
    parts = set((tmp_path / "rollouts.parts").glob("*.parquet"))
    assert parts
    assert len(score_rollouts(rollouts, data, tmp_path, replace(CONFIG, limit=1))) == 1
    assert parts <= set((tmp_path / "rollouts.parts").glob("*.parquet"))
    assert len(score_rollouts(rollouts, data, tmp_path, CONFIG, runner=Share(2, 2, Inline()))) == len(SCENARIOS)
    with pytest.raises(ConfigError, match=r"holds 6 scenarios, and limit=1 would replace them without 5"):
        score_rollouts(rollouts, data, tmp_path, replace(CONFIG, limit=1))


def test_scores_of_other_rollouts_are_not_replaced(data, rollouts, tmp_path):
    folder = tmp_path / "rollouts"
    folder.mkdir()
    write_npz(folder / "a.npz", draw_arrays(SCENARIOS[0], seed=1))
    first = score_rollouts(folder, data, tmp_path / "out", CONFIG)
    write_npz(folder / "a.npz", draw_arrays(SCENARIOS[0], seed=2))
    with pytest.raises(
        ConfigError, match=r"is the result of another policy_fingerprint \(\w{8}, not \w{8}\): choose another"
    ):
        score_rollouts(folder, data, tmp_path / "out", CONFIG)
    assert same(Evaluation.read(tmp_path / "out" / "rollouts.parquet"), first)


def test_json_has_the_official_names_and_where_the_data_come_from(data, rollouts):
    result = score_rollouts(rollouts, data, None, CONFIG)
    values = to_json(result)
    assert list(values) == ["metric", "sources", "guessed", "scenarios", "mean", "standard_error"]
    assert (values["sources"], values["guessed"]) == (["unknown"], [])
    assert values["metric"] == "2025"
    row, fields = values["scenarios"][0], values["mean"]
    assert row.keys() == {"scenario_id", *fields}
    assert fields.keys() == values["standard_error"].keys()
    assert set(fields["buckets"]) == {
        "realism_meta_metric",
        "kinematic_metrics",
        "interactive_metrics",
        "map_based_metrics",
        "min_ade",
        "simulated_collision_rate",
        "simulated_offroad_rate",
        "simulated_traffic_light_violation_rate",
    }
    assert fields["metametric"] == pytest.approx(np.mean([s["metametric"] for s in values["scenarios"]]))
    assert json.loads(json.dumps(values, allow_nan=False)) == values


def test_the_original_metric_of_2024_reports_no_lights(data, rollouts):
    values = to_json(score_rollouts(rollouts, data, None, ScoreConfig(jobs=1, metric="2024_original_code")))
    assert not any("light" in name for name in [*values["mean"], *values["mean"]["buckets"]])


def test_a_single_scenario_has_no_standard_error(data, tmp_path):
    write_npz(tmp_path / "a.npz", draw_arrays(SCENARIOS[0]))
    values = to_json(score_rollouts(tmp_path / "a.npz", data, None, CONFIG))
    assert values["standard_error"]["metametric"] is None
    assert values["standard_error"]["buckets"]["min_ade"] is None
    assert values["mean"]["metametric"] == values["scenarios"][0]["metametric"]


def test_the_table_names_the_metric_beside_every_number_and_the_light_term_set_to_one(data, rollouts):
    result = score_rollouts(rollouts, data, None, CONFIG)
    console = Console(width=140, record=True, file=io.StringIO())
    console.print(format_scores(result))
    lines = [line for line in console.export_text().splitlines() if "2025" in line]
    assert len(lines) == len(SCORE_COLUMNS)
    light_one = next(line for line in lines if "traffic light term set to 1" in line)
    assert f"{result.mean_and_error('meta_metric_light_one').mean:.4f}" in light_one


def test_scored_rollouts_compare_with_an_evaluated_policy(data, rollouts, tmp_path):
    scored = score_rollouts(rollouts, data, None, CONFIG)
    evaluated = evaluate(ConstantVelocity(), data, tmp_path, EvaluateConfig(num_rollouts=4), name="cv")
    assert compare(scored, evaluated).num_paired == len(SCENARIOS)


def test_rollouts_of_an_unknown_scenario_stop_the_run_or_are_listed(data, tmp_path):
    write_npz(tmp_path / "a.npz", draw_arrays(SCENARIOS[0]))
    write_npz(tmp_path / "b.npz", draw_arrays(scenes.straight_road("elsewhere")))
    with pytest.raises(DataError, match=r"b\.npz \(scenario elsewhere\): 1 of 2"):
        score_rollouts(tmp_path, data, None, CONFIG)
    result = score_rollouts(tmp_path, data, None, replace(CONFIG, missing_scenario="skip"))
    assert result.scenario_ids == ["straight"]
    assert [s.scenario_id for s in result.skipped] == ["elsewhere"]


def test_a_scenario_without_road_edges_stops_the_run_or_is_listed(data, tmp_path):
    folder = tmp_path / "rollouts"
    folder.mkdir()
    write_npz(folder / "a.npz", draw_arrays(SCENARIOS[0]))
    write_npz(folder / "b.npz", draw_arrays(scenes.without_road_edges()))
    with pytest.raises(DataError, match=r"no-edges has no road edge.*missing_map=skip"):
        score_rollouts(folder, data, tmp_path, CONFIG)
    result = score_rollouts(folder, data, tmp_path, replace(CONFIG, missing_map="skip"))
    assert result.scenario_ids == ["straight"]
    assert [s.scenario_id for s in result.skipped] == ["no-edges"]
    with pytest.raises(DataError, match="no-edges has no road edge"):  # now read from the file
        score_rollouts(folder, data, tmp_path, CONFIG)


def test_sets_of_different_size_are_not_averaged(data, tmp_path):
    write_npz(tmp_path / "a.npz", draw_arrays(SCENARIOS[0], num_rollouts=2))
    write_npz(tmp_path / "b.npz", draw_arrays(SCENARIOS[1], num_rollouts=3))
    with pytest.raises(DataError, match="3 rollouts, others have 2"):
        score_rollouts(tmp_path, data, None, CONFIG)


def test_two_sets_for_one_scenario_are_both_scored_with_a_message(data, tmp_path, capsys, monkeypatch):
    (tmp_path / "sets").mkdir()
    for seed in (1, 2):
        write_npz(tmp_path / "sets" / f"{seed}.npz", draw_arrays(SCENARIOS[0], seed=seed))
    result = score_rollouts(tmp_path / "sets", data, tmp_path / "out", CONFIG, show_progress=False)
    assert len(result) == 2
    assert "straight first, have several sets" in capsys.readouterr().err
    with pytest.raises(ConfigError, match="holds 2 scenarios, and limit=1 would replace them without 1"):
        score_rollouts(tmp_path / "sets", data, tmp_path / "out", replace(CONFIG, limit=1))
    monkeypatch.setattr(module, "_score_entry", lambda *_: pytest.fail("scored again"))
    assert same(score_rollouts(tmp_path / "sets", data, tmp_path / "out", CONFIG, show_progress=False), result)


def test_agents_that_are_not_the_scenarios_are_named_with_the_file(data, tmp_path):
    arrays = draw_arrays(SCENARIOS[0])
    arrays["object_ids"][0] = 77
    write_npz(tmp_path / "a.npz", arrays)
    with pytest.raises(DataError, match=r"a\.npz.*missing 100; not simulated in this scenario 77"):
        score_rollouts(tmp_path, data, None, CONFIG)


def test_impossible_settings_are_refused():
    for wrong in ({"jobs": 0}, {"limit": 0}, {"metric": "1999"}):
        with pytest.raises((ConfigError, jaxtyping.TypeCheckError)):  # the latter under run-time type checks
            ScoreConfig(**wrong)


def test_tfrecords_are_found_by_id_and_bad_ones_named(tmp_path):
    records = [womd_pb2.Scenario(scenario_id=name, sdc_track_index=0).SerializeToString() for name in ("a", "b")]
    write_records(tmp_path / "x.tfrecord", records)
    source = open_scenarios(tmp_path)
    assert len(source) == 2
    assert "b" in source
    assert "c" not in source
    with pytest.raises(DataError, match=r"x\.tfrecord: scenario b: .* it has no tracks"):
        source.by_id("b")
    with pytest.raises(DataError, match="no scenario 'c' among 2"):
        source.by_id("c")
    write_records(tmp_path / "y.tfrecord", [b"nonsense"])
    with pytest.raises(DataError, match=r"y\.tfrecord: record 0: not a WOMD Scenario"):
        open_scenarios(tmp_path)


@pytest.mark.official
def test_official_files_give_the_official_numbers(shared):
    expected = json.loads((shared / "golden" / "rmm" / "cases" / "637f_test_submission.json").read_text())
    path = shared / "golden" / "rmm" / "rollouts" / "637f_test_submission.npz"
    for metric, official in expected["configs"].items():
        (row,) = to_json(score_rollouts(path, shared / "data" / "womd", None, ScoreConfig(metric=metric, jobs=1)))[
            "scenarios"
        ]
        buckets = row.pop("buckets")
        assert row.pop("scenario_id").startswith("637f")
        assert row == pytest.approx(official["metrics"], abs=1e-5)
        assert buckets == pytest.approx(official["buckets"], abs=1e-5)


def test_what_simulate_writes_scores_as_the_evaluated_policy(data, tmp_path):
    policy = ConstantVelocity()
    for scenario in SCENARIOS:
        batch = collate([scenario])
        write_rollouts(tmp_path / "rollouts", batch, simulate(policy, batch, num_rollouts=2, seed=0))
    scored = score_rollouts(tmp_path / "rollouts", data, None, CONFIG)
    evaluated = evaluate(policy, data, tmp_path, EvaluateConfig(num_rollouts=2), name="cv")
    place = [evaluated.scenario_ids.index(scenario_id) for scenario_id in scored.scenario_ids]
    for column in SCORE_COLUMNS:
        np.testing.assert_allclose(scored.values(column), evaluated.values(column)[place], atol=1e-6)
