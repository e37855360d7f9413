"""`rlftsim report` on files of two models and the log, and comparisons of more than two."""

import json
import re
import shutil

import pytest

import rlftsim as rs
from rlftsim.cli.main import main
from rlftsim.errors import DataError
from small_things import write_synthetic

NAMES = ("constant_velocity", "demo-base", "oracle")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    write_synthetic(folder / "data")
    for name in NAMES:
        rs.evaluate(name, folder / "data", out=folder, num_rollouts=4)
    return folder


@pytest.fixture(scope="module")
def page(folder):
    """The report of the three."""
    path = rs.report([folder / f"{name}.parquet" for name in NAMES], out=folder / "report", num_listed=1)
    return path.read_text()


def test_the_index_begins_with_the_scenario_that_lacks_most_of_the_score_of_the_log(folder, page):
    _, judged, oracle = (rs.Evaluation.read(folder / f"{name}.parquet") for name in NAMES)
    index = page.partition("Scenarios, those in which demo-base loses most first")[2]
    rows = re.findall(r'<tr><th scope="row">(\w+)</th>(.*?)</tr>', index)
    lost = dict(zip(judged.scenario_ids, oracle["meta_metric"] - judged["meta_metric"]))
    assert [scenario_id for scenario_id, _ in rows] == sorted(lost, key=lambda scenario_id: -lost[scenario_id])
    for scenario_id, cells in rows:
        assert f"<td>{lost[scenario_id]:.4f}</td>".replace("-", "−") in cells


def test_the_worst_and_the_most_changed_scenario_have_a_film_and_a_page_for_each_model(folder, page):
    links = dict.fromkeys(re.findall(r'href="([^"]+)"', page))
    assert {link.rpartition(".")[2] for link in links} == {"html", "mp4"}
    assert all((folder / "report" / link).stat().st_size > 10_000 for link in links)
    assert sorted(f"scenarios/{path.name}" for path in (folder / "report" / "scenarios").iterdir()) == sorted(links)
    assert len(links) in (3, 6)  # two models and a film, of one scenario or of two


def test_the_page_of_a_score_explains_this_score(folder, page):
    for address, score in re.findall(r'href="([^"]+-[12]\.html)">([\d.]+)<', page):
        text = (folder / "report" / address).read_text()
        assert f"4 rollouts reach a meta-metric of {score} " in text
        assert f"{NAMES[int(address[-6]) - 1]}</h1>" in text


def test_all_models_are_in_the_table_and_against_the_first(page):
    for words in ("<h1>demo-base against constant_velocity</h1>", "what a perfect simulator would score"):
        assert words in page
    assert "Oracle against" not in page
    assert page.count("<canvas") == 2 * 3  # the log and two models: the scenario that gained most, and a middle one


@pytest.mark.parametrize("options", [{"num_rollouts": 2}, {"metric": "2024"}])
def test_the_score_of_the_log_is_of_the_same_rollouts_and_metric(folder, tmp_path, options):
    oracle = rs.evaluate("oracle", folder / "data", limit=1, **{"num_rollouts": 4, **options})
    with pytest.raises(DataError, match=f"oracle cannot be compared, {next(iter(options))} is"):
        rs.report([folder / "constant_velocity.parquet", oracle], out=tmp_path)


def test_a_row_of_fewer_scenarios_says_how_many(folder, tmp_path):
    oracle = rs.evaluate("oracle", folder / "data", limit=1, num_rollouts=4)
    page = rs.report([folder / "constant_velocity.parquet", oracle], out=tmp_path, num_listed=0).read_text()
    assert "what a perfect simulator would score, scenarios: 1" in page


def test_a_single_evaluation_needs_no_list(folder, tmp_path):
    path = folder / "oracle.parquet"
    for number, result in enumerate((path, str(path), rs.Evaluation.read(path))):
        assert "<h1>oracle</h1>" in rs.report(result, out=tmp_path / str(number)).read_text()


def test_models_that_are_no_shipped_ones_are_named_and_recognized_by_their_weights(folder, tmp_path, capsys):
    evaluation = rs.Evaluation.read(folder / "demo-base.parquet")
    rs.Evaluation("mine", evaluation.provenance, evaluation.table).write(tmp_path / "mine.parquet")
    words = ["report", str(tmp_path / "mine.parquet"), "--out", str(tmp_path / "out"), "--num-listed", "1"]
    assert main(words) == 0
    captured = capsys.readouterr()
    assert captured.out == f"report: {tmp_path}/out/report.html\n"
    assert "mine: no pages, its model is not at hand: name it with --models" in captured.err
    assert "href" not in (tmp_path / "out" / "report.html").read_text()
    assert main([*words, "--models", "demo-tuned"]) == 2
    assert "demo-tuned: none of the evaluations is of this model" in capsys.readouterr().err
    assert main([*words, "--models", "demo-base"]) == 0
    assert (tmp_path / "out" / "report.html").read_text().count("href") == 2


def test_data_that_moved_are_named_and_other_data_are_refused(folder, tmp_path, capsys):
    shutil.copytree(folder / "data", tmp_path / "data")
    evaluation = rs.evaluate("constant_velocity", tmp_path / "data", num_rollouts=2, name="moved")
    (tmp_path / "data").rename(tmp_path / "elsewhere")
    evaluation.write(tmp_path / "moved.parquet")
    words = ["report", str(tmp_path / "moved.parquet"), "--models", "constant_velocity", "--out", str(tmp_path / "out")]
    assert main(words) == 0
    assert "no pages and films" in capsys.readouterr().err
    assert main([*words, "--data", "synthetic"]) == 2
    assert "synthetic: moved was evaluated on other scenarios" in capsys.readouterr().err
    assert main([*words, "--data", str(tmp_path / "elsewhere")]) == 0
    assert (tmp_path / "out" / "scenarios").is_dir()


def test_runs_show_their_curves_and_settings(folder, tmp_path, capsys):
    run = tmp_path / "tuned"
    run.mkdir()
    (run / "environment.json").write_text("{}")
    (run / "config.json").write_text(json.dumps({"epochs": 2, "learning_rate": 1e-5, "num_rollouts": 8}))
    line = {"rmm": 0.5, "reward_std": 0.1, "kl": 0.01, "beta": 1.0, "offroad_rate": 0.1, "collision_rate": 0.0}
    lines = [json.dumps({"update": update, **line}) for update in (1, 2)]
    (run / "metrics.jsonl").write_text("\n".join(lines) + "\n")
    words = ["report", str(folder / "oracle.parquet"), "--out", str(tmp_path / "out"), "--run"]
    assert main([*words, str(run)]) == 0
    text = (tmp_path / "out" / "report.html").read_text()
    assert "Training: tuned" in text
    assert "2 updates, epochs 2, num rollouts 8, learning rate 1e-05" in text
    assert "Training rollouts come in groups of 8" in text
    assert main([*words, str(tmp_path / "nothing")]) == 2
    assert "nothing is no training run" in capsys.readouterr().err


def test_further_evaluations_are_each_compared_with_the_first(folder, capsys):
    paths = [folder / f"{name}.parquet" for name in NAMES]
    compared = rs.compare(paths[0], paths[1], [paths[2]])
    assert [(c.a.name, c.b.name) for c in compared] == [(NAMES[0], NAMES[1]), (NAMES[0], NAMES[2])]
    assert main(["compare", *map(str, paths)]) == 0
    out = capsys.readouterr().out
    assert out.index("demo-base against constant_velocity") < out.index("oracle against constant_velocity")
