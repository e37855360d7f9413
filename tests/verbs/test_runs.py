"""Runs side by side: what differs is shown, and a lucky training batch is not called the best."""

import json

import pytest

from rlftsim.cli.main import main
from rlftsim.errors import DataError
from rlftsim.verbs.runs import find_differences, find_seeds, runs


def write_run(folder, settings, metrics, *, is_finished=True):
    folder.mkdir(parents=True)
    (folder / "config.json").write_text(json.dumps(settings))
    (folder / "environment.json").write_text("{}")
    lines = [json.dumps({"update": update, **values}) for update, values in enumerate(metrics, 1)]
    (folder / "metrics.jsonl").write_text("".join(f"{line}\n" for line in lines))
    if is_finished:
        (folder / "model").mkdir()
        (folder / "model" / "config.json").write_text("{}")
    return folder


def test_the_best_validation_is_listed_with_its_update(tmp_path):
    scores = [
        {"loss": 1.0},
        {"loss": 0.9, "validation_rmm": 0.74},
        {"loss": 0.8},
        {"loss": 0.7, "validation_rmm": 0.72},
    ]
    (run,) = runs([str(write_run(tmp_path / "a", {"seed": 0}, scores))])
    assert (run.measure, run.best, run.last, run.num_updates) == ("validation_rmm", (2, 0.74), 0.72, 4)


def test_the_best_is_the_validation_whose_weights_are_the_model(tmp_path):
    scores = [
        {"validation_rmm": 0.74, "validation_gain_low": 0.01},
        {"validation_rmm": 0.75, "validation_gain_low": 0.0},
    ]
    (run,) = runs([str(write_run(tmp_path / "a", {"seed": 0}, scores))])
    assert run.best == (1, 0.74)


def test_training_batches_have_a_mean_of_the_last_tenth_and_no_best(tmp_path):
    batches = [{"rmm": 0.9}] + [{"rmm": 0.5}] * 17 + [{"rmm": 0.7}, {"rmm": 0.6}]
    (run,) = runs([str(write_run(tmp_path / "a", {"seed": 0}, batches))])
    assert run.best is None
    assert run.last == pytest.approx(0.65)


def test_only_settings_that_differ_are_shown_and_none_that_changes_no_result(tmp_path, capsys):
    shared = {"batch_size": 4, "kl": {"target": 0.01}}
    write_run(tmp_path / "a", {**shared, "seed": 0, "device": {"processes": 1}}, [{"rmm": 0.7}])
    write_run(tmp_path / "b", {**shared, "seed": 1, "device": {"processes": 2}}, [], is_finished=False)
    folders = [str(tmp_path / name) for name in "ab"]
    assert find_differences(runs(folders)) == {"seed": ["0", "1"]}
    (tmp_path / "notes.txt").write_text("no run")
    assert main(["runs", *folders, str(tmp_path / "notes.txt")]) == 0
    table, differences = capsys.readouterr().out.split("setting")
    assert [line.split("│")[2].strip() for line in table.splitlines() if line.startswith("│")] == ["yes", "no"]
    assert "seed" in differences
    assert "kl.target" not in differences


def test_a_folder_without_runs_is_refused_in_one_line(tmp_path):
    with pytest.raises(DataError, match="no training run"):
        runs([str(tmp_path)])
    with pytest.raises(DataError, match="does not exist"):
        runs([str(tmp_path / "missing")])


def test_runs_that_differ_in_the_seed_alone_have_a_mean_with_its_interval(tmp_path, capsys):
    for seed, rmm in enumerate((0.70, 0.72, 0.74)):
        settings = {"seed": seed, "batch_size": 4, "initial_policy": f"drawn with {seed}"}
        write_run(tmp_path / "a" / f"seed-{seed}", settings, [{"rmm": 0.1}, {"validation_rmm": rmm}])
    write_run(tmp_path / "a" / "seed-9", {"seed": 9, "batch_size": 8}, [{"validation_rmm": 0.1}])
    write_run(tmp_path / "b" / "seed-0", {"seed": 0, "batch_size": 4}, [{"validation_rmm": 0.1}])
    folders = [str(path) for path in sorted(tmp_path.glob("*/*"))]
    (group,) = find_seeds(runs(folders))
    assert [run.folder.name for run in group] == ["seed-0", "seed-1", "seed-2"]
    assert main(["runs", *folders]) == 0
    printed = capsys.readouterr().out
    # 0.72 ± 4.303 * 0.02 / sqrt(3): Student's t of two degrees of freedom
    assert printed.count("0.72 [0.67032, 0.76968]") == 2
