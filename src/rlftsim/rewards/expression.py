"""Rewards as text: "mloo", "mloo + 0.1*rloo", "0.5*(mloo + rloo)", "collision_offroad_ade(ade_weight=0.2)".

A name may stand for a sum: "gcft" is "0.9*mloo + 0.1*goal(kind='soft', partial=False)", and settings are stored so.
"""

import ast
import inspect
import math
from collections.abc import Iterator
from dataclasses import dataclass

from rlftsim.errors import ConfigError, in_short
from rlftsim.rewards.base import Reward, Sum, checked_reward, sum_by_name

Option = float | int | bool | str


@dataclass(frozen=True)
class Term:
    """A registered reward with its weight and its options, defaults filled in."""

    weight: float
    name: str
    options: tuple[tuple[str, Option], ...] = ()

    def __str__(self) -> str:
        options = ", ".join(f"{name}={value!r}" for name, value in self.options)
        return f"{self.name}({options})" if options else self.name


def parse_reward(text: str) -> tuple[Term, ...]:
    """The terms of a sum of rewards.

    Raises:
        ConfigError: not a sum of rewards; a reward that is not registered, cannot be called or comes twice; an option
            that it does not have; nothing but weights of 0.
    """
    # Read as a Python expression, of which only sums, factors, names and options are understood; nothing is evaluated.
    try:
        terms = tuple(_terms(ast.parse(text.strip(), mode="eval").body, 1.0))
    except ConfigError:
        raise
    except (SyntaxError, ValueError):
        raise ConfigError(
            f"reward {in_short(text)} cannot be read: write a sum of rewards, such as 'mloo + 0.1*collision_offroad'."
        ) from None
    names = [term.name for term in terms]
    for name in names:
        if names.count(name) > 1:
            raise ConfigError(
                f"reward {in_short(text)} has {name} {names.count(name)} times: name it once, with one weight."
            )
    if not any(term.weight for term in terms):
        raise ConfigError(f"reward {in_short(text)} is always 0: give one of its terms a weight.")
    return terms


def write_reward(terms: tuple[Term, ...]) -> str:
    """Terms in their one spelling, which `parse_reward` reads."""
    text = []
    for term in terms:
        size = abs(term.weight)
        factor = "" if size == 1 else f"{repr(size).removesuffix('.0')}*"
        text.append(f"{'-' if term.weight < 0 else '+'} {factor}{term}")
    return " ".join(text).removeprefix("+ ")


def _terms(node: ast.expr, factor: float) -> Iterator[Term]:
    """Yield the terms of a part of a sum that is multiplied by a factor. ValueError where it is something else."""
    match node:
        case ast.BinOp(left, ast.Add(), right):
            yield from _terms(left, factor)
            yield from _terms(right, factor)
        case ast.BinOp(left, ast.Sub(), right):
            yield from _terms(left, factor)
            yield from _terms(right, -factor)
        case ast.BinOp(left, ast.Mult(), right):
            # The number may stand on either side.
            number, rest = (right, left) if _is_number(right) else (left, right)
            yield from _terms(rest, factor * _number(number))
        case ast.UnaryOp(ast.USub() | ast.UAdd() as sign, operand):
            yield from _terms(operand, -factor if isinstance(sign, ast.USub) else factor)
        case ast.Name(name):
            yield from _named(name, factor, {})
        case ast.Call(ast.Name(name), [], keywords):
            given = {keyword.arg: ast.literal_eval(keyword.value) for keyword in keywords if keyword.arg}
            if len(given) < len(keywords):
                raise ValueError(node)  # an option twice, or **options
            yield from _named(name, factor, given)
        case _:
            raise ValueError(node)


def _named(name: str, factor: float, given: dict[str, Option]) -> Iterator[Term]:
    """Yield the term of a reward, or the terms of a sum that has a name."""
    known_sum = sum_by_name(name)
    if known_sum is None:
        yield Term(factor, name, _options(name, checked_reward(name), given))
    else:
        text = known_sum(**dict(_options(name, known_sum, given)))
        yield from _terms(ast.parse(text, mode="eval").body, factor)


def _is_number(node: ast.expr) -> bool:
    return isinstance(node, ast.Constant) or (isinstance(node, ast.UnaryOp) and _is_number(node.operand))


def _number(node: ast.expr) -> float:
    value = ast.literal_eval(node)
    if type(value) not in (int, float) or not math.isfinite(value):
        raise ValueError(value)
    return float(value)


def _options(name: str, reward: Reward | Sum, given: dict[str, Option]) -> tuple[tuple[str, Option], ...]:
    """All options of a reward, the given ones in place of their defaults."""
    # Keyword-only parameters are options; the positional ones are what every reward is called with.
    parameters = inspect.signature(reward).parameters.values()
    defaults = {p.name: p.default for p in parameters if p.kind is p.KEYWORD_ONLY}
    for option in given:
        if option not in defaults:
            known = f"known are {', '.join(defaults)}" if defaults else "it has none"
            raise ConfigError(f"reward {name} has no option {option!r}: {known}.")
    values = {**defaults, **given}
    for option, default in defaults.items():
        where = f"reward {name}({option}=...)"
        value = values[option]
        if isinstance(default, float) and type(value) is int:
            value = values[option] = float(value)
        # By type and not isinstance: True is an int, and no one means it as a number.
        if type(value) is not type(default):
            raise ConfigError(f"{where}: expected {type(default).__name__}, got {in_short(value)}.")
        if isinstance(value, float) and not math.isfinite(value):
            raise ConfigError(f"{where}: expected a finite number, got {in_short(value)}.")
    return tuple((option, values[option]) for option in defaults)
