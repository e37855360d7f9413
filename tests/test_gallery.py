"""Pictures of the site: the gallery is what its script writes, all are small, and the chart shows the table."""

import importlib.util
import re
from pathlib import Path

import pytest
from PIL import Image

DOCS = Path(__file__).parents[1] / "docs"


@pytest.fixture(scope="module")
def pictures():
    """The script as a module."""
    spec = importlib.util.spec_from_file_location("write_pictures", DOCS / "write_pictures.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_page_is_the_one_that_the_script_writes(pictures):
    assert (DOCS / "gallery.md").read_text() == pictures.gallery_text()


def test_there_are_twelve_pieces_of_400_kilobytes_at_most_and_films_have_a_page_that_plays(pictures):
    assert len({piece.name for piece in pictures.PIECES}) == 12
    sizes = {path.name: path.stat().st_size for path in (DOCS / "gallery").iterdir()}
    assert {f"{piece.name}.webp" for piece in pictures.PIECES} <= set(sizes)
    assert max(sizes.values()) <= 400_000
    assert sum(sizes.values()) <= 3_000_000
    for piece in pictures.PIECES:
        assert getattr(Image.open(DOCS / "gallery" / f"{piece.name}.webp"), "is_animated", False) == piece.is_film


def test_the_chart_of_the_results_has_a_mark_for_every_row_of_the_table(pictures, tmp_path):
    gains = pictures.read_gains()
    table = (DOCS / "results.md").read_text().partition("<!-- measured:begin -->")[2].partition("<!-- measured:end")[0]
    assert table.count("\n|---|") == 3
    assert 1 < len(gains) == table.count("\n|") - 2 * 3 <= 8
    assert all(line.count(" | ") == 4 for line in table.splitlines() if line.startswith("| "))
    assert all(low < gain < high for _, gain, low, high in gains)
    pictures.draw_gains(tmp_path / "chart.webp")
    with Image.open(tmp_path / "chart.webp") as drawn, Image.open(DOCS / "results.webp") as shown:
        assert drawn.size == shown.size


def test_the_live_demo_opens_on_the_scenario_that_gained_most():
    page = (DOCS / "demo" / "live.html").read_text()
    scores = [float(score) for score in re.findall(r"demo-(?:base|tuned): RMM (0\.\d+)", page)]
    gains = [tuned - base for base, tuned in zip(scores[::2], scores[1::2])]
    assert len(gains) == 6
    assert gains == sorted(gains, reverse=True)
    assert gains[0] > 0
