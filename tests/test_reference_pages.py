"""The reference that docs/write_reference.py writes: every flag, public name and error is in it."""

import ast
import inspect
import re
from pathlib import Path

import pytest
import write_reference
from run_pages import PAGES

import rlftsim
from rlftsim.cli.main import VERBS

DOCS = Path(__file__).parents[1] / "docs"


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> dict[str, str]:
    """Path and text of every page that the script writes."""
    folder = tmp_path_factory.mktemp("reference")
    (folder / "of_a_verb_that_went.md").touch()
    write_reference.write_pages(folder)
    return {path.relative_to(folder).as_posix(): path.read_text() for path in folder.rglob("*.md")}


def test_every_verb_has_a_page_and_old_pages_go(written):
    others = {"cli/index.md", "errors.md", "fields.md", "plugins.md", "python.md"}
    assert set(written) == {f"cli/{verb}.md" for verb in VERBS} | others
    assert all(f"]({verb}.md)" in written["cli/index.md"] for verb in VERBS)


def test_links_of_the_documents_into_the_reference_lead_to_a_page_and_a_heading(written):
    links = [link for page in PAGES for link in re.findall(r"\]\([./]*reference/([^)]+)\)", page.read_text())]
    assert len(links) > 1
    for link in links:
        name, _, anchor = link.partition("#")
        assert f"\n## {anchor}\n" in written[name] if anchor else name in written, link


def test_every_flag_has_a_meaning(written):
    rows = [line for name, text in written.items() if name.startswith("cli/") for line in text.splitlines()]
    flags = [line for line in rows if line.startswith("| `-")]
    assert len(flags) > 300
    assert [line for line in flags if len(line.rpartition("` | ")[2].strip(" |")) < 8] == []


def test_every_public_name_has_a_docstring_and_is_in_the_reference(written):
    for name in rlftsim.__all__:
        assert f"::: rlftsim.{name}\n" in written["python.md"]
        assert len(inspect.getdoc(getattr(rlftsim, name)) or "") > 40, name


def test_public_functions_document_every_argument():
    functions = [getattr(rlftsim, name) for name in rlftsim.__all__]
    for function in (one for one in functions if inspect.isfunction(one)):
        names = list(inspect.signature(function).parameters)
        text = inspect.getdoc(function) or ""
        missing = [name for name in names if f"{name}:" not in text]
        assert len(names) < 2 or missing == [], function.__name__


def test_every_error_of_the_package_is_listed(written):
    bases: dict[str, list[str]] = {}
    for path in (DOCS.parent / "src").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ClassDef):
                bases[node.name] = [ast.unparse(base) for base in node.bases]
    errors = {"RlftsimError"}
    while more := {name for name, above in bases.items() if errors & {*above}} - errors:
        errors |= more
    assert {"SetAside", "Unfinished", "ConfigError"} <= errors
    assert [name for name in errors if f"\n| `{name}` | " not in written["errors.md"]] == []
    assert "\n- SetAside: … pieces of the work ended their process" in written["errors.md"]


def test_messages_are_collected_from_the_sources(written):
    assert "- ConfigError: device must be one of …, got …." in written["errors.md"]
    assert written["errors.md"].count("\n- ") > 300
