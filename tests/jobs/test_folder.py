"""A folder holds one type of result, whatever the verb: others are refused before anything is written."""

import os
from pathlib import Path

import pytest

from rlftsim.cli import main
from rlftsim.errors import ConfigError, DataError
from rlftsim.evaluation.resumable import ScenarioValues, read_finished
from rlftsim.jobs.folder import (
    MARKERS,
    Lease,
    check_file,
    check_folder,
    check_name,
    find_differences,
    recognize_folder,
)
from rlftsim.jobs.items import read_stored
from rlftsim.jobs.runner import Inline
from rlftsim.policies.registry import load_policy
from rlftsim.scenario.dataset import ScenarioDataset, write_dataset
from rlftsim.scenario.synthetic import pack_path


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("folder") / "ds"
    pack = ScenarioDataset(pack_path(), "validation")
    write_dataset([pack[0], pack[1]], folder, split="validation")
    return folder


def contents(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


ENTRY = """account = "a.b@uni-x.edu"
method = "m1"
authors = ["A B"]
affiliation = "Uni X"
description = "a model"
link = "https://uni-x.edu/m1"
"""
COMMANDS = {
    "submit build": "submit build constant_velocity --data DATA --split validation --config ENTRY --i-comply --out",
    "evaluate": "evaluate constant_velocity --data DATA --num-rollouts 2 --out",
    "simulate": "simulate constant_velocity --data DATA --num-rollouts 2 --out",
    "drive": "drive constant_velocity --data DATA --traffic replay --out",
    "augment": "augment demo-base --data DATA --split validation --top-k None --out",
    "finetune": "finetune smart-demo --model demo-base --data synthetic --out",
    "experiment": "experiment oracle --out",
    "demo": "demo --quick --out",
    "studio": "studio --no-browser --out",
}


@pytest.mark.parametrize("inside", ["", "shards", "shards/validation"])
@pytest.mark.parametrize("verb", COMMANDS)
def test_no_verb_writes_into_a_data_set(verb, inside, data, tmp_path, capsys):
    (tmp_path / "entry.toml").write_text(ENTRY)
    words = COMMANDS[verb].replace("DATA", str(data)).replace("ENTRY", str(tmp_path / "entry.toml")).split()
    before = contents(data)
    assert main([*words, str(data / inside)]) == 2
    expected = "lies inside the data set" if inside else "is the folder of a data set"
    assert f"{data / inside} {expected}" in capsys.readouterr().err
    assert contents(data) == before


def test_a_link_to_a_data_set_is_one(data, tmp_path):
    (tmp_path / "link").symlink_to(data)
    with pytest.raises(DataError, match="is the folder of a data set"):
        check_folder(tmp_path / "link", "run")
    with pytest.raises(DataError, match="lies inside the data set"):
        check_folder(tmp_path / "link" / "shards" / "new", "run")


@pytest.mark.parametrize("found", MARKERS)
def test_each_type_is_recognized_and_refuses_the_others(found, tmp_path):
    for names in MARKERS[found]:
        folder = tmp_path / "-".join(names)
        folder.mkdir()
        for name in names:
            (folder / name).touch()
        assert recognize_folder(folder) == found
        check_folder(folder, found)
        for other in {*MARKERS} - {found}:
            with pytest.raises(DataError, match=f"is the folder of a {found}: choose another folder"):
                check_folder(folder, other)


def test_evaluations_lie_beside_rollouts_and_stages_inside_results(tmp_path):
    (tmp_path / "rollouts.json").touch()
    check_folder(tmp_path, "results")
    check_folder(tmp_path / "stage", "run")
    check_folder(tmp_path / "data", "data set")


def test_a_model_is_not_saved_over_a_data_set(data):
    before = contents(data)
    with pytest.raises(DataError, match="is the folder of a data set"):
        load_policy("demo-base").save_pretrained(data)
    assert contents(data) == before


def test_files_that_make_a_data_set_are_not_replaced_by_a_goals_file(data, capsys):
    scenario_id, before = ScenarioDataset(data).scenario_ids[0], contents(data)
    for name in ("manifest.json", "shards/goals.json"):
        assert main(["goals", "propose", str(data), "--scenario", scenario_id, "--out", str(data / name)]) == 2
    assert "manifest.json is part of a data set: choose another file" in capsys.readouterr().err
    assert contents(data) == before
    check_file(data / "goals.json")


@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir])
def test_what_is_no_file_in_place_of_a_result_is_refused_instead_of_waited_for(make, tmp_path):
    make(path := tmp_path / "result.json")
    values = ScenarioValues(tmp_path, ["result"], {"result": {}}, lambda _, values: values)
    for read in (
        lambda: find_differences(path, {}, "remove it"),
        lambda: read_stored(path, Path.read_bytes),
        lambda: read_finished(path, Path.read_bytes),
        lambda: Lease(path, Inline(), "works in"),
        lambda: values.read(range(1)),
    ):
        with pytest.raises(DataError, match=r"result\.json is (a folder|a pipe or device), not a file: choose another"):
            read()


@pytest.mark.parametrize("name", ["", " ", ".", "..", "a/b", "a\nb", "a\x1b[31mb", "a\\b", "x" * 300, "\udcff"])
def test_a_name_that_cannot_be_a_file_name_is_refused_in_one_line(name):
    with pytest.raises(ConfigError, match="an evaluation's name becomes a file name") as caught:
        check_name(name, "an evaluation's name")
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 300


def test_names_in_any_language_may_be_file_names():
    check_name("Größe 3, α", "an evaluation's name")
