"""Settings on the command line: flags for every field, files of settings."""

import json
import re
from dataclasses import fields, is_dataclass, replace

import pytest
import torch
from safetensors.torch import load_file

from rlftsim.cli.main import main, parse
from rlftsim.errors import ConfigError
from rlftsim.policies.smart.config import smart_demo
from rlftsim.policies.smart.policy import SmartPolicy
from rlftsim.recipes.registry import RECIPES, recipe_by_name
from rlftsim.recipes.settings import list_sections, recipe_as_json, recipe_as_text
from rlftsim.scenario.open import open_dataset
from rlftsim.tokens.clustering import build_vocabulary
from rlftsim.training.run_folder import flatten, to_plain
from rlftsim.verbs.commands import COMMANDS

PRETRAIN = ["pretrain", "smart-demo", "--data", "d", "--out", "o", "--vocabulary", "v"]
FINETUNE = ["finetune", "smart-demo", "--model", "m", "--data", "d", "--out", "o"]
TOKENS = ["tokens", "--data", "d", "--out", "o"]
EXPERIMENT = ["experiment", "benchmark"]


def settings_of(words):
    """The recipe with the values of a command line, as the verb gets it."""
    call = parse(words)
    return call.values[call.command.recipe]


def value_at(settings, name):
    """Value of a dotted name."""
    for part in name.split("."):
        settings = getattr(settings, part)
    return settings


def names_of(config, path=""):
    """Dotted names of all settings."""
    if not is_dataclass(config):
        return [path]
    return [n for f in fields(config) for n in names_of(getattr(config, f.name), f"{path}.{f.name}".strip("."))]


@pytest.mark.parametrize(
    ("words", "name", "value"),
    [
        ([*PRETRAIN, "--pretrain.epochs", "2"], "pretrain.epochs", 2.0),
        ([*PRETRAIN, "--pretrain.max-trained-agents", "16"], "pretrain.max_trained_agents", 16),
        ([*PRETRAIN, "--pretrain.max-trained-agents", "None"], "pretrain.max_trained_agents", None),
        ([*PRETRAIN, "--model.catk-compat"], "model.catk_compat", True),
        ([*FINETUNE, "--finetune.kl.target", "0.02"], "finetune.kl.target", 0.02),
        ([*FINETUNE, "--finetune.learning_rate=1e-5"], "finetune.learning_rate", 1e-5),
        (
            [*FINETUNE, "--finetune.reward", "mloo + 0.1*collision_offroad"],
            "finetune.reward",
            "mloo + 0.1*collision_offroad",
        ),
        ([*FINETUNE, "--finetune.betas", "0.8", "0.95"], "finetune.betas", (0.8, 0.95)),
        ([*FINETUNE, "--finetune.entropy-bonus", "-0.5"], "finetune.entropy_bonus", -0.5),
        ([*FINETUNE, "--finetune.metric", "2024"], "finetune.metric", "2024"),
        ([*FINETUNE, "--finetune.device.accelerator", "cpu"], "finetune.device.accelerator", "cpu"),
        ([*FINETUNE, "--finetune.kl.min-beta", "0.5", "--finetune.kl.initial-beta", "1"], "finetune.kl.min_beta", 0.5),
        ([*FINETUNE, "--finetune.seed", "1", "--finetune.seed", "2"], "finetune.seed", 2),
        ([*FINETUNE, "--method", "catk", "--catk.num-candidates", "4"], "catk.num_candidates", 4),
        ([*TOKENS, "--tokens.no-mirror"], "tokens.mirror", False),
        ([*TOKENS, "--tokens.trajtok.vehicle.min-motions", "5"], "tokens.trajtok.vehicle.min_motions", 5),
        ([*EXPERIMENT, "--finetune.epochs", "0.5"], "finetune.epochs", 0.5),
        (["finetune", "--model", "m", "--data", "d", "smart-nano", "--out", "o"], "pretrain.batch_size", 16),
    ],
)
def test_a_flag_changes_one_field(words, name, value):
    found = value_at(settings_of(words), name)
    assert found == value
    assert type(found) is type(value)


def test_flags_leave_everything_else_as_the_recipe_has_it():
    changed = settings_of([*FINETUNE, "--finetune.kl.target", "0.02"])
    recipe = recipe_by_name("smart-demo")
    kl = replace(recipe.finetune.kl, target=0.02)
    assert changed == replace(recipe, method="rlft", finetune=replace(recipe.finetune, kl=kl))


@pytest.mark.parametrize(
    ("words", "section"),
    [(FINETUNE, "finetune"), (FINETUNE, "catk"), (FINETUNE, "gcsl"), (PRETRAIN, "model"), (TOKENS, "tokens")],
)
def test_help_shows_every_field_even_without_a_recipe(words, section, capsys):
    with pytest.raises(SystemExit):
        main([words[0], "--help"])
    text = capsys.readouterr().out
    for name in names_of(getattr(recipe_by_name("smart-tiny"), section), section):
        group, _, last = name.replace("_", "-").rpartition(".")
        assert re.search(rf"--{re.escape(group)}\.(no-)?{re.escape(last)}\b", text), name


SWITCHES = ["--finetune.kl.no-condition-reference", "--no-goal-logit-bias", "--goal=concat"]


@pytest.mark.parametrize(
    "words",
    [
        [SWITCHES[0], "smart-demo", *FINETUNE[2:]],
        ["smart-demo", SWITCHES[0], *FINETUNE[2:]],
        [*FINETUNE[2:], SWITCHES[0], "smart-demo"],
        [*FINETUNE[2:], "smart-demo", SWITCHES[0]],
        [*FINETUNE[2:], *SWITCHES[:2], "smart-demo", SWITCHES[2]],
        # the run's folder has the name of a recipe, too
        [*FINETUNE[2:-1], "smart-nano", SWITCHES[0], "smart-demo"],
    ],
    ids=" ".join,
)
def test_a_switch_beside_the_recipe_changes_no_other_setting(words):
    settings = settings_of(["finetune", *words])
    recipe = recipe_by_name("smart-demo")
    recipe = (recipe.with_goals() if "--goal=concat" in words else recipe).finetune
    assert settings.model == recipe_by_name("smart-demo").model
    assert settings.finetune.kl.condition_reference is False
    assert (settings.finetune.epochs, settings.finetune.num_rollouts) == (recipe.epochs, recipe.num_rollouts)
    assert recipe.num_rollouts != recipe_by_name("smart-tiny").finetune.num_rollouts


def test_an_unknown_recipe_is_named_even_beside_a_known_one():
    with pytest.raises(ConfigError, match="unknown recipe 'smart-dmo'"):
        parse(["finetune", "smart-dmo", "--model", "m", "--data", "d", "--out", "smart-tiny"])


BAD = [
    (["finetune", "--finetune.epochs", "1"], r"^missing: RECIPE, --model, --data, --out\.$"),
    (["evaluate", "--data", "synthetic"], r"^missing: MODEL, --out\.$"),
    ([*FINETUNE, "--finetune.kl.condition-reference", "yes"], "is a switch, it takes no value: write --finetune.kl"),
    (["convert", "a.tfrecord", "b.tfrecord", "out"], "not understood: out .one word too many, or a pattern without"),
    (["submit", "buidl", "demo-base"], "no action buidl: did you mean build"),
    (["data", "repair", "d"], "no action repair: known are verify, stats"),
    (["data", "stats", "d", "e"], "not understood: e .one word too many"),
    ([*PRETRAIN, "--pretrain.epoch", "2"], "did you mean --pretrain.epochs"),
    ([*PRETRAIN, "--training.epochs", "2"], "no flag --training.epochs: did you mean --pretrain.epochs"),
    ([*PRETRAIN, "--epochs", "2"], "did you mean --pretrain.epochs"),
    ([*PRETRAIN, "--pretrain.batch-size", "2.5"], "--pretrain.batch-size 2.5: expected a whole number"),
    ([*PRETRAIN, "--pretrain.epochs", "many"], "--pretrain.epochs many: expected a number"),
    ([*PRETRAIN, "--pretrain.epochs", "inf"], "pretrain: epochs must be a finite number, got inf"),
    ([*PRETRAIN, "--pretrain.validation.seed", "-1"], "seed must not be negative"),
    ([*PRETRAIN, "--model.num-frequencies", "0"], "model: num_frequencies must be positive"),
    ([*PRETRAIN, "--tokens.seed", "1"], "--tokens.seed has no effect here: the settings of pretrain are --model"),
    ([*FINETUNE, "--finetune.lr", "1"], "no flag --finetune.lr: did you mean --finetune.learning-rate"),
    ([*FINETUNE, "--method", "rlft", "--lr", "1"], "no flag --lr: did you mean --finetune.learning-rate\\?"),
    ([*FINETUNE, "--method", "catk", "--lr", "1"], "no flag --lr: did you mean --catk.learning-rate\\?"),
    ([*FINETUNE, "--learning-rate", "1"], "did you mean .*--finetune.learning-rate or .*--gcsl.learning-rate"),
    ([*FINETUNE, "--gpus", "2"], "no flag --gpus: did you mean --processes"),
    ([*FINETUNE, "--method", "rlft", "--device", "cpu"], "did you mean --finetune.device.accelerator"),
    (["experiment", "benchmark", "--pretrain.device", "cpu"], "did you mean --pretrain.device.accelerator"),
    ([*FINETUNE, "--resume", "runs/a"], "no flag --resume: what can be continued continues with the same"),
    (["evaluate", "--model", "demo-base"], "no flag --model: write the value .* as in `rlftsim evaluate MODEL`"),
    (["export", "page", "r", "--out", "o"], "no flag --out: write .* as in `rlftsim export FORMAT ROLLOUTS OUT`"),
    (["rollout", "demo-base"], "no verb 'rollout': did you mean simulate"),
    (["frobnicate"], "no verb 'frobnicate': known are demo, .*, join"),
    ([*FINETUNE, "--finetune.kl.goal", "1"], "no flag --finetune.kl.goal"),
    (["convert", "a", "b", "--limit", "3"], "^no flag --limit: `--help` lists them all"),
    (["convert", "a", "b", "--splt", "training"], "no flag --splt: did you mean --split"),
    (["simulate", "m", "--data", "d", "--output", "o"], "no flag --output: did you mean --out"),
    ([*FINETUNE, "--finetune.betas", "0.9"], "--finetune.betas needs 2 values"),
    ([*FINETUNE, "--finetune.betas", "0.9", "2"], r"finetune: betas are .* in \[0, 1\)"),
    ([*FINETUNE, "--finetune.trained", "some"], "--finetune.trained some: expected one of 'decoder', 'head'"),
    ([*FINETUNE, "--finetune.reward", "joy"], "unknown reward 'joy'"),
    ([*FINETUNE, "--finetune.num-rollouts", "1"], "at least 2 rollouts"),
    ([*FINETUNE, "--finetune.kl.target", "0"], "finetune.kl: target must be positive"),
    ([*FINETUNE, "--method", "rlft", "--catk.choice", "closest"], "--catk.choice has no effect with --method rlft"),
    ([*FINETUNE, "--method", "gcsl", "--finetune.seed", "1"], "--finetune.seed has no effect with --method gcsl"),
    ([*TOKENS, "--tokens.trajtok.vehicle.x-max-m", "inf"], "x_max_m must be a finite number"),
    ([*EXPERIMENT, "--finetune.reward", "rloo"], "--finetune.reward has no effect: experiments vary it"),
    ([*EXPERIMENT, "--catk.batch-size", "3"], "--catk.batch-size has no effect: experiments vary it"),
    (["finetune", "smart-dmo", "--model", "m"], "unknown recipe 'smart-dmo': did you mean 'smart-demo'"),
    (["tokens", "--recipe", "smarttiny", "--data", "d"], "unknown recipe 'smarttiny': did you mean 'smart-tiny'"),
    (["simulate", "demo-base", "--data", "synthetic", "--out", "o", "--export"], "^--export needs at least one value"),
    (
        ["join"],
        "^join: write the command of a share behind join, .* evaluate, experiment true-world, failures, score,",
    ),
    (["join", "foo"], "^join foo: write the command of a share behind join"),
    (["join", "pretrain", "--help"], "^join pretrain --help: write the command of a share behind join"),
    (["join", "submit", "check"], "^join submit check: write the command of a share behind join"),
    (["join", "convert", "a", "b", "--share", "1/2"], "^join convert a: write .* without --share"),
    (
        ["convert", "my files", "s3://b/c", "--jobs", "2"],
        "^s3://b/c is an address, .*: `rlftsim convert 'my files' FOLDER --jobs 2`, then `rlftsim data push FOLDER s3:",
    ),
    (["evaluate", "oracle", "--data", "synthetic", "--out", "gs://b/c/"], "^gs://b/c/ is an address: name a folder"),
    (["convert", "a", "b", "--item-log", "s3://b/c"], "^s3://b/c is an address: name a folder or a file"),
]


@pytest.mark.parametrize(("words", "message"), BAD, ids=[" ".join(words[-2:]) for words, _ in BAD])
def test_a_bad_setting_is_refused_in_one_line(words, message):
    with pytest.raises(ConfigError, match=message) as caught:
        parse(words)
    assert "\n" not in str(caught.value)


# ---- files of settings ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["smart-tiny", "smart-demo"])
def test_a_printed_recipe_is_read_back(name, tmp_path, capsys):
    assert main(["recipe", name, "--json"]) == 0
    (tmp_path / "mine.json").write_text(capsys.readouterr().out)
    recipe = recipe_by_name(name)
    for words in (PRETRAIN, FINETUNE, TOKENS):
        settings = settings_of([*words, "--config", str(tmp_path / "mine.json")])
        for section in COMMANDS[words[0]].sections:
            assert getattr(settings, section) == getattr(recipe, section)


def test_the_text_of_a_recipe_has_every_field_and_its_documentation():
    recipe = recipe_by_name("smart-tiny")
    text = recipe_as_text(recipe)
    for name in flatten(to_plain(list_sections(recipe))):
        assert f"  {name.rpartition('.')[2]}: " in text
    assert "method: rlft" in text.splitlines()
    assert "# Rollouts per scenario and update (N).\n  num_rollouts: 4" in text
    assert list(json.loads(recipe_as_json(recipe))) == list(list_sections(recipe))


def test_recipes_are_listed_with_a_summary_each(capsys):
    assert main(["recipe"]) == 0
    lines = capsys.readouterr().out.splitlines()
    smart = ["smart-demo", "smart-demo-long", "smart-mini", "smart-nano", "smart-tiny"]
    assert [line.split()[0] for line in lines] == [*smart, "synthetic", "trafficbots", "trafficbots-demo"]
    assert all(len(line.split()) > 2 for line in lines)


def test_flags_override_a_file_which_overrides_the_recipe(tmp_path):
    path = tmp_path / "some.json"
    path.write_text(json.dumps({"finetune": {"learning_rate": 1e-5, "kl": {"target": 0.5}, "betas": [0.7, 0.8]}}))
    settings = settings_of([*FINETUNE, "--finetune.kl.target", "0.02", "--config", str(path)]).finetune
    recipe = recipe_by_name("smart-demo").finetune
    assert (settings.kl.target, settings.learning_rate, settings.betas) == (0.02, 1e-5, (0.7, 0.8))
    assert settings.num_rollouts == recipe.num_rollouts


def test_a_runs_config_is_read_by_its_method(tmp_path):
    path = tmp_path / "config.json"
    path.write_text(
        json.dumps({"num_candidates": 7, "goal_probability": 0.5, "initial_policy": "ab", "scenarios": "cd"})
    )
    for words in (["--method", "catk"], []):
        settings = settings_of([*FINETUNE, *words, "--config", str(path)])
        assert (settings.method, settings.catk.num_candidates, settings.catk.goal_probability) == ("catk", 7, 0.5)
    with pytest.raises(
        ConfigError, match=r"config\.json: no setting finetune\.goal_probability: did you mean finetune\."
    ):
        parse([*FINETUNE, "--method", "rlft", "--config", str(path)])


@pytest.mark.parametrize(
    ("words", "method"),
    [
        ([], "calibrate"),
        (["--goal", "concat"], "rlft"),
        (["--finetune.epochs", "2"], "rlft"),
        (["--catk.epochs=2"], "catk"),
        (["--method", "road", "--road.epochs", "2"], "road"),
    ],
)
def test_the_method_is_that_whose_settings_are_given_or_that_of_the_recipe(words, method):
    assert settings_of([*FINETUNE, *words]).method == method
    assert settings_of(["finetune", "smart-tiny", *FINETUNE[2:]]).method == "rlft"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ('{"finetune": {"lerning_rate": 1}}', "no setting finetune.lerning_rate: did you mean finetune.learning_rate"),
        ('{"finetune": {"kl": 1}}', r"no setting finetune\.kl: did you mean finetune\.kl\."),
        ('{"finetune": {"epochs": "many"}}', r"some\.json: finetune\.epochs many: expected a number"),
        ('{"finetune": {"betas": [1]}}', r"some\.json: finetune\.betas needs 2 values"),
        ('{"finetune": {"epochs": -1}}', "finetune: epochs must be positive"),
        ('{"finetune": {"epochs": 1}, "comment": "mine"}', "no setting comment: sections are tokens, model, pretrain"),
        ('{"finetune": {"epochs": 1}, "lerning_rate": 1}', r"no setting lerning_rate: did you mean \w+\.learning_rate"),
        ('{"finetun": {"epochs": 1}}', "no setting finetun.epochs: did you mean finetune.epochs"),
        ('{"epochs": 1, "lerning_rate": 1}', "no setting finetune.lerning_rate: did you mean finetune.learning_rate"),
        ('{"lerning_rate": 1}', "no setting lerning_rate: did you mean learning_rate"),
        ('{"finetune": 3}', "finetune is 3, not settings by name"),
        ('{"finetune": null}', "finetune is null, not settings by name"),
        ("null", "holds null instead of an object"),
        ("[1]", "holds a list instead of an object"),
        ("{", "not JSON"),
    ],
)
def test_a_file_that_makes_no_sense_is_refused_in_one_line(content, message, tmp_path):
    path = tmp_path / "some.json"
    path.write_text(content)
    with pytest.raises(ConfigError, match=message) as caught:
        parse([*FINETUNE, "--config", str(path)])
    assert "\n" not in str(caught.value)


@pytest.mark.slow
def test_a_run_repeated_from_its_own_config_gives_the_same_bits(tmp_path):
    scenarios = open_dataset("synthetic", "validation")
    tokens = replace(recipe_by_name("smart-demo").tokens, num_tokens=32, num_map_prototypes=8, max_scenarios=8)
    model = replace(smart_demo(), dim=16, num_heads=2, head_dim=8, num_decoder_layers=1)
    torch.manual_seed(0)
    SmartPolicy(model, build_vocabulary(scenarios, tokens)[0]).save_pretrained(tmp_path / "base")
    common = [
        "finetune",
        "smart-demo",
        "--model",
        str(tmp_path / "base"),
        "--data",
        "synthetic",
        "--split",
        "validation",
    ]
    few = ["--finetune.epochs", "0.05", "--finetune.batch-size", "1", "--finetune.num-rollouts", "2"]
    other = ["--finetune.seed", "3", "--finetune.betas", "0.8", "0.9", "--finetune.learning-rate", "1e-3"]
    assert main([*common, "--out", str(tmp_path / "first"), *few, *other]) == 0
    assert main([*common, "--out", str(tmp_path / "again"), "--config", str(tmp_path / "first" / "config.json")]) == 0
    first, again = (load_file(tmp_path / run / "model" / "model.safetensors") for run in ("first", "again"))
    assert set(first) == set(again)
    assert all(torch.equal(first[key], again[key]) for key in first)
    before = load_file(tmp_path / "base" / "model.safetensors")
    assert any(not torch.equal(first[key], before[key]) for key in first)


@pytest.mark.parametrize(
    ("words", "bias"),
    [([], None), (["--goal-logit-bias"], True), (["--no-goal-logit-bias"], False)],
)
def test_the_goal_logit_bias_is_on_off_or_left_to_the_model(words, bias):
    values = parse([*FINETUNE, "--goal", "concat", *words]).values
    assert values["goal_logit_bias"] is bias
    assert "goal" in values["recipe"].finetune.reward
    assert values["recipe"].catk.goal_probability == 1


def test_a_recipe_without_a_method_has_no_flags_of_it_and_refuses_it(monkeypatch):
    without = replace(recipe_by_name("smart-demo"), catk=None)
    monkeypatch.setitem(RECIPES._registered, "without", lambda: without)
    words = ["without", *FINETUNE[2:]]
    assert settings_of(["finetune", *words]).catk is None
    with pytest.raises(ConfigError, match=r"no flag --catk\.num-candidates"):
        parse(["finetune", *words, "--catk.num-candidates", "4", "--method", "catk"])
    with pytest.raises(
        ConfigError, match=r"recipe without has no section catk: .* any other model is trained by --method rlft"
    ):
        parse(["finetune", *words, "--method", "catk"])
