"""The command line as a user meets it: help for every verb, one line for every mistake."""

import errno
import io
import json
import os
import re
import shutil
import subprocess
import sys
import typing
from dataclasses import replace
from functools import wraps
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch

import rlftsim as rs
from rlftsim import __version__
from rlftsim.cli.completion import SCRIPT
from rlftsim.cli.main import VERBS, main, parse
from rlftsim.errors import PERMISSION_WAY_OUT
from rlftsim.policies.registry import load_policy
from rlftsim.policies.smart.config import smart_demo
from rlftsim.policies.smart.policy import SmartPolicy
from rlftsim.rollout.baselines import ConstantVelocity
from rlftsim.scenario.dataset import SYNTHETIC
from rlftsim.scenario.maneuver import BENCHMARK_MANEUVERS
from rlftsim.scenario.open import open_dataset
from rlftsim.scenario.synthetic import pack_path
from rlftsim.tokens.vocabulary import Vocabulary
from rlftsim.training.run_folder import read_metrics
from rlftsim.verbs.goals import Choice


def run(capsys, *arguments) -> tuple[int, str, str]:
    """Exit status, standard output and standard error of a command line."""
    try:
        status = main([str(a) for a in arguments])
    except SystemExit as stop:  # what the command line itself does not understand
        status = int(stop.code or 0)
    captured = capsys.readouterr()
    return status, captured.out, captured.err


def settings(section, **values) -> list[str]:
    """Flags of a section, such as --finetune.learning-rate 1e-5."""
    return [word for name, value in values.items() for word in (f"--{section}.{name.replace('_', '-')}", str(value))]


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


def test_the_version_is_printed(capsys):
    assert run(capsys, "--version") == (0, f"rlftsim {__version__}\n", "")


def test_a_shell_completes_verbs_actions_flags_and_names_of_files(tmp_path):
    (tmp_path / "rlftsim").write_text(f'#!/bin/sh\nexec {sys.executable} -m rlftsim "$@"\n')
    (tmp_path / "rlftsim").chmod(0o755)
    script = """
        eval "$(rlftsim --completion bash)"
        try() { COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); _rlftsim; echo "${COMPREPLY[@]}"; }
        try rlftsim eva; try rlftsim submit b; try rlftsim finetune smart-demo --finetune.kl.t; try rlftsim evaluate ru
    """
    environment = {**os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}"}
    done = subprocess.run(["bash", "-c", script], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == ["evaluate", "build", "--finetune.kl.target", ""]
    assert "\ncomplete -o default -F _rlftsim rlftsim\n" in SCRIPT  # nothing fits: names of files


@pytest.mark.parametrize("words", [[], ["--help"], ["--version"], ["score", "--help"]])
def test_help_on_a_full_disk_ends_in_one_line(words):
    with open("/dev/full", "w") as full:
        done = subprocess.run([sys.executable, "-m", "rlftsim", *words], stdout=full, stderr=subprocess.PIPE, text=True)
    assert (done.returncode, done.stderr) == (1, "rlftsim: the disk is full: free some space and repeat the command.\n")


def test_a_misspelled_verb_is_guessed(capsys):
    status, _, err = run(capsys, "finetun")
    assert (status, err) == (2, "rlftsim: no verb 'finetun': did you mean finetune?\n")


@pytest.fixture
def vocabulary(tmp_path, capsys):
    """A small vocabulary file made by the command."""
    path = tmp_path / "vocabulary.safetensors"
    small = ["--tokens.num-tokens", "32", "--tokens.num-map-prototypes", "8"]
    arguments = ["tokens", "--data", "synthetic", "--split", "validation", "--out", path, "--recipe", "smart-demo"]
    status, out, _ = run(capsys, *arguments, *small)
    assert status == 0
    assert "32 vehicle, " in out
    assert "8 map pieces" in out
    assert (tmp_path / "vocabulary.report" / "picture.png").exists()
    return path


def test_a_vocabulary_can_be_looked_at_again(vocabulary, tmp_path, capsys):
    arguments = ["tokens", "--data", "synthetic", "--split", "validation", "--check", vocabulary]
    status, out, _ = run(capsys, *arguments, "--report", tmp_path / "other", "--tokens.max-scenarios", "2")
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


def test_a_file_that_is_no_evaluation_is_never_replaced(evaluation, tmp_path, capsys):
    damaged, foreign = tmp_path / "d" / "damaged.parquet", tmp_path / "d" / "tracks.parquet"
    foreign.parent.mkdir()
    pq.write_table(pa.table({"track": [1, 2]}), foreign)
    damaged.write_bytes(evaluation.read_bytes()[:-100])
    for path, cause in ((foreign, "not an evaluation of this version"), (damaged, "cannot be read (.*)")):
        before = path.read_bytes()
        status, _, err = run(
            capsys, "evaluate", "oracle", "--data", "synthetic", "--limit", "1", "--out", path.parent,
            "--name", path.stem,
        )  # fmt: skip
        assert (status, len(err.splitlines())) == (2, 1)
        assert re.search(rf"{path} is in the way \({cause}\): choose another --out, or remove the file", err)
        assert path.read_bytes() == before


@pytest.mark.parametrize(
    "words",
    [
        "evaluate oracle --data synthetic --limit 1 --out OUT",
        "simulate constant_velocity --data synthetic --limit 1 --out OUT",
        "convert OUT destination",
        "score OUT --data synthetic",
        "finetune smart-demo --model demo-base --data synthetic --out OUT",
        "submit build constant_velocity --data synthetic --i-comply --out OUT",
        "join simulate constant_velocity --data synthetic --out OUT",
    ],
)
def test_a_path_that_is_no_text_is_refused_in_one_line(words, tmp_path, capsys):
    out = tmp_path / os.fsdecode(b"ev\xff")
    status, _, err = run(capsys, *words.replace("OUT", str(out)).split())
    assert status == 2
    assert err.endswith("ev\\udcff' is no text in UTF-8: rename the file or folder.\n")
    assert len(err.splitlines()) == 1
    assert not out.exists()


WRONG = {
    "a data set that is not there": ("data stats {tmp}/nothing", "nothing is no data set.*no such folder"),
    "a folder that is no data set": ("data verify {tmp}", "is no data set: it has no manifest.json"),
    "a damaged manifest": ("data stats {tmp}/broken", "manifest.json: not JSON, line 1"),
    "an unfinished conversion": ("data stats {tmp}/unfinished", "was not finished: run the same convert command again"),
    "an unknown split": (
        "simulate constant_velocity --data synthetic --out {tmp}/o --split tests",
        "no split 'tests', only testing, training, validation",
    ),
    "an unknown split to train on": (
        "tokens --data synthetic --out {tmp}/v --split tests",
        "no split 'tests', only testing, training, validation",
    ),
    "an unknown split to evaluate": (
        "evaluate oracle --data synthetic --out {tmp}/o --split tests",
        "no split 'tests', only testing, training, validation",
    ),
    "an unknown scenario": (
        "simulate constant_velocity --data synthetic --out {tmp}/o --scenario nobody",
        "no scenario nobody in split 'validation'",
    ),
    "an unknown model": (
        "evaluate {tmp}/no-model --data synthetic --out {tmp}/o",
        "no-model' is neither a model folder nor one of constant_velocity, ",
    ),
    "a folder that is no model": (
        "simulate {tmp} --data synthetic --out {tmp}/o",
        "not a model folder, config.json is missing",
    ),
    "a model to fine-tune that is not there": (
        "finetune smart-demo --model {tmp}/no-model --data synthetic --out {tmp}/o",
        "is neither a model folder",
    ),
    "a baseline to fine-tune": (
        "finetune smart-demo --model constant_velocity --data synthetic --out {tmp}/o",
        "ConstantVelocity has no weights",
    ),
    "a baseline to pre-train": (
        "pretrain smart-demo --data synthetic --out {tmp}/o --init-from constant_velocity",
        "this recipe makes SMART policies, none like a ConstantVelocity",
    ),
    "a vocabulary that is not there": (
        "pretrain smart-demo --data synthetic --out {tmp}/o --vocabulary {tmp}/v",
        "no such vocabulary: build one with",
    ),
    "a vocabulary that is none": (
        "pretrain smart-demo --data synthetic --out {tmp}/o --vocabulary {tmp}/garbage",
        "damaged vocabulary",
    ),
    "a field that does not exist": (
        "tokens --data synthetic --out {tmp}/v --tokens.num-token 5",
        "no flag --tokens.num-token: did you mean --tokens.num-tokens",
    ),
    "a field with the name of no other": (
        "tokens --data synthetic --out {tmp}/v --tokens.zzz 5",
        "no flag --tokens.zzz: `--help` lists them all",
    ),
    "a mistyped flag": ("evaluate oracle --date synthetic --out {tmp}/o", "no flag --date: did you mean --data"),
    "a mistyped recipe": (
        "finetune smart-tinny --model {tmp} --data synthetic --out {tmp}/o",
        "unknown recipe 'smart-tinny': did you mean 'smart-tiny'",
    ),
    "a flag that is missing": ("evaluate oracle --data synthetic", "missing: --out"),
    "an action that does not exist": ("data veriy synthetic", "no action veriy: did you mean verify"),
    "a choice of a flag that may be left out": (
        "convert a b --window frist",
        "--window frist: expected one of 'av2', 'both', 'first', 'last'.",
    ),
    "a choice that does not exist": ("convert a b --on-error wait", "--on-error wait: expected one of 'skip', 'stop'"),
    "a value that is missing": ("evaluate oracle --out", "--out needs a value"),
    "a value of the wrong kind": (
        "tokens --data synthetic --out {tmp}/v --tokens.num-tokens few",
        "--tokens.num-tokens few: expected a whole number",
    ),
    "a value out of range": (
        "tokens --data synthetic --out {tmp}/v --tokens.num-tokens 1",
        "tokens: .* needs num_tokens >= 2",
    ),
    "a vocabulary neither to build nor to look at": (
        "tokens --data synthetic",
        "either --out FILE, to build a vocabulary, or --check FILE",
    ),
    "a vocabulary to look at that is not there": (
        "tokens --data synthetic --check {tmp}/v.safetensors",
        "no such vocabulary: build one with",
    ),
    "a vocabulary to look at that is none": ("tokens --data synthetic --check {tmp}/garbage", "damaged vocabulary"),
    "tables to look at that are none": (
        "tokens --data synthetic --check {tmp}/garbage.npz",
        "not an npz of token tables",
    ),
    "tables in an empty file": ("tokens --data synthetic --check {tmp}/empty.npz", "not an npz of token tables"),
    "a vocabulary of another format": (
        "tokens --data synthetic --out {tmp}/v.npz",
        "v.npz: vocabularies are safetensors files: name it .*v.safetensors",
    ),
    "a vocabulary in place of something else": (
        "tokens --data synthetic --out {tmp}/garbage",
        "exists and is not a vocabulary: name another --out",
    ),
    "rollouts of an unknown model": (
        "simulate constant_velocity --data synthetic --out {tmp}/whose",
        "rollouts.json: not JSON.*: name another --out",
    ),
    "a flag of a forecast that was not asked for": ("doctor --nodes 4", "--nodes has no effect: add --plan evaluate"),
    "an unknown metric": (
        "evaluate oracle --data synthetic --out {tmp}/o --metric 1999",
        "Unknown metric '1999': known are 2025",
    ),
    "no rollouts": (
        "evaluate oracle --data synthetic --out {tmp}/o --num-rollouts 0",
        "--num-rollouts must be at least 1, got 0",
    ),
    "no rollouts to simulate": (
        "simulate constant_velocity --data synthetic --out {tmp}/o --num-rollouts 0",
        "--num-rollouts must be at least 1, got 0",
    ),
    "no processes to convert with": ("convert {tmp} {tmp}/o --jobs 0", "--jobs must be at least 1, got 0"),
    "fewer processes than none": ("synthesize {tmp}/o --jobs -1", "--jobs must be at least 1, got -1"),
    "no scenarios to make": ("synthesize {tmp}/o --num-scenarios 0", "--num-scenarios must be at least 1, got 0"),
    "no scenarios to score": ("score {tmp} --data synthetic --limit 0", "limit must be at least 1, got 0"),
    "no seeds": ("experiment benchmark --out {tmp}/o --seeds 0", "--seeds must be at least 1, got 0"),
    "no rollouts to sample goals from": (
        "augment {tmp} --data synthetic --out {tmp}/o --num-rollouts 0",
        "num_rollouts must be (positive|at least 1)",
    ),
    "settings that are not there": (
        "finetune smart-demo --model {tmp} --data synthetic --out {tmp}/o --config {tmp}/no.json",
        "no.json: no such file",
    ),
    "settings that are not JSON": (
        "finetune smart-demo --model {tmp} --data synthetic --out {tmp}/o --config {tmp}/garbage",
        "garbage: not JSON",
    ),
    "settings of a goals file": (
        "finetune smart-demo --model {tmp} --data synthetic --out {tmp}/o --config {tmp}/goals.json",
        "goals.json: no setting finetune.format",
    ),
    "a temperature below zero": (
        "simulate constant_velocity --data synthetic --out {tmp}/o --temperature -1",
        "temperature must be >= 0",
    ),
    "an infinite temperature": (
        "simulate constant_velocity --data synthetic --out {tmp}/o --temperature inf",
        "temperature must be >= 0 and finite",
    ),
    "an export of another architecture": (
        "model export trafficbots-base --to catk {tmp}/x.safetensors",
        "trafficbots-base: a TrafficBotsPolicy cannot be exported",
    ),
    "top-k of a policy without categories": (
        "simulate constant_velocity --data synthetic --out {tmp}/o --top-k 3",
        "top_k 3 has no effect, as ConstantVelocity samples no decisions",
    ),
    "goals of a policy that has none": (
        "simulate constant_velocity --data synthetic --out {tmp}/o --goals {tmp}/goals.json",
        "constant_velocity is not goal-conditioned, 1 goals would have no effect",
    ),
    "a goal without its scenario": (
        "simulate constant_velocity --data synthetic --out {tmp}/o --goal 5=1,2",
        "--goal AGENT=X,Y needs one scenario",
    ),
    "a goal that is none": (
        "simulate constant_velocity --data synthetic --out {tmp}/o --scenario 9d639de83d6f5239 --goal 5=here",
        "--goal 5=here: not AGENT=X,Y",
    ),
    "a goals file that is not there": (
        "simulate constant_velocity --data synthetic --out {tmp}/o --goals {tmp}/no.json",
        "no such goals file: make one with",
    ),
    "a goal of an unknown agent": (
        "goals check {tmp}/goals.json --data synthetic",
        r"goals\[0\]: scenario 9d639de83d6f5239 has no agent 9999",
    ),
    "proposals for an unknown scenario": (
        "goals propose synthetic --scenario nobody",
        "no scenario nobody in synthetic",
    ),
    "proposals for an unknown agent": (
        "goals propose synthetic --scenario 9d639de83d6f5239 --agent 9999",
        "no agent 9999 in scenario 9d639de83d6f5239: there are ",
    ),
    "a tfrecord that is not there": ("convert {tmp}/x.tfrecord {tmp}/o", "no such file or folder"),
    "a folder without tfrecords": ("convert {tmp} {tmp}/o", "no tfrecord file in this folder"),
    "a destination that is taken": ("convert {tmp}/garbage {tmp}", "is not empty and not a data set"),
    "an evaluation that is none": ("compare {tmp}/garbage {tmp}/garbage", "garbage"),
    "an evaluation that is not there": ("compare {tmp}/a.parquet {tmp}/b.parquet", "a.parquet"),
}


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
    messages = [part for part in err.splitlines() if part.startswith("rlftsim: ")]
    assert status == 2
    assert len(messages) == 1, err
    assert "Traceback" not in err
    assert re.search(words, messages[0]), messages[0]


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


@pytest.mark.parametrize(
    ("error", "expected", "line"),
    [
        (KeyboardInterrupt(), 130, "rlftsim: stopped. The same command starts anew."),
        (
            KeyboardInterrupt("continues behind update 3"),
            130,
            "rlftsim: stopped. The same command continues behind update 3.",
        ),
        (
            OSError(errno.ENOSPC, "No space left on device", "/data/x"),
            1,
            "rlftsim: the disk is full, writing /data/x: free",
        ),
        (
            RuntimeError("write failed: No space left on device (os error 28)"),
            1,
            "rlftsim: the disk is full: free some",
        ),
        (PermissionError(errno.EACCES, "Permission denied", "/data/x"), 1, "rlftsim: Permission denied: /data/x: give"),
        (torch.OutOfMemoryError("CUDA out of memory"), 1, "rlftsim: the GPU has too little memory: lower"),
    ],
)
def test_what_stops_a_verb_is_one_line(error, expected, line, capsys, monkeypatch):
    def stop(*_, **__):
        raise error

    monkeypatch.setattr("rlftsim.verbs.data.dataset_stats", stop)
    status, _, err = run(capsys, "data", "stats", "synthetic")
    assert (status, err.strip().count("\n")) == (expected, 0)
    assert err.strip().startswith(line)


@pytest.mark.parametrize("words", ["score FOLDER --data synthetic", "convert FOLDER out", "data verify FOLDER"])
def test_a_folder_that_is_closed_to_the_user_is_named_with_the_way_out(words, tmp_path, capsys, monkeypatch):
    def guard(call, is_closed):
        def guarded(path=".", *arguments, **options):
            if is_closed(Path(str(path))):
                raise PermissionError(errno.EACCES, "Permission denied", str(path))
            return call(path, *arguments, **options)

        return guarded

    monkeypatch.setattr(os, "scandir", guard(os.scandir, lambda path: path == tmp_path))
    monkeypatch.setattr(os, "stat", guard(os.stat, lambda path: tmp_path in path.parents))
    monkeypatch.setattr(os, "access", lambda path, _: Path(path) != tmp_path)
    status, _, err = run(capsys, *words.replace("FOLDER", str(tmp_path)).split())
    assert (status, err) == (1, f"rlftsim: Permission denied: {tmp_path}: {PERMISSION_WAY_OUT}.\n")


def test_a_command_runs_what_others_have_put_around_a_verb(capsys, monkeypatch):
    recipe, seen = rs.recipe, []

    @wraps(recipe)
    def watched(*arguments, **options):
        seen.append(options)
        return recipe(*arguments, **options)

    monkeypatch.setattr("rlftsim.verbs.recipe.recipe", watched)
    assert main(["recipe", "smart-demo"]) == 0
    assert seen == [{"name": "smart-demo"}]


def test_a_bug_keeps_its_traceback(capsys, monkeypatch):
    monkeypatch.setattr("rlftsim.verbs.data.dataset_stats", lambda *_, **__: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        run(capsys, "data", "stats", "synthetic")


def test_an_evaluation_of_fewer_scenarios_never_replaces_a_larger_one(tmp_path, capsys):
    arguments = ["evaluate", "oracle", "--data", "synthetic", "--out", tmp_path, "--num-rollouts", "2"]
    assert run(capsys, *arguments, "--limit", "2")[0] == 0
    before = (tmp_path / "oracle.parquet").read_bytes()
    status, _, err = run(capsys, *arguments, "--limit", "1")
    assert (status, "oracle.parquet holds 2 scenarios, and limit=1 would replace them without 1 of these" in err) == (
        2,
        True,
    )
    assert "--name" in err
    assert (tmp_path / "oracle.parquet").read_bytes() == before
    assert run(capsys, *arguments, "--limit", "1", "--name", "brief")[0] == 0
    assert run(capsys, *arguments, "--limit", "2")[0] == 0


def test_stats_and_verify_of_the_embedded_scenarios(capsys):
    status, out, _ = run(capsys, "data", "stats", "synthetic")
    assert status == 0
    assert "160 training" in out
    assert "40 validation" in out


def test_pretraining_and_fine_tuning_by_command(vocabulary, tmp_path, capsys):
    small = settings("model", dim=16, num_heads=2, head_dim=8, num_decoder_layers=1)
    once = [*settings("pretrain", epochs=0.05, batch_size=1), "--pretrain.device.accelerator", "cpu"]
    common = ["--data", "synthetic", "--split", "validation"]
    base, tuned = tmp_path / "base", tmp_path / "tuned"
    status, out, _ = run(
        capsys, "pretrain", "smart-demo", *common, "--out", base, "--vocabulary", vocabulary, *small, *once
    )
    assert status == 0
    assert f"model: {base / 'model'}" in out
    card = (base / "model" / "README.md").read_text()
    assert "CC0" in card
    assert "40 scenarios" in card
    # trained further, by a recipe of another size
    further = ["pretrain", "smart-nano", *common, "--init-from", base, "--out", tmp_path / "further"]
    further += ["--model.max-agent-neighbors", "3"]
    assert run(capsys, *further, *once, *settings("pretrain", learning_rate=1e-9))[0] == 0
    before, after = (load_policy(folder).state_dict() for folder in (base, tmp_path / "further"))
    for name, value in before.items():
        torch.testing.assert_close(after[name], value, atol=1e-6, rtol=0)
    assert load_policy(tmp_path / "further").config == replace(load_policy(base).config, max_agent_neighbors=3)
    once = settings("finetune", epochs=0.025, batch_size=1, num_rollouts=2)
    status, out, _ = run(capsys, "finetune", "smart-demo", "--model", base, *common, "--out", tuned, *once)
    assert status == 0
    assert json.loads((tuned / "config.json").read_text())["num_rollouts"] == 2
    # the same model, fine-tuned with CAT-K
    few = settings("catk", epochs=0.05, batch_size=1, num_candidates=4)
    few += settings("catk.validation", every=1, num_scenarios=2, num_rollouts=2)
    words = ["finetune", "smart-demo", "--method", "catk", "--model", base, *common, "--out", tmp_path / "catk"]
    assert run(capsys, *words, *few)[0] == 0
    assert json.loads((tmp_path / "catk" / "config.json").read_text())["num_candidates"] == 4
    assert "CAT-K" in (tmp_path / "catk" / "model" / "README.md").read_text()
    assert len([line for line in read_metrics(tmp_path / "catk") if line["validation_rmm"] > 0]) == 2
    # the same model, trained on its own rollouts relabelled with their endpoints
    few = settings("gcsl", epochs=0.05, num_rollouts=2)
    words = ["finetune", "smart-demo", "--method", "gcsl", "--goal", "indication", "--model", base, *common]
    assert run(capsys, *words, "--out", tmp_path / "gcsl", *few)[0] == 0
    assert '"goal_logit_bias": true' in (tmp_path / "gcsl" / "model" / "config.json").read_text()
    assert "goals by indication" in (tmp_path / "gcsl" / "model" / "README.md").read_text()
    # the same model, calibrated
    few = settings("calibrate", num_scenarios=2, num_rollouts=2)
    words = [
        "finetune",
        "smart-demo",
        "--method",
        "calibrate",
        "--model",
        base,
        *common,
        "--out",
        tmp_path / "calibrated",
    ]
    assert run(capsys, *words, *few)[0] == 0
    assert (tmp_path / "calibrated" / "model" / "calibration.png").read_bytes().startswith(b"\x89PNG")
    status, out, _ = run(capsys, "model", "show", tmp_path / "calibrated")
    assert status == 0
    assert "CalibratedTokenPolicy" in out
    assert "| speed_gap_under_2s |" in out
    for run_folder in (base, tuned, tmp_path / "catk", tmp_path / "gcsl", tmp_path / "calibrated"):
        assert (run_folder / "learning_curve.png").read_bytes().startswith(b"\x89PNG")
    # the same folder with other settings is another run
    status, _, err = run(
        capsys, "finetune", "smart-demo", "--model", base, *common, "--out", tuned, *once, "--finetune.seed", "1"
    )
    assert status == 2
    assert "other settings or inputs (seed)" in err
    # a damaged checkpoint says what to do
    newest = next((tuned / "checkpoints").iterdir())
    (newest / "policy.safetensors").write_bytes(b"garbage")
    status, _, err = run(capsys, "finetune", "smart-demo", "--model", base, *common, "--out", tuned, *once)
    assert status == 2
    assert newest.name in err
    assert "cannot go on from it, delete this folder" in err


def test_simulating_again_keeps_what_is_there(tmp_path, capsys):
    arguments = ["simulate", "constant_velocity", "--data", "synthetic", "--out", tmp_path, "--num-rollouts", "2"]
    name = open_dataset("synthetic", "validation").scenario_ids[0]
    for _ in range(2):
        status, out, _ = run(capsys, *arguments, "--scenario", name)
        assert status == 0
        assert "2 rollouts of 1 scenarios" in out
    [file] = tmp_path.glob("*.npz")
    stamp = file.stat().st_mtime_ns
    run(capsys, *arguments, "--scenario", name)
    assert file.stat().st_mtime_ns == stamp


def test_a_limit_takes_the_first_scenarios_and_a_higher_one_adds_to_them(tmp_path, capsys):
    arguments = ["simulate", "constant_velocity", "--data", "synthetic", "--out", tmp_path, "--num-rollouts", "2"]
    ids = open_dataset("synthetic", "validation").scenario_ids
    for limit in (1, 3):
        assert f"2 rollouts of {limit} scenarios" in run(capsys, *arguments, "--limit", limit)[1]
        assert {path.stem for path in tmp_path.glob("*.npz")} == set(ids[:limit])
    status, _, err = run(capsys, *arguments, "--limit", "0")
    assert (status, "--limit must be at least 1, got 0" in err) == (2, True)


def npz_of_one_rollout() -> bytes:
    """A whole file of other rollouts: one in place of two."""
    file, paths = io.BytesIO(), np.zeros((1, 3, 80), np.float32)
    name = open_dataset("synthetic", "validation").scenario_ids[0]
    np.savez(file, scenario_id=name, object_ids=np.arange(3), x=paths, y=paths, z=paths, heading=paths)
    return file.getvalue()


@pytest.mark.parametrize(
    "damage",
    [
        *(lambda whole, size=size: whole[:size] for size in (0, 100, 1000)),
        lambda whole: whole[:500] + bytes(500) + whole[1000:],  # of an array: the list of contents is whole
        lambda whole: whole[:900] + bytes([whole[900] ^ 1]) + whole[901:],
        lambda _: npz_of_one_rollout(),
    ],
)
def test_rollouts_that_are_damaged_are_simulated_again(tmp_path, capsys, damage):
    arguments = ["simulate", "constant_velocity", "--data", "synthetic", "--out", tmp_path, "--num-rollouts", "2"]
    names = open_dataset("synthetic", "validation").scenario_ids[:2]
    assert run(capsys, *arguments, "--scenario", *names)[0] == 0
    cut, kept = (tmp_path / f"{name}.npz" for name in names)
    whole, stamp = cut.read_bytes(), kept.stat().st_mtime_ns
    cut.write_bytes(damage(whole))
    status, _, err = run(capsys, *arguments, "--scenario", *names)
    assert status == 0
    assert f"{cut} has to be made again: " in err
    with np.load(cut) as again, np.load(io.BytesIO(whole)) as before:
        assert again.files == before.files
        assert all(np.array_equal(again[name], before[name]) for name in again.files)
    assert kept.stat().st_mtime_ns == stamp


def test_a_folder_of_other_rollouts_is_refused(tmp_path, capsys):
    arguments = ["simulate", "constant_velocity", "--data", "synthetic", "--out", tmp_path, "--num-rollouts", "2"]
    name = open_dataset("synthetic", "validation").scenario_ids[0]
    assert run(capsys, *arguments, "--scenario", name)[0] == 0
    status, _, err = run(capsys, *arguments, "--seed", "1", "--scenario", name)
    assert status == 2
    assert "holds rollouts of constant_velocity with another seed (0, not 1): name another --out" in err


def test_shares_of_different_settings_do_not_meet_in_a_folder(tmp_path, capsys):
    words = ["simulate", "constant_velocity", "--data", "synthetic", "--limit", "2", "--num-rollouts", "1"]
    main([*words, "--out", str(tmp_path), "--share", "1/2"])
    for path in tmp_path.glob("*.npz"):
        path.unlink()  # as before the first rollouts are made
    assert main([*words, "--out", str(tmp_path), "--share", "2/2", "--seed", "1"]) == 2
    assert (
        "was begun by a share for rollouts of constant_velocity with another seed (0, not 1)" in capsys.readouterr().err
    )


@pytest.mark.parametrize(
    ("name", "cause"),
    [
        ("loop", "loop is a link that leads nowhere, not a folder: choose another folder."),
        ("link", "link is a link that leads nowhere, not a folder: choose another folder."),
        ("loop/inner", "loop/inner: its links lead nowhere: choose another folder."),
        ("pipe", "pipe is a pipe or device, not a folder: choose another folder."),
        ("", "'' is no word, as of a variable that is not set: write a value."),
        ("n" * 300, ": choose a shorter name."),
    ],
)
def test_what_can_be_no_folder_is_no_output(name, cause, tmp_path, capsys):
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "link").symlink_to("nothing")
    os.mkfifo(tmp_path / "pipe")
    out = name and str(tmp_path / name)
    assert main(["simulate", "constant_velocity", "--data", "synthetic", "--out", out]) in (1, 2)
    assert capsys.readouterr().err.endswith(f"{cause}\n")


@pytest.mark.parametrize(("name", "cause"), [("loop", "a link that leads nowhere"), ("pipe", "a pipe or device")])
@pytest.mark.parametrize("line", ["convert SOURCE OUT", "score SOURCE --data synthetic"])
def test_a_source_that_is_no_file_is_called_what_it_is(line, name, cause, tmp_path, capsys):
    (tmp_path / "loop").symlink_to("loop")
    os.mkfifo(tmp_path / "pipe")
    words = line.replace("SOURCE", str(tmp_path / name)).replace("OUT", str(tmp_path / "out"))
    assert main(words.split()) == 2
    assert f"{name}: {cause}" in capsys.readouterr().err


def test_settings_without_effect_are_refused(tmp_path, capsys):
    words = ["pretrain", "smart-demo", "--data", "synthetic", "--vocabulary", tmp_path / "v", "--out", tmp_path / "run"]
    status, _, err = run(capsys, *words, "--finetune.reward", "rloo")
    assert status == 2
    assert "--finetune.reward has no effect here: the settings of pretrain are --model.* and --pretrain.*" in err
    status, _, err = run(capsys, *words, "--keep-tokens", "vehicle")
    assert status == 2
    assert "--keep-tokens has no effect without both --init-from and --vocabulary" in err
    words = ["pretrain", "trafficbots-demo", *words[2:], "--init-from", "trafficbots-base"]
    load_policy("demo-base").vocabulary.save(tmp_path / "v")
    status, _, err = run(capsys, *words)
    assert status == 2
    assert "makes a model without a vocabulary: leave --vocabulary out" in err
    words = ["pretrain", "smart-demo", "--data", "synthetic", "--init-from", "demo-base", "--out", tmp_path / "run"]
    status, _, err = run(capsys, *words, "--model.num-heads", "2")
    assert status == 2
    assert "--model.num-heads cannot be changed with --init-from demo-base, whose weights are made for it" in err
    (tmp_path / "settings.json").write_text(json.dumps({"model": {"max_agent_neighbors": 3}}))
    for start, rest in (("--init_from", []), ("--init-from", ["--config", str(tmp_path / "settings.json")])):
        words = ["pretrain", "smart-demo", "--data", "synthetic", "--out", str(tmp_path), start, "demo-base", *rest]
        assert parse(words).values["policy"].model == load_policy("demo-base").config


def test_what_has_no_effect_on_a_method_is_refused(tmp_path, vocabulary, capsys):
    catk, every = ["--method", "catk"], ["--catk.validation.every", "1"]
    wrong = [
        (
            [*catk, "--finetune.reward", "rloo"],
            "--finetune.reward has no effect with --method catk: its settings are --catk.*",
        ),
        (
            ["--method", "rlft", "--catk.num_candidates", "4"],
            "--catk.num-candidates has no effect with --method rlft: its settings are --finetune.*",
        ),
        ([*catk, "--catk.choice", "farthest"], "expected one of 'closest', 'top_k', 'trajeglish'"),
        ([*catk, "--validation-split", "validation"], "--validation-split validation has no effect"),
        (["--validation-split", "validation"], "--validation-split validation has no effect"),
        ([*catk, *every, "--validation-split", "tests"], "no split 'tests'"),
        ([*catk, "--catk.trained", "goals"], "add --goal concat"),
        ([*catk, "--catk.goal-probability", "1"], "add --goal concat"),
        (["--method", "gcsl"], "add --goal concat"),
        (["--no-goal-logit-bias"], "--no-goal-logit-bias has no effect without goals: add --goal concat"),
        (["--method", "gcsl", "--goal", "concat", "--validation-split", "validation"], "See what was learned by"),
        (
            ["--method", "gcsl", "--goal", "concat", "--gcsl.goal-learning-rate-scale", "2"],
            "set gcsl.learning_rate",
        ),
        (["--finetune.reward", "gcft"], "needs goals: set finetune.goals.probability above 0"),
        (
            ["--finetune.goals.probability", "1"],
            "add --goal concat or --goal indication",
        ),
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


@pytest.mark.parametrize(
    ("policy", "way_out"), [("PASSIVE", "set OMP_NUM_THREADS=1"), ("ACTIVE", "set OMP_WAIT_POLICY=PASSIVE, or OMP_NUM")]
)
def test_doctor_looks_at_everything(policy, way_out, capsys, monkeypatch):
    seconds = iter([1.0, 3.0])
    monkeypatch.setattr("rlftsim.verbs.doctor.measure_work", lambda: next(seconds))
    monkeypatch.setenv("OMP_WAIT_POLICY", policy)
    status, out, _ = run(capsys, "doctor")
    assert status in (0, 1)
    for what in ("Python", "torch", "threads", "GPU", "SUMO", "environments", "disk", "synthetic scenarios"):
        assert what in out
    assert f"2 threads take 3.0 times as long as 1: {way_out}" in out


def test_doctor_names_a_folder_that_cannot_be_written_to(capsys, monkeypatch):
    monkeypatch.setattr(os, "access", lambda *_: False)
    assert "cannot be written to: work in another folder" in " ".join(run(capsys, "doctor")[1].split())


def test_a_model_folder_without_weights_or_with_garbage_is_refused_in_words(tmp_path, capsys):
    for name, content in (("config.json", bytes(range(128, 256))), ("config.json", b"3")):
        (tmp_path / name).write_bytes(content)
        status, _, err = run(capsys, "simulate", tmp_path, "--data", "synthetic", "--out", tmp_path / "out")
        assert (status, "Traceback" in err) == (2, False)
        assert "damaged model folder" in err


# ---- goals ---------------------------------------------------------------------------------------------------------

SCENARIO, TURNS = "9d639de83d6f5239", 9
"""An agent of this synthetic scenario stands before a junction and may go straight on, turn right or change lanes."""


def test_proposals_are_printed_written_and_drawn(tmp_path, capsys):
    arguments = ["goals", "propose", "synthetic", "--scenario", SCENARIO, "--agent", TURNS, "--choose", "right"]
    status, out, _ = run(capsys, *arguments, "--out", tmp_path / "g.json", "--picture", tmp_path / "g.png")
    assert status == 0
    assert "right ← goal" in out
    file = json.loads((tmp_path / "g.json").read_text())
    assert [(goal["agent"], goal["label"]) for goal in file["goals"]] == [(TURNS, "right")]
    assert {goal["label"] for goal in file["alternatives"]} == {"straight", "lane_change_left"}
    assert (tmp_path / "g.png").read_bytes().startswith(b"\x89PNG")
    status, out, _ = run(capsys, "goals", "check", tmp_path / "g.json", "--data", "synthetic")
    assert status == 0
    assert f"agent {TURNS} (vehicle, 0.0 m/s) stands still" in out
    assert out.count("stands still") == 3  # the alternatives are checked, too
    assert "1 goals in 1 scenarios, 2 alternatives, 3 doubts" in out


def test_every_maneuver_can_be_chosen():
    assert set(typing.get_args(Choice)) == {"alternative", "logged", *BENCHMARK_MANEUVERS}


class GoalConditioned(ConstantVelocity):
    """Drives the straight line to its goal."""

    is_goal_conditioned = True

    def begin(self, context, num_rollouts, goals, noise):
        state = super().begin(context, num_rollouts, goals, noise)
        targeted = goals.goal_mask[..., None] if goals is not None else False
        velocity = (
            torch.where(targeted, (goals.position - state.position) / 8.0, state.velocity) if goals else state.velocity
        )
        return replace(state, velocity=velocity)


def test_a_goal_is_given_to_the_model_and_its_outcome_is_printed(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("rlftsim.verbs.inputs.load_policy", lambda *_: GoalConditioned())
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
    assert (status, "out of reach in 8 s" in err) == (2, True)
    assert not (tmp_path / "far").exists()


def test_only_the_scenarios_of_a_goals_file_are_simulated(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("rlftsim.verbs.inputs.load_policy", lambda *_: GoalConditioned())
    run(capsys, "goals", "propose", "synthetic", "--scenario", SCENARIO, "--out", tmp_path / "g.json")
    arguments = ["simulate", "goal-seeker", "--data", "synthetic", "--out", tmp_path / "o", "--num-rollouts", "1"]
    status, out, _ = run(capsys, *arguments, "--goals", tmp_path / "g.json")
    assert status == 0
    assert [p.name for p in (tmp_path / "o").glob("*.npz")] == [f"{SCENARIO}.npz"]
    assert "lane_change_right" in out


def test_an_evaluation_with_goals_says_so_and_replaces_none_without(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("rlftsim.verbs.evaluate.load_policy_or_oracle", lambda *_: GoalConditioned())
    arguments = [
        "evaluate",
        "goal-seeker",
        "--data",
        "synthetic",
        "--out",
        tmp_path,
        "--num-rollouts",
        "2",
        "--limit",
        "1",
    ]
    status, out, _ = run(capsys, *arguments, "--goals", "logged")
    assert (status, "goal missed" in " ".join(out.split())) == (0, True)
    status, _, err = run(capsys, *arguments)
    assert (
        status,
        "goal-seeker.parquet is the result of another goals (logged, not none): choose another --name" in err,
    ) == (2, True)
    status, out, _ = run(capsys, *arguments, "--name", "free")
    assert (status, "missed" in out) == (0, False)


# ---- goals that make no sense --------------------------------------------------------------------------------------


def goals_file(path, *goals, alternatives=()):
    entries = [
        [{"scenario": SCENARIO, "agent": a, "x": x, "y": y, **more} for a, x, y, more in part]
        for part in (goals, alternatives)
    ]
    path.write_text(json.dumps({"format": "rlftsim-goals-1", "goals": entries[0], "alternatives": entries[1]}))
    return path


@pytest.fixture
def simulated(tmp_path, capsys, monkeypatch):
    """Runs `simulate` with a model that drives to its goals; returns status, output and errors."""
    monkeypatch.setattr("rlftsim.verbs.inputs.load_policy", lambda *_: GoalConditioned())
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


def test_a_goals_file_without_goals_is_refused(tmp_path, simulated):
    alone = goals_file(tmp_path / "g.json", alternatives=[(TURNS, -74.19, 19.77, {})])
    status, _, err = simulated("--goals", alone)
    assert (status, 'has no entry in "goals": move one of its 1 alternatives to "goals"' in err) == (2, True)
    file = goals_file(tmp_path / "g.json", (TURNS, -74.19, 19.77, {}))
    other = open_dataset(SYNTHETIC, "validation").scenario_ids[-1]
    status, _, err = simulated("--goals", file, "--scenario", other)
    assert (status, f"such as {SCENARIO}, none in {other}" in err) == (2, True)
    status, _, err = simulated("--goals", file, "--scenario", SCENARIO, other, SCENARIO)
    assert (status, f"scenario {other} has no goals: it is simulated without" in err) == (0, True)
    assert len(list((tmp_path / "o").glob("*.npz"))) == 2


def test_a_scenario_of_another_split_or_data_set_is_found(tmp_path, capsys, simulated):
    training = open_dataset(SYNTHETIC, "training").scenario_ids[0]
    status, _, err = simulated("--scenario", training)
    assert (status, "in split 'validation' of synthetic: it is in split 'training', add --split training" in err) == (
        2,
        True,
    )
    file = goals_file(tmp_path / "g.json", (TURNS, 0, 0, {"scenario": "nobody"}))
    for status, _, err in (simulated("--goals", file), run(capsys, "goals", "check", file, "--data", "synthetic")):
        assert (status, f"{file}: goals[0]: no scenario nobody in" in err) == (2, True)
        assert "--data names another data set" in err


def test_rollouts_of_an_unknown_model_are_refused(tmp_path, simulated):
    arguments = ["--scenario", SCENARIO, "--goal", f"{TURNS}=-74.19,19.77"]
    assert simulated(*arguments)[0] == 0
    (tmp_path / "o" / "rollouts.json").unlink()
    status, _, err = simulated(*arguments)
    assert (status, f"holds {SCENARIO}.npz but no rollouts.json" in err) == (2, True)


PROPOSE = ["goals", "propose", "synthetic", "--scenario", SCENARIO]


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--picture", "plot"], "plot: pictures are written as .png, .svg, .pdf: name the file so"),
        (["--agent", "--picture", "a.png"], "--agent needs at least one value."),
        (
            ["--agent", TURNS, "--choose", "left_uturn", "--out", "g.json"],
            "none of these agents can do left_uturn: they can do straight, right, lane_change_left (--choose)",
        ),
    ],
)
def test_proposals_that_cannot_be_are_refused(more, message, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    status, _, err = run(capsys, *PROPOSE, *more)
    assert (status, message in err) == (2, True), err
    assert not list(tmp_path.iterdir())
    assert "--scenario needs at least one value." in run(capsys, *PROPOSE[:4])[2]


def test_agents_named_twice_have_one_goal_and_doubts_are_printed_at_once(tmp_path, capsys):
    file = tmp_path / "g.json"
    status, out, err = run(capsys, *PROPOSE, SCENARIO, "--agent", TURNS, TURNS, "--out", file)
    assert (status, "1 goals, 2 alternatives" in out) == (0, True)
    assert "stands still, perhaps parked" in err
    assert run(capsys, "goals", "check", file, "--data", "synthetic")[0] == 0


# ---- terminals and texts -------------------------------------------------------------------------------------------


def test_a_terminal_without_a_sign_gets_another_one_in_its_place(tmp_path):
    words = "evaluate constant_velocity --data synthetic --limit 1 --num-rollouts 2 --out"
    done = subprocess.run(
        [sys.executable, "-m", "rlftsim", *words.split(), tmp_path],
        env={**os.environ, "PYTHONIOENCODING": "cp1252"}, capture_output=True,
    )  # fmt: skip
    assert (done.returncode, b"Traceback" in done.stderr, b"RMM" in done.stdout) == (0, False, True)


@pytest.mark.parametrize(
    "words",
    [
        ["x" * 100_000],
        ["evaluate", "constant_velocity", "--data", "synthetic", "--out", "o", "--name", "a\nb\x1b[2J" + "c" * 100_000],
        ["evaluate", "constant_velocity", "--data", "d\n\x1b[2J" * 50_000, "--out", "o"],
        ["drive", "p" * 100_000, "--data", "synthetic", "--out", "o"],
        ["finetune", "smart-demo", "--model", "m" * 100_000, "--data", "synthetic", "--out", "o"],
        ["score", "r" * 100_000, "--data", "synthetic"],
        ["convert", "s\n" * 50_000, "o"],
        ["evaluate", "constant_velocity", "--data", "synthetic", "--out", "o", "--metric", "2\n" * 50_000],
        ["evaluate", "constant_velocity", "--data", "synthetic", "--out", "o", "--seed", "9" * 100_000],
        ["evaluate", "constant_velocity", "--data", "synthetic", "--out", "o" * 100_000],
    ],
)
def test_whatever_a_user_writes_the_message_is_one_short_line(words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    status, _, err = run(capsys, *words)
    assert status in (1, 2)
    assert (err.count("\n"), err[:-1].isprintable(), len(err) < 2100) == (1, True, True), err[:300]
    assert list(tmp_path.iterdir()) == []
