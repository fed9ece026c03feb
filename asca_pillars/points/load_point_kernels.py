"""Whether numba runs the loops over points, or NumPy."""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple


class PointKernels(NamedTuple):
    """Compiled forms of the functions of these names (most with an underscore) in this folder."""

    sort: Callable[..., Any]
    farthest_points: Callable[..., Any]
    near_circles: Callable[..., Any]
    ball_query: Callable[..., Any]
    three_nearest: Callable[..., Any]


@cache
def load_point_kernels() -> PointKernels | None:
    """The compiled forms, or None where numba is not installed or does not fit the NumPy beside it.

    Apart from `geometry.kernels`, so that a detector of one stage need not load them.
    """
    try:
        from asca_pillars.points import ball_kernels, sampling_kernels
    except ImportError:
        return None
    return PointKernels(
        *(sampling_kernels.sort, sampling_kernels.farthest_points, sampling_kernels.near_circles),
        *(ball_kernels.ball_query, ball_kernels.three_nearest),
    )
