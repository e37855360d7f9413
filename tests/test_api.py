"""The public names of `import rlftsim as rs`: first steps of a newcomer, and equality with the command line."""

import ast
import html
import importlib
import os
import pickle
import re
import subprocess
import sys
import warnings
from dataclasses import fields, replace
from functools import partial
from pathlib import Path

import jaxtyping
import numpy as np
import pytest
import torch

import rlftsim as rs
from made_up import CPU, TINY
from rlftsim.cli.main import main
from rlftsim.envs.config import EnvConfig
from rlftsim.envs.source import Source
from rlftsim.errors import CheckpointError, ConfigError, DataError
from rlftsim.evaluation.results import SCORE_COLUMNS, EvaluateConfig, Evaluation
from rlftsim.evaluation.score_files import ScoreConfig
from rlftsim.jobs.runner import Work
from rlftsim.rollout.fingerprint import fingerprint_policy
from rlftsim.rollout.simulate import simulate as simulate_batch
from rlftsim.scenario.batch import collate
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.tokens.clustering import build_vocabulary
from rlftsim.training.config import CatkConfig, DeviceConfig, GcslConfig, PretrainConfig
from rlftsim.training.run_folder import read_metrics

NAMES = [
    *("Scenario", "load_dataset", "write_dataset"),
    *("Policy", "SmartPolicy", "ConstantVelocity", "load_policy", "check_policy"),
    *("simulate", "Rollouts", "Sampling", "Goals"),
    *("score", "RealismResult"),
    *("register_reward", "leave_one_out", "masked_mean", "check_reward"),
    *("recipe", "pretrain", "finetune", "FinetuneConfig"),
    *("evaluate", "Evaluation", "compare", "report"),
    *("show", "film", "open_studio"),
    "RlftsimError",
]
SMALL = "data/small"
"""Data set with the smallest scenarios of the package's own: four for training, two for validation."""
NOTEBOOK = """
import rlftsim as rs

data = rs.load_dataset("synthetic", "validation")            # or "data/womd"
base = rs.load_policy("runs/base")                           # a run, a model folder, "constant_velocity"
scenario = data[0]
rollouts = rs.simulate(base, scenario, num_rollouts=32, seed=0)
print(rs.score(scenario, rollouts))                          # RMM 0.743 | kinematic … | interactive … | map-based …
rs.show(scenario, rollouts)                                  # logged and simulated, playing in the cell

@rs.register_reward("on_the_road")
def on_the_road(scores, rollouts, batch):
    return rs.leave_one_out(-scores.rollout_offroad_rate)

config = rs.FinetuneConfig(reward="mloo + 0.1*on_the_road", epochs=0.05)
tuned = rs.finetune(base, rs.load_dataset("synthetic", "training"), out="runs/tuned", config=config)
print(rs.compare(rs.evaluate(base, data), rs.evaluate(tuned, data))["meta_metric"])
"""


def smallest(split, count):
    """The scenarios of a split of the package's data set that have the fewest agents."""
    data = rs.load_dataset("synthetic", split)
    num_agents = sum(data.index[f"num_{kind}"].to_numpy() for kind in ("vehicles", "pedestrians", "cyclists"))
    order = np.argsort(num_agents, kind="stable")
    return [data[int(position)] for position in order[:count]]


@pytest.fixture(scope="session")
def stored(tmp_path_factory):
    """Folder with a small data set and a run's folder with a tiny model, both read only."""
    folder = tmp_path_factory.mktemp("stored")
    training, validation = smallest("training", 4), smallest("validation", 2)
    of = {scenario.scenario_id: "validation" for scenario in validation}
    rs.write_dataset(
        [*training, *validation], folder / SMALL, split=lambda scenario: of.get(scenario.scenario_id, "training")
    )
    policy = TINY.new_policy(build_vocabulary(training, TINY.tokens)[0])
    policy.save_pretrained(folder / "runs" / "base" / "model")
    return folder


@pytest.fixture
def home(stored, tmp_path, monkeypatch):
    """Working directory with runs/base and data/small, as the notebook has."""
    for name in ("data", "runs"):
        (tmp_path / name).mkdir()
    (tmp_path / SMALL).symlink_to(stored / SMALL)
    (tmp_path / "runs" / "base").symlink_to(stored / "runs" / "base")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def base(home):
    return rs.load_policy("runs/base", "cpu")


@pytest.fixture
def data(home):
    return rs.load_dataset(SMALL, "validation")


@pytest.fixture
def follower(base):
    """The tiny model, goal-conditioned."""
    torch.manual_seed(0)
    return base.with_goal_conditioning("concat").eval().requires_grad_(False)


def few_updates(**changes):
    """Settings of a fine-tuning of two updates, a step large enough to see."""
    return replace(TINY.finetune, device=CPU, **changes)


# ---- names --------------------------------------------------------------------------------------------------------


def test_the_public_names_are_these_and_sorted():
    assert sorted(NAMES) == rs.__all__


def test_every_public_name_can_be_loaded_and_nothing_else_is_public():
    for name in rs.__all__:
        assert getattr(rs, name) is not None
        assert name in dir(rs)
    found = {name for name, value in vars(rs).items() if not name.startswith("_") and not isinstance(value, type(rs))}
    assert found - {"Any"} == set(rs.__all__)
    with pytest.raises(AttributeError, match="has no attribute 'simulation'"):
        _ = rs.simulation


def test_every_public_name_is_documented_and_named_as_it_is_imported():
    for name in rs.__all__:
        value = getattr(rs, name)
        assert value.__name__ == name
        assert value.__doc__
        assert value.__module__.startswith("rlftsim")


def test_type_checkers_see_the_names_that_are_loaded():
    stub = ast.parse(Path(rs.__file__).with_suffix(".pyi").read_text())
    seen: dict[str, tuple[str, ...]] = {}
    for node in stub.body:
        if isinstance(node, ast.ImportFrom):
            seen[node.module] = (*seen.get(node.module, ()), *(alias.asname for alias in node.names))
    assert seen == rs._MODULES
    assert (Path(rs.__file__).parent / "py.typed").exists()


@pytest.mark.parametrize("room", ["rewards", "evaluation", "training", "recipes", "realism", "scenario", "viewer"])
def test_no_public_name_hides_a_room(room):
    assert importlib.import_module(f"rlftsim.{room}").__name__ == f"rlftsim.{room}"
    assert room not in rs.__all__


def test_the_import_takes_a_tenth_of_a_second_and_no_torch():
    code = "import time; t = time.process_time(); import rlftsim; print(time.process_time() - t)"
    code += "; import sys; assert not {'torch', 'numpy', 'pyarrow'} & set(sys.modules)"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    run = [sys.executable, "-c", code]
    seconds = [float(subprocess.check_output(run, env=environment, text=True)) for _ in range(3)]
    assert min(seconds) < 0.1


@pytest.mark.parametrize(
    ("verb", "arguments", "options", "message"),
    [
        ("simulate", ("a", "b"), {"temperature": 0.8}, r"write sampling=rs\.Sampling\(temperature=\.\.\.\)\."),
        ("evaluate", ("a", "b"), {"top_k": 48}, r"no argument 'top_k': write sampling=rs\.Sampling\(top_k=\.\.\.\)\."),
        ("finetune", ("a", "b"), {"top_k": 48}, r"set policy\.sampling = rs\.Sampling\(top_k=\.\.\.\) before\."),
        (
            "finetune",
            ("a", "b"),
            {"epochs": 2},
            r"replace\(rs\.recipe\('smart-demo'\)\.finetune, epochs=\.\.\.\)",
        ),
        ("pretrain", ("a", "b"), {"learning_rate": 1}, r"replace\(rs\.recipe\('smart-demo'\)\.pretrain, learning_rate"),
        ("simulate", ("a", "b"), {"num_rollout": 8}, r"no argument 'num_rollout': did you mean num_rollouts\?$"),
        ("score", ("a",), {}, r"missing a required argument: 'rollouts': the arguments are scenarios, rollouts, "),
        ("load_policy", ("a", "cpu", 3), {}, r"too many positional arguments: the arguments are name, device\.$"),
    ],
)
def test_wrong_arguments_of_a_public_function_are_refused_with_what_works(verb, arguments, options, message):
    with pytest.raises(ConfigError, match=rf"rs\.{verb}: .*{message}"):
        getattr(rs, verb)(*arguments, **options)


def test_public_functions_can_be_handed_to_other_processes():
    assert pickle.loads(pickle.dumps(rs.evaluate)) is rs.evaluate


# ---- ten things a newcomer types ----------------------------------------------------------------------------------


def test_1_the_module_has_what_one_looks_for_first():
    assert callable(rs.simulate)


def test_2_a_model_folder_is_read_by_a_path_in_a_string(home):
    assert isinstance(rs.SmartPolicy.from_pretrained("runs/base/model"), rs.SmartPolicy)


def test_3_a_run_folder_is_as_good_as_its_model_folder(home):
    of_run, of_model = (rs.SmartPolicy.from_pretrained(Path(name)) for name in ("runs/base", "runs/base/model"))
    assert fingerprint_policy(of_run) == fingerprint_policy(of_model)
    assert fingerprint_policy(rs.load_policy(Path("runs/base"))) == fingerprint_policy(of_model)


def test_4_the_synthetic_data_set_is_known_by_name():
    assert len(rs.load_dataset("synthetic")) == 240
    assert len(rs.load_dataset("synthetic", "validation")) == 40


def test_5_one_scenario_is_simulated_as_it_is(data):
    rollouts = rs.simulate(rs.ConstantVelocity(), data[0], num_rollouts=2)
    assert rollouts.position.shape == (1, 2, len(data[0].simulated_indices), 80, 2)


def test_6_rollouts_are_scored_as_they_are(data):
    result = rs.score(data[0], rs.simulate(rs.ConstantVelocity(), data[0], num_rollouts=2))
    assert 0 < float(result.meta_metric) < 1


def test_7_the_folder_of_a_run_may_be_a_string(base, home):
    tuned = rs.finetune(base, rs.load_dataset(SMALL, "training"), "runs/tuned", few_updates())
    assert fingerprint_policy(rs.load_policy("runs/tuned")) == fingerprint_policy(tuned)


def test_8_a_reward_is_registered_again_when_its_cell_is_run_again():
    def cell(scale):
        @rs.register_reward("repeated_in_a_cell")
        def reward(scores, rollouts, batch):
            return rs.leave_one_out(-scale * scores.rollout_offroad_rate)

        return reward

    cell(1.0)
    with pytest.warns(UserWarning, match="'repeated_in_a_cell'.*replaces"):
        second = cell(2.0)
    assert importlib.import_module("rlftsim.rewards").reward_by_name("repeated_in_a_cell") is second
    with pytest.raises(ConfigError, match="'mloo'"):
        rs.register_reward("mloo")(second)


def test_9_values_at_the_end_of_a_cell_are_short(data):
    rollouts = rs.simulate(rs.ConstantVelocity(), list(data), num_rollouts=2, seed=7)
    values = (data, data[0], collate([data[0]]), rollouts, rs.score(list(data), rollouts))
    assert all(len(repr(value)) < 200 for value in values)
    assert repr(data[0]).startswith(f"Scenario('{data[0].scenario_id}', {len(data[0].simulated_indices)} agents (")
    assert repr(rollouts).startswith("Rollouts(2 scenarios × 2 rollouts × ")
    assert repr(rollouts).endswith("agents × 80 steps, seed 7)")
    assert str(values[-1]).startswith("RMM 0.")
    assert repr(data).endswith("split 'validation', 2 scenarios)")
    synthetic = rs.load_dataset("synthetic", "validation")
    assert repr(synthetic) == "ScenarioDataset('synthetic', split 'validation', 40 scenarios)"


def test_10_the_base_model_is_what_it_was_after_fine_tuning(base, data):
    before = fingerprint_policy(base)
    tuned = rs.finetune(base, rs.load_dataset(SMALL, "training"), config=few_updates(learning_rate=0.05))
    assert fingerprint_policy(base) == before != fingerprint_policy(tuned)
    results = [rs.evaluate(policy, data, num_rollouts=2, out="runs/evaluations") for policy in (base, tuned)]
    assert rs.compare(*results)["meta_metric"].difference != 0
    # Both are kept: names come from the weights where none is given.
    assert len(list(Path("runs/evaluations").glob("*.parquet"))) == 2


def test_the_notebook_of_the_overview_runs(home, capsys):
    # As written, but for the data: a small set in place of the synthetic one, whose 40 scenarios with 32 rollouts each
    # are simulated and scored twice. That takes three minutes on two CPU cores, even with this tiny model.
    exec(compile(NOTEBOOK.replace('"synthetic"', f'"{SMALL}"'), "notebook", "exec"), {})
    out = capsys.readouterr().out
    assert out.startswith("RMM 0.")
    assert "meta_metric" in out


# ---- the command line gives the same bits ---------------------------------------------------------------------------


@pytest.mark.parametrize("flags", [[], ["--temperature", "0.8", "--top-k", "5"]])
def test_simulate_equals_the_command_line(base, data, flags):
    sampling = rs.Sampling(0.8, 5) if flags else rs.Sampling()
    words = ["simulate", "runs/base", "--data", SMALL, "--out", "runs/rollouts", "--num-rollouts", "3", "--seed", "5"]
    assert main([*words, "--device", "cpu", *flags]) == 0
    together = rs.simulate(base, data, num_rollouts=3, seed=5, sampling=sampling)
    for scenario in data:
        alone = rs.simulate("runs/base", scenario, num_rollouts=3, seed=5, sampling=sampling)
        with np.load(f"runs/rollouts/{scenario.scenario_id}.npz") as file:
            assert file["object_ids"].tolist() == alone.object_ids().tolist()
            for agent, object_id in enumerate(alone.object_ids()):
                expected = np.stack([file[axis][:, agent] for axis in ("x", "y", "heading")], -1)
                for rollouts in (alone, together):
                    found = rollouts.trajectory(int(object_id), scenario.scenario_id)
                    np.testing.assert_array_equal(found.numpy(), expected)


def test_goals_by_object_id_equal_those_of_the_command_line(follower, data, home):
    follower.save_pretrained(home / "runs" / "follower")
    scenario = data[0]
    agent = int(scenario.tracks.object_id[scenario.evaluated_indices[0]])
    x, y = (scenario.tracks.position[scenario.evaluated_indices[0], 10, :2] + np.float32(8)).tolist()
    words = ["simulate", "runs/follower", "--data", SMALL, "--out", "runs/rollouts", "--scenario", scenario.scenario_id]
    assert main([*words, "--num-rollouts", "2", "--goal", f"{agent}={x},{y}", "--device", "cpu"]) == 0
    rollouts = rs.simulate(follower, scenario, num_rollouts=2, goals={agent: (x, y)})
    with np.load(f"runs/rollouts/{scenario.scenario_id}.npz") as file:
        place = file["object_ids"].tolist().index(agent)
        np.testing.assert_array_equal(rollouts.trajectory(agent)[..., 0].numpy(), file["x"][:, place])
    assert rollouts.goals is not None
    assert int(rollouts.goals.goal_mask.sum()) == 2  # one agent in both rollouts


@pytest.mark.parametrize("metric", ["2025", "2024"])
def test_score_equals_the_command_line(base, data, metric):
    words = ["simulate", "runs/base", "--data", SMALL, "--out", "runs/rollouts", "--num-rollouts", "3", "--seed", "5"]
    assert main([*words, "--device", "cpu"]) == 0
    assert main(["score", "runs/rollouts", "--data", SMALL, "--out", "runs/scores", "--metric", metric]) == 0
    rows = {row["scenario_id"]: row for row in Evaluation.read(Path("runs/scores/rollouts.parquet")).table.to_pylist()}
    assert set(rows) == set(data.scenario_ids)
    for scenario in data:
        result = rs.score(scenario, rs.simulate(base, scenario, num_rollouts=3, seed=5), metric=metric)
        # the rest is measured beside the metric: misses and drift
        names = SCORE_COLUMNS[: SCORE_COLUMNS.index("traffic_light_violation_rate") + 1]
        names = [name for name in names if name != "meta_metric_light_one"]
        assert len(names) > 15
        # NaN where a likelihood has no scored step
        expected = [rows[scenario.scenario_id][name] for name in names]
        np.testing.assert_array_equal([float(result.find_score(name)) for name in names], expected)


@pytest.mark.parametrize("goals", ["none", "logged"])
def test_evaluate_equals_the_command_line(base, follower, data, home, goals):
    if goals == "logged":
        base = follower
        (home / "runs" / "base").unlink()
        follower.save_pretrained(home / "runs" / "base" / "model")
    words = ["evaluate", "runs/base", "--data", SMALL, "--out", "runs/e", "--num-rollouts", "2", "--device", "cpu"]
    assert main([*words, "--goals", goals]) == 0
    by_command = Evaluation.read(Path("runs/e/base.parquet"))
    by_name, by_policy = (rs.evaluate(policy, data, num_rollouts=2, goals=goals) for policy in ("runs/base", base))
    from_list = rs.evaluate(base, list(data), num_rollouts=2, goals=goals)
    assert by_name.name == by_command.name == "base"
    assert by_name.table.equals(by_command.table)
    assert by_policy.table.equals(by_command.table)
    assert from_list.table.equals(by_command.table)
    assert by_policy.provenance.policy_fingerprint == by_command.provenance.policy_fingerprint


def test_fine_tuning_equals_the_command_line(base, home):
    flags = "--finetune.epochs 0.5 --finetune.batch-size 1 --finetune.num-rollouts 2 --finetune.learning-rate 1e-3"
    words = ["finetune", "smart-tiny", "--model", "runs/base", "--data", SMALL, "--out", "runs/by-command"]
    assert main([*words, *flags.split(), "--finetune.device.accelerator", "cpu"]) == 0
    config = rs.FinetuneConfig(epochs=0.5, batch_size=1, num_rollouts=2, learning_rate=1e-3, device=CPU)
    tuned = rs.finetune("runs/base", rs.load_dataset(SMALL, "training"), out="runs/by-call", config=config)
    assert fingerprint_policy(tuned) == fingerprint_policy(rs.load_policy("runs/by-command"))


def test_fine_tuning_by_a_recipe_a_method_and_goals_equals_the_command_line(base, home):
    flags = "--catk.epochs 0.5 --catk.batch-size 1 --catk.num-candidates 4 --catk.device.accelerator cpu"
    words = ["finetune", "smart-demo", "--method", "catk", "--goal", "concat", "--model", "runs/base", "--data", SMALL]
    assert main([*words, *flags.split(), "--out", "runs/by-command"]) == 0
    recipe = rs.recipe("smart-demo").with_goals()
    recipe = replace(recipe, catk=replace(recipe.catk, epochs=0.5, batch_size=1, num_candidates=4, device=CPU))
    start = rs.load_policy("runs/base")
    rs.finetune(start, SMALL, "runs/by-call", recipe=recipe, method="catk", goal="concat")
    by_command, by_call = (Path(f"runs/{run}") for run in ("by-command", "by-call"))
    for file in ("config.json", "model/config.json", "model/model.safetensors"):
        assert (by_call / file).read_bytes() == (by_command / file).read_bytes()
    assert "goals by concat" in (by_call / "model" / "README.md").read_text()
    assert (by_call / "learning_curve.png").exists()
    assert fingerprint_policy(start) == fingerprint_policy(rs.load_policy("runs/base"))


def test_pre_training_further_by_a_recipe_equals_the_command_line(base, home):
    flags = "--pretrain.epochs 1 --pretrain.batch-size 1 --pretrain.device.accelerator cpu"
    words = ["pretrain", "smart-demo", "--init-from", "runs/base", "--data", SMALL, "--out", "runs/by-command"]
    assert main([*words, *flags.split()]) == 0
    config = replace(rs.recipe("smart-demo").pretrain, epochs=1.0, batch_size=1, device=CPU)
    further = rs.pretrain("smart-demo", SMALL, "runs/by-call", config, init_from="runs/base")
    assert fingerprint_policy(further) == fingerprint_policy(rs.load_policy("runs/by-command"))
    with pytest.raises(ConfigError, match="init_from and vocabulary go with a recipe as the policy"):
        rs.pretrain("runs/base", SMALL, init_from="runs/base")


def test_a_first_try_takes_few_scenarios_and_few_updates(home, base):
    words = ["finetune", "smart-tiny", "--model", "runs/base", "--data", SMALL, "--out", "runs/by-command"]
    flags = "--limit 3 --max-updates 2 --finetune.batch-size 1 --finetune.num-rollouts 2 --finetune.warmup-updates 1"
    assert main([*words, *flags.split(), "--finetune.device.accelerator", "cpu"]) == 0
    assert "trained on 3 scenarios" in (home / "runs" / "by-command" / "model" / "README.md").read_text()
    config = replace(rs.recipe("smart-tiny").finetune, batch_size=1, num_rollouts=2, warmup_updates=1, device=CPU)
    training = rs.load_dataset(SMALL, "training")
    scenarios = list(training)[:3]
    for data, options in ((training, {"limit": 3}), (list(training), {"limit": 3}), (scenarios, {"limit": 9})):
        rs.finetune("runs/base", data, "runs/by-call", config, max_updates=2, **options)
    assert [len(read_metrics(home / "runs" / name)) for name in ("by-command", "by-call")] == [2, 2]
    # the same scenarios, so the same run and the same model
    model = fingerprint_policy(rs.load_policy("runs/by-call"))
    assert fingerprint_policy(rs.load_policy("runs/by-command")) == model
    with pytest.raises(ConfigError, match="limit must be a whole number of at least 1, got 0"):
        rs.pretrain(base, training, limit=0)


def test_a_function_is_called_behind_each_update_and_may_end_the_run(base, home):
    training, calls = rs.load_dataset(SMALL, "training"), []
    config = few_updates(epochs=1.0, batch_size=1, checkpoint_every=1)

    def prune(update, values):
        calls.append((update, values["rmm"]))
        if len(calls) == 2:
            raise LookupError("pruned")

    with pytest.raises(LookupError, match="pruned"):
        rs.finetune(base, training, "runs/pruned", config, limit=4, on_update=prune)
    tuned = rs.finetune(base, training, "runs/pruned", config, limit=4, on_update=prune)
    logged = [(line["update"], line["rmm"]) for line in read_metrics(home / "runs" / "pruned")]
    assert calls == logged
    assert [update for update, _ in calls] == [1, 2, 3, 4]
    whole = rs.finetune(base, training, config=replace(config, device=replace(CPU, processes=2)), limit=4)
    assert fingerprint_policy(tuned) != fingerprint_policy(base) != fingerprint_policy(whole)


def test_several_seeds_have_a_run_each_and_a_mean(home, capsys):
    words = ["finetune", "smart-tiny", "--model", "runs/base", "--data", SMALL, "--out", "runs/seeds", "--seeds", "2"]
    flags = "--limit 2 --max-updates 1 --finetune.batch-size 1 --finetune.num-rollouts 2 --finetune.warmup-updates 1"
    assert main([*words, *flags.split(), "--finetune.device.accelerator", "cpu"]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "mean over seeds" in printed
    config = replace(rs.recipe("smart-tiny").finetune, batch_size=1, num_rollouts=2, warmup_updates=1, device=CPU)
    for seed in range(2):
        alone = rs.finetune("runs/base", SMALL, config=config, seed=seed, limit=2, max_updates=1)
        assert fingerprint_policy(rs.load_policy(f"runs/seeds/seed-{seed}")) == fingerprint_policy(alone)
    models = [rs.pretrain(TINY, SMALL, f"runs/{name}", seeds=2, max_updates=1) for name in ("fresh", "fresh")]
    assert fingerprint_policy(models[0]) == fingerprint_policy(models[1])  # the same command does nothing more
    weights = [fingerprint_policy(rs.load_policy(f"runs/fresh/seed-{seed}")) for seed in range(2)]
    assert weights[0] == fingerprint_policy(models[0]) != weights[1]
    with pytest.raises(ConfigError, match="seeds=2: several runs need a folder for theirs"):
        rs.finetune("runs/base", SMALL, seeds=2)


def test_a_limit_holds_for_several_processes_and_for_an_evaluation_of_the_same_scenarios(home, base):
    training = rs.load_dataset(SMALL, "training")
    limited = ScenarioDataset(training.folder, "training", limit=2)
    assert limited.scenario_ids == training.scenario_ids[:2]
    assert pickle.loads(pickle.dumps(limited)).scenario_ids == limited.scenario_ids
    result = rs.evaluate("constant_velocity", limited, num_rollouts=2)
    assert result.table["scenario_id"].to_pylist() == limited.scenario_ids


def test_pre_training_from_a_recipe_makes_a_new_policy_that_is_ready(home):
    training = rs.load_dataset(SMALL, "training")
    model = rs.pretrain(TINY, training, out="runs/pretrained")
    assert fingerprint_policy(rs.load_policy("runs/pretrained")) == fingerprint_policy(model)
    further = rs.pretrain(model, training, config=TINY.pretrain)
    assert fingerprint_policy(further) != fingerprint_policy(model)
    assert not any(weight.requires_grad for weight in model.parameters())


@pytest.mark.parametrize("stage", ["pretrain", "road"])
def test_what_training_returns_is_what_it_saves_also_where_weights_are_averaged(home, stage):
    """The moving average, not the weights that it is the average of; also where the run is only read."""
    training = rs.load_dataset(SMALL, "training")
    settings = {
        "pretrain": replace(TINY.pretrain, ema_decay=0.5),
        "road": replace(TINY.catk, ema_decay=0.5, choice="sampled", targets="taken", num_candidates=4, epochs=1.0),
    }
    start = rs.pretrain(TINY, training, out="runs/start")
    train = rs.pretrain if stage == "pretrain" else rs.finetune
    for _ in range(2):
        model = train(start, training, out="runs/averaged", config=settings[stage])
        assert fingerprint_policy(model) == fingerprint_policy(rs.load_policy("runs/averaged"))


def test_dropout_changes_no_simulation(home, data):
    """A module in training mode, as a fresh one is, is simulated as in evaluation mode; environments refuse it."""
    policy = TINY.new_policy(rs.load_policy("runs/base").vocabulary)
    config = replace(policy.config, dropout=0.5)
    policy = rs.SmartPolicy(config, policy.vocabulary).train()
    first, again, still = (rs.simulate(one, data[0], num_rollouts=2) for one in (policy, policy, policy.eval()))
    assert torch.equal(first.position, again.position)
    assert torch.equal(first.position, still.position)
    in_files = [rs.simulate(one, data, num_rollouts=2, out=home / name, limit=1)[0].read_bytes()
                for one, name in ((policy.train(), "training"), (policy.eval(), "evaluated"))]  # fmt: skip
    assert in_files[0] == in_files[1]
    with pytest.raises(ConfigError, match="limit"):
        rs.simulate(policy, data, out=home / "none", limit=0)
    with pytest.raises(ConfigError, match=r"policy is in training mode, .* call policy\.eval\(\)"):
        Source(EnvConfig(), list(data), policy.train())


def test_weights_that_are_nan_are_refused_where_they_are_simulated(base, data):
    with torch.no_grad():
        next(base.parameters()).fill_(float("nan"))
    with pytest.raises(DataError, match=f"probabilities that are NaN in scenario {data.scenario_ids[0]}"):
        rs.simulate(base, data, num_rollouts=2)
    with pytest.raises(DataError, match="probabilities that are NaN"):
        rs.evaluate(base, data, num_rollouts=2)


def test_recipes_by_name():
    assert isinstance(rs.recipe("smart-demo").finetune, rs.FinetuneConfig)
    with pytest.raises(ConfigError, match="did you mean 'smart-demo'"):
        rs.recipe("smart-dmeo")


# ---- scenarios in every form --------------------------------------------------------------------------------------


def test_one_several_a_batch_and_a_data_set_are_alike(base, data):
    options = {"num_rollouts": 2, "seed": 3}
    forms = [list(data), tuple(data), data, collate(list(data))]
    found = [rs.simulate(base, form, **options) for form in forms]
    assert all(torch.equal(found[0].position, other.position) for other in found)
    scores = [rs.score(form, rollouts).meta_metric for form, rollouts in zip(forms, found)]
    assert all(torch.equal(scores[0], other) for other in scores)
    alone = [rs.simulate(base, scenario, **options) for scenario in data]
    for row, (scenario, rollouts) in enumerate(zip(data, alone)):
        assert torch.equal(rollouts.position[0], found[0].position[row, :, : rollouts.position.shape[2]])
        assert float(rs.score(scenario, rollouts).meta_metric) == float(scores[0][row])


def test_a_bare_name_stands_for_the_split_of_the_command(base, data):
    ids, training = tuple(data.scenario_ids), rs.load_dataset(SMALL, "training")
    rollouts = rs.simulate(base, SMALL, num_rollouts=2)
    assert rollouts.provenance is not None
    assert rollouts.provenance.scenario_ids == ids
    assert rs.score(SMALL, rollouts).scenario_ids == ids
    assert "iframe" in rs.show(SMALL, rollouts)._repr_html_()
    assert tuple(rs.evaluate(rs.ConstantVelocity(), SMALL, num_rollouts=2).scenario_ids) == ids
    for train in (partial(rs.finetune, config=few_updates()), partial(rs.pretrain, config=TINY.pretrain)):
        assert fingerprint_policy(train(base, SMALL)) == fingerprint_policy(train(base, training))


@pytest.mark.parametrize(
    ("call", "split"),
    [(rs.simulate, "validation"), (rs.evaluate, "validation"), (rs.finetune, "training"), (rs.pretrain, "training")],
)
def test_a_data_set_without_the_split_of_the_command_is_refused(call, split, base, data):
    rs.write_dataset(data[0], "one")
    refuse(lambda: call(base, "one"), rf"no split '{split}', only unknown: .* by load_dataset\(name, split\)")


def test_the_closed_loop_itself_gives_the_same_rollouts(base, data):
    rollouts = rs.simulate(base, data[0], num_rollouts=2, seed=1)
    plain = simulate_batch(base, collate([data[0]]), num_rollouts=2, seed=1)
    for field in fields(plain):
        if isinstance(value := getattr(plain, field.name), torch.Tensor):
            assert torch.equal(value, getattr(rollouts, field.name))
    assert plain.provenance is None


@pytest.mark.parametrize("nothing", [[], ["a"]])
def test_what_is_no_scenario_is_refused(nothing):
    with pytest.raises(ConfigError, match="hand over"):
        rs.simulate(rs.ConstantVelocity(), nothing)


def test_rollouts_of_other_scenarios_are_refused(data):
    rollouts = rs.simulate(rs.ConstantVelocity(), data[0], num_rollouts=2)
    with pytest.raises(ConfigError, match=f"rollouts of {data[0].scenario_id} do not belong to {data[1].scenario_id}"):
        rs.score(data[1], rollouts)
    with pytest.raises(ConfigError, match="rollouts of"):
        rs.show(data[1], rollouts)
    with pytest.raises(ConfigError, match="do not belong to 2"):
        rs.score(list(data), replace(rollouts, provenance=None))


def test_rollouts_of_other_agents_are_refused(data):
    scenario = data[0]
    rollouts = rs.simulate(CV, scenario, num_rollouts=2)
    other = int(np.setdiff1d(scenario.simulated_indices, scenario.evaluated_indices)[0])
    valid, position = scenario.tracks.valid.copy(), scenario.tracks.position.copy()
    valid[other, 10] = False
    position[..., 0] += 7
    fewer = replace(scenario, tracks=replace(scenario.tracks, valid=valid))
    moved = replace(scenario, tracks=replace(scenario.tracks, position=position))
    for call in (rs.score, rs.show):
        agent = scenario.tracks.object_id[other]
        refuse(lambda: call(fewer, rollouts), f"not as it was simulated: only one of them simulates agent {agent}:")  # noqa: B023
        refuse(lambda: call(moved, rollouts), "not as it was simulated: the ego is elsewhere")  # noqa: B023
    # The logged future may be another one.
    position = scenario.tracks.position.copy()
    position[:, 11:, 0] += 7
    later = replace(scenario, tracks=replace(scenario.tracks, position=position))
    assert float(rs.score(later, rollouts).meta_metric) < float(rs.score(scenario, rollouts).meta_metric)


def test_rollouts_in_the_world_frame_are_scored_there(data):
    scenario = data[0]
    world, centered = collate([scenario], frame="world"), collate([scenario])
    rollouts = rs.simulate(CV, world, num_rollouts=2)
    expected = float(rs.score(scenario, rs.simulate(CV, scenario, num_rollouts=2)).meta_metric)
    for form in (scenario, world, centered):
        assert float(rs.score(form, rollouts).meta_metric) == pytest.approx(expected, abs=1e-3)
    assert float(rs.score(world, rs.simulate(CV, scenario, num_rollouts=2)).meta_metric) == expected


# ---- agents by object id, provenance --------------------------------------------------------------------------------


def test_rollouts_that_are_not_finite_have_no_score(base, data):
    rollouts = rs.simulate(base, data, num_rollouts=2)
    rollouts.position[1, 1, 0, 40] = np.nan
    scenario_id = data[1].scenario_id
    refuse(
        lambda: rs.score(data, rollouts),
        f"object id {rollouts.object_ids(scenario_id)[0]} of scenario {scenario_id} in rollout 1 at future step 40 is "
        "not finite",
    )


def test_rollouts_know_where_they_come_from(base, data):
    rollouts = rs.simulate(base, list(data), num_rollouts=3, seed=11, sampling=rs.Sampling(temperature=0.5))
    about = rollouts.provenance
    assert about.scenario_ids == tuple(scenario.scenario_id for scenario in data)
    assert about.policy_fingerprint == fingerprint_policy(base)
    assert (about.policy, about.seed, about.temperature, about.rlftsim_version) == (
        "SmartPolicy",
        11,
        0.5,
        rs.__version__,
    )
    assert rollouts.select(slice(0, 1)).provenance is about


def test_an_agent_is_found_by_its_object_id_in_the_world_frame(data):
    rollouts = rs.simulate(rs.ConstantVelocity(), data, num_rollouts=2)
    scenario = data[1]
    track = scenario.evaluated_indices[0]
    poses = rollouts.trajectory(int(scenario.tracks.object_id[track]), scenario.scenario_id)
    expected = scenario.tracks.position[track, 10, :2] + 0.1 * scenario.tracks.velocity[track, 10]
    np.testing.assert_allclose(poses[:, 0, :2], [expected] * 2, atol=1e-3)
    with pytest.raises(ConfigError, match="a scenario_id is needed: these are rollouts of"):
        rollouts.trajectory(1)
    with pytest.raises(ConfigError, match="no scenario 'x': these are rollouts of"):
        rollouts.object_ids("x")
    with pytest.raises(ConfigError, match="simulates no agent 987654: there are"):
        rollouts.trajectory(987654, scenario.scenario_id)
    with pytest.raises(ConfigError, match="do not know their scenarios"):
        replace(rollouts, provenance=None).object_ids()


def test_goals_that_make_no_sense_are_refused_in_one_line(base, follower, data):
    scenario = data[0]
    agent = int(scenario.tracks.object_id[scenario.evaluated_indices[0]])
    near = tuple(scenario.tracks.position[scenario.evaluated_indices[0], 10, :2].tolist())
    with pytest.raises(ConfigError, match="SmartPolicy is not goal-conditioned"):
        rs.simulate(base, scenario, goals={agent: near})
    cases = [
        ({987654: near}, r"scenario \w+ has no agent 987654: it simulates \d+ agents: \d+"),
        ({agent: (1.0,)}, r"is not a point: give \(x, y\)"),
        ({agent: (float("nan"), 0.0)}, r"is not a point: give \(x, y\)"),
        (
            {agent: (near[0] + 1000, near[1])},
            rf"goal of agent {agent} in scenario \w+ is 1000 m away, out of reach in 8 s",
        ),
        ({"nowhere": {agent: near}}, "'nowhere', which is not in the batch: it has"),
    ]
    for goals, message in cases:
        with pytest.raises(rs.RlftsimError, match=message) as caught:
            rs.simulate(follower, scenario, goals=goals, num_rollouts=1)
        assert "\n" not in str(caught.value)
    with pytest.raises(ConfigError, match="need a batch of one scenario, this one has 2"):
        rs.simulate(follower, data, goals={agent: near})


def test_scenarios_without_goals_are_simulated_without(follower, data):
    scenario = data[1]
    track = scenario.evaluated_indices[0]
    point = scenario.tracks.position[track, 10, :2] + np.float32(6)
    goals = {scenario.scenario_id: {int(scenario.tracks.object_id[track]): point}}
    free, led = (rs.simulate(follower, data, num_rollouts=2, goals=g) for g in (None, goals))
    assert torch.equal(free.position[0], led.position[0])
    assert led.goals.goal_mask.sum(dim=(1, 2)).tolist() == [0, 2]
    assert torch.equal(rs.simulate(follower, data, num_rollouts=2, goals=led.goals).position, led.position)
    assert repr(led.goals) == f"Goals(1 agent of 2 scenarios × {led.position.shape[2]}, in 2 rollouts)"


# ---- looking at things --------------------------------------------------------------------------------------------


def test_a_scenario_without_agents_has_empty_rollouts(base, follower, data):
    tracks = data[0].tracks
    empty = replace(data[0], tracks=replace(tracks, valid=np.zeros_like(tracks.valid)))
    for policy in (base, follower, CV):
        assert rs.simulate(policy, empty, num_rollouts=2).position.shape == (1, 2, 0, 80, 2)
    goals = {int(tracks.object_id[data[0].ego_index]): (0.0, 0.0)}
    refuse(lambda: rs.simulate(follower, empty, goals=goals), "not simulated|not valid")


def test_scenarios_and_rollouts_play_in_a_cell(base, data, tmp_path):
    scenario = data[0]
    rollouts = rs.simulate(base, scenario, num_rollouts=8)
    cell = rs.show(scenario, rollouts, rollouts, titles=("base",))
    page = html.unescape(cell._repr_html_())
    assert "<iframe" in page
    assert all(title in page for title in ("logged", "base", "rollouts 2"))
    assert rs.show(scenario, rollouts, titles="base").page == rs.show(scenario, rollouts, titles=("base",)).page
    assert len(repr(cell)) < 100
    cell.save(tmp_path / "page.html")
    assert (tmp_path / "page.html").read_text() == cell.page
    assert "<iframe" in scenario._repr_html_()
    assert "rollouts" in rollouts._repr_html_()
    assert replace(rollouts, provenance=None)._repr_html_() is None
    assert len(scenario._repr_html_()) < 300_000


def test_the_ending_of_a_file_decides_between_a_page_and_a_film(data, tmp_path):
    rollouts = rs.simulate(rs.ConstantVelocity(), data[0], num_rollouts=1)
    assert rs.film(data[0], rollouts, tmp_path / "film.GIF") == tmp_path / "film.GIF"
    assert (tmp_path / "film.GIF").read_bytes()[:3] == b"GIF"
    rs.show(data[0], rollouts).save(tmp_path / "film.mp4")
    assert (tmp_path / "film.mp4").read_bytes()[4:8] == b"ftyp"
    with pytest.raises(ConfigError, match=r"film.avi: a page ends in .html, a film in .mp4, .webp, .gif"):
        rs.show(data[0], rollouts).save(tmp_path / "film.avi")
    with pytest.raises(ConfigError, match=r"page.html: a film is .mp4 or .webp or .gif"):
        rs.film(data[0], rollouts, tmp_path / "page.html")
    assert len(list(tmp_path.glob("film.*"))) == 2


def test_an_evaluation_bears_the_name_that_its_model_was_loaded_by_unless_it_was_changed_since(base, data):
    loaded = rs.load_policy("runs/base")
    assert rs.evaluate(loaded, data, num_rollouts=1).name == "base"
    next(iter(loaded.parameters())).data += 0.1
    assert rs.evaluate(loaded, data, num_rollouts=1).name.startswith("SmartPolicy-")


def test_a_trained_model_is_named_like_its_run(base, home):
    tuned = rs.finetune(base, rs.load_dataset(SMALL, "training"), "runs/named", few_updates())
    assert rs.evaluate(tuned, SMALL, num_rollouts=1).name == "named"


def test_a_notebook_shows_an_error_of_ours_in_one_line_and_all_of_it_when_asked(capsys):
    shell = pytest.importorskip("IPython.core.interactiveshell").InteractiveShell()
    shell.run_cell("import rlftsim as rs; rs.load_policy('nothing-of-this-name')")
    (line,) = capsys.readouterr().out.splitlines()
    assert line.startswith("ConfigError: 'nothing-of-this-name' is neither a model folder nor one of")
    shell.run_cell("import traceback; traceback.print_last()")
    assert "registry.py" in "".join(capsys.readouterr())


def test_what_cannot_be_shown_is_refused(data):
    rollouts = rs.simulate(rs.ConstantVelocity(), data[0], num_rollouts=1)
    with pytest.raises(ConfigError, match="2 titles for 1 rollouts"):
        rs.show(data[0], rollouts, titles=("a", "b"))
    with pytest.raises(ConfigError, match="no scenario: hand over at least one"):
        rs.show([])


def test_a_run_folder_of_something_else_is_refused(base, home):
    rs.finetune(base, rs.load_dataset(SMALL, "training"), "runs/tuned", few_updates())
    with pytest.raises(CheckpointError, match="other settings"):
        rs.finetune(base, rs.load_dataset(SMALL, "training"), "runs/tuned", few_updates(seed=1))


def test_a_finished_run_is_not_repeated(base, home):
    data = rs.load_dataset(SMALL, "training")
    first = rs.finetune(base, data, "runs/tuned", few_updates())
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        again = rs.finetune(base, data, "runs/tuned", few_updates())
    assert fingerprint_policy(first) == fingerprint_policy(again)
    assert len(Path("runs/tuned/metrics.jsonl").read_text().splitlines()) == 2


def test_a_data_set_is_a_data_set():
    assert isinstance(rs.load_dataset("synthetic"), ScenarioDataset)


# ---- wrong arguments: one line, before anything runs ----------------------------------------------------------------


@pytest.fixture
def unchecked():
    """Calls as users make them: without the type checks of the test run."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


def refuse(call, message):
    with pytest.raises(rs.RlftsimError, match=message) as caught:
        call()
    assert "\n" not in str(caught.value)


def arranged(rollouts, make):
    """Rollouts with positions in another form."""
    return replace(rollouts, position=make(rollouts.position))


CV = rs.ConstantVelocity()  # has no state, so tests may share it
WHOLE = "num_rollouts must be a whole number of at least 1, got"
GOALS = "goals must be one of none, logged, got"
CONFIG = "config must be a FinetuneConfig, CatkConfig, GcslConfig or CalibrateConfig, got"
AXES = r"tensors \[B, N, A, T, 2\] and \[B, N, A, T\], got (ndarray )?\(2, .*\): hand over"
ORDER = r"write rs\.\w+\(scenario, rollouts\), got"


@pytest.mark.parametrize(
    ("call", "message"),
    [
        *((lambda d, n=n: rs.simulate(CV, d, num_rollouts=n), WHOLE) for n in ("4", "12", True, 2.0, None, 0, -1)),
        *((lambda d, s=s: rs.simulate(CV, d, seed=s), "seed must be a whole number.*, got") for s in ("a", None, 1.5)),
        *((lambda d, s=s: rs.evaluate(CV, d, seed=s), "seed must be a whole number, got") for s in ("a", None, 1.5)),
        (lambda d: rs.simulate(CV, d, seed=-1), "seed must be a whole number of at least 0, got -1"),
        (lambda d: rs.evaluate(CV, d, seed=-1), "seed must not be negative, got -1"),
        *((lambda d, v=v: v(CV, d, device="cpu"), r"rs\.load_policy\(name, 'cpu'") for v in (rs.simulate, rs.evaluate)),
        (lambda d: rs.simulate(CV, d, sampling=0.5), "sampling must be rs.Sampling"),
        *(
            (lambda d, o=o: rs.simulate(CV, d, **o), f"{next(iter(o))} has no effect on rollouts in memory: leave it")
            for o in ({"jobs": 2}, {"work": Work(on_error="stop")}, {"limit": 1}, {"picture": True})
        ),
        (lambda d: rs.simulate(CV, d, guidance_scale=2.0), "guidance_scale=2 has no effect without goals: add goals"),
        *(
            (
                lambda d, o=o: rs.score(d, rs.simulate(CV, d, num_rollouts=2), **o),
                f"{next(iter(o))} has no effect on rollouts in memory: leave it out, or name files of rollouts",
            )
            for o in ({"missing_map": "skip"}, {"missing_scenario": "skip"}, {"work": Work(share="1/2")}, {"jobs": 1})
        ),
        *((lambda d, g=g: rs.evaluate(CV, d, goals=g), GOALS) for g in ("Logged", True, None, {})),
        *((lambda d, g=g: rs.simulate(CV, d, goals=g), "goals must be {object_id") for g in ([], (1, 2), "a", 3)),
        *((lambda d, p=p: rs.simulate(p, d), "is not a policy") for p in (None, 3, [], torch.nn.Linear(1, 1))),
        (lambda d: rs.simulate(d[0], d), "Scenario is not a policy"),
        (lambda d: rs.evaluate(None, d), "None is not a policy"),
        (lambda d: rs.finetune(None, d), "None is not a policy"),
        (lambda d: rs.check_policy(None, d), "None is not a policy"),
        (lambda d: rs.simulate(rs.SmartPolicy, d), "SmartPolicy is a class, not a policy"),
        (lambda d: rs.load_policy(None), "None is no name of a policy"),
        (lambda d: rs.load_dataset(None), "None is no name of a data set"),
        (lambda d: rs.recipe(None), "None is no name of a recipe"),
        (
            lambda d: rs.load_policy("constant_velocity", device="gpu"),
            "device must be one of auto, cpu, cuda, got 'gpu'",
        ),
        (lambda d: rs.simulate(CV, {"a": 1}), "dict: not scenarios"),
        (lambda d: rs.simulate(CV, [d[0], "a"]), "list with 'a': not scenarios"),
        (lambda d: rs.simulate(CV, None), "None: not scenarios"),
        (lambda d: rs.show(None), "None: not scenarios"),
        (lambda d: rs.show("nowhere"), "nowhere"),
        (lambda d: rs.show(rs.simulate(CV, d[0], num_rollouts=1), d[0]), ORDER),
        (lambda d: rs.score(rs.simulate(CV, d[0], num_rollouts=1), d[0]), ORDER),
        (lambda d: rs.score(d[0], None), ORDER),
        (
            lambda d: rs.simulate(CV, d, num_rollouts=2).select(0),
            r"a slice of the rollouts, got 0: write slice\(0, 1\)",
        ),
        *(
            (lambda d, c=c, make=make: c(d, arranged(rs.simulate(CV, d, num_rollouts=2), make)), AXES)
            for c in (rs.score, rs.show)
            for make in (torch.Tensor.numpy, lambda values: values[..., :1], lambda values: values[:, 0])
        ),
        (lambda d: rs.compare(None, 3), "NoneType: not an evaluation"),
        (lambda d: rs.compare("a.parquet", "b.parquet"), "a.parquet: no such evaluation"),
        (lambda d: rs.register_reward(len), "write @register_reward"),
        (lambda d: rs.write_dataset([], "empty"), "no scenario to write to empty"),
        (lambda d: rs.write_dataset(["a"], "empty"), "str: not a scenario"),
        (lambda d: d[0.5], "position of a scenario must be a whole number, got 0.5"),
        (lambda d: rs.finetune(CV, d, config=rs.recipe("smart-nano")), rf"{CONFIG} SmartRecipe: pass .*\.finetune"),
        *((lambda d, c=c: rs.finetune(CV, d, config=c), CONFIG) for c in ({}, "a", PretrainConfig())),
        (lambda d: rs.pretrain(CV, d, config=rs.FinetuneConfig()), r"must be a PretrainConfig, got .*\.pretrain"),
    ],
)
def test_a_wrong_argument_is_refused_in_one_line(call, message, data, unchecked):
    refuse(lambda: call(data), message)
    assert not Path("empty").exists()


def test_a_scenario_made_in_python_is_checked_by_every_function(data, unchecked):
    tracks = data[0].tracks
    lost, wide = tracks.position.copy(), tracks.position.astype(np.float64)
    lost[data[0].ego_index, 10, 0] = np.nan
    good = rs.simulate(CV, data[0], num_rollouts=2)
    calls = [partial(call, CV) for call in (rs.simulate, rs.evaluate, rs.finetune, rs.pretrain, rs.check_policy)]
    for position, message in ((lost, "NaN or infinite position at step 10"), (wide, "is float64, it must be float32")):
        broken = replace(data[0], tracks=replace(tracks, position=position))
        for call in (*calls, rs.show, lambda one: rs.score(one, good)):
            refuse(lambda call=call, broken=broken: call(broken), f"scenario {broken.scenario_id}: .*{message}")
    one, features, lights = data[0], data[0].map_features, data[0].lights
    more = replace(lights, step=np.zeros(1, np.int32), lane_id=np.ones(1, np.int64), stop_point=np.zeros((1, 3), "f4"))
    for broken, message in (
        (replace(one, tracks=replace(tracks, position=tracks.position[..., :2])), r"tracks.position has the shape"),
        (replace(one, tracks=replace(tracks, valid=tracks.valid[:, :-1])), r"must be \[O, S\]: O = .*, S = 91"),
        (
            replace(one, tracks=replace(tracks, heading=tracks.heading.tolist())),
            "tracks.heading is list, it must be an",
        ),
        (replace(one, tracks_to_predict=[0]), "tracks_to_predict is list, it must be int32"),
        (replace(one, map_features=replace(features, offsets=features.offsets[:-1])), "map.offsets has the shape"),
        (
            replace(one, map_features=replace(features, offsets=features.offsets[::-1].copy())),
            "offsets does not divide",
        ),
        (
            replace(one, map_features=replace(features, feature_type=features.feature_type + np.int8(50))),
            r"map feature \d+: type \d+ is none of 0 lane_undefined, 1 lane_freeway",
        ),
        (
            replace(one, lights=replace(more, state=np.full(1, 77, np.int8))),
            "light of lane 1: state 77 is none of 0 unk",
        ),
    ):
        for call in (calls[0], rs.show, lambda one: rs.score(one, good)):
            refuse(lambda call=call, broken=broken: call(broken), f"scenario {broken.scenario_id}: .*{message}")
    batch = replace(collate([data[0]]), scenarios=(replace(data[0], ego_index=-1),))
    refuse(lambda: rs.simulate(CV, batch), "ego_index names track index -1")


@pytest.mark.parametrize(
    ("kind", "values", "message"),
    [
        (rs.FinetuneConfig, {"trained": "encoder"}, "trained must be one of .*decoder.*, got 'encoder'"),
        (rs.FinetuneConfig, {"credit": "foo"}, "credit must be one of .*rollout.*, got 'foo'"),
        *((rs.FinetuneConfig, {"seed": seed}, "seed must be a whole number") for seed in ("a", None, 1.5, True)),
        (rs.FinetuneConfig, {"kl": {"target": 1}}, "kl must be a KlConfig, got"),
        (rs.FinetuneConfig, {"kl": None}, "kl must be a KlConfig, got None"),
        (rs.FinetuneConfig, {"goals": None}, "goals must be a GoalConfig, got None"),
        (rs.FinetuneConfig, {"reward": None}, "reward must be text, got None"),
        (rs.FinetuneConfig, {"learning_rate": "abc"}, "learning_rate must be a number, got 'abc'"),
        (rs.FinetuneConfig, {"batch_size": 1.5}, "batch_size must be a whole number, got 1.5"),
        (rs.FinetuneConfig, {"betas": 0.9}, "betas must be 2 numbers, got 0.9"),
        (CatkConfig, {"choice": "nearest"}, "choice must be one of closest"),
        (CatkConfig, {"context_radius_m": "far"}, "context_radius_m must be a number or None"),
        (GcslConfig, {"seed": "a"}, "seed must be a whole number"),
        (PretrainConfig, {"label_smoothing_kind": "even"}, "label_smoothing_kind must be one of uniform, spatial"),
        (DeviceConfig, {"accelerator": "gpu"}, "accelerator must be one of auto, cpu, cuda"),
        (EvaluateConfig, {"goals": "all"}, GOALS),
    ],
)
def test_a_wrong_setting_is_refused_in_one_line(kind, values, message, unchecked):
    refuse(lambda: kind(**values), message)


def test_numbers_of_numpy_are_numbers(data, home, unchecked):
    rollouts = rs.simulate(CV, data[np.int64(0)], num_rollouts=np.int64(2), seed=np.int32(1), sampling=None)
    assert type(rollouts.provenance.seed) is int
    assert float(rs.score(data[0], rollouts, metric=2025).meta_metric) > 0
    two = np.int64(2)
    one = rs.evaluate(CV, data, num_rollouts=two, limit=np.int64(1), seed=two, metric=2025, name="a", out="runs/e")
    assert one.config.metric == "2025"
    assert one["RMM"].tolist() == one["meta_metric"].tolist()
    compared = rs.compare("runs/e/a.parquet", one)
    assert compared["RMM"] is compared["meta_metric"]
    assert type(rs.FinetuneConfig(seed=two, learning_rate=np.float32(0.5)).learning_rate) is float


def test_scenarios_of_a_data_set_cannot_be_edited_in_place(data):
    scenario = data[0]
    features = scenario.map_features
    for part in (scenario, scenario.tracks, features, features.topology, scenario.lights):
        arrays = [value for value in vars(part).values() if isinstance(value, np.ndarray)]
        assert not any(array.flags.writeable for array in arrays)
    with pytest.raises(ValueError, match="read-only"):
        scenario.tracks.position[:, 11:] += 5


def test_a_data_set_is_read_like_a_list(data):
    scenario = data[0]
    assert scenario in data
    assert scenario.scenario_id in data
    assert "nothing" not in data
    ids = [one.scenario_id for one in data]
    for chosen in (data[0:3], data[[0, 1]], data[np.arange(2)]):
        assert [one.scenario_id for one in chosen] == ids
    rs.write_dataset(scenario, "one")
    assert rs.load_dataset("one").scenario_ids == ids[:1]
    assert "iframe" in rs.show(rs.load_dataset("one"))._repr_html_()


def test_goals_of_another_batch_are_refused(follower, data):
    scenario = data[1]
    track = scenario.evaluated_indices[0]
    points = {int(scenario.tracks.object_id[track]): scenario.tracks.position[track, 10, :2]}
    goals = rs.simulate(follower, scenario, num_rollouts=2, goals=points).goals
    refuse(
        lambda: rs.simulate(follower, data, num_rollouts=2, goals=goals), "goals of 1 scenarios .* do not belong to 2"
    )
    refuse(lambda: rs.simulate(follower, scenario, num_rollouts=3, goals=goals), "do not fit num_rollouts=3")


def test_goals_in_another_frame_are_refused(follower, data):
    scenario = data[1]
    track = scenario.evaluated_indices[0]
    points = {int(scenario.tracks.object_id[track]): scenario.tracks.position[track, 10, :2]}
    world = collate([scenario], frame="world")
    goals = rs.Goals.from_points(world, points)
    assert rs.simulate(follower, world, num_rollouts=2, goals=goals).goals.frame == "world"
    refuse(
        lambda: rs.simulate(follower, scenario, num_rollouts=2, goals=goals),
        "goals in the world frame do not fit scenarios in the map frame",
    )


def test_a_misspelled_public_name_has_a_suggestion():
    with pytest.raises(AttributeError, match="no attribute 'simulat': did you mean simulate"):
        _ = rs.simulat
    with pytest.raises(AttributeError, match="no attribute 'load_model': did you mean load_policy"):
        _ = rs.load_model
    with pytest.raises(AttributeError, match=r"no attribute 'EgoEnv': did you mean rlftsim\.envs\.EgoEnv"):
        _ = rs.EgoEnv
    assert repr(CV) == "ConstantVelocity()"


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda: rs.Sampling(temperature="1"), "temperature"),
        (lambda: rs.Sampling(top_k=2.5), "top_k"),
        (lambda: replace(rs.recipe("smart-demo").model, dim="64"), "dim"),
        (lambda: replace(rs.recipe("smart-demo").tokens, kind="k-discs"), "kind"),
        (lambda: ScoreConfig(limit="3"), "limit"),
    ],
)
def test_settings_of_another_type_are_refused_by_name(unchecked, make, name):
    with pytest.raises(ConfigError, match=f"^{name} must be .*, got "):
        make()


def test_a_model_shows_itself_on_one_line():
    assert re.fullmatch(r"SmartPolicy\([\d,]+ weights, follows no goals\)", repr(rs.load_policy("demo-base")))
