"""Functions as machine code, by numba; without numba they run as they stand, with equal results but slowly."""

import warnings
from collections.abc import Callable

try:
    from numba import njit
except ImportError as error:
    njit = None
    warnings.warn(
        f"environments are many times slower without numba ({error}): pip install 'rlftsim[env]'.", stacklevel=2
    )


def compiled(function: Callable) -> Callable:
    """Machine code of a function of numbers and arrays, compiled at the first call and kept on the disk.

    Args:
        function: Function of what numba knows; `no_type_check` keeps run-time checks of types out.
    """
    if njit is None:
        return function
    try:
        return njit(function, cache=True, error_model="numpy")
    except RuntimeError:  # no folder can be written
        return njit(function, error_model="numpy")
