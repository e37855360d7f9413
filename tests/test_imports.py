"""The arrows of the package: an import points to a lower floor, never sideways between rooms, never up."""

import ast
import re
from pathlib import Path

import pytest

import rlftsim

PACKAGE = Path(rlftsim.__file__).parent

FLOORS = (
    ("errors",),
    ("jobs",),
    ("geometry", "plugins", "statistics"),
    ("scenario",),
    ("tokens", "goals"),
    ("rollout",),
    ("policies", "realism", "viewer"),
    ("rewards",),
    ("training",),
    ("recipes",),
    ("evaluation",),
    ("submission", "experiments", "envs"),
    ("studio",),
    ("verbs",),
    ("cli",),
)
"""From the ground up: the first is what any module may raise, the last the command line.

A room is a sub-package or a top-level module.
"""

MODULE = re.compile(r"rlftsim(\.\w+)+(:[\w.]+)?")
"""A string that names a module, or something in one."""
FLOOR_OF = {room: floor for floor, rooms in enumerate(FLOORS) for room in rooms}
NOT_THOUGH_BELOW = {("training", "policies"), ("training", "viewer"), ("rewards", "policies"), ("rewards", "viewer")}
"""Training changes the weights of any policy: a recipe hands one in."""
NO_ROOM = ("__init__", "__main__")
"""The package's own two files: the version number, and the way into the command line."""


def room_of(path: Path, package: Path) -> str:
    """Room that a file of a package belongs to."""
    return path.relative_to(package).with_suffix("").parts[0]


def imported_rooms(source: str, package_of_file: tuple[str, ...] = ("rlftsim",)) -> set[str]:
    """Rooms of rlftsim that a source text imports (at the top, in functions, relatively) or names in a string."""
    names = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names += [alias.name.split(".") for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            above = list(package_of_file[: len(package_of_file) - node.level + 1]) if node.level else []
            base = above + (node.module.split(".") if node.module else [])
            names += [[*base, alias.name] for alias in node.names] if len(base) == 1 else [base]
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and MODULE.fullmatch(node.value):
            module, colon, _ = node.value.partition(":")
            # the bare name of a sub-package is an entry-point group
            if colon or PACKAGE.parent.joinpath(*module.split(".")).with_suffix(".py").is_file():
                names.append(module.split("."))
    return {name[1] for name in names if name[0] == "rlftsim" and len(name) > 1 and name[1] in FLOOR_OF}


def source_files() -> list[Path]:
    return sorted(p for p in PACKAGE.rglob("*.py") if room_of(p, PACKAGE) not in NO_ROOM)


def offences(path: Path) -> list[str]:
    """What a file imports and must not."""
    own = room_of(path, PACKAGE)
    inside = ("rlftsim", *path.relative_to(PACKAGE).parent.parts)
    others = imported_rooms(path.read_text(), inside) - {own}
    return [o for o in sorted(others) if FLOOR_OF[o] >= FLOOR_OF[own] or (own, o) in NOT_THOUGH_BELOW]


def test_every_room_has_a_floor():
    rooms = {room_of(path, PACKAGE) for path in source_files()}
    assert rooms == set(FLOOR_OF)


@pytest.mark.parametrize("path", source_files(), ids=lambda p: p.relative_to(PACKAGE).as_posix())
def test_imports_point_down(path):
    assert offences(path) == []


@pytest.mark.parametrize(
    ("source", "rooms"),
    [
        ("import rlftsim.cli.main", {"cli"}),
        ("from rlftsim import cli, __version__", {"cli"}),
        ("from rlftsim.training.finetune import finetune", {"training"}),
        ("def f():\n    from rlftsim.viewer import page", {"viewer"}),
        ("if TYPE_CHECKING:\n    import rlftsim.realism as r", {"realism"}),
        ("from ..policies import layers", {"policies"}),
        ("from .. import policies", {"policies"}),
        ("import_module('rlftsim.viewer.notebook')", {"viewer"}),
        ("PLACES = {'a': 'rlftsim.rewards:REWARDS'}", {"rewards"}),
        ("group = 'rlftsim.rewards'", set()),
        ("import torch\nfrom pathlib import Path", set()),
    ],
)
def test_the_reader_of_imports_sees_every_form(source, rooms):
    assert imported_rooms(source, ("rlftsim", "realism")) == rooms


def test_smart_is_imported_by_its_recipes_the_public_names_and_three_commands():
    importing = {
        path.relative_to(PACKAGE).as_posix()
        for path in source_files()
        if "policies/smart" not in path.as_posix()
        and any(
            isinstance(node, ast.ImportFrom)
            and (node.module or "").startswith(("rlftsim.policies.smart", "rlftsim.recipes.smart"))
            for node in ast.walk(ast.parse(path.read_text()))
        )
    }
    assert importing == {
        "recipes/smart.py", "policies/shipped/__init__.py", "verbs/demo.py", "verbs/model.py", "verbs/tokens.py"
    }  # fmt: skip


def test_a_policy_that_knows_the_metric_would_be_seen(tmp_path, monkeypatch):
    monkeypatch.setattr(f"{__name__}.PACKAGE", tmp_path)
    bad = tmp_path / "policies" / "bad.py"
    bad.parent.mkdir()
    bad.write_text(
        "from rlftsim.realism import score\nfrom rlftsim.scenario.types import Scenario\nimport rlftsim.cli\n"
    )
    assert offences(bad) == ["cli", "realism"]
    teacher = tmp_path / "training" / "teacher.py"
    teacher.parent.mkdir()
    teacher.write_text("def f():\n    from rlftsim.policies.smart.policy import SmartPolicy\n")
    assert offences(teacher) == ["policies"]
