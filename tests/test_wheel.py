"""The wheel and the sdist: what is in them, the same bytes every time, and a package that works outside the tree."""

import hashlib
import io
import os
import re
import subprocess
import sys
import tarfile
import zipfile
from email import message_from_string
from pathlib import Path

import pytest

from try_installed import try_installed

ROOT = Path(__file__).parents[1]
MAX_BYTES = 10_000_000
MAX_MODEL_BYTES = 4_000_000
EPOCH = "1700000000"
pytest.importorskip("hatch_fancy_pypi_readme", reason="the tools that build a wheel are not installed")


def build(tree: Path, out: Path, *targets: str) -> list[Path]:
    """Files that hatchling builds from a tree, without isolation and so without a network."""
    command = [sys.executable, "-m", "hatchling", "build", "-d", str(out), *(f"-t{target}" for target in targets)]
    environment = {**os.environ, "SOURCE_DATE_EPOCH": EPOCH}
    subprocess.run(command, cwd=tree, env=environment, capture_output=True, check=True)
    return sorted(out.iterdir())


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> tuple[Path, Path]:
    """Wheel and sdist of this tree."""
    wheel, sdist = build(ROOT, tmp_path_factory.mktemp("dist"), "wheel", "sdist")
    return wheel, sdist


def test_the_wheel_is_pure_python_typed_and_small(built):
    wheel = built[0]
    assert wheel.name.endswith("-py3-none-any.whl")
    assert wheel.stat().st_size <= MAX_BYTES
    with zipfile.ZipFile(wheel) as archive:
        sizes = {item.filename: item.file_size for item in archive.infolist()}
    assert {"rlftsim/py.typed", "rlftsim/__init__.pyi", "rlftsim/viewer/player.js"} <= set(sizes)
    assert sum(size for name, size in sizes.items() if "/shipped/" in name) <= MAX_MODEL_BYTES
    assert {name.partition("/")[0].partition("-")[0] for name in sizes} == {"rlftsim"}


def test_two_builds_have_one_hash_and_the_sdist_builds_the_same_wheel(built, tmp_path):
    wheel, sdist = built
    with tarfile.open(sdist) as archive:
        archive.extractall(tmp_path / "source")
    tree = next((tmp_path / "source").iterdir())
    assert {"tests", "docs", "benchmarks", "src"} <= {path.name for path in tree.iterdir()}
    again = build(tree, tmp_path / "dist", "wheel")[0]
    assert hashlib.sha256(again.read_bytes()).digest() == hashlib.sha256(wheel.read_bytes()).digest()


def test_checkers_of_packages_find_nothing(built):
    for command in (["twine", "check", "--strict", *built], ["check_wheel_contents", built[0]]):
        done = subprocess.run([sys.executable, "-m", *map(str, command)], capture_output=True, text=True)
        assert done.returncode == 0, done.stdout + done.stderr


def test_the_long_description_renders_without_a_relative_link(built):
    from readme_renderer.markdown import render

    with zipfile.ZipFile(built[0]) as archive:
        name = next(name for name in archive.namelist() if name.endswith("/METADATA"))
        about = message_from_string(archive.read(name).decode())
    page = render(about.get_payload(), stream=io.StringIO())
    assert page
    assert "Traffic agents that behave like real road users" in page
    targets = re.findall(r'(?:href|src)="([^"]+)"', page)
    assert [target for target in targets if not target.startswith(("https://", "#"))] == []
    assert set(about.get_all("Provides-Extra")) >= {"all", "av2", "docs", "env", "studio", "synthetic"}


def test_the_installed_wheel_simulates_and_writes_a_page(built, tmp_path):
    """A folder on the path instead of an environment: the dependencies are those of this one."""
    target, empty = tmp_path / "installed", tmp_path / "empty"
    empty.mkdir()
    with zipfile.ZipFile(built[0]) as archive:
        archive.extractall(target)
    package, version, _ = try_installed(sys.executable, empty, {"PYTHONPATH": str(target), "OMP_NUM_THREADS": "1"})
    assert package == target / "rlftsim"
    assert f"-{version}-" in built[0].name
