"""Run-time type checks that check what they have not checked before.

jaxtyping checks the arguments of each call twice and its result once, which took half of the time of the tests. The
verdict on a value depends on its class and its text, or on the class, dtype and shape of an array: calls of a function
with values alike are checked once in a process. Calls with lists, dictionaries and sets are checked each time. A
function that a test calls more than `MOST_CALLS` times is in a loop, where one call is like the others: the rest of its
calls in this test are not checked.
"""

import functools
import threading
from collections import defaultdict
from types import FunctionType
from typing import Any

import jaxtyping
import numpy as np
import torch

ARRAYS = (torch.Tensor, torch.nn.Parameter, np.ndarray)
CONTAINERS = (tuple, list, dict, set, frozenset)
CHECKED: dict[tuple, dict[tuple, set]] = defaultdict(dict)
"""Right results by right arguments by function: its name and its code, as inner functions are made again and again."""
IN_HAND = threading.local()
MOST_CALLS = 100
"""Calls of a function that are checked in a test."""
CALLS: dict[int, int] = {}
"""Calls of each function in the test that runs; a test begins with none."""
check_each_call, config = jaxtyping.jaxtyped, jaxtyping.config


class LooksInside(Exception):
    """The check of a container looks at one item, another one in each call."""


def describe(value: object) -> object:
    """What the verdict on a value depends on."""
    cls = type(value)
    if cls in ARRAYS:
        return cls, value.dtype, value.shape
    if cls is str or cls is type:
        return value
    if cls is tuple and all(type(item) in ARRAYS for item in value):
        return tuple(map(describe, value))
    if isinstance(value, CONTAINERS):
        raise LooksInside
    return cls


def check_once(fn: Any = None, **options: Any) -> Any:
    """`jaxtyping.jaxtyped` of a function, a class or a descriptor."""
    if fn is None:
        return functools.partial(check_once, **options)
    if not isinstance(fn, FunctionType):
        return check_each_call(fn, **options)
    name = fn.__module__, fn.__qualname__, fn.__code__
    results, in_hand, counter = CHECKED[name], IN_HAND, id(CHECKED[name])

    def hand_out(*args, **kwargs):
        return in_hand.result

    @functools.cache
    def checked():
        return check_each_call(fn, **options)

    @functools.cache
    def checked_result():
        # names in annotations are looked up among the globals of `fn`
        function = FunctionType(hand_out.__code__, fn.__globals__, closure=hand_out.__closure__)
        return check_each_call(functools.wraps(fn)(function), **options)

    @functools.wraps(fn)
    def call(*args, **kwargs):
        CALLS[counter] = number = CALLS.get(counter, 0) + 1
        if number > MOST_CALLS or config.jaxtyping_disable:
            return fn(*args, **kwargs)
        try:
            arguments = (*map(describe, args), *kwargs, *map(describe, kwargs.values()))
        except LooksInside:
            return checked()(*args, **kwargs)
        right = results.get(arguments)
        result = checked()(*args, **kwargs) if right is None else fn(*args, **kwargs)
        try:
            description = describe(result)
        except LooksInside:
            description = LooksInside
        if right is not None and description not in right:
            in_hand.result = result
            checked_result()(*args, **kwargs)
        if description is not LooksInside:
            results.setdefault(arguments, set()).add(description)
        return result

    return call


def remember_checks() -> None:
    """Modules that are imported from now on are checked by `check_once`."""
    jaxtyping.jaxtyped = jaxtyping._decorator.jaxtyped = check_once
