"""Whether numba runs the loops of this package, or NumPy."""

import importlib
from functools import cache
from types import ModuleType


@cache
def load_kernels() -> ModuleType | None:
    """`geometry.kernels`, or None where numba is not installed or does not fit the NumPy beside it.

    The results are the same; without it a full scan costs some milliseconds more. The first call of a process imports
    numba and takes a few tenths of a second, the very first one on a machine also compiles.
    """
    try:
        return importlib.import_module("asca_pillars.geometry.kernels")
    except ImportError:
        return None
