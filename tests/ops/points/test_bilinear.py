"""Bilinear cells against torch's grid_sample."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from asca_pillars.ops.points.sampling import bilinear_cells, read_map
from tests.ops.numpy_kernels import both_forms


@given(st.integers(0, 2**32 - 1))
def test_is_grid_sample(seed: int) -> None:
    rng = np.random.default_rng(seed)
    height, width = rng.integers(2, 9, 2)
    image = rng.normal(size=(height, width)).astype(np.float32)
    x_m, y_m = 3 + 0.4 * np.arange(width), -2 + 0.3 * np.arange(height)
    points = rng.uniform([2, -3], [3 + 0.4 * width, -2 + 0.4 * height], (30, 2))
    cells, weights = bilinear_cells(points, x_m, y_m)
    assert (weights >= 0).all()
    np.testing.assert_allclose(weights.sum(axis=1), 1, rtol=1e-6)
    place = np.stack([(points[:, 0] - 3) / 0.4 / (width - 1), (points[:, 1] + 2) / 0.3 / (height - 1)], axis=1) * 2 - 1
    expected = torch.nn.functional.grid_sample(
        torch.from_numpy(image)[None, None].double(),
        torch.from_numpy(place)[None, None],
        align_corners=True,
        padding_mode="border",
    )
    np.testing.assert_allclose((image.ravel()[cells] * weights).sum(axis=1), expected[0, 0, 0], atol=1e-5)


def test_cells_need_not_be_evenly_spaced() -> None:
    cells, weights = bilinear_cells(np.array([[2.5, 0.0]]), np.array([0.0, 1.0, 4.0]), np.array([0.0, 1.0]))
    assert cells.tolist() == [[1, 2, 4, 5]]
    assert weights[0] == pytest.approx([0.5, 0.5, 0, 0])


@given(st.integers(0, 2**32 - 1), st.integers(0, 20), st.sampled_from([np.float32, np.uint8]))
def test_both_forms_read_the_same(seed: int, count: int, dtype: type[np.generic]) -> None:
    rng = np.random.default_rng(seed)
    rows = rng.uniform(0, 255, (30, 9)).astype(dtype)
    cells = rng.integers(0, 30, (count, 4)).astype(np.int32)
    weights = rng.random((count, 4), np.float32)
    compiled, in_numpy = both_forms(read_map, rows, cells, weights)
    assert compiled.shape == in_numpy.shape and compiled.tobytes() == in_numpy.tobytes()
    np.testing.assert_allclose(compiled, (rows[cells] * weights[..., None]).sum(axis=1), rtol=1e-5)
