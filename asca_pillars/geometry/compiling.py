"""How numba compiles the loops of the `*_kernels.py` files.

The compiled functions take memory made by NumPy and have their signatures written out: that takes a quarter off the
time to compile, and all of it is spent when they are imported, once per machine (numba's cache keeps the result).
`nogil` lets other threads run meanwhile; nothing is `parallel`, because the network owns the cores.
"""

from collections.abc import Callable
from typing import Any

import numba
from numba import types

# NumPy's division, which does not look out for zeros; no entry for C programs.
_PLAIN = {"error_model": "numpy", "no_cfunc_wrapper": True}

inner = numba.njit(no_cpython_wrapper=True, **_PLAIN)
"""Decorates what is called by compiled functions of the same file alone."""


def compiled(*arguments: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Decorator: compiled for arguments of these types, cached where a folder for it can be written."""

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        try:
            return numba.njit(arguments, cache=True, nogil=True, **_PLAIN)(function)
        except RuntimeError:  # no such folder: each process compiles for two seconds, and is then as fast as others
            return numba.njit(arguments, nogil=True, **_PLAIN)(function)

    return decorate


def given(dtype: Any, axes: int = 1) -> Any:
    """Type of an array that is only read."""
    return types.Array(dtype, axes, "C", readonly=True)


def written(dtype: Any, axes: int = 1) -> Any:
    """Type of an array that is written: results, or room to work in."""
    return types.Array(dtype, axes, "C")
