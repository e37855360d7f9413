"""Pages that say "A test runs" are run as they stand: all Python blocks of a page, in order, in one namespace.

Python on other pages is there to be adapted: it must be Python.
"""

import ast
import re
from pathlib import Path

import pytest

from rlftsim.policies.registry import POLICIES
from rlftsim.recipes.registry import RECIPES
from rlftsim.rewards.base import REWARDS
from rlftsim.scenario.sources import SOURCES

ROOT = Path(__file__).parents[1]
DOCS = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md"), *(ROOT / "docs").glob("tutorials/*.md")])
NEVER_RUN = {
    "README.md": "takes ten minutes; tests/test_api.py runs the same lines smaller",
    "planner.md": "tutorial 7 runs its planner and environment; the training takes minutes",
    "studio.md": "opens a server",
}
"""Pages whose Python is compiled only, and the reason."""
BLOCK = re.compile(r"^```python\n(.*?)^```", re.DOTALL | re.MULTILINE)
TEST_NAME = re.compile(r"`(test_\w+)`")
LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")


def blocks(text: str) -> list[tuple[int, str]]:
    """Python blocks of a page, each with the line it starts on."""
    return [(text[: m.start(1)].count("\n"), m.group(1)) for m in BLOCK.finditer(text)]


def with_code() -> list[Path]:
    return [page for page in DOCS if blocks(page.read_text())]


def promised() -> list[Path]:
    """Pages that say that they are run."""
    return [page for page in DOCS if "A test runs " in page.read_text()]


def run_page(page: Path) -> dict[str, object]:
    """Run a page's blocks; errors point to lines of the page."""
    namespace: dict[str, object] = {"__name__": page.stem}
    for line, code in blocks(page.read_text()):
        exec(compile("\n" * line + code, str(page), "exec"), namespace)  # the repository's own documentation
    return namespace


@pytest.fixture
def names_as_before():
    """What a page registers is forgotten, so that other tests of the process see the shipped names alone."""
    tables = (POLICIES, RECIPES, REWARDS, SOURCES)
    before = [set(table.names()) for table in tables]
    yield
    for table, known in zip(tables, before):
        for name in set(table.names()) - known:
            table.remove(name)


@pytest.mark.usefixtures("names_as_before")
@pytest.mark.parametrize("page", promised(), ids=lambda p: p.name)
def test_the_page_runs(page, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    run_page(page)


@pytest.mark.parametrize("page", with_code(), ids=lambda p: p.name)
def test_python_in_the_documents_is_python(page):
    for line, code in blocks(page.read_text()):
        compile("\n" * line + code, str(page), "exec")


def test_the_pages_that_promise_to_run_are_found():
    tutorials = {page.name for page in (ROOT / "docs" / "tutorials").glob("[1-8]*.md")}
    assert len(tutorials) == 8
    assert {page.name for page in promised()} == {"data.md", "extending.md", "goals.md", "walk.md", *tutorials}


def test_python_that_is_not_run_is_listed_and_little():
    silent = [page for page in with_code() if page not in promised()]
    assert {page.name for page in silent} == set(NEVER_RUN)
    count = sum(len(blocks(page.read_text())) for page in silent)
    assert count <= 0.1 * sum(len(blocks(page.read_text())) for page in with_code())


def test_the_walk_checks_every_station():
    code = blocks((ROOT / "docs" / "walk.md").read_text())
    assert len(code) > 10
    silent = [c for _, c in code if not any(isinstance(n, ast.Assert) for n in ast.walk(ast.parse(c)))]
    assert [c for c in silent if "assert_close" not in c] == []


def test_a_page_that_lies_would_be_seen(tmp_path):
    page = tmp_path / "lie.md"
    page.write_text("One.\n\n```python\nx = 1\n```\n\nTwo.\n\n```python\nassert x == 2\n```\n")
    with pytest.raises(AssertionError) as caught:
        run_page(page)
    assert caught.traceback[-1].lineno == 9  # counted from 0: the tenth line of the page


@pytest.mark.parametrize("page", [p for p in DOCS if TEST_NAME.search(p.read_text())], ids=lambda p: p.name)
def test_tests_named_in_the_documents_exist(page):
    source = "".join(path.read_text() for path in (ROOT / "tests").rglob("*.py"))
    tests = set(re.findall(r"^def (test_\w+)", source, re.MULTILINE))
    assert [name for name in TEST_NAME.findall(page.read_text()) if name not in tests] == []


@pytest.mark.parametrize("page", DOCS, ids=lambda p: p.name)
def test_links_between_pages_lead_somewhere(page):
    local = [target for target in LINK.findall(page.read_text()) if "://" not in target]
    for target in local:
        path, _, anchor = target.partition("#")
        goal = page.parent / path if path else page
        if goal.suffix in (".png", ".html"):
            continue  # pictures are made by the demo
        assert goal.exists(), f"{page.name} links to {target}"
        if anchor:
            headings = re.findall(r"^#+ (.+)$", goal.read_text(), re.MULTILINE)
            assert anchor in {re.sub(r"[^\w -]", "", h).strip().lower().replace(" ", "-") for h in headings}, target
