"""Whether numba runs the loops over points, or NumPy."""

from functools import cache
from types import ModuleType


@cache
def load_point_kernels() -> ModuleType | None:
    """`point_kernels`, or None where numba is not installed or does not fit the NumPy beside it.

    Apart from `geometry.kernels`, so that a detector of one stage need not load them.
    """
    try:
        from asca_pillars.points import point_kernels
    except ImportError:
        return None
    return point_kernels
