"""Whether numba runs the loops of `pillarize` and `rotated_nms`, or NumPy."""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple


class Kernels(NamedTuple):
    """Compiled forms of the functions of these names (with an underscore) in `pillarize` and `overlap`."""

    sort_points: Callable[..., Any]
    fill_pillars: Callable[..., Any]
    suppress: Callable[..., Any]


@cache
def load_kernels() -> Kernels | None:
    """The compiled forms, or None where numba is not installed or does not fit the NumPy beside it.

    Without them the results are the same and a full scan takes some milliseconds more. The first call of a process
    imports numba and takes a few tenths of a second; the very first one on a machine compiles, two seconds.
    """
    try:
        from asca_pillars.geometry import overlap_kernels as kernels_overlap
        from asca_pillars.pillars import pillar_kernels as kernels_pillars
    except ImportError:
        return None
    return Kernels(kernels_pillars.sort_points, kernels_pillars.fill_pillars, kernels_overlap.suppress)
