"""Extension points: the one way in which names of other packages, notebooks and this package come together."""

import importlib
import re
import shutil
import subprocess
import sys
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest

import third_party
from rlftsim.cli.main import main
from rlftsim.envs.planners.registry import load_planner
from rlftsim.errors import ConfigError
from rlftsim.plugins import ExtensionPoint
from rlftsim.policies.calibrated.features import FEATURES, register_feature
from rlftsim.rewards.base import reward_by_name
from rlftsim.training.constraints import CONSTRAINTS
from rlftsim.verbs.plugins import POINTS

ROOT = Path(__file__).parents[1]
GROUP = "rlftsim.test_colors"
SCENARIO = "9d639de83d6f5239"


@pytest.fixture
def colors():
    return ExtensionPoint("color", GROUP, {"tau": "math:tau", "ours": "rlftsim.errors:DataError"})


@pytest.fixture
def install(tmp_path, monkeypatch):
    """Install a package of one module with some entry points; its module is forgotten after the test."""
    names = []

    def install_package(name, source, entries):
        names.append(name)
        (tmp_path / f"{name}.py").write_text(source)
        about = tmp_path / f"{name}-1.0.dist-info"
        about.mkdir()
        (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
        lines = "\n".join(f"{key} = {value}" for key, value in entries.items())
        (about / "entry_points.txt").write_text(f"[{GROUP}]\n{lines}\n")
        monkeypatch.syspath_prepend(tmp_path)

    yield install_package
    for name in names:
        sys.modules.pop(name, None)


def test_shipped_things_are_imported_when_they_are_looked_up(colors):
    assert colors.get("tau") == pytest.approx(6.283, abs=1e-3)
    assert colors.names() == ["ours", "tau"]


def test_a_decorated_thing_is_found_and_returned_as_it_is(colors):
    @colors.register("red")
    def red():
        return 1

    assert red() == 1
    assert colors.get("red") is red
    colors.remove("red")
    assert colors.find("red") is None


def test_an_entry_point_may_be_the_thing_itself(colors, install):
    install("test_paint", "green = 'g'\nblue = 'b'\n", {"green": "test_paint:green"})
    assert colors.get("green") == "g"
    assert colors.find("blue") is None
    assert colors.names() == ["green", "ours", "tau"]


def test_an_entry_point_may_be_a_module_that_registers_things(colors, install, monkeypatch):
    monkeypatch.setattr("rlftsim.errors.test_colors", colors, raising=False)
    source = "from rlftsim import errors\nerrors.test_colors.register('cyan')(len)\n"
    install("test_dyes", source, {"anything": "test_dyes"})
    assert colors.get("cyan") is len
    assert "anything" not in colors.names()


def test_only_the_package_that_has_a_name_is_imported(colors, install):
    install("test_fine", "violet = 'v'\n", {"violet": "test_fine:violet"})
    install("test_broken", "import a_module_that_is_not_there\n", {"black": "test_broken:black"})
    assert colors.get("violet") == "v"
    assert "test_broken" not in sys.modules


def test_a_package_that_cannot_be_imported_is_named(colors, install):
    install("test_broken", "import a_module_that_is_not_there\n", {"black": "test_broken:black"})
    expected = r"'black' of package test_broken 1.0 \(test_broken:black\) cannot .*a_module_that_is_not_there.*repair"
    for look_up in (colors.get, colors.find):
        with pytest.raises(ConfigError, match=expected):
            look_up("black")


def test_a_package_that_cannot_be_imported_does_not_break_others(colors, install):
    install("test_broken", "1 / 0\n", {"black": "test_broken:black"})
    install("test_fine", "violet = 'v'\n", {"violet": "test_fine:violet"})
    with pytest.warns(UserWarning, match=r"'black' of package test_broken 1.0 .*zero, test_broken.py:1 in "):
        assert colors.find("white") is None
    with pytest.warns(UserWarning, match="division by zero"):
        assert colors.names() == ["ours", "tau", "violet"]


def test_a_package_that_ends_the_program_ends_nothing(colors, install):
    install("test_rude", "import sys\nsys.exit(3)\n", {"black": "test_rude:black"})
    with pytest.raises(ConfigError, match=r"'black' of package test_rude 1.0 .* cannot be imported \(SystemExit: 3"):
        colors.get("black")


def test_an_attribute_that_is_missing_is_named(colors, install):
    install("test_empty", "", {"pink": "test_empty:pink"})
    with pytest.raises(ConfigError, match=r"color 'pink' of package test_empty 1.0 .* cannot be imported .*pink"):
        colors.get("pink")


def test_a_thing_of_ones_own_is_replaced_with_a_warning(colors):
    colors.register("red")(print)
    with pytest.warns(UserWarning, match="color 'red' is registered again and replaces the earlier one"):
        colors.register("red")(repr)
    assert colors.get("red") is repr


def test_the_same_thing_may_be_registered_twice_in_silence(colors, recwarn):
    colors.register("red")(print)
    colors.register("red")(print)
    assert not recwarn.list


def test_the_name_of_a_shipped_thing_is_refused(colors):
    with pytest.raises(ConfigError, match="color 'tau' ships with rlftsim: choose another name"):
        colors.register("tau")(print)
    colors.register("own")(ConfigError)  # as a module of this package does
    with pytest.raises(ConfigError, match="color 'own' ships with rlftsim"):
        colors.register("own")(print)
    assert colors.get("own") is ConfigError


def test_an_entry_point_cannot_take_the_name_of_a_shipped_thing(colors, install):
    install("test_thief", "tau = 3\n", {"tau": "test_thief:tau"})
    assert colors.get("tau") != 3
    with pytest.warns(UserWarning, match="color 'tau' ships with rlftsim"):
        assert colors.names() == ["ours", "tau"]


def test_a_package_decorates_what_its_entry_points_name_and_takes_no_shipped_name(tmp_path):
    source = """
from rlftsim.policies.calibrated.features import register_feature
from rlftsim.training.constraints import register_constraint

gap = register_constraint("gap", tolerance=1.0)(lambda batch, rollouts, agents: agents.collision)
braking = register_feature("braking", low=-1.0, high=1.0)(lambda candidates: -candidates.speed_change)
"""
    entries = {"rlftsim.constraints": {"gap": "test_held:gap"}, "rlftsim.features": {"braking": "test_held:braking"}}
    with third_party.installed(tmp_path / "site", "test_held", source, entries):
        constraint, feature = CONSTRAINTS.get("gap"), FEATURES.get("braking")
    try:
        with pytest.raises(ConfigError, match="constraint 'speed' ships with rlftsim"):
            CONSTRAINTS.add("speed", constraint)
        with pytest.raises(ConfigError, match="feature 'speed_slow' ships with rlftsim"):
            register_feature("speed_slow", low=-1.0, high=1.0)(feature.compute)
    finally:
        CONSTRAINTS.remove("gap")
        FEATURES.remove("braking")


def test_an_unknown_name_is_refused_with_the_nearest_one(colors):
    with pytest.raises(ConfigError, match=r"unknown color 'tua': did you mean 'tau'\? known are ours, tau"):
        colors.get("tua")
    with pytest.raises(ConfigError, match="unknown color 'xyzzy': known are ours, tau"):
        colors.get("xyzzy")
    with pytest.raises(ConfigError, match="unknown shade 'a': there are none"):
        ExtensionPoint("shade", "rlftsim.test_shades").get("a")


@pytest.fixture
def template(tmp_path, monkeypatch):
    """The template of docs/ built and installed as pip does it, and a broken package beside it."""
    shutil.copytree(ROOT / "docs" / "plugin_template", tmp_path / "source")
    target = tmp_path / "installed"
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation", "--no-index"]
    subprocess.run([*command, "--target", str(target), str(tmp_path / "source")], check=True, capture_output=True)
    third_party.install(target, "test_shattered", "1 / 0\n", {"rlftsim.rewards": {"calm": "test_shattered:calm"}})
    monkeypatch.syspath_prepend(target)
    monkeypatch.chdir(tmp_path)
    yield
    sys.modules.pop("rlftsim_plugin", None)


def test_the_page_of_the_template_shows_its_files():
    folder = ROOT / "docs" / "plugin_template"
    page = (folder / "README.md").read_text()
    for path in (folder / "pyproject.toml", folder / "src" / "rlftsim_plugin" / "__init__.py"):
        assert f"`{path.relative_to(folder).as_posix()}`:" in page
        assert path.read_text() in page


def test_the_template_is_built_installed_listed_and_used(template, capsys):
    # 1. listed with package and version; the broken package has its reason and stops nothing
    assert main(["plugins"]) == 1
    rows = [[cell.strip() for cell in line.split("│")[1:-1]] for line in capsys.readouterr().out.splitlines()]
    states = {row[1]: (row[0], row[2], row[3], row[5]) for row in rows if len(row) == 6}
    assert states["on_the_road"] == ("rlftsim.rewards", "rlftsim-plugin", "0.1.0", "works")
    assert states["csv"] == ("rlftsim.exporters", "rlftsim-plugin", "0.1.0", "works")
    assert states["coast"] == ("rlftsim.planners", "rlftsim-plugin", "0.1.0", "works")
    assert states["calm"] == ("rlftsim.rewards", "test_shattered", "0.1.0", "fails")
    main(["plugins"])
    assert "reward 'calm' of package test_shattered 0.1.0" in capsys.readouterr().out
    # 2. used by name
    assert reward_by_name("on_the_road").__module__ == "rlftsim_plugin"
    command = f"simulate constant_velocity --data synthetic --scenario {SCENARIO} --num-rollouts 2 --out r"
    assert main([*command.split(), "--export", "csv", "page", "film"]) == 0
    lines = (Path("r") / f"{SCENARIO}.csv").read_text().splitlines()
    with np.load(Path("r") / f"{SCENARIO}.npz") as stored:
        assert len(lines) == 1 + 2 * len(stored["object_ids"])
        assert lines[1].startswith(f"0,{stored['object_ids'][0]},{stored['x'][0, 0, -1]:.3f}"[:-1])
    assert "<canvas" in (Path("r") / f"{SCENARIO}.html").read_text()
    film = imageio_ffmpeg.read_frames(str(Path("r") / f"{SCENARIO}.mp4"))
    assert next(film)["fps"] == 10.0
    assert len(list(film)) == 81 + 10  # from the current step on, and a second to look at the end
    assert load_planner("coast").act({}) == [0.0, 0.0]


def test_what_its_users_refuse_is_listed_as_failing(tmp_path, capsys):
    """Things that can be imported and are not what their group is for; the reason is the one that their users read."""
    source = "five = 5\ndef of_two(a, b): pass\ndef broken(): return 1 / 0\n"
    source += "class Rough:\n    def __init__(self, path): pass\n"
    things = {
        "rlftsim.rewards": ("of_two", r"reward bad: of_two cannot be called with realism, rollouts and batch"),
        "rlftsim.policies": ("Rough", r"policy 'bad' cannot be read from a folder: give its class"),
        "rlftsim.sources": ("five", r"data source 'bad' has no license_note, find, read, describe"),
        "rlftsim.recipes": (
            "broken",
            r"recipe 'bad' fails \(ZeroDivisionError: division by zero, __init__.py:3 in broken",
        ),
        "rlftsim.methods": (
            "five",
            r"method 'bad' has no settings and no title and no start and no update: make it",
        ),
        "rlftsim.features": ("five", r"feature 'bad' is of type int: decorate it with register_feature"),
        "rlftsim.constraints": ("five", r"constraint 'bad' is of type int: decorate it with register_constraint"),
        "rlftsim.planners": ("five", r"planner 'bad' is of type int: give it reset\(info\) and act\(observation\)"),
        "rlftsim.experiments": (
            "five",
            r"experiment 'bad' is of type int: make it a rlftsim.experiments.results.Experiment",
        ),
        "rlftsim.trackers": ("five", r"tracker 'bad' has no start, log, artifact, finish: see docs/trackers.md"),
        "rlftsim.entries": ("five", r"entry model 'bad' is of type int: give it expect and draw"),
        "rlftsim.exporters": (
            "five",
            r"exporter 'bad' cannot be called \(.*\): make it a function of scenario, rollouts and folder",
        ),
    }
    assert things.keys() == POINTS.keys()
    entries = {group: {"bad": f"test_rough:{thing}"} for group, (thing, _) in things.items()}
    with third_party.installed(tmp_path / "site", "test_rough", source, entries):
        assert main(["plugins"]) == 1
        text = capsys.readouterr().out
        assert "works" not in text
        for _, reason in things.values():
            assert re.search(reason, text)
        assert main(["experiment", "bad", "--data", "synthetic", "--out", str(tmp_path / "out")]) == 2
        assert re.search(things["rlftsim.experiments"][1], capsys.readouterr().err)


def test_constraints_and_features_are_tried_out(tmp_path, capsys):
    source = """
from rlftsim.policies.calibrated.features import register_feature
from rlftsim.training.constraints import register_constraint

total = register_constraint("total", tolerance=1.0)(lambda batch, rollouts, agents: agents.collision.sum(-1))
spare = register_constraint("spare", tolerance=1.0)(lambda batch, rollouts: agents.collision)
shares = register_constraint("shares", tolerance=1.0)(lambda batch, rollouts, agents: agents.collision)
zero = register_feature("zero", low=0.0, high=1.0)(lambda candidates: 0.0)
slower = register_feature("slower", low=-1.0, high=1.0)(lambda candidates: -candidates.speed_change)
"""
    groups = {"rlftsim.constraints": ("total", "spare", "shares"), "rlftsim.features": ("zero", "slower")}
    entries = {group: {name: f"test_trial:{name}" for name in names} for group, names in groups.items()}
    with third_party.installed(tmp_path / "site", "test_trial", source, entries):
        assert main(["plugins"]) == 1
    text = capsys.readouterr().out
    rows = [[cell.strip() for cell in line.split("│")[1:-1]] for line in text.splitlines()]
    states = {row[1]: row[5] for row in rows if len(row) == 6}
    expected = {"total": "fails", "spare": "fails", "shares": "works", "zero": "fails", "slower": "works"}
    assert {name: states[name] for name in expected} == expected
    text = " ".join(text.split())
    assert "constraint 'total' of test_trial gives shape [2, 2], expected [2, 2, " in text
    assert "constraint 'spare' fails (TypeError: <lambda>() takes 2 positional arguments but 3 were given" in text
    assert "feature 'zero' gives float for " in text


def test_without_plug_ins_the_groups_are_named(capsys):
    assert main(["plugins"]) == 0
    text = capsys.readouterr().out
    assert all(group in text for group in POINTS)


def test_every_group_is_listed():
    """Each extension point of the package announces itself in the table that `rlftsim plugins` reads."""
    sources = [path.read_text() for path in (ROOT / "src" / "rlftsim").rglob("*.py")]
    groups = {found for text in sources for found in re.findall(r'\(\s*"[\w ]+",\s*"(rlftsim\.\w+)"', text)}
    assert groups == set(POINTS)
    for group, place in POINTS.items():
        module, _, attribute = place.partition(":")
        assert getattr(importlib.import_module(module), attribute).group == group
