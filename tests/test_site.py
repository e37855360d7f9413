"""The site: both builders in strict mode, no dead link or anchor, nothing from another host, and a search."""

import html.parser
import os
import resource
import subprocess
import sys
import time
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest
from run_pages import TUTORIALS, blocks_of

from test_docs import TOLERANCE, assert_alike

pytest.importorskip("zensical", reason="the site's builder is not installed")
pytest.importorskip("mkdocs", reason="the site's second builder is not installed")
build_site = pytest.importorskip("build_site", reason="jupytext is not installed")
nbformat = pytest.importorskip("nbformat")
pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]
FIRST = {
    "MLOO": "mloo",
    "road edge": "distance_to_road_edge",
    "tracks to predict": "tracks_to_predict",
    "vocabulary": "the-vocabulary",
}
"""Words for the search, and the end of the anchor that it has to find first."""
KINDS = (
    "index", "start", "live", "gallery", "comparison", "training", "results", "results/speed",
    "tutorials/1_futures", "reference/cli/finetune", "reference/python",
)  # fmt: skip
"""A page of each kind."""
SHORTER = """["article .doc-object", ".md-nav--secondary li"].forEach((entries) =>
  [...document.querySelectorAll(entries)].slice(15).forEach((one) => one.remove()))"""
"""The Python page has hundreds of entries of a few kinds, and axe-core looks at each for milliseconds."""


class Links(html.parser.HTMLParser):
    """Targets and anchors of a page."""

    def __init__(self, text: str):
        super().__init__()
        self.targets: list[str] = []
        self.anchors: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        values = dict(attrs)
        self.anchors |= {values[name] for name in ("id", "name") if values.get(name)}
        name = {"a": "href", "link": "href", "img": "src", "script": "src", "iframe": "src"}.get(tag)
        if name and values.get(name) and values.get("rel") not in ("canonical", "next", "prev"):
            self.targets.append(values[name])


@pytest.fixture(scope="module", params=["zensical", "mkdocs"])
def site(request) -> Path:
    """Folder of the site, as `make docs` builds it."""
    command = [sys.executable, str(ROOT / "docs" / "build_site.py"), "--builder", request.param]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return Path(done.stdout.strip()).parent


def test_no_link_or_anchor_is_dead_and_nothing_is_loaded_from_another_host(site):
    pages = {path: Links(path.read_text()) for path in site.rglob("*.html") if path.name != "404.html"}
    assert len(pages) > 60
    dead = []
    for path, page in pages.items():
        for target in page.targets:
            parts = urlsplit(target)
            if parts.scheme or target.startswith("//"):
                continue
            goal = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            if not goal.exists():
                dead.append(f"{path.relative_to(site)}: {target}")
            elif parts.fragment and goal in pages and unquote(parts.fragment) not in pages[goal].anchors:
                # "__..." are the theme's own switches
                dead += [f"{path.relative_to(site)}: {target}"] if not parts.fragment.startswith("__") else []
    assert dead == []
    assert (site / "demo" / "live.html").stat().st_size <= 1_500_000
    # what pages tell a reader to copy is there
    template = (site / "plugin_template" / "index.html").read_text()
    assert all(words in template for words in ("entry-points", "write_csv", "src/rlftsim_plugin/__init__.py"))
    assert (site / "commonroad_to_tables.py").is_file()
    # every public name has an entry, under the name that `import rlftsim as rs` gives it
    reference = pages[site / "reference" / "python.html"]
    assert {"rlftsim.simulate", "rlftsim.load_policy", "rlftsim.Scenario"} <= reference.anchors


def test_from_disk_nothing_is_requested_elsewhere_and_the_search_finds(site, browser):
    page, elsewhere = browser.new_page(viewport={"width": 360, "height": 740}), []
    page.set_default_timeout(120_000)
    page.on("request", lambda request: elsewhere.append(request.url) if request.url.startswith("http") else None)
    for kind in KINDS:
        page.goto(f"file://{site}/{kind}.html", wait_until="domcontentloaded")
        # readable on a telephone: wide tables and code scroll by themselves
        assert page.evaluate("document.documentElement.scrollWidth") <= 360, kind
    if site.name == "site":
        assert {words: first_result(page, words).rpartition(".")[2].rpartition("#")[2] for words in FIRST} == FIRST
    page.close()
    assert elsewhere == []


def test_no_name_in_a_table_of_contents_is_cut(site, browser):
    if site.name == "mkdocs":
        pytest.skip("the published site is the other builder's")
    page = browser.new_page(viewport={"width": 1280, "height": 800})
    page.goto(f"file://{site}/reference/python.html", wait_until="domcontentloaded")
    names = "[...document.querySelectorAll('.md-nav--secondary .md-ellipsis')]"
    assert page.evaluate(f"{names}.length") > 15
    assert page.evaluate(f"{names}.filter((name) => name.scrollWidth > name.clientWidth + 1).length") == 0
    page.close()


def test_axe_finds_no_serious_violation_on_any_kind_of_page(site, browser, barriers):
    if site.name == "mkdocs":
        pytest.skip("the published site is the other builder's")
    found = {}
    for scheme, rules in (("light", ()), ("dark", ("color-contrast",))):
        page = browser.new_page(viewport={"width": 1280, "height": 800}, color_scheme=scheme, reduced_motion="reduce")
        for kind in (*KINDS, "demo/live"):
            page.goto(f"file://{site}/{kind}.html")
            page.evaluate(SHORTER)
            found[kind, scheme] = barriers(page, rules)
        page.close()
    assert {name: violations for name, violations in found.items() if violations} == {}


def test_films_stand_still_where_less_motion_is_wanted(site, browser):
    page = browser.new_page(viewport={"width": 360, "height": 740}, reduced_motion="reduce")
    page.goto(f"file://{site}/index.html")
    film = page.get_by_role("button", name="Play: Film of synthetic traffic")
    film.wait_for()
    assert film.locator("canvas").evaluate("(one) => one.width") > 500
    film.click()
    assert page.locator("img[alt^=Film]").is_visible()
    page.emulate_media(reduced_motion="no-preference")
    page.reload()
    assert page.locator("img[alt^=Film]").is_visible()
    page.close()


def first_result(page, words: str) -> str:
    """Address of the first result of the search of a page, in which it may be open already."""
    if not page.evaluate("document.querySelector('[data-md-component=search]').dataset.open"):
        page.evaluate("document.querySelector('.md-search__button').click()")
        page.evaluate("document.querySelector('[data-md-component=search]').dataset.open = 1")
        page.wait_for_timeout(1000)
    page.keyboard.press("Control+A")
    page.keyboard.type(words)
    # Results lie in a shadow root, and their addresses end with the words that are to be marked.
    results = page.locator(f"a[href*='?h={words.replace(' ', '+')}']")
    results.first.wait_for(state="attached")
    page.wait_for_timeout(500)
    return results.first.get_attribute("href")


def test_every_tutorial_is_a_notebook_with_its_outputs(site):
    if site.name == "mkdocs":
        pytest.skip("the notebooks are those of the other builder")
    for page in TUTORIALS:
        notebook = nbformat.read(site / "tutorials" / f"{page.stem}.ipynb", as_version=4)
        shown = [block.output["text"] for block in blocks_of(page) if block.output is not None]
        assert [output.text for cell in code_cells(notebook) for output in cell.outputs] == shown


def code_cells(notebook) -> list:
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def test_the_first_tutorial_runs_as_a_notebook_and_prints_what_it_shows(tmp_path, monkeypatch):
    nbclient = pytest.importorskip("nbclient")
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
    notebook = build_site.notebook_of(TUTORIALS[0], None)
    shown = [cell.get("outputs") for cell in code_cells(notebook)]
    start, before = time.monotonic(), resource.getrusage(resource.RUSAGE_CHILDREN)
    nbclient.NotebookClient(notebook, timeout=600, resources={"metadata": {"path": str(tmp_path)}}).execute()
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    print(f"{time.monotonic() - start:.1f} s, {seconds:.1f} s of them computing")
    assert seconds <= 60
    for cell, expected in zip(code_cells(notebook), shown, strict=True):
        printed = "".join(output.text for output in cell.outputs if output.get("name") == "stdout")
        assert_alike(printed, "".join(output.text for output in expected), TOLERANCE)
    assert (tmp_path / "futures.html").stat().st_size > 50_000


def test_a_dead_link_stops_the_build():
    for link in ("[walk](wlak.md)", "![picture](studio/none.webp)", "[code](../src/rlftsim/none.py)"):
        with pytest.raises(SystemExit, match=r"docs/start.md: dead link to \S+: there is no "):
            build_site.relinked(f"See {link}.", "docs/start.md", None)
    fine = "[walk](walk.md#one) and [code](../src/rlftsim/errors.py)"
    assert build_site.relinked(fine, "docs/start.md", None) == "[walk](walk.md#one) and code"
