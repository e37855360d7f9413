"""Values computed from a scenario, cached for as long as the scenario is in memory."""

from collections.abc import Callable, Hashable
from functools import wraps
from typing import Concatenate, ParamSpec, TypeVar
from weakref import WeakKeyDictionary

from rlftsim.scenario.types import Scenario

Value = TypeVar("Value")
Arguments = ParamSpec("Arguments")


def cached_on_scenario(
    compute: Callable[Concatenate[Scenario, Arguments], Value],
) -> Callable[Concatenate[Scenario, Arguments], Value]:
    """Decorator that caches a function of a scenario, and of further hashable arguments, with the scenario.

    The values are dropped together with the scenario.
    """
    # weak keys: the cache must not keep a scenario in memory that its data set has dropped
    cache: WeakKeyDictionary[Scenario, dict[Hashable, Value]] = WeakKeyDictionary()

    @wraps(compute)
    def remembered(scenario: Scenario, *arguments: Arguments.args, **named: Arguments.kwargs) -> Value:
        values = cache.setdefault(scenario, {})
        key = (arguments, tuple(named.items()))
        if key not in values:
            values[key] = compute(scenario, *arguments, **named)
        return values[key]

    return remembered
