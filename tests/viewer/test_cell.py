"""Cells of a notebook in a browser: the frame has a fixed height, and the width is the reader's."""

import html
import re

import pytest

import rlftsim as rs


@pytest.fixture(scope="module")
def cells():
    scenario = rs.load_dataset("synthetic", "validation")[0]
    rollouts = rs.simulate("constant_velocity", scenario, num_rollouts=1)
    return {number: rs.show(scenario, *[rollouts] * (number - 1)) for number in (2, 3, 4)}


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [360, 600, 760, 900, 1000, 1280])
@pytest.mark.parametrize("number", [2, 3, 4])
def test_the_play_button_is_inside_of_the_frame_and_panels_stand_side_by_side(cells, number, width, scheme, browser):
    cell = cells[number]
    assert f"height:{cell.height}px" in cell._repr_html_()
    page = browser.new_page(viewport={"width": width, "height": cell.height}, color_scheme=scheme)
    page.set_content(html.unescape(re.search(r'srcdoc="(.*?)">', cell._repr_html_(), re.DOTALL)[1]))
    button, *panels = (page.locator(where).all() for where in (".play", ".panel"))
    box = button[0].bounding_box()
    assert box["x"] >= 0
    assert box["y"] >= 0
    assert box["x"] + box["width"] <= width
    assert box["y"] + box["height"] <= cell.height
    first, second = (panel.bounding_box() for panel in panels[0][:2])
    assert (first["y"] == second["y"]) == (width >= 600)
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    page.close()
