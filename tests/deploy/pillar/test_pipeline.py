from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from asca_deploy.bundle import CanvasFormat
from asca_deploy.pillar.pipeline import Canvas, take_or_create
from asca_pillars.ops.pillar.grid import PillarGrid

# 8 + 16 + 32 columns by 16 rows, off center.
GRID = PillarGrid(x_range_m=(1.0, 8.68), y_range_m=(-0.64, 1.92))
CHANNELS = 3
FORMATS = (CanvasFormat(), CanvasFormat("uint8", (7, 0, 130)))


def scatter_by_loop(pillar_features: NDArray[np.generic], cells: NDArray[np.int64], empty: object) -> object:
    image = np.empty((1, GRID.ny + 1, GRID.nx + 1, CHANNELS), pillar_features.dtype)
    image[:] = empty
    for features, cell in zip(pillar_features, cells, strict=True):
        image[0, 1 + cell // GRID.nx, 1 + cell % GRID.nx] = features
    return image


@pytest.mark.parametrize("form", FORMATS)
def test_every_frame_equals_a_scatter_onto_nothing(form: CanvasFormat) -> None:
    rng = np.random.default_rng(0)
    canvas = Canvas(CHANNELS, GRID, form)
    for count in (40, 7, 0, 1, GRID.nx * GRID.ny, 12):
        cells = np.sort(rng.choice(GRID.nx * GRID.ny, count, replace=False))
        features = rng.uniform(0, 255, (count, CHANNELS)).astype(form.type)
        expected = scatter_by_loop(features, cells, form.empty or 0)
        np.testing.assert_array_equal(canvas.scatter(features, cells), expected)
        assert canvas.image.dtype == form.type


def test_the_image_is_allocated_once() -> None:
    canvas = Canvas(CHANNELS, GRID)
    first = canvas.scatter(np.ones((1, CHANNELS), np.float32), np.array([5]))
    second = canvas.scatter(np.ones((1, CHANNELS), np.float32), np.array([9]))
    assert first is second
    assert second.flags.c_contiguous


class TakenMeanwhile(list[Any]):
    """Its last entry is taken by another thread after one has looked and before one takes."""

    def __len__(self) -> int:
        return 1

    def __bool__(self) -> bool:
        return True


def test_what_is_free_is_used_again() -> None:
    free = ["kept"]
    assert (take_or_create(free, lambda: "made"), take_or_create(free, lambda: "made")) == ("kept", "made")


def test_another_thread_may_take_the_last_one() -> None:
    assert take_or_create(TakenMeanwhile(), lambda: "made") == "made"
