"""What a person meets at the prompt: help for every verb, and one line for every mistake."""

import json
import os
import re
import shutil
import subprocess
import sys
import typing
from dataclasses import replace

import pytest
import torch

from rlftsim import __version__
from rlftsim.cli.data import SYNTHETIC, open_split
from rlftsim.cli.experiment import ExperimentRecipe
from rlftsim.cli.goals import Choice
from rlftsim.cli.main import VERBS, main, parse
from rlftsim.cli.train import RecipeName
from rlftsim.goals.manoeuvre import Manoeuvre
from rlftsim.policies.smart.config import smart_demo
from rlftsim.policies.smart.policy import SmartPolicy
from rlftsim.recipes.smart import RECIPES
from rlftsim.rollout.baselines import ConstantVelocity
from rlftsim.scenario.synthetic import pack_path
from rlftsim.tokens.vocabulary import Vocabulary
from rlftsim.training.run_folder import read_metrics


def run(capsys, *arguments) -> tuple[int, str, str]:
    """Exit status, standard output and standard error of a command line."""
    try:
        status = main([str(a) for a in arguments])
    except SystemExit as stop:  # what the command line itself does not understand
        status = int(stop.code or 0)
    captured = capsys.readouterr()
    return status, captured.out, captured.err


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_explains_itself(verb, capsys):
    status, out, _ = run(capsys, verb, "--help")
    assert status == 0
    assert f"rlftsim {verb}" in out
    assert len(out.splitlines()) > 5


@pytest.mark.parametrize(("line", "expected"), [(["--help"], 0), (["-h"], 0), (["help"], 0), ([], 2)])
def test_the_overview_names_every_verb(line, expected, capsys):
    status, out, _ = run(capsys, *line)
    assert status == expected
    assert all(re.search(rf"^  {verb} ", out, re.MULTILINE) for verb in VERBS)


def test_the_version_is_told(capsys):
    assert run(capsys, "--version") == (0, f"rlftsim {__version__}\n", "")


def test_a_misspelt_verb_is_guessed(capsys):
    status, _, err = run(capsys, "finetun")
    assert (status, err) == (2, "rlftsim: no verb 'finetun': did you mean finetune?\n")


def test_help_does_not_wait_for_torch():
    code = "import sys; from rlftsim.cli import main; main(['--help']); sys.exit('torch' in sys.modules)"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    assert subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True).returncode == 0


def test_the_recipes_one_can_name_are_the_ones_there_are():
    assert typing.get_args(RecipeName) == tuple(RECIPES)
    assert typing.get_args(ExperimentRecipe) == (SYNTHETIC, *RECIPES)


@pytest.fixture
def vocabulary(tmp_path, capsys):
    """A small vocabulary file made by the command."""
    path = tmp_path / "vocabulary.safetensors"
    small = ["tokens.num-tokens=32", "tokens.num-map-prototypes=8"]
    arguments = ["tokens", "--data", "synthetic", "--split", "validation", "--out", path, "--recipe", "smart-demo"]
    status, out, _ = run(capsys, *arguments, "--set", *small)
    assert status == 0
    assert "32 vehicle, " in out
    assert "8 map pieces" in out
    assert (tmp_path / "vocabulary.report" / "picture.png").exists()
    return path


def test_a_vocabulary_can_be_looked_at_again(vocabulary, tmp_path, capsys):
    arguments = ["tokens", "--data", "synthetic", "--split", "validation", "--check", vocabulary]
    status, out, _ = run(capsys, *arguments, "--report", tmp_path / "other", "--set", "tokens.max-scenarios=2")
    assert status == 0
    assert "error of whole tracks: mean · 95 % · max [cm]" in out
    assert "2 scenarios of synthetic, validation" in (tmp_path / "other" / "report.md").read_text()


@pytest.fixture
def evaluation(tmp_path, capsys):
    """A small evaluation made by the command."""
    arguments = ["evaluate", "oracle", "--data", "synthetic", "--out", tmp_path / "e", "--num-rollouts", "2"]
    status, out, err = run(capsys, *arguments, "--limit", "1")
    assert status == 0, err
    assert "oracle.parquet" in out
    return tmp_path / "e" / "oracle.parquet"


WRONG = {
    "a data set that is not there": ("data stats {tmp}/nothing", "nothing is no data set.*no such folder"),
    "a folder that is no data set": ("data verify {tmp}", "is no data set, it has no manifest.json"),
    "a damaged manifest": ("data stats {tmp}/broken", "manifest.json cannot be read"),
    "an unfinished conversion": ("data stats {tmp}/unfinished", "was not finished: run the same convert command again"),
    "an unknown split": ("simulate constant_velocity --data synthetic --out {tmp}/o --split tests", "no split 'tests', only training, validation"),
    "an unknown split to train on": ("tokens --data synthetic --out {tmp}/v --split tests", "no split 'tests', only training, validation"),
    "an unknown split to evaluate": ("evaluate oracle --data synthetic --out {tmp}/o --split tests", "no split 'tests', only training, validation"),
    "an unknown scenario": ("simulate constant_velocity --data synthetic --out {tmp}/o --scenario nobody", "no scenario nobody in split 'validation'"),
    "an unknown model": ("evaluate {tmp}/no-model --data synthetic --out {tmp}/o", "no-model' is neither a model folder nor one of constant_velocity, oracle"),
    "a folder that is no model": ("simulate {tmp} --data synthetic --out {tmp}/o", "not a model folder, config.json is missing"),
    "a model to fine-tune that is not there": ("finetune smart-demo --model {tmp}/no-model --data synthetic --out {tmp}/o", "is neither a model folder"),
    "a baseline to fine-tune": ("finetune smart-demo --model constant_velocity --data synthetic --out {tmp}/o", "ConstantVelocity has no weights"),
    "a vocabulary that is not there": ("pretrain smart-demo --data synthetic --out {tmp}/o --vocabulary {tmp}/v", "no such vocabulary: build one with"),
    "a vocabulary that is none": ("pretrain smart-demo --data synthetic --out {tmp}/o --vocabulary {tmp}/garbage", "damaged vocabulary"),
    "a field that does not exist": ("tokens --data synthetic --out {tmp}/v --set tokens.size=5", "no field 'size' here, known are kind, num_tokens"),
    "a value of the wrong kind": ("tokens --data synthetic --out {tmp}/v --set tokens.num_tokens=few", "expected int"),
    "a value out of range": ("tokens --data synthetic --out {tmp}/v --set tokens.num_tokens=1", "needs num_tokens >= 2"),
    "a vocabulary neither to build nor to look at": ("tokens --data synthetic", "either --out FILE, to build a vocabulary, or --check FILE"),
    "a vocabulary to look at that is not there": ("tokens --data synthetic --check {tmp}/v.safetensors", "no such vocabulary: build one with"),
    "a vocabulary to look at that is none": ("tokens --data synthetic --check {tmp}/garbage", "damaged vocabulary"),
    "tables to look at that are none": ("tokens --data synthetic --check {tmp}/garbage.npz", "not an npz of token tables"),
    "tables in an empty file": ("tokens --data synthetic --check {tmp}/empty.npz", "not an npz of token tables"),
    "a vocabulary in place of something else": ("tokens --data synthetic --out {tmp}/garbage", "is there and no vocabulary: name another --out"),
    "rollouts that nobody knows the maker of": ("simulate constant_velocity --data synthetic --out {tmp}/whose", "rollouts.json: damaged .* name another --out"),
    "no value": ("tokens --data synthetic --out {tmp}/v --set tokens.num_tokens", "is not field=value"),
    "an unknown metric": ("evaluate oracle --data synthetic --out {tmp}/o --metric 1999", "Unknown metric '1999': known are 2025"),
    "no rollouts": ("evaluate oracle --data synthetic --out {tmp}/o --num-rollouts 0", "num_rollouts must be at least 1"),
    "a temperature below zero": ("simulate constant_velocity --data synthetic --out {tmp}/o --temperature -1", "temperature must be >= 0"),
    "top-k of a policy without categories": ("simulate constant_velocity --data synthetic --out {tmp}/o --top-k 3", "top_k=3 needs a policy with categories"),
    "goals of a policy that sees none": ("simulate constant_velocity --data synthetic --out {tmp}/o --goals {tmp}/goals.json", "constant_velocity does not see goals, 1 would have no effect"),
    "a goal without its scenario": ("simulate constant_velocity --data synthetic --out {tmp}/o --goal 5=1,2", "--goal AGENT=X,Y needs to know the scenario"),
    "a goal that is none": ("simulate constant_velocity --data synthetic --out {tmp}/o --scenario 9d639de83d6f5239 --goal 5=here", "--goal 5=here: not AGENT=X,Y"),
    "a goals file that is not there": ("simulate constant_velocity --data synthetic --out {tmp}/o --goals {tmp}/no.json", "no such goals file: make one with"),
    "a goal of an unknown agent": ("goals check {tmp}/goals.json --data synthetic", r"goals\[0\]: scenario 9d639de83d6f5239 has no agent 9999"),
    "proposals for an unknown scenario": ("goals propose synthetic --scenario nobody", "no scenario nobody in synthetic"),
    "proposals for an unknown agent": ("goals propose synthetic --scenario 9d639de83d6f5239 --agent 9999", "no agent 9999 in scenario 9d639de83d6f5239: there are "),
    "a tfrecord that is not there": ("convert {tmp}/x.tfrecord {tmp}/o", "no such file or folder"),
    "a folder without tfrecords": ("convert {tmp} {tmp}/o", "no tfrecord file in this folder"),
    "a destination that is taken": ("convert {tmp}/garbage {tmp}", "is not empty and not a data set"),
    "an evaluation that is none": ("compare {tmp}/garbage {tmp}/garbage", "garbage"),
    "an evaluation that is not there": ("compare {tmp}/a.parquet {tmp}/b.parquet", "a.parquet"),
}  # fmt: skip


@pytest.mark.parametrize("mistake", WRONG)
def test_a_mistake_ends_in_one_line_and_status_2(mistake, tmp_path, capsys):
    (tmp_path / "garbage").write_bytes(b"garbage" * 9)
    (tmp_path / "garbage.npz").write_bytes(b"garbage" * 9)
    (tmp_path / "empty.npz").touch()
    (tmp_path / "goals.json").write_text(
        '{"format": "rlftsim-goals-1", "goals": [{"scenario": "9d639de83d6f5239", "agent": 9999, "x": 1, "y": 2}]}'
    )
    (tmp_path / "whose").mkdir()
    (tmp_path / "whose" / "rollouts.json").write_text("{")
    shutil.copytree(pack_path(), tmp_path / "unfinished", ignore=shutil.ignore_patterns("*.arrow"))
    (tmp_path / "unfinished" / "INCOMPLETE").touch()
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "manifest.json").write_text("{")
    line, words = WRONG[mistake]
    status, _, err = run(capsys, *line.format(tmp=tmp_path).split())
    said = [part for part in err.splitlines() if part.startswith("rlftsim: ")]
    assert status == 2
    assert len(said) == 1, err
    assert "Traceback" not in err
    assert re.search(words, said[0]), said[0]


@pytest.mark.parametrize(
    "line",
    [
        "fly",
        "pretrain smart-huge --data synthetic --out o --vocabulary v",
        "evaluate oracle --data synthetic",
        "evaluate oracle --data synthetic --out o --num-rollouts many",
        "data",
        "convert a b --on-error wait",
    ],
)
def test_a_line_that_cannot_be_read_is_explained(line, capsys):
    status, out, err = run(capsys, *line.split())
    assert status == 2
    assert "Traceback" not in err + out
    assert err.strip()


def test_stats_and_verify_of_the_embedded_scenarios(capsys):
    status, out, _ = run(capsys, "data", "stats", "synthetic")
    assert status == 0
    assert "160 training" in out
    assert "40 validation" in out


def test_pretraining_and_fine_tuning_by_command(vocabulary, tmp_path, capsys):
    small = ["model.dim=16", "model.num-heads=2", "model.head-dim=8", "model.num-decoder-layers=1"]
    once = ["pretrain.epochs=0.05", "pretrain.batch-size=1", "pretrain.device.accelerator=cpu", "pretrain.device.threads=1"]  # fmt: skip
    common = ["--data", "synthetic", "--split", "validation"]
    base, tuned = tmp_path / "base", tmp_path / "tuned"
    status, out, _ = run(
        capsys, "pretrain", "smart-demo", *common, "--out", base, "--vocabulary", vocabulary, "--set", *small, *once
    )
    assert status == 0
    assert f"model: {base / 'model'}" in out
    card = (base / "model" / "README.md").read_text()
    assert "CC0" in card
    assert "40 scenarios" in card
    once = ["finetune.epochs=0.025", "finetune.batch-size=1", "finetune.num-rollouts=2", "finetune.device.threads=1"]
    status, out, _ = run(capsys, "finetune", "smart-demo", "--model", base, *common, "--out", tuned, "--set", *once)
    assert status == 0
    assert json.loads((tuned / "config.json").read_text())["num_rollouts"] == 2
    # the same model, fine-tuned with CAT-K
    few = ["catk.epochs=0.05", "catk.batch-size=1", "catk.device.threads=1", "catk.num-candidates=4"]
    few += ["catk.validation.every=1", "catk.validation.num-scenarios=2", "catk.validation.num-rollouts=2"]
    words = ["finetune", "smart-demo", "--method", "catk", "--model", base, *common, "--out", tmp_path / "catk"]
    assert run(capsys, *words, "--set", *few)[0] == 0
    assert json.loads((tmp_path / "catk" / "config.json").read_text())["num_candidates"] == 4
    assert "CAT-K" in (tmp_path / "catk" / "model" / "README.md").read_text()
    assert len([line for line in read_metrics(tmp_path / "catk") if line["validation_rmm"] > 0]) == 2
    # the same model, told where its own rollouts led
    few = ["gcsl.epochs=0.05", "gcsl.num-rollouts=2", "gcsl.device.threads=1"]
    words = ["finetune", "smart-demo", "--method", "gcsl", "--goal", "indication", "--model", base, *common]
    assert run(capsys, *words, "--out", tmp_path / "gcsl", "--set", *few)[0] == 0
    assert '"goal_aim": true' in (tmp_path / "gcsl" / "model" / "config.json").read_text()
    assert (
        "told where its own rollouts led, goals by indication, from"
        in (tmp_path / "gcsl" / "model" / "README.md").read_text()
    )
    for run_folder in (base, tuned, tmp_path / "catk", tmp_path / "gcsl"):
        assert (run_folder / "learning_curve.png").read_bytes().startswith(b"\x89PNG")
    # the same folder with other settings is another run
    status, _, err = run(
        capsys, "finetune", "smart-demo", "--model", base, *common, "--out", tuned, "--set", *once, "finetune.seed=1"
    )
    assert status == 2
    assert "other settings or inputs (seed)" in err
    # a damaged checkpoint says what to do
    newest = next((tuned / "checkpoints").iterdir())
    (newest / "policy.safetensors").write_bytes(b"garbage")
    status, _, err = run(capsys, "finetune", "smart-demo", "--model", base, *common, "--out", tuned, "--set", *once)
    assert status == 2
    assert f"{newest.name}: cannot go on from it" in err


def test_simulating_again_keeps_what_is_there(tmp_path, capsys):
    arguments = ["simulate", "constant_velocity", "--data", "synthetic", "--out", tmp_path, "--num-rollouts", "2"]
    name = open_split("synthetic", "validation").scenario_ids[0]
    for _ in range(2):
        status, out, _ = run(capsys, *arguments, "--scenario", name)
        assert status == 0
        assert "2 rollouts of 1 scenarios" in out
    [file] = tmp_path.glob("*.npz")
    stamp = file.stat().st_mtime_ns
    run(capsys, *arguments, "--scenario", name)
    assert file.stat().st_mtime_ns == stamp


def test_a_folder_of_other_rollouts_is_refused(tmp_path, capsys):
    arguments = ["simulate", "constant_velocity", "--data", "synthetic", "--out", tmp_path, "--num-rollouts", "2"]
    name = open_split("synthetic", "validation").scenario_ids[0]
    assert run(capsys, *arguments, "--scenario", name)[0] == 0
    status, _, err = run(capsys, *arguments, "--seed", "1", "--scenario", name)
    assert status == 2
    assert "holds rollouts of constant_velocity with another seed: name another --out" in err


def test_settings_without_effect_are_refused(tmp_path, capsys):
    words = ["pretrain", "smart-demo", "--data", "synthetic", "--vocabulary", tmp_path / "v", "--out", tmp_path / "run"]
    status, _, err = run(capsys, *words, "--set", "finetune.reward=rloo")
    assert status == 2
    assert "finetune.reward has no effect here: only fields of model and pretrain can be set" in err


def test_what_has_no_effect_on_a_method_is_refused(tmp_path, vocabulary, capsys):
    catk, every = ["--method", "catk"], ["--set", "catk.validation.every=1"]
    wrong = [
        ([*catk, "--set", "finetune.reward=rloo"], "finetune.reward has no effect here: only fields of catk"),
        (["--set", "catk.num_candidates=4"], "catk.num_candidates has no effect here: only fields of finetune"),
        ([*catk, "--set", "catk.choice=farthest"], "expected one of closest, top_k, trajeglish"),
        ([*catk, "--validation-split", "validation"], "--validation-split validation has no effect"),
        (["--validation-split", "validation"], "--validation-split validation has no effect"),
        ([*catk, *every, "--validation-split", "tests"], "no split 'tests'"),
        ([*catk, "--set", "catk.trained=goals"], "this model does not see goals: add --goal concat"),
        ([*catk, "--set", "catk.goal_share=1"], "this model does not see goals: add --goal concat"),
        (["--method", "gcsl"], "this model does not see goals: add --goal concat"),
        (["--goal-aim", "no"], "--goal-aim no has no effect: name a --goal"),
        (["--method", "gcsl", "--goal", "concat", "--validation-split", "validation"], "See what was learned by"),
        (
            ["--method", "gcsl", "--goal", "concat", "--set", "gcsl.goal_learning_rate_scale=2"],
            "set gcsl.learning_rate",
        ),
        (["--set", "finetune.reward=gcft"], "needs goals: set finetune.goals.share above 0"),
        (["--set", "finetune.goals.share=1"], "this model does not see goals: add --goal concat or --goal indication"),
    ]
    SmartPolicy(smart_demo(), Vocabulary.load(vocabulary)).save_pretrained(tmp_path / "base")
    words = ["finetune", "smart-demo", "--model", tmp_path / "base", "--data", "synthetic", "--out", tmp_path / "o"]
    for more, expected in wrong:
        status, _, err = run(capsys, *words, *more)
        assert (status, err.count("\n")) == (2, 1)
        assert expected in err
        assert not (tmp_path / "o").exists()


def test_comparing_an_evaluation_with_itself(evaluation, capsys):
    status, out, _ = run(capsys, "compare", evaluation, evaluation)
    assert status == 0
    assert "oracle" in out


def test_doctor_looks_at_everything(capsys):
    status, out, _ = run(capsys, "doctor")
    assert status in (0, 1)
    for what in ("Python", "torch", "threads", "GPU", "SUMO", "disk", "synthetic scenarios"):
        assert what in out


def test_settings_may_be_given_once_or_many_times():
    once = ["tokens", "--data", "d", "--set", "a=1", "b=2", "--out", "o"]
    many = ["tokens", "--set", "a=1", "--data", "d", "--set", "b=2", "--out", "o"]
    for words in (once, many):
        assert parse(words).set == ["a=1", "b=2"]


def test_a_model_folder_without_weights_or_with_garbage_is_refused_in_words(tmp_path, capsys):
    for name, content in (("config.json", bytes(range(128, 256))), ("config.json", b"3")):
        (tmp_path / name).write_bytes(content)
        status, _, err = run(capsys, "simulate", tmp_path, "--data", "synthetic", "--out", tmp_path / "out")
        assert (status, err.count("\n")) == (2, 1)
        assert "damaged model folder" in err


# ---- goals --------------------------------------------------------------------------------------------------------------

SCENARIO, TURNS = "9d639de83d6f5239", 9
"""An agent of this synthetic scenario stands before a junction and may go straight on, turn right or change lanes."""


def test_proposals_are_printed_written_and_drawn(tmp_path, capsys):
    arguments = ["goals", "propose", "synthetic", "--scenario", SCENARIO, "--agent", TURNS, "--choose", "right"]
    status, out, _ = run(capsys, *arguments, "--out", tmp_path / "g.json", "--picture", tmp_path / "g.png")
    assert status == 0
    assert "right ← asked for" in out
    file = json.loads((tmp_path / "g.json").read_text())
    assert [(goal["agent"], goal["label"]) for goal in file["goals"]] == [(TURNS, "right")]
    assert {goal["label"] for goal in file["alternatives"]} == {"straight", "lane_change_left"}
    assert (tmp_path / "g.png").read_bytes().startswith(b"\x89PNG")
    status, out, _ = run(capsys, "goals", "check", tmp_path / "g.json", "--data", "synthetic")
    assert status == 0
    assert f"agent {TURNS} (vehicle, 0.0 m/s) stands still" in out
    assert out.count("stands still") == 3  # the alternatives are checked, too
    assert "1 goals in 1 scenarios, 2 alternatives, 3 doubts" in out


def test_every_manoeuvre_can_be_chosen():
    assert set(typing.get_args(Choice)) == {"alternative", "recorded", *Manoeuvre}


class SeesGoals(ConstantVelocity):
    """Drives the straight line to its goal."""

    sees_goals = True

    def begin(self, context, num_rollouts, goals, noise):
        state = super().begin(context, num_rollouts, goals, noise)
        asked = goals.goal_mask[..., None] if goals is not None else False
        velocity = (
            torch.where(asked, (goals.position - state.position) / 8.0, state.velocity) if goals else state.velocity
        )
        return replace(state, velocity=velocity)


def test_a_goal_is_given_to_the_model_and_who_got_there_is_said(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("rlftsim.cli.simulate.load_policy", lambda *_, **__: SeesGoals())
    arguments = ["simulate", "goal-seeker", "--data", "synthetic", "--scenario", SCENARIO, "--num-rollouts", "2"]
    goals = ["--goal", f"{TURNS}=-74.19,19.77", "--goal", "52=3.28,-4.49"]
    status, out, err = run(capsys, *arguments, "--out", tmp_path / "o", *goals, "--picture")
    assert status == 0, err
    assert out.count("100%") == 4  # two goals, both reached and passed
    assert "stands still" in err
    assert (tmp_path / "o" / f"{SCENARIO}.png").exists()
    status, _, err = run(capsys, *arguments, "--out", tmp_path / "o")
    assert (status, "with another goals" in err) == (2, True)
    status, _, err = run(capsys, *arguments, "--out", tmp_path / "far", "--goal", f"{TURNS}=5000,0")
    assert (status, "nobody gets there in 8 s" in err) == (2, True)
    assert not (tmp_path / "far").exists()


def test_only_the_scenarios_of_a_goals_file_are_simulated(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("rlftsim.cli.simulate.load_policy", lambda *_, **__: SeesGoals())
    run(capsys, "goals", "propose", "synthetic", "--scenario", SCENARIO, "--out", tmp_path / "g.json")
    arguments = ["simulate", "goal-seeker", "--data", "synthetic", "--out", tmp_path / "o", "--num-rollouts", "1"]
    status, out, _ = run(capsys, *arguments, "--goals", tmp_path / "g.json")
    assert status == 0
    assert [p.name for p in (tmp_path / "o").glob("*.npz")] == [f"{SCENARIO}.npz"]
    assert "lane_change_right" in out


def test_an_evaluation_with_goals_says_so_and_replaces_none_without(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("rlftsim.cli.results.load_policy_or_oracle", lambda *_, **__: SeesGoals())
    arguments = ["evaluate", "goal-seeker", "--data", "synthetic", "--out", tmp_path, "--num-rollouts", "2", "--limit", "1"]  # fmt: skip
    status, out, _ = run(capsys, *arguments, "--goals", "recorded")
    assert (status, "goal missed" in " ".join(out.split())) == (0, True)
    assert "goal-seeker: evaluated agents were asked to go where their record ends" in out
    status, _, err = run(capsys, *arguments)
    assert (status, "goal-seeker.parquet was measured with goals=recorded, not none: name this one apart" in err) == (2, True)  # fmt: skip
    status, out, _ = run(capsys, *arguments, "--name", "free")
    assert (status, "missed" in out) == (0, False)


# ---- goals asked wrongly ------------------------------------------------------------------------------------------------


def goals_file(path, *goals, alternatives=()):
    entries = [[{"scenario": SCENARIO, "agent": a, "x": x, "y": y, **more} for a, x, y, more in part] for part in (goals, alternatives)]  # fmt: skip
    path.write_text(json.dumps({"format": "rlftsim-goals-1", "goals": entries[0], "alternatives": entries[1]}))
    return path


@pytest.fixture
def simulated(tmp_path, capsys, monkeypatch):
    """Runs `simulate` with a model that drives to its goals; returns status, output and errors."""
    monkeypatch.setattr("rlftsim.cli.simulate.load_policy", lambda *_, **__: SeesGoals())
    common = ["simulate", "goal-seeker", "--data", "synthetic", "--num-rollouts", "2", "--out", tmp_path / "o"]
    return lambda *arguments: run(capsys, *common, *arguments)


@pytest.mark.parametrize("label", ["[/bold] hm", "left [lane 3] :car:", r"a $\foo$ b", "x" * 300])
def test_any_label_is_shown_as_it_is(label, tmp_path, simulated):
    file = goals_file(tmp_path / "g.json", (TURNS, -74.19, 19.77, {"label": label}))
    status, out, err = simulated("--goals", file, "--picture")
    assert status == 0, err
    assert label[:30] in out
    assert "closest [m]: best" in out
    assert (tmp_path / "o" / f"{SCENARIO}.png").stat().st_size > 10_000


def test_a_goals_file_that_asks_nobody_is_refused(tmp_path, simulated):
    alone = goals_file(tmp_path / "g.json", alternatives=[(TURNS, -74.19, 19.77, {})])
    status, _, err = simulated("--goals", alone)
    assert (status, 'nobody is asked: move one of its 1 alternatives to "goals"' in err) == (2, True)
    file = goals_file(tmp_path / "g.json", (TURNS, -74.19, 19.77, {}))
    other = open_split(SYNTHETIC, "validation").scenario_ids[-1]
    status, _, err = simulated("--goals", file, "--scenario", other)
    assert (status, f"such as {SCENARIO}, none in {other}" in err) == (2, True)
    status, _, err = simulated("--goals", file, "--scenario", SCENARIO, other, SCENARIO)
    assert (status, f"scenario {other} has no goals: it is simulated without" in err) == (0, True)
    assert len(list((tmp_path / "o").glob("*.npz"))) == 2


def test_a_scenario_of_another_split_or_data_set_is_said_to_be(tmp_path, capsys, simulated):
    training = open_split(SYNTHETIC, "training").scenario_ids[0]
    status, _, err = simulated("--scenario", training)
    assert (status, "in split 'validation' of synthetic: it is in split 'training', add --split training" in err) == (
        2,
        True,
    )
    file = goals_file(tmp_path / "g.json", (TURNS, 0, 0, {"scenario": "nobody"}))
    for status, _, err in (simulated("--goals", file), run(capsys, "goals", "check", file, "--data", "synthetic")):
        assert (status, f"{file}: goals[0]: no scenario nobody in" in err) == (2, True)
        assert "--data names another data set" in err


def test_rollouts_that_are_damaged_or_of_nobody_are_not_taken_over(tmp_path, simulated):
    arguments = ["--scenario", SCENARIO, "--goal", f"{TURNS}=-74.19,19.77"]
    assert simulated(*arguments)[0] == 0
    path = tmp_path / "o" / f"{SCENARIO}.npz"
    path.write_bytes(path.read_bytes()[:1000])
    status, _, err = simulated(*arguments)
    assert (status, err.count("\n")) == (2, 2)  # the doubt, and the cause
    assert f"{path} (scenario {SCENARIO})" in err
    assert "remove it, then run the same command again" in err
    (tmp_path / "o" / "rollouts.json").unlink()
    status, _, err = simulated(*arguments)
    assert (status, f"holds {SCENARIO}.npz but no rollouts.json" in err) == (2, True)


PROPOSE = ["goals", "propose", "synthetic", "--scenario", SCENARIO]


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--picture", "plot"], "plot: pictures are written as .png, .svg, .pdf: name the file so"),
        (["--agent", "--picture", "a.png"], "--agent names nobody: give object ids, or leave it out"),
        (["--agent", TURNS, "--choose", "left_uturn", "--out", "g.json"], "none of these agents can do left_uturn: they can do straight, right, lane_change_left (--choose)"),
    ],
)  # fmt: skip
def test_proposals_that_cannot_be_are_refused(more, message, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    status, _, err = run(capsys, *PROPOSE, *more)
    assert (status, message in err) == (2, True), err
    assert not list(tmp_path.iterdir())
    assert "--scenario names none" in run(capsys, *PROPOSE[:4])[2]


def test_who_is_named_twice_is_asked_once_and_doubts_are_said_at_once(tmp_path, capsys):
    file = tmp_path / "g.json"
    status, out, err = run(capsys, *PROPOSE, SCENARIO, "--agent", TURNS, TURNS, "--out", file)
    assert (status, "1 goals, 2 alternatives" in out) == (0, True)
    assert "stands still, perhaps parked" in err
    assert run(capsys, "goals", "check", file, "--data", "synthetic")[0] == 0
