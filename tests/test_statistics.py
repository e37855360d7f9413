"""Means and intervals against numbers worked out by hand."""

import math

import numpy as np
import pytest

from rlftsim.statistics import interval_around, mean_interval


def test_student_s_interval_of_four_values_is_as_in_the_tables():
    # 1, 2, 3, 4: variance 5/3, divided by 4; the 97.5 % quantile of t with 3 degrees of freedom is 3.18245
    found = mean_interval(np.array([1.0, 2.0, math.nan, 3.0, 4.0]))
    assert found.count == 4
    assert found.mean == 2.5
    assert found.standard_error == pytest.approx(math.sqrt(5 / 3 / 4))
    assert found.interval == pytest.approx((2.5 - 3.18245 * 0.645497, 2.5 + 3.18245 * 0.645497), abs=1e-4)
    assert found == interval_around(found.mean, found.standard_error, 4)


def test_fewer_than_two_values_have_no_interval_and_equal_ones_a_point():
    assert math.isnan(mean_interval(np.array([])).mean)
    single = mean_interval(np.array([3.0]))
    assert (single.mean, single.count) == (3.0, 1)
    assert all(map(math.isnan, (single.standard_error, *single.interval, single.p_value)))
    assert mean_interval(np.full(5, 0.5)).interval == (0.5, 0.5)
