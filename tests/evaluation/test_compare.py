import io
import json
import math
import re
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from rich.console import Console
from scipy import stats

from made_up import evaluation
from rlftsim.errors import ConfigError, DataError
from rlftsim.evaluation.compare import compare, compare_paired, format_comparison, format_table
from rlftsim.evaluation.results import Evaluation
from rlftsim.jobs.progress import print_wide


def render(table):
    console = Console(width=220, record=True, file=io.StringIO())
    console.print(table)
    return console.export_text()


def test_interval_and_p_value_are_those_of_a_paired_t_test():
    a, b = np.array([0.50, 0.61, 0.72, 0.43]), np.array([0.55, 0.64, 0.75, 0.50])
    row = compare(evaluation("base", a), evaluation("tuned", b))["meta_metric"]
    # differences 0.05, 0.03, 0.03, 0.07: mean 0.045, standard deviation sqrt(0.0011 / 3), t(0.975, 3) = 3.1824
    assert row.difference == pytest.approx(0.045)
    assert row.standard_error == pytest.approx(math.sqrt(0.0011 / 3) / 2)
    half = 3.182446 * math.sqrt(0.0011 / 3) / 2
    assert row.interval == pytest.approx((0.045 - half, 0.045 + half), abs=1e-6)
    assert row.p_value == pytest.approx(stats.ttest_rel(b, a).pvalue)
    assert (row.mean_a, row.mean_b) == pytest.approx((0.565, 0.61))
    assert row.verdict.startswith("difference, for the better: +0.0450, 95% interval [+0.0")


def test_scenarios_are_paired_by_id_and_the_others_counted():
    a = evaluation("base", [0.1, 0.2, 0.3], ["x", "y", "z"])
    b = evaluation("tuned", [0.5, 0.31, 0.22, 0.9], ["v", "z", "y", "u"])
    comparison = compare(a, b)
    assert (comparison.num_paired, comparison.num_only_a, comparison.num_only_b) == (2, 1, 2)
    assert comparison["meta_metric"].difference == pytest.approx(0.015)
    assert comparison.pairing == "2 scenarios in both, 1 only in base left out, 2 only in tuned left out"


def test_what_chance_explains_is_called_no_difference():
    row = compare(evaluation("a", [0.1, 0.2, 0.3]), evaluation("b", [0.2, 0.1, 0.31]))["meta_metric"]
    assert not row.is_difference
    assert row.verdict.startswith("no difference at the 5% level")


def test_a_lower_error_is_better():
    row = compare_paired("collision_rate", np.array([0.3, 0.4, 0.5]), np.array([0.2, 0.31, 0.39]))
    assert row.verdict.startswith("difference, for the better: -0.1000")
    assert compare_paired("kinematic", np.array([0.3, 0.4, 0.5]), np.array([0.2, 0.31, 0.39])).verdict.startswith(
        "difference, for the worse"
    )


def test_a_single_scenario_gives_no_verdict():
    row = compare(evaluation("a", [0.1]), evaluation("b", [0.3]))["meta_metric"]
    assert row.verdict == "no verdict: a single scenario, which differs by +0.2000."
    assert math.isnan(row.p_value)
    assert not row.is_difference


def test_no_spread_has_its_own_words():
    equal = compare(evaluation("a", [0.1, 0.2]), evaluation("b", [0.1, 0.2]))["meta_metric"]
    assert equal.verdict == "no difference: equal in all 2 scenarios."
    shifted = compare(evaluation("a", [0.1, 0.2, 0.3]), evaluation("b", [0.2, 0.3, 0.4]))["meta_metric"]
    assert shifted.verdict == "difference: +0.1000 in every one of the 3 scenarios."
    assert shifted.is_difference


def test_scenarios_without_a_value_in_both_are_left_out():
    row = compare_paired("time_to_collision_likelihood", np.array([np.nan, 0.2, 0.4]), np.array([0.1, 0.3, np.nan]))
    assert (row.count, row.mean_a, row.mean_b) == (1, 0.2, 0.3)
    neither = compare_paired("time_to_collision_likelihood", np.array([np.nan]), np.array([0.1]))
    assert neither.verdict.startswith("nothing to compare")


def test_evaluations_of_different_kinds_are_refused():
    a = evaluation("a", [0.1, 0.2])
    with pytest.raises(DataError, match="metric is 2025 and 2024"):
        compare(a, evaluation("b", [0.1, 0.2], metric="2024"))
    with pytest.raises(DataError, match="num_rollouts is 32 and 8"):
        compare(a, evaluation("b", [0.1, 0.2], num_rollouts=8))
    with pytest.raises(DataError, match="no scenario in common"):
        compare(a, evaluation("b", [0.1, 0.2], ["x", "y"]))
    with pytest.raises(ConfigError, match="alpha"):
        compare(a, a, alpha=5.0)


def test_an_interval_holds_the_truth_as_often_as_it_says():
    rng = np.random.default_rng(0)
    holds = []
    for _ in range(2000):
        a = rng.normal(size=12)
        low, high = compare_paired("kinematic", a, a + 0.3 + rng.normal(size=12), alpha=0.1).interval
        holds.append(low <= 0.3 <= high)
    assert abs(np.mean(holds) - 0.9) < 0.025  # 3.7 standard errors


def test_a_table_shows_means_errors_and_which_way_is_better():
    text = render(format_table(evaluation("base", [0.4, 0.6]), evaluation("tuned", [0.7])))
    assert "RMM ↑" in text
    assert "collision rate ↓" in text
    assert "0.5000 ± 0.1000" in text
    assert "0.7000 " in text
    assert "nan" not in text


def test_scenarios_without_a_meta_metric_are_counted_beside_the_mean():
    partly, whole = evaluation("a", [0.4, math.nan, 0.6]), evaluation("b", [0.5, 0.5, 0.5])
    assert repr(partly).startswith("a, 3 scenarios (2 with RMM) x 32 rollouts, metric 2025: RMM 0.5000 ± 0.1000")
    assert "<caption>a, 3 scenarios (2 with RMM) x" in partly._repr_html_()
    assert repr(whole).startswith("b, 3 scenarios x 32 rollouts")
    text = render(format_table(partly, whole))
    assert "3 (2 with RMM)" in text
    assert text.count("with RMM") == 1
    assert compare(partly, whole).pairing == "3 scenarios in both (2 with RMM)"


def test_a_comparison_is_shown_with_its_verdict():
    text = render(format_comparison(compare(evaluation("base", [0.4, 0.6]), evaluation("tuned", [0.5, 0.71]))))
    assert "tuned against base: 2 scenarios in both" in text
    assert "0.5000 0.6050 +0.1050" in text
    assert "+0.0415 +0.1685 0.03 better" in text


def test_a_comparison_needs_80_characters_and_nothing_is_cut(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "80")
    comparison = compare(evaluation("demo-base", [0.4, 0.6, 0.5]), evaluation("demo-tuned", [0.5, 0.71, 0.5]))
    assert len(f"{comparison['meta_metric'].cells[-2]}") == 4  # p has the digits that it mostly has
    print_wide(format_comparison(comparison), format_table(comparison.a, comparison.b))
    text = capsys.readouterr().out
    assert max(map(len, text.splitlines())) <= 80
    assert "…" not in text
    assert text.count("demo-tuned") == 3  # no name is broken
    assert text.count("RMM ↑") == 2
    assert all(line.count("0.") >= 4 for line in text.splitlines() if line.strip().startswith("RMM ↑"))


def test_words_of_a_verdict_claim_no_equality_that_was_not_shown():
    cells = {
        "better": ([0.1, 0.2, 0.3], [0.2, 0.3, 0.41]), "worse": ([0.2, 0.3, 0.41], [0.1, 0.2, 0.3]),
        "unclear": ([0.1, 0.2, 0.3], [0.2, 0.1, 0.31]), "equal": ([0.1, 0.2], [0.1, 0.2]),
    }  # fmt: skip
    for verdict, (a, b) in cells.items():
        row = compare(evaluation("a", a), evaluation("b", b))["meta_metric"]
        assert row.cells[-1] == verdict


def test_files_of_another_version_are_refused(tmp_path):
    whole = evaluation("a", [0.1])
    whole.write(tmp_path / "a.parquet")
    pq.write_table(whole.table, tmp_path / "b.parquet")
    assert Evaluation.read(tmp_path / "a.parquet").name == "a"
    with pytest.raises(DataError, match="not an evaluation of this version"):
        Evaluation.read(tmp_path / "b.parquet")
    with pytest.raises(DataError, match="no such evaluation"):
        Evaluation.read(tmp_path / "c.parquet")


def test_other_tables_and_columns_of_text_are_refused_in_one_line(tmp_path):
    pq.write_table(pa.table({"scenario_id": ["a"], "split": ["training"]}), tmp_path / "index.parquet")
    with pytest.raises(DataError, match=r"index\.parquet: not an evaluation of this version: name a file that"):
        Evaluation.read(tmp_path / "index.parquet")
    whole = evaluation("a", [0.1])
    column = whole.table.schema.get_field_index("kinematic")
    text = whole.table.set_column(column, "kinematic", pa.array(["0.5"]))
    for table, message in (
        (text, "damaged evaluation (column kinematic holds string, not double): evaluate again."),
        (whole.table.drop_columns("kinematic"), "damaged evaluation (no column kinematic): evaluate again."),
    ):
        replace(whole, table=table).write(tmp_path / "edited.parquet")
        with pytest.raises(DataError, match=re.escape(message)):
            Evaluation.read(tmp_path / "edited.parquet")


IMPOSSIBLE = {
    "meta_metric": (-5.0, "meta_metric of scenario s0 is -5, not in [0, 1]"),
    "kinematic": (float("inf"), "kinematic of scenario s0 is inf, not in [0, 1]"),
    "collision_rate": (1.5, "collision_rate of scenario s0 is 1.5, not in [0, 1]"),
    "average_displacement_error": (-1.0, "of scenario s0 is -1, not in [0, 1e+07]"),
    "speed_gap": (float("-inf"), "speed_gap of scenario s0 is -inf, not within 1e+07"),
}


@pytest.mark.parametrize("column", IMPOSSIBLE)
def test_scores_that_cannot_be_are_refused(tmp_path, column):
    value, words = IMPOSSIBLE[column]
    evaluation("a", [0.1], columns={column: [value]}).write(tmp_path / "a.parquet")
    with pytest.raises(DataError, match=re.escape(f"damaged evaluation ({'' if column in words else column}")) as error:
        Evaluation.read(tmp_path / "a.parquet")
    assert words in str(error.value)


def test_scores_of_rounding_and_of_nothing_are_read(tmp_path):
    columns = {"kinematic": [1.0 + 1e-9], "speed_gap": [-3.0], "miss_rate": [float("nan")]}
    evaluation("a", [0.1], columns=columns).write(tmp_path / "a.parquet")
    assert len(Evaluation.read(tmp_path / "a.parquet")) == 1


def empty_cell(table):
    return table.set_column(0, "scenario_id", pa.array([None], pa.string()))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda table, about: (empty_cell(table), about), "column scenario_id has empty cells"),
        (lambda table, about: (table, {**about, "name": [1]}), "its name is a list"),
        (lambda table, about: (table, {**about, "provenance": "x"}), "its provenance is text"),
        (lambda table, about: (table, {**about, "skipped": [{"scenario_id": 1, "reason": 2}]}), "is no text"),
        (lambda table, about: (table, "[" * 100_000), "brackets nested more than 64 deep"),
    ],
)
def test_a_description_that_cannot_be_is_refused_in_one_line(tmp_path, change, words):
    path = tmp_path / "a.parquet"
    evaluation("a", [0.1]).write(path)
    table = pq.read_table(path)
    table, about = change(table, json.loads(table.schema.metadata[b"rlftsim"]))
    about = about if isinstance(about, str) else json.dumps(about)
    pq.write_table(table.replace_schema_metadata({"rlftsim": about}), path)
    with pytest.raises(DataError) as error:
        Evaluation.read(path)
    assert words in str(error.value)
    assert "\n" not in str(error.value)


def test_provenance_lists_what_differs():
    one = evaluation("a", [0.1]).provenance
    assert one.differences(replace(one, dataset="/moved", config=replace(one.config, jobs=3, limit=9))) == []
    assert one.differences(replace(one, manifest_sha256="b", config=replace(one.config, seed=3))) == [
        "manifest_sha256",
        "seed",
    ]


def test_differences_and_comparisons_are_shown_in_a_line():
    comparison = compare(evaluation("base", [0.4, 0.6]), evaluation("tuned", [0.5, 0.71]))
    assert repr(comparison["meta_metric"]).startswith(
        "meta_metric: 0.5000 -> 0.6050, difference, for the better: +0.10"
    )
    assert repr(comparison).startswith("tuned against base, 2 scenarios in both; meta_metric: 0.5000 -> 0.6050")


def test_a_folder_and_a_scenario_with_two_rows_are_refused(tmp_path):
    for name in ("base", "tuned"):
        evaluation(name, [0.1, 0.2]).write(tmp_path / f"{name}.parquet")
    with pytest.raises(DataError, match=r"is a folder: name one of base\.parquet, tuned\.parquet\.$"):
        Evaluation.read(tmp_path)
    twice = evaluation("twice", [0.1, 0.2], ["x", "x"])
    for pair in ((twice, evaluation("b", [0.1], ["x"])), (evaluation("b", [0.1], ["x"]), twice)):
        with pytest.raises(DataError, match="twice: scenario x has several rows, a pair needs one"):
            compare(*pair)


def test_scenarios_of_few_street_networks_count_by_network():
    networks = [*"aaaaabbbbbcccccddddd"]
    # every scenario of a network gains alike: twenty scenarios say no more than four
    gain = np.repeat([0.01, 0.02, 0.03, 0.04], 5)
    base, tuned = np.full(20, 0.5), 0.5 + gain
    comparison = compare(evaluation("base", base, clusters=networks), evaluation("tuned", tuned, clusters=networks))
    row = comparison["meta_metric"]
    assert comparison.num_clusters == row.num_clusters == 4
    assert comparison.pairing == "20 scenarios of 4 clusters in both"
    four = compare_paired("meta_metric", np.full(4, 0.5), 0.5 + np.array([0.01, 0.02, 0.03, 0.04]))
    assert row.interval == pytest.approx(four.interval, abs=1e-3)
    assert row.count == 20
    text = render(format_comparison(comparison))
    assert "Street networks or recordings of the scenarios: 4." in text
    # the same without networks: as it always was
    plain = compare(evaluation("base", base), evaluation("tuned", tuned))
    assert (plain.num_clusters, plain.caution) == (0, "")
    assert plain["meta_metric"].interval == compare_paired("meta_metric", base, tuned).interval
    assert plain["meta_metric"].interval[0] > row.interval[0]


def test_scenarios_of_one_street_network_give_no_verdict():
    a, b = (evaluation(name, values, clusters=["a", "a"]) for name, values in (("a", [0.1, 0.2]), ("b", [0.2, 0.4])))
    row = compare(a, b)["meta_metric"]
    assert row.verdict == "no verdict: all 2 scenarios are of one cluster, whose mean differs by +0.1500."
    assert not row.is_difference


def test_the_networks_of_scenarios_are_stored_with_their_scores(tmp_path):
    evaluation("a", [0.1, 0.2, 0.3], clusters=["x", "x", ""]).write(tmp_path / "a.parquet")
    assert Evaluation.read(tmp_path / "a.parquet").clusters.tolist() == ["x", "x", "s2"]
