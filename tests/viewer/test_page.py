import json
import re

import numpy as np
import pytest

from rlftsim.errors import DataError
from rlftsim.viewer.page import Animation, Panel, animation_html, write_page
from rlftsim.viewer.picture import to_png
from rlftsim.viewer.scene import SceneMotion

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"


@pytest.fixture
def page(browser, animation, tmp_path):
    """The page in a browser; fails on script errors and on anything fetched over a network."""
    write_page(tmp_path / "scene.html", "Scenes", [animation])
    opened = browser.new_page(viewport={"width": 1200, "height": 900})
    errors, requests = [], []
    opened.on("pageerror", lambda error: errors.append(str(error)))
    opened.on("request", lambda request: requests.append(request.url))
    opened.goto((tmp_path / "scene.html").as_uri())
    yield opened
    opened.close()
    assert errors == []
    assert all(url.startswith(("file:", "data:")) for url in requests)


def seen_positions(page, panel):
    return page.evaluate(
        f"document.querySelector('figure.player').player.panels[{panel}].states.map(s => s && [s.x, s.y])"
    )


def test_page_loads_nothing_from_elsewhere(animation, tmp_path):
    write_page(tmp_path / "scene.html", "Scenes", [animation])
    text = (tmp_path / "scene.html").read_text()
    assert not re.search(r"""<link|<img|<iframe|@import|\b(src|href)\s*=|url\(|https?://""", text)


def test_texts_are_escaped_and_data_cannot_end_its_script(animation):
    html = animation_html(animation)
    assert "A &lt;title&gt;" in html
    assert "Base &amp; more" in html
    assert html.count("</script>") == 1


def test_embedded_data_is_valid_json(animation):
    html = animation_html(animation)
    (data,) = re.findall(r'<script type="application/json">(.*?)</script>', html, re.S)
    payload = json.loads(data)
    assert [len(panel["rollouts"]) for panel in payload["panels"]] == [1, 2]
    assert payload["panels"][0]["marks"] == [True, False]
    assert len(payload["scene"]["agents"]) == 3


def test_three_scenes_of_64_agents_and_four_rollouts_stay_under_3_mb(animation):
    rng = np.random.default_rng(0)

    def restless(num_rollouts):  # accelerations of about 1 m/s² that change every 0.1 s: worse than any model
        speed = np.cumsum(rng.normal(0, 0.1, (num_rollouts, 64, 91, 2)), 2)
        position = np.cumsum(speed, 2) * 0.1 + rng.uniform(-80, 80, (1, 64, 1, 2))
        turning = np.cumsum(rng.normal(0, 0.05, position.shape[:3]), 2)
        return SceneMotion(position, turning, np.ones(turning.shape, bool))

    sizes = [len(json.dumps(restless(n).to_payload(), separators=(",", ":"))) for n in (1, 4, 4)]
    assert 3 * sum(sizes) < 3e6


def test_panel_of_another_scene_is_refused(animation):
    log = animation.panels[0].trajectories
    fewer = SceneMotion(log.position[:, :2], log.heading[:, :2], log.valid[:, :2])
    with pytest.raises(DataError, match="2 agents, but scene drawn has 3"):
        Animation("Scene", animation.scene, [Panel("Logged", fewer)])


def test_picture_is_a_png_of_all_panels(animation, tmp_path):
    to_png(tmp_path / "scene.png", animation, dots_per_inch=50)
    data = (tmp_path / "scene.png").read_bytes()
    assert data.startswith(PNG_SIGNATURE)
    width, height = int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")
    assert (width, height) == (2 * 4 * 50, 235)


def test_player_shows_every_panel_at_the_current_step(page):
    assert page.locator("figure.player canvas").count() == 2
    assert page.locator("[data-part=clock]").inner_text() == "+0.0 s"
    # parked car, ego, cyclist: the ego is the origin of the map frame
    assert np.allclose(seen_positions(page, 0), [[10, 0], [0, 0], [0, 5]], atol=0.01)
    assert np.allclose(seen_positions(page, 1), [[11, 0], [1, 0], [1, 5]], atol=0.01)


def test_playing_moves_the_boxes_and_pausing_stops_them(page):
    picture = "document.querySelector('canvas').toDataURL()"
    before = page.evaluate(picture)
    page.locator("[data-part=play]").click()
    page.wait_for_function("Number(document.querySelector('figure.player').dataset.step) >= 16")
    page.locator("[data-part=play]").click()
    assert page.evaluate(picture) != before
    assert seen_positions(page, 0)[1][0] >= 6
    still = page.evaluate(picture)
    page.wait_for_timeout(150)
    assert page.evaluate(picture) == still


def test_keys_and_slider_move_in_time(page):
    page.locator("figure.player").focus()
    for _ in range(5):
        page.keyboard.press("ArrowRight")
    assert np.allclose(seen_positions(page, 0)[1], [5, 0], atol=0.01)
    page.locator("[data-part=time]").fill("50")
    # the cyclist's record has ended, so it is gone; in the rollouts it goes on
    assert seen_positions(page, 0)[2] is None
    assert seen_positions(page, 1)[2] is not None
    assert page.locator(".panel-status").nth(0).inner_text() == "2 collided"
    page.keyboard.press("Home")
    assert page.locator("[data-part=clock]").inner_text() == "−1.0 s"


def test_rollout_selector_changes_only_panels_that_have_several(page):
    page.locator("[data-part=rollout]").select_option("1")
    assert np.allclose(seen_positions(page, 0)[1], [0, 0], atol=0.01)
    assert np.allclose(seen_positions(page, 1)[1], [2, 0], atol=0.01)


def test_zoom_and_drag_are_shared_by_all_panels(page):
    view = "document.querySelector('figure.player').player.view"
    start = page.evaluate(view)
    page.locator("[data-part=zoom-in]").click()
    assert page.evaluate(view)["r"] < start["r"]
    box = page.locator("canvas").nth(1).bounding_box()
    page.mouse.move(box["x"] + 100, box["y"] + 100)
    page.mouse.down()
    page.mouse.move(box["x"] + 150, box["y"] + 100, steps=3)
    page.mouse.up()
    assert page.evaluate(view)["x"] < start["x"]
    page.mouse.wheel(0, -300)
    page.wait_for_timeout(100)
    assert page.evaluate(view)["r"] < start["r"] / 1.4
    page.locator("[data-part=reset]").click()
    assert page.evaluate(view) == start


def test_pointing_at_an_agent_names_it_in_every_panel(page):
    box = page.locator("canvas").nth(0).bounding_box()
    radius = page.evaluate("document.querySelector('figure.player').player.view")
    x = box["x"] + box["width"] / 2 + (0 - radius["x"]) * box["width"] / (2 * radius["r"])
    y = box["y"] + box["height"] / 2 - (0 - radius["y"]) * box["height"] / (2 * radius["r"])
    page.mouse.move(x, y)
    assert page.locator(".panel-tip").all_inner_texts() == ["vehicle 9 · ego · 10.0 m/s"] * 2


@pytest.mark.parametrize("width", [360, 768])
def test_narrow_screens_need_no_sideways_scrolling(page, width):
    page.set_viewport_size({"width": width, "height": 700})
    assert page.evaluate("document.documentElement.scrollWidth") <= width
