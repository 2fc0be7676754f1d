"""Compilation of loops over numbers and arrays, for what is computed in every step of an environment."""

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

Function = TypeVar("Function", bound=Callable[..., Any])


def compiled(function: Function) -> Function:
    """
    Compile a function when it is first called, and keep the machine code on disk for later processes.

    Where there is no folder to keep it in, every process compiles anew. numba notices changes of the function's own file
    only, so a compiled function calls no compiled function of another file.

    :param function: of numbers, arrays and tuples of them
    :return: the same function, compiled; divisions by zero give inf or nan, as in numpy
    """
    try:
        return cast(Function, numba.njit(function, cache=True, error_model="numpy"))
    except RuntimeError:  # numba found no folder that it can write to
        return cast(Function, numba.njit(function, error_model="numpy"))
