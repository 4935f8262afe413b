"""Compiled loops: Numba's compiler with the settings of this project, imported only where a loop is about to run.

A module of compiled functions is imported inside the function that uses it, so that ``import robcal`` and the commands
that look at no image stay quick. A compiled function calls only those of its own module: the cache on disk is renewed
when that file changes, not when another does. The cache is beside the file; where that folder cannot be written, in the
user's cache folder; where that cannot either, functions are compiled anew in every process.
"""

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

F = TypeVar("F", bound=Callable[..., Any])

_SUMS_IN_ANY_ORDER = {"reassoc", "contract", "nsz", "arcp"}  # infinities and NaN keep their meaning
_SETTINGS: dict[str, Any] = {"fastmath": _SUMS_IN_ANY_ORDER, "error_model": "numpy", "nogil": True}


def compiled(function: F) -> F:
    """The function compiled at its first call, kept on disk for later processes."""
    try:
        return cast(F, numba.njit(cache=True, **_SETTINGS)(function))
    except RuntimeError:  # no folder for the cache
        return inner(function)


def inner(function: F) -> F:
    """A function that only compiled ones call: it becomes part of them, and of what they keep on disk.

    Inlined by force: one left out of line has a second machine code, compiled for itself, which a process that compiles
    links and a process that loads from disk does not; these two round differently.
    """
    return cast(F, numba.njit(forceinline=True, **_SETTINGS)(function))
