"""Clouds of points."""

import numpy as np
from hypothesis import strategies as st


def cloud(seed: int, count: int, spread_m: float, coarse: bool) -> np.ndarray:
    """(count, 4) points; coarse ones lie on a lattice, so that many stand in one place or equally far apart."""
    rng = np.random.default_rng(seed)
    points = rng.normal(0, spread_m, (count, 4)).astype(np.float32) + np.array([30, -5, 0, 0], np.float32)
    return np.round(points) if coarse else points


CLOUDS = st.builds(
    cloud, st.integers(0, 2**32 - 1), st.integers(0, 300), st.sampled_from([0.0, 0.3, 3.0, 30.0, 3000.0]), st.booleans()
)


def squared_distances(points: np.ndarray, queries: np.ndarray) -> np.ndarray:
    """(Q, N), float32, added up in the order x, y, z."""
    d = points[None, :, :3] - queries[:, None, :3]
    return d[..., 0] * d[..., 0] + d[..., 1] * d[..., 1] + d[..., 2] * d[..., 2]
