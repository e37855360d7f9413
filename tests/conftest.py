import multiprocessing
import os
import shutil
import sys
import tarfile
from pathlib import Path

import pytest
from hypothesis import settings

import type_checks
from rlftsim.plugins import is_ours
from rlftsim.verbs.plugins import POINTS

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
"""Of the system; None = the one of `playwright install chromium`."""
BROWSER = os.environ.get("RLFTSIM_BROWSER", "chromium")
"""Or "firefox", of `playwright install firefox`."""

type_checks.remember_checks()

# pytest-xdist sets the width of its own terminal
os.environ.pop("COLUMNS", None)

# Servers of a test leave grpc's threads behind. Revived in a worker that another test forks, they close files of it, so
# that ffmpeg's pipe broke. No worker speaks grpc.
os.environ["GRPC_ENABLE_FORK_SUPPORT"] = "0"

# slow machines are no failure; the same examples every time
settings.register_profile("rlftsim", deadline=None, derandomize=True)
settings.load_profile("rlftsim")

multiprocessing.set_forkserver_preload(["rlftsim.verbs.evaluate", "rlftsim.verbs.convert", "rlftsim.verbs.drive"])

# no test cuts the power: nothing waits for the disk
os.fsync = lambda file: None

# Archives are unpacked alike by all versions: Python 3.11.0 to 3.11.3 have no filters, 3.12 warns where none is set.
if hasattr(tarfile, "data_filter"):
    tarfile.TarFile.extraction_filter = staticmethod(tarfile.data_filter)


def pytest_collection_modifyitems(items):
    """Files with slow tests come first, so that at the end no process is left with a long one."""
    slow_files = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: item.path not in slow_files)


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder with official material that is not part of the repository: RLFTSIM_SHARED, else ../shared."""
    folder = Path(os.environ.get("RLFTSIM_SHARED", Path(__file__).parents[2] / "shared"))
    if not folder.is_dir():
        pytest.skip(f"no official material at {folder}: set RLFTSIM_SHARED to compare with it")
    return folder


def pytest_runtest_setup():
    type_checks.CALLS.clear()


@pytest.fixture(autouse=True)
def forget_the_width(monkeypatch):
    """Tables are as wide as in a file unless a test says another width."""
    monkeypatch.delenv("COLUMNS", raising=False)


@pytest.fixture(autouse=True)
def fork_workers(request, monkeypatch):
    """Workers are forked from a server that has imported what they would import; two folders spawn them as users do."""
    if not {"jobs", "submission"} & {*request.path.parts}:
        choose = multiprocessing.get_context
        methods = {"spawn": "forkserver"}
        monkeypatch.setattr(multiprocessing, "get_context", lambda method=None: choose(methods.get(method, method)))


@pytest.fixture(autouse=True)
def forget_registered_names():
    """Names that a test registers are forgotten after it, so that no other test of the same process finds them."""
    yield
    for place in POINTS.values():
        module, _, attribute = place.partition(":")
        if module not in sys.modules:
            continue  # nothing can have been registered
        point = getattr(sys.modules[module], attribute)
        for name in [name for name, value in point._registered.items() if not is_ours(value)]:
            point.remove(name)


@pytest.fixture(scope="session")
def browser():
    """A headless browser; skipped where there is none."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    found = {"executable_path": CHROMIUM, "args": ["--no-sandbox", "--disable-gpu"]} if BROWSER == "chromium" else {}
    with playwright.sync_playwright() as session:
        try:
            launched = getattr(session, BROWSER).launch(**found)
        except playwright.Error as error:
            pytest.skip(f"no usable {BROWSER}: {str(error).splitlines()[0]}")
        yield launched
        launched.close()


@pytest.fixture(scope="session")
def barriers():
    """Serious and critical violations that axe-core finds on a page, of all its rules or of some."""
    axe = pytest.importorskip("axe_playwright_python.sync_playwright", reason="axe-playwright-python is not installed")

    def find(page, rules: tuple[str, ...] = ()) -> list[str]:
        options = {"resultTypes": ["violations"]} | ({"runOnly": rules} if rules else {})
        violations = axe.Axe().run(page, options=options).response["violations"]
        return [
            f"{one['id']}: {[node['target'] for node in one['nodes'][:4]]} {one['nodes'][0].get('failureSummary')}"
            for one in violations
            if one["impact"] in ("serious", "critical")
        ]

    return find
