"""Extension points: the one way in which names of other packages, notebooks and this package come together."""

import sys

import pytest

from rlftsim.errors import ConfigError
from rlftsim.plugins import ExtensionPoint

GROUP = "rlftsim.test_colors"


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
    expected = r"color 'black' of test_broken:black cannot be imported .*a_module_that_is_not_there.*uninstall"
    for look_up in (lambda: colors.get("black"), lambda: colors.find("white"), colors.names):
        with pytest.raises(ConfigError, match=expected):
            look_up()


def test_an_attribute_that_is_missing_is_named(colors, install):
    install("test_empty", "", {"pink": "test_empty:pink"})
    with pytest.raises(ConfigError, match=r"color 'pink' of test_empty:pink cannot be imported .*pink"):
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
    with pytest.raises(ConfigError, match="color 'tau' ships with rlftsim"):
        colors.names()


def test_an_unknown_name_is_refused_with_the_nearest_one(colors):
    with pytest.raises(ConfigError, match=r"unknown color 'tua': did you mean 'tau'\? known are ours, tau"):
        colors.get("tua")
    with pytest.raises(ConfigError, match="unknown color 'xyzzy': known are ours, tau"):
        colors.get("xyzzy")
    with pytest.raises(ConfigError, match="unknown shade 'a': there are none"):
        ExtensionPoint("shade", "rlftsim.test_shades").get("a")
