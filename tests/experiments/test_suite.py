"""Experiments from beginning to end with a tiny model on a few scenarios: what is trained once is not trained again."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

import scenes
from made_up import TINY
from rlftsim.cli.main import main
from rlftsim.errors import CheckpointError, ConfigError, DataError
from rlftsim.evaluation.columns import SCORES
from rlftsim.evaluation.evaluate import EvaluateConfig
from rlftsim.experiments.demo import place_gain, run_demo
from rlftsim.experiments.model_specs import BASE, CATK, ORACLE, Base, FineTuned, over_seeds
from rlftsim.experiments.paper import qualitative, variance_scaling
from rlftsim.experiments.results import Experiment, ExperimentResult, run_experiment
from rlftsim.experiments.suite import ExperimentSuite
from rlftsim.experiments.tables import build_table
from rlftsim.recipes import train as training
from rlftsim.recipes.base import Recipe
from rlftsim.scenario.dataset import write_dataset

QUICK = EvaluateConfig(num_rollouts=4)
ROWS = {"base": (BASE,), "MLOO": over_seeds(FineTuned("mloo"), 1), "oracle": (ORACLE,)}


@pytest.fixture(autouse=True)
def _one_thread_as_before():
    """Runs set the number of threads; the next test file shall not notice."""
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Four scenarios to train on, two to evaluate on."""
    training = [scenes.straight_road("a"), scenes.junction_with_light(), scenes.with_gaps(), scenes.straight_road("b")]
    held_out = [scenes.straight_road("c"), scenes.straight_road("d")]
    folder = tmp_path_factory.mktemp("suite") / "data"
    splits = {scenario.scenario_id: "training" for scenario in training}
    write_dataset([*training, *held_out], folder, split=lambda s: splits.get(s.scenario_id, "validation"))
    return folder


@pytest.fixture(scope="module")
def done(data, tmp_path_factory):
    """A suite in which base model and MLOO are trained and measured."""
    suite = ExperimentSuite(TINY, data, tmp_path_factory.mktemp("done"), QUICK)
    suite.evaluate(ROWS)
    return suite


def stamps(folder):
    """When results and checkpoints were written, and what the metrics of runs say."""
    kept = [*folder.rglob("*.parquet"), *(p for p in folder.rglob("*") if p.parent.name.startswith("update-"))]
    files = {p: p.stat().st_mtime_ns for p in kept}
    return {**files, **{p: p.read_text() for p in folder.rglob("metrics.jsonl")}}


def test_a_finished_stage_is_not_repeated(done, capfd):
    before = stamps(done.out)
    again = replace(done).evaluate(ROWS)
    assert stamps(done.out) == before
    assert len(before) > 5
    assert "fine-tune: " not in capfd.readouterr().err  # no update was made
    assert [len(row.mean) for row in again.values()] == [2, 2, 2]


def test_an_interrupted_experiment_does_what_is_missing(done, data, tmp_path, monkeypatch):
    """Killed while the third spec was trained: the first two stay as they are."""
    rows = {"base": (BASE,), "MLOO": over_seeds(FineTuned("mloo"), 1), "RLOO": (FineTuned("rloo"),)}
    suite = ExperimentSuite(TINY, data, tmp_path, QUICK)
    true_training = training.train_policy

    def killed(policy, scenarios, out, config, **rest):
        if getattr(config, "reward", None) == "rloo":
            raise KeyboardInterrupt
        return true_training(policy, scenarios, out, config, **rest)

    monkeypatch.setattr(training, "train_policy", killed)
    with pytest.raises(KeyboardInterrupt):
        suite.evaluate(rows)
    monkeypatch.setattr(training, "train_policy", true_training)
    before = stamps(tmp_path)
    measured = suite.evaluate(rows)
    assert {path: stamp for path, stamp in stamps(tmp_path).items() if path in before} == before
    # and the numbers are those of a suite that was never stopped
    never_stopped = done.evaluate(ROWS)
    for name in ("base", "MLOO"):
        np.testing.assert_array_equal(
            measured[name].mean.values("meta_metric"), never_stopped[name].mean.values("meta_metric")
        )


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda w: {"recipe": replace(TINY, finetune=replace(TINY.finetune, epochs=4.0))}, r"recipe\.finetune\.epochs"),
        (lambda w: {"recipe": replace(TINY, model=replace(TINY.model, dim=32))}, r"recipe\.model\.dim"),
        (lambda w: {"evaluation": replace(QUICK, num_rollouts=8)}, r"evaluation\.num_rollouts"),
        (lambda w: {"evaluation": replace(QUICK, limit=1)}, r"evaluation\.limit"),
        (lambda w: {"base_model": str(w.out / "runs" / "base")}, "base_model"),
    ],
)
def test_changed_settings_are_refused_by_name(done, change, named):
    with pytest.raises(CheckpointError, match=rf"belongs to a run with other settings or inputs \({named}\)"):
        replace(done, **change(done))


def test_other_data_are_refused(done, tmp_path):
    one = scenes.straight_road()
    write_dataset([one, replace(one, scenario_id="validation")], tmp_path / "other", split=_split_by_id)
    with pytest.raises(CheckpointError, match="data"):
        replace(done, data=tmp_path / "other")


def _split_by_id(scenario):
    return "validation" if scenario.scenario_id == "validation" else "training"


def test_data_without_the_split_to_measure_on_are_refused_before_anything_is_trained(done, tmp_path):
    write_dataset([scenes.straight_road()], tmp_path / "half", split="training")
    with pytest.raises(DataError, match="no split 'validation', only training"):
        replace(done, data=tmp_path / "half", out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_what_changes_no_result_may_change(done):
    config = replace(TINY.finetune, checkpoint_every=7)
    replace(done, evaluation=replace(QUICK, jobs=2), num_seeds=5, recipe=replace(TINY, finetune=config))
    with pytest.raises(ConfigError, match="at least one seed, got 0"):
        replace(done, num_seeds=0)


def test_a_longer_run_goes_on_from_a_shorter_one_to_the_same_weights(done):
    """Two updates at once, or one and then another."""
    half, whole = FineTuned("mloo", seed=1, epochs_fraction=0.5), FineTuned("mloo", seed=1)
    done.evaluate({"half": (half,), "whole": (whole,)})
    steps = [json.loads(line) for line in (done.model_folder(whole) / "metrics.jsonl").read_text().splitlines()]
    assert [line["update"] for line in steps] == [1, 2]
    alone = done.out / "alone"
    config = replace(TINY.finetune, seed=1)
    training.finetune_model(done.base(), done.training, config, alone)
    expected, found = (load_file(f / "model" / "model.safetensors") for f in (alone, done.model_folder(whole)))
    for name, values in expected.items():
        torch.testing.assert_close(found[name], values, rtol=0, atol=0)


def test_catk_has_as_many_updates_of_as_many_scenarios(done):
    catk = FineTuned(CATK)
    measured = done.evaluate({"CAT-K": (catk,)})
    config = json.loads((done.model_folder(catk) / "config.json").read_text())
    lines = (done.model_folder(catk) / "metrics.jsonl").read_text().splitlines()
    assert len(lines) == done.budget.updates == 2
    assert (config["batch_size"], config["epochs"], config["seed"]) == (1, 0.5, 0)
    assert len(measured["CAT-K"].mean) == 2


def test_a_model_that_is_handed_in_is_the_base(done, data, tmp_path):
    suite = ExperimentSuite(TINY, data, tmp_path, QUICK, base_model=str(done.model_folder(BASE)))
    weak = suite.evaluate({"base": (BASE,), "weak": (Base(0.5),)})
    assert not (tmp_path / "vocabulary.safetensors").exists()
    assert not (tmp_path / "runs" / "base").exists()
    given = done.evaluate(ROWS)["base"].mean
    np.testing.assert_array_equal(weak["base"].mean.values("meta_metric"), given.values("meta_metric"))
    assert (tmp_path / "runs" / "base-0.5-epochs" / "model").is_dir()


def test_a_shipped_model_is_the_base_by_its_name(data, tmp_path):
    suite = ExperimentSuite(TINY, data, tmp_path, QUICK, base_model="demo-base")
    assert suite.base() == "demo-base"
    assert len(suite.evaluate({"base": (BASE,)})["base"].mean) == 2


def test_a_recipe_without_the_models_architecture_cannot_pretrain_a_weaker_one(done, data, tmp_path):
    recipe = Recipe(pretrain=TINY.pretrain, finetune=TINY.finetune, catk=TINY.catk, gcsl=TINY.gcsl)
    base = str(done.model_folder(BASE))
    suite = ExperimentSuite(recipe, data, tmp_path, QUICK, base_model=base)
    assert suite.base() == base
    with pytest.raises(ConfigError, match=r"the recipe pre-trains no model like .*: leave the base model out"):
        suite.models([Base(0.5)])


def test_an_experiment_of_ones_own_needs_two_functions(done):
    """Run and summarize; the rest is written for it."""
    experiment = Experiment(
        question="Does anything move?",
        run=lambda suite: suite.evaluate(ROWS),
        summarize=lambda rows, suite: ExperimentResult(
            title="Mine",
            tables=(build_table("Ours", rows.values(), SCORES),),
            verdicts=(rows["oracle"].against(rows["base"]),),
            numbers={"nothing": float("nan")},
        ),
    )
    run_experiment("mine", experiment, done)
    text, numbers = (done.out / "mine.md").read_text(), json.loads((done.out / "mine.json").read_text())
    assert text.startswith("# Mine\n\nDoes anything move?")
    assert "oracle against base, 2 scenarios in both" in text
    assert "| MLOO | 0." in text
    assert numbers["nothing"] is None
    assert numbers["budget"] == {"updates": 2, "scenarios_an_update": 1, "rollouts_a_scenario": 2}
    assert not list(done.out.glob(".*.tmp"))


def test_variances_are_measured_on_rollouts_of_the_base_model(done):
    suite = replace(done, out=done.out)
    first = variance_scaling.EXPERIMENT.run(suite)
    assert first.sizes == (2, 3, 4)
    assert all((values > 0).all() for values in first.by_reward.values())
    # at N = 2 they are the same number but for the factor: MLOO is half of RLOO
    np.testing.assert_allclose(first.by_reward["mloo"][:, 0], first.by_reward["rloo"][:, 0] / 4, rtol=1e-4)
    files = sorted((done.out / "variances").iterdir())
    files[0].write_text("{")  # damaged: measured again, the others are not
    kept = files[1].stat().st_mtime_ns
    again = variance_scaling.EXPERIMENT.run(suite)
    np.testing.assert_array_equal(again.by_reward["mloo"], first.by_reward["mloo"])
    assert files[1].stat().st_mtime_ns == kept


def test_a_slope_needs_rollouts(done, tmp_path):
    few = replace(done, evaluation=replace(QUICK, num_rollouts=2), out=tmp_path)
    with pytest.raises(ConfigError, match="needs 4 rollouts at least, got 2"):
        variance_scaling.EXPERIMENT.run(few)


def test_pairs_are_films_of_the_rollouts_that_were_scored(done):
    result = run_experiment("qualitative", qualitative.EXPERIMENT, done)
    shown = json.loads((done.out / "qualitative.json").read_text())["pairs"]
    assert 1 <= len(shown) <= 2  # of two scenarios
    for number, pair in enumerate(shown, 1):
        assert (done.out / f"qualitative-{number}.mp4").stat().st_size > 1000
        assert (
            f"![Film of Scenario {pair['scenario_id']}](qualitative-{number}.webp)"
            in (done.out / "qualitative.md").read_text()
        )
    assert (done.out / "qualitative.html").read_text().count('<figure class="player"') == len(shown)
    # the rollouts that are shown were scored: the events that are counted are the marks on the picture
    for pair, animation in zip(shown, result.animations):
        for panel, count in zip(animation.panels, pair["events"]):
            seen = panel.trajectories
            assert seen.num_rollouts == 1
            assert count == sum(int(marks.any(-1).sum()) for marks in (seen.collides, seen.offroad))
    rates = {row: done.evaluate(ROWS)[row].mean for row in ("base", "MLOO")}
    for pair in shown:
        for rate, scores in zip(pair["rates"], rates.values()):
            place = scores.scenario_ids.index(pair["scenario_id"])
            stored = scores.values("collision_rate")[place] + scores.values("offroad_rate")[place]
            assert rate == pytest.approx(float(stored), abs=1e-5)


# ---- the command ----------------------------------------------------------------------------------------------------


def test_the_command_writes_its_files_and_prints_the_path(tmp_path, capsys):
    words = ["experiment", "oracle", "--out", str(tmp_path), "--limit", "2", "--num-rollouts", "4"]
    assert main(words) == 0
    out = capsys.readouterr().out
    assert out.rstrip().endswith(f"{tmp_path}/oracle.md")
    assert {p.name for p in tmp_path.glob("oracle.*")} == {"oracle.md", "oracle.json", "oracle.png", "oracle.svg"}
    assert main([*words[:-1], "8"]) == 2
    assert "other settings or inputs (evaluation.num_rollouts)" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("nothing", "unknown experiment 'nothing': known are benchmark"),
        ("oracle --recipe smart-tiny", "recipe smart-tiny needs scenarios: name a data set with --data"),
        ("oracle --data somewhere", "recipe synthetic brings its own scenarios"),
        ("oracle --recipe smart-demo --data somewhere", "somewhere is no data set"),
        ("oracle --finetune.rate 1", "no flag --finetune.rate"),
        ("oracle --processes 0", "--processes must be at least 1, got 0"),
        ("oracle --finetune.reward rloo", "--finetune.reward has no effect: experiments vary it"),
        ("oracle --catk.batch-size 2", "--catk.batch-size has no effect: experiments vary it"),
        ("oracle --seeds 0", "--seeds must be at least 1, got 0"),
    ],
)
def test_mistakes_end_in_a_line(words, message, tmp_path, capsys):
    assert main(["experiment", *words.split(), "--out", str(tmp_path / "out")]) == 2
    err = capsys.readouterr().err
    assert message in err
    assert "Traceback" not in err
    assert not (tmp_path / "out").exists()  # a mistake claims no folder


def test_the_demo_runs_the_same_stages(data, tmp_path):
    evaluations = run_demo(TINY, data, QUICK, tmp_path, is_quick=True)
    page = (tmp_path / "report.html").read_text()
    assert [e.name for e in evaluations] == ["base", "fine-tuned", "constant velocity", "oracle"]
    assert "what a perfect simulator would score" in page
    assert "2 held-out scenarios, 4 rollouts each" in page
    assert page.count("Scenario c") + page.count("Scenario d") >= 1
    assert "Quick run: every stage at its smallest size. These numbers mean nothing" in page
    assert "RLFTSim demo: closed-loop fine-tuning of a traffic model" in page  # no claim
    assert "expected gain" not in page
    assert {path.suffix for path in (tmp_path / "scenarios").iterdir()} == {".html", ".mp4"}
    assert (tmp_path / "picture.png").exists()


@pytest.mark.parametrize(("gain", "position"), [(0.009, "below"), (0.0257, "inside"), (0.0351, "above")])
def test_the_demo_says_where_its_gain_lies_among_those_of_other_runs(gain, position):
    text = f"RMM +0.0168 to +0.0346, by ten earlier runs; this run's +{gain:.4f} lies {position}"
    assert place_gain(gain) == text


def test_rows_of_methods_that_cannot_train_the_policy_are_left_out_before_anything_runs(done, data, tmp_path, capsys):
    rows = {"base": (BASE,), "CAT-K": over_seeds(FineTuned(CATK), 2), "MLOO": (FineTuned("mloo"),)}
    assert done.select_feasible(rows) == rows
    suite = ExperimentSuite(replace(TINY, catk=None), data, tmp_path, QUICK)
    assert list(suite.select_feasible(rows)) == ["base", "MLOO"]
    assert "left out: CAT-K (the policy cannot be trained with catk)" in capsys.readouterr().err
    with pytest.raises(ConfigError, match="the recipe has no section catk"):
        FineTuned(CATK).training_config(suite.recipe)
    # A base model without tokens needs no recipe that says so.
    wordless = ExperimentSuite(TINY, data, tmp_path / "wordless", QUICK, base_model="constant_velocity")
    assert list(wordless.select_feasible(rows)) == ["base", "MLOO"]
