import re

import numpy as np
import pytest

from rlftsim.errors import DataError
from rlftsim.viewer.figure import COLORS, Band, Interval, draw_bands, draw_intervals, save_figure
from rlftsim.viewer.page import read_asset

X = np.array([2.0, 4.0, 8.0])


def test_curves_have_the_colors_of_the_page():
    light = read_asset("palette.css").split("@media")[0]
    assert re.findall(r"--series-\d: (#\w+)", light) == list(COLORS[:4])


def test_both_kinds_of_files_are_written_whole(tmp_path):
    figure = draw_intervals([Interval("a <b>", 0.1, 0.0, 0.2)], title="Gains", x_label="gain", zero=True)
    save_figure(tmp_path / "new" / "f.png", figure, dots_per_inch=40)
    save_figure(tmp_path / "new" / "f.svg", figure)
    assert (tmp_path / "new" / "f.png").read_bytes().startswith(b"\x89PNG")
    text = (tmp_path / "new" / "f.svg").read_text()
    assert "a &lt;b&gt;" in text  # words stay words
    assert "Gains" in text
    assert sorted(p.name for p in (tmp_path / "new").iterdir()) == ["f.png", "f.svg"]
    (tmp_path / "file").touch()
    with pytest.raises(DataError, match="cannot write"):
        save_figure(tmp_path / "file" / "f.png", figure)


def test_the_same_figure_is_the_same_file(tmp_path):
    for name in ("a.svg", "b.svg"):
        save_figure(tmp_path / name, draw_bands([Band("x", X, X)], title="t", x_label="x", y_label="y"))
    assert (tmp_path / "a.svg").read_text() == (tmp_path / "b.svg").read_text()


def test_a_law_is_dashed_and_what_was_measured_has_dots():
    bands = [Band("measured", X, 1 / X, 0.5 / X, 2 / X), Band("law", X, 1 / X, style="theory")]
    axis = draw_bands(bands, title="t", x_label="N", y_label="variance", log=True, ticks=(2, 4, 8)).axes[0]
    measured, law = axis.lines
    assert (measured.get_linestyle(), measured.get_marker()) == ("-", "o")
    assert (law.get_linestyle(), law.get_marker()) == ("--", "None")
    assert axis.get_xscale() == axis.get_yscale() == "log"
    assert [label.get_text() for label in axis.get_xticklabels()] == ["2", "4", "8"]
    assert len(axis.collections) == 1  # one of them has a band


def test_the_first_interval_is_on_top_and_zero_is_marked_for_differences():
    items = [Interval("first", 0.1, 0.05, 0.2), Interval("second", -0.1, -0.2, 0.0)]
    axis = draw_intervals(items, title="t", x_label="gain", zero=True).axes[0]
    low, high = axis.get_ylim()
    assert low > high  # row 0 above row 1
    assert [label.get_text() for label in axis.get_yticklabels()] == ["first", "second"]
    assert len(axis.lines) == 5
    assert len(draw_intervals(items, title="t", x_label="score", zero=False).axes[0].lines) == 4
