"""Whether numba runs the loops of a module, such as those of `rotated_nms` and `pillarize`, or NumPy.

Each module names its own kernels, so that a detector of one stage, or without tables, does not wait for the others.
"""

import importlib
from functools import cache
from types import ModuleType


@cache
def load_kernels(module: str) -> ModuleType | None:
    """The compiled forms of a module's functions, or None where numba is not installed or does not fit NumPy.

    Without them the results are the same and a full scan takes some milliseconds more. The first call of a process
    imports numba and takes a few tenths of a second; the very first one on a machine compiles, some seconds.

    Args:
        module: that holds them, such as `asca_pillars.geometry.nms_kernels`.
    """
    try:
        return importlib.import_module(module)
    except ImportError:
        return None
