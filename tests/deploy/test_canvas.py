import numpy as np
from numpy.typing import NDArray

from asca_deploy.canvas import Canvas
from asca_pillars.geometry.grid import PillarGrid

# 8 + 16 + 32 columns by 16 rows, off centre.
GRID = PillarGrid(x_range_m=(1.0, 8.68), y_range_m=(-0.64, 1.92))
CHANNELS = 3


def scatter_by_loop(pillar_features: NDArray[np.float32], cells: NDArray[np.int64]) -> NDArray[np.float32]:
    image = np.zeros((1, CHANNELS, GRID.ny, GRID.nx), np.float32)
    for features, cell in zip(pillar_features, cells, strict=True):
        for channel, value in enumerate(features):
            image[0, channel, cell // GRID.nx, cell % GRID.nx] = value
    return image


def test_every_frame_equals_a_scatter_onto_zeros() -> None:
    rng = np.random.default_rng(0)
    canvas = Canvas(CHANNELS, GRID)
    for count in (40, 7, 0, 1, GRID.nx * GRID.ny, 12):
        cells = np.sort(rng.choice(GRID.nx * GRID.ny, count, replace=False))
        features = rng.normal(size=(count, CHANNELS)).astype(np.float32)
        np.testing.assert_array_equal(canvas.scatter(features, cells), scatter_by_loop(features, cells))


def test_the_image_is_allocated_once() -> None:
    canvas = Canvas(CHANNELS, GRID)
    first = canvas.scatter(np.ones((1, CHANNELS), np.float32), np.array([5]))
    second = canvas.scatter(np.ones((1, CHANNELS), np.float32), np.array([9]))
    assert first is second
    assert second.flags.c_contiguous
