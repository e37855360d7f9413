"""The page at the smallest and the largest usual screen, light and dark: nothing overlaps or is cut off."""

import io

import numpy as np
import pytest
from PIL import Image

from rlftsim.studio.server import Studio

SCENARIO = "9d639de83d6f5239"
EGO = 179
ADDRESS = f"#split=validation&id={SCENARIO}&panels=log,goals&count=4&agent={EGO}&goals={EGO}@-36.715,-2.361&run=1"
OVER = """studio.state.run && !studio.state.isRunning && studio.state.proposals
  && studio.state.variants.get("goals")?.score && Object.keys(studio.state.maneuvers).length"""
BOXES = """() => {
  const clipped = (box, element) => {
    for (let up = element; up; up = up.parentElement) {
      if (getComputedStyle(up).overflow === "visible") continue;
      const by = up.getBoundingClientRect();
      box = { left: Math.max(box.left, by.left), top: Math.max(box.top, by.top),
        right: Math.min(box.right, by.right), bottom: Math.min(box.bottom, by.bottom) };
    }
    return box;
  };
  const found = [], add = (element, name, { left, top, right, bottom }, isText) => {
    const whole = { left, top, right, bottom };
    found.push({
      name, isText, whole, seen: clipped(whole, isText ? element : element.parentElement),
      size: parseFloat(getComputedStyle(element).fontSize) * (element.currentCSSZoom || 1),
      scrolls: Boolean(element.closest(".rows, .inspector, .scroll")), says: Boolean(element.closest("[title]")),
    });
  };
  const isVisible = (element) => element.checkVisibility() && !element.closest("#speaker, option");
  for (const one of document.querySelectorAll("button, select, input, progress, #marks, .row canvas")) {
    if (isVisible(one)) add(one, `${one.tagName} ${one.id || one.textContent}`, one.getBoundingClientRect(), false);
  }
  const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  for (let node; (node = walker.nextNode());) {
    const parent = node.parentElement, range = document.createRange();
    if (!node.textContent.trim() || !isVisible(parent) || parent.closest("button, select")) continue;
    range.selectNodeContents(node);
    for (const rect of range.getClientRects()) add(parent, node.textContent.trim(), rect, true);
  }
  return found;
}"""
"""Boxes of all controls and texts: whole, and the part that scrolling or cutting leaves."""
PANELS = """() => [...document.querySelectorAll(".frame")].map((frame) => {
  const canvas = frame.querySelector("canvas"), [a, b] = [frame, canvas].map((one) => one.getBoundingClientRect());
  return [a.width, a.height, b.width, b.height, canvas.width / devicePixelRatio, canvas.height / devicePixelRatio];
})"""


@pytest.fixture(scope="module")
def address(session):
    with Studio(session) as running:
        yield running.url + ADDRESS


def area(first, second):
    """Of the part that two boxes share, a pixel off each side."""
    width = min(first["right"], second["right"]) - max(first["left"], second["left"]) - 2
    height = min(first["bottom"], second["bottom"]) - max(first["top"], second["top"]) - 2
    return max(width, 0) * max(height, 0)


def wait_for(page, condition):
    """Wait for a minute at most until the page has a scene and a condition holds; its policy forbids to poll there."""
    for _ in range(600):
        if page.evaluate(f"() => Boolean(globalThis.studio?.state.scene && {condition})"):
            return
        page.wait_for_timeout(100)
    raise AssertionError(f"never holds: {condition}")


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize(("width", "height", "smallest"), [(1280, 720, 10), (3840, 2160, 16)])
def test_nothing_overlaps_or_is_cut_off(address, browser, barriers, width, height, smallest, scheme):
    page = browser.new_page(viewport={"width": width, "height": height}, color_scheme=scheme, reduced_motion="reduce")
    page.goto(address)
    wait_for(page, f"{OVER} && document.querySelectorAll('.row').length > 5")
    page.evaluate("() => studio.timeline.seek(40)")
    page.wait_for_timeout(500)  # thumbnails
    boxes = page.evaluate(BOXES)
    assert sum(box["isText"] for box in boxes) > 60
    seen = [box for box in boxes if area(box["seen"], box["seen"]) > 0]
    overlaps = [
        (a["name"], b["name"])
        for i, a in enumerate(seen)
        for b in seen[:i]
        if a["name"] != b["name"] and area(a["seen"], b["seen"]) > 0
    ]
    assert overlaps == []
    # what is cut off can be scrolled to, or is said by a tooltip
    cut = [box["name"] for box in boxes if not (box["scrolls"] or box["says"]) and box["whole"] != box["seen"]]
    assert cut == []
    assert page.evaluate("() => [document.documentElement.scrollWidth, document.documentElement.scrollHeight]") == [
        width, height,
    ]  # fmt: skip
    sideways = "[...document.querySelectorAll('.inspector, .rows')].map((one) => one.scrollWidth - one.clientWidth)"
    assert page.evaluate(sideways) == [0, 0]
    short = "[...document.querySelectorAll('input')].filter((one) => one.scrollWidth > one.clientWidth + 1)"
    assert page.evaluate(f"{short}.map((one) => [one.id, one.value])") == []
    panels = page.evaluate(PANELS)
    assert sum(panel[0] * panel[1] for panel in panels) > 0.4 * width * height
    for frame_width, frame_height, *canvas in panels:
        assert canvas == pytest.approx([frame_width, frame_height] * 2, abs=1)
    assert min(box["size"] for box in boxes if box["isText"]) >= smallest
    assert barriers(page) == []
    for canvas in page.locator(".panel canvas").all():
        drawn = np.asarray(Image.open(io.BytesIO(canvas.screenshot())).convert("L"))
        assert drawn.std() > 4  # a map
    page.close()


@pytest.mark.parametrize("width", [360, 900, 1280])
def test_the_status_of_each_of_three_panels_is_whole_and_moves_no_picture(address, browser, width):
    page = browser.new_page(viewport={"width": width, "height": 720}, reduced_motion="reduce")
    page.goto(address.replace("panels=log,goals", "panels=log,goals,demo-base"))
    frames = "() => [...document.querySelectorAll('.frame')].map((one) => [one.clientWidth, one.clientHeight])"
    wait_for(page, "document.querySelectorAll('.frame').length === 3")
    empty = page.evaluate(frames)
    wait_for(page, OVER.replace("Object.keys", "studio.state.variants.get('demo-base')?.score && Object.keys"))
    page.evaluate("() => studio.timeline.seek(90)")
    page.wait_for_timeout(300)
    assert page.evaluate(frames) == empty
    heads, texts = (page.locator(f".{name}").all() for name in ("panel-head", "panel-status"))
    assert [text.inner_text().count(" · ") for text in texts] == [0, 2, 2]
    sizes = "(one) => [one.scrollWidth - one.clientWidth, one.scrollHeight - one.clientHeight]"
    assert [one.evaluate(sizes) for one in [*heads, *texts]] == [[0, 0]] * 6
    page.close()
