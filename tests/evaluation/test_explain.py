import numpy as np
import pytest
from rollout_drawing import draw_arrays, write_npz

import scenes
from rlftsim.cli.main import main
from rlftsim.evaluation import explain_page
from rlftsim.evaluation.explain import WHOLE_FUTURE, explain
from rlftsim.evaluation.explain_page import explain_rollouts, explanation_html
from rlftsim.evaluation.rollout_files import find_rollouts, read_states
from rlftsim.evaluation.score_files import ScoreConfig
from rlftsim.realism import METRIC_2023, METRIC_2025, SimulatedStates
from rlftsim.realism.config import FEATURE_NAMES
from rlftsim.realism.from_rollouts import logged_states
from rlftsim.scenario.dataset import write_dataset


@pytest.fixture(scope="module")
def scenario():
    return scenes.junction_with_light()


@pytest.fixture(scope="module")
def states(scenario, tmp_path_factory):
    path = write_npz(tmp_path_factory.mktemp("explain") / "a.npz", draw_arrays(scenario))
    return read_states(find_rollouts(path)[0])


@pytest.mark.parametrize("config", [METRIC_2025, METRIC_2023])
def test_costs_add_up_to_what_lies_between_score_and_ceiling(scenario, states, config):
    explanation = explain(scenario, states, config)
    assert explanation.cost.shape == (10, len(scenario.evaluated_indices), 81)
    assert explanation.cost.sum() == pytest.approx(explanation.lost, abs=1e-6)
    weights = np.array(config.weights)
    by_feature = weights * (explanation.ceiling.likelihoods - explanation.result.likelihoods).numpy()
    assert explanation.cost.sum((1, 2)) == pytest.approx(by_feature, abs=1e-6)


def test_the_oracle_loses_nothing(scenario):
    explanation = explain(scenario, logged_states(scenario, num_rollouts=4))
    assert explanation.lost == 0
    assert not explanation.cost.any()


def test_an_agent_that_leaves_the_road_pays_for_it(scenario, states):
    ego = int(np.searchsorted(scenario.simulated_indices, scenario.ego_index))
    y = states.y.clone()
    y[:, ego, 40:] += 500.0
    explanation = explain(scenario, SimulatedStates(states.object_id, states.x, y, states.z, states.heading))
    (row,) = (k for k, name in enumerate(explanation.agent_names) if "ego" in name)
    off_road, edge = FEATURE_NAMES.index("offroad_indication"), FEATURE_NAMES.index("distance_to_road_edge")
    assert explanation.cost[off_road, :, WHOLE_FUTURE].argmax() == row
    assert explanation.events[1, :, row, 40:44].all()
    assert explanation.cost[edge, row, :WHOLE_FUTURE].sum() > 0


def test_histograms_are_fractions_over_the_official_bins(scenario, states):
    for histogram in explain(scenario, states).histograms:
        assert len(histogram.edges) == len(histogram.log_fraction) + 1
        assert histogram.log_fraction.sum() == pytest.approx(1)
        assert histogram.rollout_fraction.sum() == pytest.approx(1)


def test_the_page_needs_no_network_and_names_feature_agent_and_ceiling(scenario, states):
    explanation = explain(scenario, states)
    page = explanation_html(explanation)
    assert "http" not in page.replace("http://www.w3.org", "")
    for text in (f"{float(explanation.ceiling.meta_metric):.4f}", "time to collision", *explanation.agent_names):
        assert text in page


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_axe_finds_no_serious_violation(scenario, states, browser, barriers, scheme):
    page = browser.new_page(viewport={"width": 360, "height": 740}, color_scheme=scheme)
    page.set_content(explanation_html(explain(scenario, states)))
    assert page.evaluate("document.documentElement.scrollWidth") <= 360
    assert barriers(page) == []
    page.close()


def test_every_scenario_has_a_page_and_other_rollouts_another_one(scenario, tmp_path):
    write_dataset([scenario, scenes.lone_agent(), scenes.without_road_edges()], tmp_path / "data")
    (tmp_path / "rollouts").mkdir()
    for one in (scenario, scenes.lone_agent(), scenes.without_road_edges()):
        write_npz(tmp_path / "rollouts" / f"{one.scenario_id}.npz", draw_arrays(one, num_rollouts=2))
    config = ScoreConfig(jobs=1, missing_map="skip")
    pages = explain_rollouts(tmp_path / "rollouts", tmp_path / "data", tmp_path / "out", config)
    assert [page.name for page in pages] == ["junction.html", "lone.html"]
    before = pages[0].read_text()
    arrays = draw_arrays(scenario, num_rollouts=2)
    write_npz(tmp_path / "rollouts" / "junction.npz", {**arrays, "x": arrays["x"] + 3})
    explain_rollouts(tmp_path / "rollouts", tmp_path / "data", tmp_path / "out", config)
    assert pages[0].read_text() != before


def test_pages_of_several_sets_of_a_scenario_are_numbered(scenario, tmp_path):
    write_dataset([scenario], tmp_path / "data")
    for policy in "abc":
        (tmp_path / "rollouts" / policy).mkdir(parents=True)
        write_npz(tmp_path / "rollouts" / policy / "s.npz", draw_arrays(scenario, num_rollouts=2))
    pages = explain_rollouts(tmp_path / "rollouts", tmp_path / "data", tmp_path / "out", ScoreConfig(jobs=1))
    assert [page.name for page in pages] == ["junction.html", "junction-2.html", "junction-3.html"]


def killed_after_the_first(function):
    """The function, which ends the process in the middle of its second call, or of its first file."""
    calls = []

    def call(path, rest):
        calls.append(path)
        if function.__name__ == "remove_folder":
            function(path, list(rest)[:1])
            raise KeyboardInterrupt
        if len(calls) == 2:
            path.with_name(f".{path.name}.machine.12.tmp").write_text("cut short")  # as SIGKILL leaves it
            raise KeyboardInterrupt
        return function(path, rest)

    return call


def test_pages_by_shares_and_after_an_interruption_are_the_same(scenario, tmp_path, capsys, monkeypatch):
    write_dataset([scenario, scenes.lone_agent(), scenes.without_road_edges()], tmp_path / "data")
    (tmp_path / "rollouts").mkdir()
    for logged in (scenario, scenes.lone_agent(), scenes.without_road_edges()):
        write_npz(tmp_path / "rollouts" / f"{logged.scenario_id}.npz", draw_arrays(logged, num_rollouts=2))

    def words(out):
        folders = ["--out", str(tmp_path / out), "--explain", str(tmp_path / out / "pages")]
        return [
            "score",
            str(tmp_path / "rollouts"),
            "--data",
            str(tmp_path / "data"),
            *folders,
            "--missing-map",
            "skip",
        ]

    def files(out):
        paths = (path for path in (tmp_path / out / "pages").rglob("*") if path.is_file())
        return {path.relative_to(tmp_path / out).as_posix(): path.read_bytes() for path in paths}

    assert main([*words("whole"), "--jobs", "1"]) == 0
    assert sorted(files("whole")) == ["pages/junction.html", "pages/lone.html"]
    # a share that ends first leaves all to the last one
    assert main([*words("shared"), "--jobs", "1", "--share", "1/2"]) == 0
    assert "explain: share 1/2 is done; 1 of 3 pieces are left" in capsys.readouterr().err
    assert not (tmp_path / "shared" / "pages" / "junction.html").exists()
    [page] = (tmp_path / "shared" / "pages").rglob("junction.html")
    page.write_bytes(page.read_bytes()[:-1000])
    assert main([*words("shared"), "--jobs", "1", "--share", "2/2"]) == 0
    assert "junction.html has to be made again: its end is missing" in capsys.readouterr().err
    assert main([*words("shared"), "--jobs", "1", "--share", "1/2"]) == 0
    assert files("shared") == files("whole")
    # killed while the finished pages are put in their places, and while the rest is cleared away
    for name in ("write_atomically", "remove_folder"):
        assert main([*words(name), "--jobs", "1", "--share", "1/2"]) == 0
        with monkeypatch.context() as patch:
            patch.setattr(explain_page, name, killed_after_the_first(getattr(explain_page, name)))
            assert main([*words(name), "--jobs", "1", "--share", "2/2"]) == 130
        assert main([*words(name), "--jobs", "1", "--share", "2/2"]) == 0
        assert files(name) == files("whole")
        # a share that is repeated behind the end has nothing to do
        assert main([*words(name), "--jobs", "1", "--share", "1/2"]) == 0
        assert files(name) == files("whole")
    # the second page fails; the first is not made again
    explained, original = [], explain_page.explain

    def failing(logged, states, config):
        explained.append(logged.scenario_id)
        if len(explained) == 2:
            raise KeyboardInterrupt
        return original(logged, states, config)

    monkeypatch.setattr(explain_page, "explain", failing)
    assert main([*words("cut"), "--jobs", "1"]) == 130
    assert main([*words("cut"), "--jobs", "1"]) == 0
    assert explained == ["junction", "lone", "lone"]
    assert files("cut") == files("whole")
