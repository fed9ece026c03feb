"""Clouds of points, and the forms of a function: numba's and NumPy's."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any
from unittest.mock import patch

import numpy as np
from hypothesis import strategies as st

_MODULES = ("columns", "farthest_points", "ball_query", "bilinear", "cube_neighbors")


def by_numpy(function: Callable[..., Any], *arguments: Any) -> Any:
    """The function's result where numba is not installed."""
    with ExitStack() as stack:
        for name in _MODULES:
            stack.enter_context(patch(f"asca_pillars.ops.points.{name}.load_kernels", lambda _: None))
        return function(*arguments)


def both_forms(function: Callable[..., Any], *arguments: Any) -> Iterator[Any]:
    """The result of numba's form and that of NumPy's."""
    yield function(*arguments)
    yield by_numpy(function, *arguments)


def cloud(seed: int, count: int, spread_m: float, coarse: bool) -> np.ndarray:
    """(count, 4) points; coarse ones lie on a lattice, so that many stand in one place or equally far apart."""
    rng = np.random.default_rng(seed)
    points = rng.normal(0, spread_m, (count, 4)).astype(np.float32) + np.array([30, -5, 0, 0], np.float32)
    return np.round(points) if coarse else points


CLOUDS = st.builds(
    cloud, st.integers(0, 2**32 - 1), st.integers(0, 300), st.sampled_from([0.0, 0.3, 3.0, 30.0, 3000.0]), st.booleans()
)
