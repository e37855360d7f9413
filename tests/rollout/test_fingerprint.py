"""Fingerprints of policies: names that outlive a move of the code, and settings that do not hide each other."""

import importlib.util
import sys
from dataclasses import dataclass
from typing import ClassVar

import pytest
from torch import nn

from rlftsim.rollout.baselines import ConstantVelocity
from rlftsim.rollout.fingerprint import fingerprint_policy


def moved(kind, module="elsewhere.policies"):
    """The same class as if it stood in another file."""
    return type(kind.__name__, kind.__bases__, {**vars(kind), "__module__": module})


class Cruise(ConstantVelocity):
    architecture = "cruise"


class Renamed(Cruise):
    architecture = "cruise"


class Named(ConstantVelocity):
    architecture = "cruise"
    fingerprint_name = "cruise_package.Cruise"


class Undeclared(ConstantVelocity):
    pass


@dataclass(frozen=True)
class Width:
    fingerprint_name: ClassVar[str] = "cruise_package.Width"
    width: int = 3


class Sized(nn.Module):
    architecture = "sized"

    def __init__(self, settings):
        super().__init__()
        self.settings = settings


def test_a_class_that_declares_a_name_may_move():
    assert fingerprint_policy(moved(Named)()) == fingerprint_policy(Named())


@pytest.mark.parametrize("declared", ["", "fingerprint_name = 'package.Cruise'"])
def test_an_edited_policy_is_another_one_unless_it_declares_a_name(tmp_path, declared):
    def load(text):
        path = tmp_path / "cruising.py"
        path.write_text(
            f"from rlftsim.rollout.baselines import ConstantVelocity\nSPEED = {text}\n"
            f"class Cruise(ConstantVelocity):\n    architecture = 'cruise'\n    {declared}\n"
        )
        spec = importlib.util.spec_from_file_location("cruising", path)
        module = importlib.util.module_from_spec(spec)
        monkeypatch.setitem(sys.modules, "cruising", module)
        spec.loader.exec_module(module)
        return fingerprint_policy(module.Cruise())

    with pytest.MonkeyPatch.context() as monkeypatch:
        assert load("12") == load("12")
        assert (load("3") == load("12")) == bool(declared)


def test_a_renamed_class_keeps_the_fingerprint_of_its_architecture():
    assert fingerprint_policy(Renamed()) == fingerprint_policy(Cruise())


def test_a_declared_fingerprint_name_comes_before_the_architecture():
    assert fingerprint_policy(Named()) != fingerprint_policy(Cruise())


def test_a_class_without_a_name_is_known_by_its_place_and_does_not_pass_for_its_base():
    assert fingerprint_policy(moved(Undeclared)()) != fingerprint_policy(Undeclared())
    assert fingerprint_policy(Undeclared()) != fingerprint_policy(ConstantVelocity())


def test_nested_settings_that_declare_a_name_may_move():
    assert fingerprint_policy(Sized(moved(Width)())) == fingerprint_policy(Sized(Width()))
    assert fingerprint_policy(Sized(Width(4))) != fingerprint_policy(Sized(Width()))


def test_fields_of_foreign_settings_never_share_a_key():
    @dataclass(frozen=True)
    class Both:
        share: float
        probability: float

    values = [(0.1, 0.5), (0.1, 0.6), (0.2, 0.5)]
    assert len({fingerprint_policy(Sized(Both(*both))) for both in values}) == 3
