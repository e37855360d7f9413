"""Every Python and shell block of the pages is run, or says why not; what tutorials show is what they print.

Python runs as it stands, with the package's own data and models. Commands run as they stand, too, among small things of
the names that they use (`small_things`): four of the synthetic scenarios, a data set of a few scenes, tiny models.
"""

import ast
import contextlib
import math
import re
import shlex
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace

import jaxtyping
import numpy as np
import pytest
from PIL import Image
from run_pages import LANGUAGES, PAGES, ROOT, RUN, TUTORIALS, Block, PageRun, blocks_of, pictures_of

import scenes
import small_things

MAX_NOT_RUN = 0.1
TAKEN_FOR_GRANTED = {
    "README.md": ("womd",),
    "alpasim.md": ("DATA", "trafficsim-models"),
    "catk.md": (
        "DATA", "epoch_031.ckpt", "agent_vocab.npz", "map_tokens.npz", "agent_vocab_555_s2.pkl", "map_traj_token5.pkl",
    ),
    "data.md": ("womd", "av2", "recordings", "logs"),
    "goals.md": ("runs",),
    "gpudrive.md": ("GPUDrive_mini",),
    "machines.md": ("data", "runs"),
    "rollout_formats.md": ("data", "rollouts", "predictions", "messages"),
    "scenario_generation.md": ("data", "runs", "submission.toml"),
    "start.md": ("womd", "argoverse2"),
    "studio.md": ("runs",),
    "submission.md": ("data", "runs"),
    "training.md": ("data", "runs/v.safetensors"),
    "training_settings.md": ("data", "runs", "agent_vocab.npz", "map_tokens.npz"),
    "training_why.md": ("data", "runs"),
    "8_submission.md": ("data", "runs", "submission.toml"),
}  # fmt: skip
"""Files and folders that a page's reader has."""
WITH_TEMPLATE = (ROOT / "docs" / "plugin_template" / "README.md", ROOT / "docs" / "tutorials" / "5_reward.md")
"""Pages whose reader has installed the plug-in template."""
SMALL_PYTHON = ("README.md", "training.md")
"""Pages whose Python runs among the small things, too: it would take minutes."""
NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?:e-?\d+)?")
TOLERANCE = 1e-4
LOOSE = {"3_finetune.md": 0.5, "4_goals.md": 0.5}
"""Relative tolerance of pages that train: rounding errors grow with every update, and differ by machine."""
TEST_NAME = re.compile(r"`(test_\w+)`")
LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")


def code_of(page: Path) -> list[Block]:
    """Python and shell blocks."""
    return [block for block in blocks_of(page) if block.language in RUN]


WITH_CODE = [page for page in PAGES if code_of(page)]


@pytest.fixture(scope="session")
def things(tmp_path_factory) -> Path:
    """Small things under the names of the pages."""
    folder = tmp_path_factory.mktemp("things")
    small_things.write_things(folder)
    return folder


@pytest.fixture
def unchecked():
    """Pages run as their readers run them: without the type checks of the test run, which take most of the time."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


def names_of(page: Path) -> dict[str, object]:
    """Names that a page leaves to its reader."""
    if page.name == "data.md":
        record = SimpleNamespace(is_broken=False, name="one")
        return {"parse_log": lambda path: [record], "scenario_of": lambda record: scenes.straight_road(record.name)}
    if page.name == "rollout_formats.md":
        with np.load("rollouts/v1.npz") as file:
            arrays = {name: file[name] for name in ("x", "y", "z", "heading")}
            return {"scenario_id": "v1", "ids": file["object_ids"], **arrays}
    return {}


@pytest.mark.slow
@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("page", WITH_CODE, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_the_page_runs_and_prints_what_it_shows(page, things, monkeypatch, tmp_path):
    for name in TAKEN_FOR_GRANTED.get(page.name, ()):
        source, target = things / name, tmp_path / name
        target.parent.mkdir(exist_ok=True)
        shutil.copytree(source, target) if source.is_dir() else shutil.copyfile(source, target)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("SLURM_ARRAY_TASK_ID", "1")
    if page in WITH_TEMPLATE:
        monkeypatch.syspath_prepend(things / "installed")
    run, commands = PageRun(page, names_of(page)), ""
    for block in blocks_of(page):
        commands += block.text if block.language == "sh" else ""
        is_small = block.language == "sh" or page.name in SMALL_PYTHON
        with small_things.small_world(things, commands) if is_small else contextlib.nullcontext():
            printed = run.run(block)
        if block.output is not None:
            assert_alike(printed, block.output["text"], LOOSE.get(page.name, TOLERANCE))
        if block.title is not None:
            sys.modules.pop(Path(block.title).stem, None)
    for name in pictures_of(page) if page in TUTORIALS else ():
        with Image.open(next(tmp_path.rglob(name))) as made, Image.open(page.parent / name) as shown:
            assert made.size == shown.size
            assert len(made.convert("RGB").getcolors(2**24)) > 100  # not empty


def assert_alike(printed: str, shown: str, tolerance: float) -> None:
    """Assert that two texts are the same but for numbers, and their numbers but for a tolerance.

    Args:
        printed: now.
        shown: by the page.
        tolerance: relative; a number with a point may also differ by one in its last digit, as it is rounded.
    """
    assert NUMBER.sub("#", printed) == NUMBER.sub("#", shown)
    for now, then in zip(NUMBER.findall(printed), NUMBER.findall(shown)):
        last = 10.0 ** -len(then.partition(".")[2]) if "." in then else 0.0
        close = math.isclose(float(now), float(then), rel_tol=tolerance, abs_tol=1.01 * last)
        assert close, f"{now} is printed, {then} is shown:\n{printed}"


def test_what_is_not_run_is_marked_and_little():
    blocks = [block for page in PAGES for block in code_of(page)]
    silent = [block for block in blocks if block.reason is not None]
    print(f"{len(blocks)} blocks, {len(silent)} of them not run:", *(f"{b}: {b.reason}" for b in silent), sep="\n")
    assert len(blocks) > 100
    assert len(silent) <= MAX_NOT_RUN * len(blocks)


def test_blocks_have_a_language_and_files_are_used():
    for page in PAGES:
        blocks = blocks_of(page)
        assert page.read_text().count("\n```") == 2 * (len(blocks) + sum(b.output is not None for b in blocks)), page
        assert [str(block) for block in blocks if block.language not in LANGUAGES] == []
        for block in blocks:
            uses = "".join(other.text for other in blocks if other is not block)
            assert block.title is None or Path(block.title).stem in uses, block


def test_commands_fit_into_80_characters():
    """A single word that is longer stays whole."""
    lines = [
        (str(block), line)
        for page in PAGES
        for block in blocks_of(page)
        for line in block.text.splitlines()
        if block.language == "sh"
    ]
    assert [
        (block, line) for block, line in lines if len(line) > 80 and len(shlex.split(line, comments=True)) > 1
    ] == []


def test_every_tutorial_shows_what_it_prints():
    assert len(TUTORIALS) == 8
    for page in TUTORIALS:
        printing = [block for block in blocks_of(page) if block.language == "python" and "print(" in block.text]
        assert printing, page.name
        assert [str(block) for block in printing if block.output is None] == []


def test_the_walk_checks_every_station():
    code = [block.text for block in code_of(ROOT / "docs" / "walk.md")]
    assert len(code) > 10
    silent = [c for c in code if not any(isinstance(n, ast.Assert) for n in ast.walk(ast.parse(c)))]
    assert [c for c in silent if "assert_close" not in c] == []


def test_a_page_that_lies_would_be_seen(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    page = tmp_path / "lie.md"
    page.write_text("One.\n\n```python\nx = 1\n```\n\nTwo.\n\n```python\nassert x == 2\n```\n")
    run = PageRun(page)
    run.run(blocks_of(page)[0])
    with pytest.raises(AssertionError) as caught:
        run.run(blocks_of(page)[1])
    assert caught.traceback[-1].lineno == 9  # counted from 0: the tenth line of the page
    page.write_text("```sh\nrlftsim score nothing --data synthetic\n```\n")
    with pytest.raises(RuntimeError, match=r"lie.md:1: status 2 of rlftsim score"):
        run.run(blocks_of(page)[0])
    assert_alike("1.2301 m of 7\n", "1.2300 m of 7\n", TOLERANCE)
    for printed in ("1.25 m of 7\n", "1.23 m of 8\n", "1.23 s of 7\n"):
        with pytest.raises(AssertionError):
            assert_alike(printed, "1.23 m of 7\n", TOLERANCE)


@pytest.mark.parametrize("page", [p for p in PAGES if TEST_NAME.search(p.read_text())], ids=lambda p: p.name)
def test_tests_named_in_the_documents_exist(page):
    source = "".join(path.read_text() for path in (ROOT / "tests").rglob("*.py"))
    tests = set(re.findall(r"^def (test_\w+)", source, re.MULTILINE))
    assert [name for name in TEST_NAME.findall(page.read_text()) if name not in tests] == []


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_links_between_pages_lead_somewhere(page):
    local = [target for target in LINK.findall(page.read_text()) if "://" not in target]
    for target in local:
        path, _, anchor = target.partition("#")
        goal = page.parent / path if path else page
        if goal.suffix in (".png", ".html") or goal.resolve().is_relative_to(ROOT / "docs" / "reference"):
            continue  # pictures are made by the demo, the reference with the site
        assert goal.exists(), f"{page.name} links to {target}"
        if anchor:
            headings = re.findall(r"^#+ (.+)$", goal.read_text(), re.MULTILINE)
            assert anchor in {re.sub(r"[^\w -]", "", h).strip().lower().replace(" ", "-") for h in headings}, target
