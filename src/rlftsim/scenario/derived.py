"""Values computed from a scenario, cached for as long as the scenario itself is in memory."""

from collections.abc import Callable, Hashable
from functools import wraps
from typing import Concatenate, ParamSpec, TypeVar
from weakref import WeakKeyDictionary

from rlftsim.scenario.types import Scenario

Value = TypeVar("Value")
More = ParamSpec("More")


def cached_on_scenario(
    compute: Callable[Concatenate[Scenario, More], Value],
) -> Callable[Concatenate[Scenario, More], Value]:
    """Decorator that caches a function of a scenario, and of further hashable arguments, with the scenario.

    The values go when the scenario goes.
    """
    # weak keys: the cache must not keep a scenario in memory that its data set has dropped
    known: WeakKeyDictionary[Scenario, dict[Hashable, Value]] = WeakKeyDictionary()

    @wraps(compute)
    def remembered(scenario: Scenario, *more: More.args, **named: More.kwargs) -> Value:
        values = known.setdefault(scenario, {})
        key = (more, tuple(named.items()))
        if key not in values:
            values[key] = compute(scenario, *more, **named)
        return values[key]

    return remembered
