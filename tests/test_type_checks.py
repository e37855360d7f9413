"""Checks that remember: what is wrong stays wrong, whatever has been right before."""

import importlib

import jaxtyping
import numpy as np
import pytest
import torch

import type_checks

SOURCE = """
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Shaped
from torch import Tensor


def add(first: Float[Tensor, "A"], second: Float[Tensor, "#A"]) -> Float[Tensor, "A"]:
    return first + second


def shape(values: Shaped[np.ndarray, "A 2"]) -> int:
    return len(values)


def cut(values: Float[Tensor, "A"], count: int) -> Float[Tensor, "A"]:
    return values[:count]


def pair(count: int) -> tuple[Float[Tensor, "A"], Float[Tensor, "A"]]:
    return torch.zeros(2), torch.zeros(count)


def choose(word: Literal["a", "b"], *, words: list[str]) -> dict[str, int]:
    return {word: len(words) if len(words) < 3 else "many"}


def repeat(word: Literal["a", "b"]) -> str:
    return 2 * word


def name(value: object) -> str | None:
    return value


def outer(value: object) -> int:
    def inner(number: int) -> int:
        return number

    return inner(value)


@dataclass
class Box:
    values: Float[Tensor, "A 2"]
    names: tuple[str, ...] = ()

    @property
    def size(self) -> int:
        return len(self.names) or 0.5

    @classmethod
    def of(cls, number: int, value: object = 1) -> "int":
        return value

    @staticmethod
    def double(number: int) -> int:
        return number * 2


class Seen(type):
    count = 0

    def __instancecheck__(cls, value):
        Seen.count += 1
        return True


class Anything(metaclass=Seen):
    pass


def look(value: Anything) -> float:
    return 1.0
"""


@pytest.fixture(scope="module")
def checked(tmp_path_factory):
    """A module under the checks of the test run."""
    assert jaxtyping.jaxtyped is type_checks.check_once
    folder = tmp_path_factory.mktemp("checked")
    (folder / "checked_module.py").write_text(SOURCE)
    with (
        pytest.MonkeyPatch.context() as patch,
        jaxtyping.install_import_hook("checked_module", "beartype.beartype"),
    ):
        patch.syspath_prepend(folder)
        yield importlib.import_module("checked_module")


@pytest.mark.parametrize(
    ("right", "wrong"),
    [
        (lambda m: m.add(torch.zeros(3), torch.zeros(3)), lambda m: m.add(torch.zeros(3), torch.zeros(2))),
        (lambda m: m.add(torch.zeros(3), torch.zeros(1)), lambda m: m.add(torch.zeros(1), torch.zeros(3))),
        (lambda m: m.add(torch.zeros(3), torch.zeros(3)), lambda m: m.add(torch.zeros(3), torch.zeros(3).long())),
        (lambda m: m.add(torch.zeros(3), torch.zeros(3)), lambda m: m.add(torch.zeros(3), second=np.zeros(3))),
        (lambda m: m.shape(np.zeros((3, 2))), lambda m: m.shape(np.zeros((2, 3)))),
        (lambda m: m.cut(torch.zeros(3), 3), lambda m: m.cut(torch.zeros(3), 2)),
        (lambda m: m.cut(torch.zeros(3), 3), lambda m: m.cut(torch.zeros(3), 3.0)),
        (lambda m: m.pair(2), lambda m: m.pair(3)),
        (lambda m: m.choose("a", words=["x"]), lambda m: m.choose("c", words=["x"])),
        (lambda m: m.choose("a", words=["x"]), lambda m: m.choose("a", words=[1])),
        (lambda m: m.choose("a", words=["x"]), lambda m: m.choose("a", words=["x"] * 3)),
        (lambda m: m.repeat("a"), lambda m: m.repeat("c")),
        (lambda m: (m.name("x"), m.name(None)), lambda m: m.name(1)),
        (lambda m: m.outer(1), lambda m: m.outer("1")),
        (lambda m: m.Box(torch.zeros(3, 2)), lambda m: m.Box(torch.zeros(2, 3))),
        (lambda m: m.Box(torch.zeros(3, 2), ("x", "y")), lambda m: m.Box(torch.zeros(3, 2), (1, 2))),
        (lambda m: m.Box(torch.zeros(3, 2), ("x",)).size, lambda m: m.Box(torch.zeros(3, 2)).size),
        (lambda m: m.Box.of(1), lambda m: m.Box.of(1, value="1")),
        (lambda m: m.Box.double(1), lambda m: m.Box.double("1")),
    ],
)
def test_a_wrong_call_is_seen_behind_right_ones(checked, right, wrong):
    for _ in range(3):
        right(checked)
        with pytest.raises(jaxtyping.TypeCheckError):
            wrong(checked)


def test_what_was_right_is_not_checked_again(checked):
    checked.look(1)
    count = type(checked.Anything).count
    assert count > 0
    assert [checked.look(number) for number in range(5)] == [1.0] * 5
    assert type(checked.Anything).count == count
    checked.look("another class")
    assert type(checked.Anything).count > count


@pytest.mark.parametrize("test", ["first", "second"])
def test_a_loop_is_checked_at_its_beginning_in_every_test(checked, test):
    with pytest.raises(jaxtyping.TypeCheckError):
        checked.Box.double("1")
    for number in range(type_checks.MOST_CALLS):
        checked.Box.double(number)
    assert checked.Box.double("1") == "11"
