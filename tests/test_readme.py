"""Commands and files that README and docs name exist, and the tree in CONTRIBUTING is the tree there is."""

import re
import shlex
import tomllib
from pathlib import Path

import pytest
from run_pages import PAGES, ROOT, blocks_of

import rlftsim
from rlftsim.cli.main import VERBS, parse
from rlftsim.errors import RlftsimError
from rlftsim.recipes.registry import recipe_by_name

README = (ROOT / "README.md").read_text()
CONTRIBUTING = (ROOT / "CONTRIBUTING.md").read_text()


SHELL = [
    (page.name, line)
    for page in PAGES
    for block in blocks_of(page)
    if block.language == "sh"
    for line in block.commands
]
COMMANDS = [(page, line[line.index("rlftsim ") :]) for page, line in SHELL if re.search(r"(^|-m )rlftsim ", line)]
"""Commands of all pages, also of blocks that are not run."""
INLINE = [
    (page.name, code) for page in PAGES for code in re.findall(r"`(rlftsim [^`\n]+)`", page.read_text())
]  # fmt: skip


@pytest.mark.parametrize(("page", "line"), COMMANDS, ids=[f"{p}: {line[8:60]}" for p, line in COMMANDS])
def test_every_command_can_be_read(page, line):
    words = [word for word in shlex.split(line, comments=True)[1:] if word not in ("|", "...")]
    words = [
        word.replace("on_the_road(scale=2)", "rloo").replace("on_the_road", "rloo") for word in words
    ]  # of a plug-in
    if ">" in words:
        words = words[: words.index(">")]
    if words != ["--help"] and "--config" not in words:
        parse(words)


def test_there_are_commands_and_a_wrong_one_would_be_seen():
    shown = {shlex.split(line)[1] for page, line in COMMANDS if page == "README.md"}
    assert {"convert", "tokens", "pretrain", "finetune", "evaluate", "compare", "simulate"} <= shown
    with pytest.raises(RlftsimError):
        parse(shlex.split("evaluate runs/base --date data/womd --out runs/evaluations"))
    with pytest.raises(RlftsimError):
        parse(shlex.split("finetune smart-tiny --model m --data d --out o --finetune.learnin-rate 1e-5"))


@pytest.mark.parametrize(("page", "code"), INLINE, ids=[f"{p}: {c[8:40]}" for p, c in INLINE])
def test_commands_named_in_passing_name_verbs_and_options_that_exist(page, code, capsys):
    words = shlex.split(code)[1:]
    assert words[0] in (*VERBS, "VERB")
    options = [w for w in words if w.startswith("--") and w != "--help"]
    if options:
        with pytest.raises(SystemExit):
            parse([*words[: 1 + (words[1] in ("exam", "true-world"))], "--help"])
        text = capsys.readouterr().out
        assert all(option in text for option in options)


FIELD = re.compile(r"--((?:tokens|model|pretrain|finetune|catk|gcsl)\.[\w.-]*\w)")


@pytest.mark.parametrize("name", sorted(set(FIELD.findall("".join(p.read_text() for p in PAGES)))))
def test_every_setting_in_the_documents_is_a_field(name):
    parts = name.replace("-", "_").replace(".no_", ".").split(".")
    assert any(has_field(recipe_by_name(recipe), parts) for recipe in ("smart-tiny", "trafficbots"))


def has_field(settings: object, parts: list[str]) -> bool:
    """True if the settings have a field under these names, one below the other."""
    return not parts or (hasattr(settings, parts[0]) and has_field(getattr(settings, parts[0]), parts[1:]))


def test_make_knows_the_targets_that_are_shown():
    makefile = (ROOT / "Makefile").read_text()
    shown = {line.split()[1] for _, line in SHELL if line.startswith("make ")}
    shown |= set(re.findall(r"`make ([\w-]+)", README))
    assert {"demo", "test"} <= shown
    assert all(re.search(rf"^{target}:", makefile, re.MULTILINE) for target in shown)


def tree() -> dict[str, str]:
    """Path → reason of the file tree in CONTRIBUTING."""
    block = next(b.text for b in blocks_of(ROOT / "CONTRIBUTING.md") if b.text.startswith("src/rlftsim/"))
    entries, parent = {}, ""
    for line in block.splitlines():
        name, _, reason = line.strip().partition(" ")
        if not line.startswith(" "):
            parent = name if name == "src/rlftsim/" else ""
        entries[name if name == parent else parent + name] = reason.strip()
    return entries


def test_the_tree_shows_what_is_there_with_a_reason():
    entries = tree()
    assert all((ROOT / path).exists() for path in entries), [p for p in entries if not (ROOT / p).exists()]
    assert all(reason for path, reason in entries.items() if path != "src/rlftsim/")
    package = ROOT / "src" / "rlftsim"
    rooms = {p.name for p in package.iterdir() if not p.name.startswith(("__", "."))}
    assert {Path(path).name for path in entries if path.startswith("src/rlftsim/") and path != "src/rlftsim/"} == rooms


def test_the_tree_climbs_from_the_ground():
    from test_imports import FLOOR_OF

    floors = [
        FLOOR_OF[Path(path).stem]
        for path in tree()
        if path.startswith("src/rlftsim/") and not path.endswith(("rlftsim/", ".typed"))
    ]
    assert floors == sorted(floors)


def test_the_block_of_measurements_is_marked():
    results = (ROOT / "docs" / "results.md").read_text()
    assert results.count("<!-- measured:begin -->") == results.count("<!-- measured:end -->") == 1


def test_the_readme_is_short():
    assert len(re.sub(r"<!--.*?-->", "", README).split()) <= 700


def test_one_version_everywhere():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["version"] == rlftsim.__version__
    # the citation has the release that a development version leads to, and the changelog begins with it
    release = rlftsim.__version__.partition(".dev")[0]
    assert re.search(rf"^version: {re.escape(release)}$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)
    versions = re.findall(r"^## \[(.+?)\]", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert versions[0] == release


def test_the_license_is_apache_2():
    text = (ROOT / "LICENSE").read_text()
    assert "Apache License" in text
    assert "Version 2.0, January 2004" in text
    assert "END OF TERMS AND CONDITIONS" in text
    assert 'license = "Apache-2.0"' in (ROOT / "pyproject.toml").read_text()


@pytest.mark.parametrize(
    "path", re.findall(r"`((?:tests|docs|benchmarks)/[\w/]+\.\w+)", "".join(p.read_text() for p in PAGES))
)
def test_files_named_in_the_documents_exist(path):
    assert (ROOT / path).exists()


ROOMS = "|".join(path.name for path in (ROOT / "src" / "rlftsim").iterdir() if (path / "__init__.py").exists())
MODULE = re.compile(rf"`((?:{ROOMS})/[\w/]+\.\w+)(?::[^`]*)?`")


@pytest.mark.parametrize("name", sorted(set(MODULE.findall("".join(p.read_text() for p in PAGES)))))
def test_modules_named_in_the_documents_exist(name):
    assert (ROOT / "src" / "rlftsim" / name).exists()
