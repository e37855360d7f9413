"""Rewards as text: "mloo", "mloo + 0.1*rloo", "0.5*(mloo + rloo)", "collision_offroad_ade(ade_weight=0.2)".

A name may stand for a sum: "gcft" is "0.9*mloo + 0.1*goal(kind='soft', partial=False)", and settings are stored so.
"""

import ast
import inspect
import math
from collections.abc import Iterator
from dataclasses import dataclass

from rlftsim.errors import ConfigError, in_short
from rlftsim.rewards.base import Reward, Sum, sum_by_name, validate_reward

Option = float | int | bool | str


@dataclass(frozen=True)
class Term:
    """A registered reward with weight and options, defaults filled in."""

    weight: float
    name: str
    options: tuple[tuple[str, Option], ...] = ()

    def __str__(self) -> str:
        options = ", ".join(f"{name}={value!r}" for name, value in self.options)
        return f"{self.name}({options})" if options else self.name


def parse_reward(text: str) -> tuple[Term, ...]:
    """The terms of a sum of rewards.

    Raises:
        ConfigError: Not a sum of rewards; a reward that is not registered, cannot be called or comes twice; an option
            that the reward lacks; all weights 0.
    """
    # Read as a Python expression, of which only sums, factors, names and options are understood; nothing is evaluated.
    try:
        terms = tuple(_parse_terms(ast.parse(text.strip(), mode="eval").body, 1.0))
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
    """Terms in the canonical spelling, which `parse_reward` reads."""
    spelled_terms = []
    for term in terms:
        size = abs(term.weight)
        factor = "" if size == 1 else f"{repr(size).removesuffix('.0')}*"
        spelled_terms.append(f"{'-' if term.weight < 0 else '+'} {factor}{term}")
    return " ".join(spelled_terms).removeprefix("+ ")


def _parse_terms(node: ast.expr, factor: float) -> Iterator[Term]:
    """Yield the terms of a summand that is multiplied by a factor. ValueError where the node is no sum of rewards."""
    match node:
        case ast.BinOp(left, ast.Add(), right):
            yield from _parse_terms(left, factor)
            yield from _parse_terms(right, factor)
        case ast.BinOp(left, ast.Sub(), right):
            yield from _parse_terms(left, factor)
            yield from _parse_terms(right, -factor)
        case ast.BinOp(left, ast.Mult(), right):
            # The number may stand on either side.
            number, summand = (right, left) if _is_number(right) else (left, right)
            yield from _parse_terms(summand, factor * _parse_number(number))
        case ast.UnaryOp(ast.USub() | ast.UAdd() as sign, operand):
            yield from _parse_terms(operand, -factor if isinstance(sign, ast.USub) else factor)
        case ast.Name(name):
            yield from _parse_name(name, factor, {})
        case ast.Call(ast.Name(name), [], keywords):
            options = {keyword.arg: ast.literal_eval(keyword.value) for keyword in keywords if keyword.arg}
            if len(options) < len(keywords):
                raise ValueError(node)  # an option twice, or **options
            yield from _parse_name(name, factor, options)
        case _:
            raise ValueError(node)


def _parse_name(name: str, factor: float, options: dict[str, Option]) -> Iterator[Term]:
    """Yield the term of a reward, or the terms of a sum that has a name."""
    named_sum = sum_by_name(name)
    if named_sum is None:
        yield Term(factor, name, _fill_options(name, validate_reward(name), options))
    else:
        text = named_sum(**dict(_fill_options(name, named_sum, options)))
        yield from _parse_terms(ast.parse(text, mode="eval").body, factor)


def _is_number(node: ast.expr) -> bool:
    return isinstance(node, ast.Constant) or (isinstance(node, ast.UnaryOp) and _is_number(node.operand))


def _parse_number(node: ast.expr) -> float:
    value = ast.literal_eval(node)
    if type(value) not in (int, float) or not math.isfinite(value):
        raise ValueError(value)
    return float(value)


def _fill_options(name: str, reward: Reward | Sum, options: dict[str, Option]) -> tuple[tuple[str, Option], ...]:
    """All options of a reward; options that are not written have the defaults."""
    # Keyword-only parameters are options; the positional ones are what every reward is called with.
    parameters = inspect.signature(reward).parameters.values()
    defaults = {p.name: p.default for p in parameters if p.kind is p.KEYWORD_ONLY}
    values = {**defaults, **options}
    for option, value in values.items():
        if option not in defaults:
            hint = f"known are {', '.join(defaults)}" if defaults else "it has none"
            raise ConfigError(f"reward {name} has no option {option!r}: {hint}.")
        option_type = type(defaults[option])
        if option_type is float and type(value) is int:
            value = values[option] = float(value)
        # By type and not isinstance: True is an int, and no one means it as a number.
        if type(value) is not option_type:
            raise ConfigError(f"reward {name}({option}=...): expected {option_type.__name__}, got {in_short(value)}.")
        if isinstance(value, float) and not math.isfinite(value):
            raise ConfigError(f"reward {name}({option}=...): expected a finite number, got {in_short(value)}.")
    return tuple(values.items())
