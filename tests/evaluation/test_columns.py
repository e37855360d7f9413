"""Columns of tables of evaluations."""

import pytest

from rlftsim.evaluation.columns import COLUMNS, GOAL_COLUMNS, SCORES, TERMINAL_GOAL_COLUMNS, find_direction
from rlftsim.evaluation.results import SCORE_COLUMNS
from rlftsim.statistics import interval_around

EVERY = {column.source: column for column in (*COLUMNS, *GOAL_COLUMNS, *TERMINAL_GOAL_COLUMNS)}


def test_columns_are_those_of_evaluations_and_have_one_heading_each():
    assert set(EVERY) <= set(SCORE_COLUMNS)
    for tables in ((*COLUMNS, *GOAL_COLUMNS), TERMINAL_GOAL_COLUMNS):
        assert all(EVERY[column.source] is column for column in tables)


def test_labels_have_unit_and_direction():
    rmm, min_ade, collision = SCORES[0], SCORES[4], SCORES[5]
    assert [rmm.label, min_ade.label, collision.label] == ["RMM ↑", "minADE [m] ↓", "collision [%] ↓"]
    assert [rmm.fraction_label, min_ade.fraction_label] == ["RMM ↑", "minADE [m] ↓"]
    assert collision.fraction_label == "collision rate ↓"
    assert find_direction("average_displacement_error") == "lower"


@pytest.mark.parametrize(
    ("source", "mean", "error", "text"),
    [
        ("meta_metric", 0.61234, 0.01, "0.6123 ± 0.0100"),
        ("min_average_displacement_error", 4.567, 0.1234, "4.57 ± 0.12"),
        ("collision_rate", 0.1234, 0.01, "12.34 ± 1.00"),
    ],
)
def test_cells_are_in_the_unit_of_the_column(source, mean, error, text):
    assert EVERY[source].cell(interval_around(mean, error, 9)) == text


def test_cells_without_a_mean_are_dashes_and_without_an_error_means():
    column = SCORES[0]
    assert column.cell(None) == column.cell(interval_around(float("nan"), 0.0, 0)) == "–"
    assert column.cell(interval_around(-0.5, 0.0, 1)) == "−0.5000"
