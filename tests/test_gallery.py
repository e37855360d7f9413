"""The gallery of the site: its page is the one that its script writes, and all of its pictures are there and small."""

import importlib.util
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
