"""docs/reference is what docs/write_reference.py writes, and every public name is in it."""

import ast
import inspect
from pathlib import Path

import pytest
import write_reference

import rlftsim

DOCS = Path(__file__).parents[1] / "docs"


@pytest.fixture(scope="module")
def written() -> dict[str, str]:
    """Pages as the script would write them now."""
    return write_reference.pages()


def test_the_reference_is_up_to_date(written):
    committed = {
        path.relative_to(DOCS / "reference").as_posix(): path.read_text()
        for path in (DOCS / "reference").rglob("*.md")
    }  # fmt: skip
    assert set(committed) == set(written), "run `make reference`"
    assert [name for name, text in written.items() if text != committed[name]] == [], "run `make reference`"


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
