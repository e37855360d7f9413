"""What is computed from a scenario, remembered for as long as the scenario itself is in memory."""

from collections.abc import Callable, Hashable
from functools import wraps
from typing import Concatenate, ParamSpec, TypeVar
from weakref import WeakKeyDictionary

from rlftsim.scenario.types import Scenario

Value = TypeVar("Value")
More = ParamSpec("More")


def derived(compute: Callable[Concatenate[Scenario, More], Value]) -> Callable[Concatenate[Scenario, More], Value]:
    """Decorator: compute once for each scenario (and further, hashable arguments); forget it together with the scenario."""
    known: WeakKeyDictionary[Scenario, dict[Hashable, Value]] = WeakKeyDictionary()

    @wraps(compute)
    def remembered(scenario: Scenario, *more: More.args, **named: More.kwargs) -> Value:
        values = known.setdefault(scenario, {})
        key = (more, tuple(named.items()))
        if key not in values:
            values[key] = compute(scenario, *more, **named)
        return values[key]

    return remembered
