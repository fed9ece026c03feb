"""Compiled kernels of a module, such as those of `rotated_nms` and `pillarize`, imported on first use.

Each module names its own kernels, so that a detector of one stage, or without rulebooks, does not wait for the others.
"""

import importlib
from functools import cache
from types import ModuleType


@cache
def load_kernels(module: str) -> ModuleType:
    """Return the compiled functions of a module.

    The first call of a process imports numba and takes a few tenths of a second; the very first one on a machine
    compiles, some seconds.

    Args:
        module: that holds them, such as `asca_pillars.geometry.nms_kernels`.
    """
    return importlib.import_module(module)
