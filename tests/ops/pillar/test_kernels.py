"""The compiled PFN layer against NumPy's products and maxima."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from asca_pillars.ops.pillar.kernels import pfn_maxima


@given(st.integers(0, 2**32 - 1), st.lists(st.integers(1, 40), max_size=20), st.sampled_from([1, 7, 32, 64]))
def test_the_pfn_layer(seed: int, counts: list[int], channels: int) -> None:
    rng = np.random.default_rng(seed)
    point_counts = np.array(counts, np.int64)
    features, weight, bias = (
        rng.normal(0, 3, shape).astype(np.float32) for shape in ((sum(counts), 9), (9, channels), channels)
    )
    maxima = pfn_maxima(features, point_counts, weight, bias)
    activations = np.maximum(features.astype(np.float64) @ weight + bias, 0)
    starts = np.cumsum(point_counts) - point_counts
    expected = np.maximum.reduceat(activations, starts) if counts else np.empty((0, channels))
    assert maxima.dtype == np.float32 and (maxima >= 0).all()
    np.testing.assert_allclose(maxima, expected, rtol=1e-5, atol=1e-4)
