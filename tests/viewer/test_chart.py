import re

import numpy as np
import pytest

from rlftsim.errors import DataError
from rlftsim.viewer.chart import Chart, Curve, chart_html, format_tick, nice_ticks


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        (0.0, 1.0, [0, 0.2, 0.4, 0.6, 0.8, 1]),
        (0.689, 0.713, [0.69, 0.695, 0.7, 0.705, 0.71]),
        (-3.0, 12.0, [-2.5, 0, 2.5, 5, 7.5, 10]),
    ],
)
def test_ticks_are_round_numbers_inside_the_limits(low, high, expected):
    assert nice_ticks(low, high, 5) == pytest.approx(expected)


def test_tick_labels_have_the_digits_they_need():
    assert [format_tick(v, 0.005) for v in (0.69, 0.695)] == ["0.690", "0.695"]
    assert format_tick(-2.5, 2.5) == "−2.5"
    assert format_tick(20000.0, 5000.0) == "20\u202f000"
    assert format_tick(0.0025, 0.0025) == "0.0025"


def test_few_points_are_dots_on_a_line_and_many_a_line_alone():
    few = chart_html(Chart("Loss", "update", "nats", [Curve("a", range(5), range(5))]))
    many = chart_html(Chart("Loss", "update", "nats", [Curve("a", range(50), range(50))]))
    assert (few.count("<circle"), many.count("<circle")) == (5, 0)
    assert few.count('class="curve"') == many.count('class="curve"') == 1


def test_chart_has_axis_labels_and_escapes_them():
    html = chart_html(
        Chart("KL & beta", "update <n>", "KL [nats]", [Curve("a<b", [1, 2], [3, 4]), Curve("c", [1], [2])])
    )
    assert "KL &amp; beta" in html
    assert "update &lt;n&gt;" in html
    assert "KL [nats]" in html
    assert "a<b" not in html


@pytest.mark.parametrize(
    "values", [[], [float("nan")] * 3, [0.0, 0.0, 0.0], [5.0], [1e-300, 1e300, 1.0], [1e6, 1e6 + 1]]
)
def test_odd_values_never_break_a_chart(values):
    html = chart_html(Chart("t", "x", "y", [Curve("a", range(len(values)), values)], reference=("target", 0.5)))
    assert not re.search(r"\bnan\b|\binf\b", html)


def test_gaps_are_left_out():
    html = chart_html(Chart("t", "x", "y", [Curve("a", [0, 1, 2], [1.0, float("nan"), 3.0])]))
    assert html.count("<circle") == 2


def test_thousands_of_points_are_thinned():
    noise = np.random.default_rng(0).normal(size=50_000)
    assert len(chart_html(Chart("t", "x", "y", [Curve("a", range(50_000), noise)]))) < 80_000


def test_curve_with_unequal_lengths_is_refused():
    with pytest.raises(DataError, match="2 x values but 3 y values"):
        Curve("a", [1, 2], [1, 2, 3])
