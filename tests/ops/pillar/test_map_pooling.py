"""The pooled map: pillars of every zone in columns of one depth, against a loop over points in metres."""

import dataclasses

import numpy as np
import pytest

from asca_pillars.ops.pillar.grid import PillarGrid, map_cells, pool_pillars


def pooled_grid(zones: int) -> PillarGrid:
    depth_m = 7.68 * zones  # 24 columns of 0.32 m in each zone
    return PillarGrid((0.0, depth_m), (-2.56, 2.56), (-3.0, 1.0), v_max_m=0.32, zones=zones, map="pooled")


def random_pillars(grid: PillarGrid, share: float) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    cells = np.flatnonzero(rng.random(grid.ny * grid.nx) < share)
    return rng.normal(-1.0, 1.0, (len(cells), 5)).astype(np.float32), cells


@pytest.mark.parametrize("zones", [2, 3, 4, 5])
@pytest.mark.parametrize("share", [0.02, 1.0])
def test_every_cell_has_the_largest_values_of_the_pillars_on_it(zones: int, share: float) -> None:
    grid = pooled_grid(zones)
    features, cells = random_pillars(grid, share)
    rows, columns = grid.map_shape
    edges_m = np.linspace(*grid.x_range_m, columns + 1)
    expected = np.full((rows, columns, 5), -np.inf, np.float32)
    for feature, cell in zip(features, cells, strict=True):
        row, column = divmod(int(cell), grid.nx)
        low, high = grid.x_edges_m[column : column + 2]
        on_it = (edges_m[:-1] < high - 1e-6) & (edges_m[1:] > low + 1e-6)  # by metres alone
        expected[row, on_it] = np.maximum(expected[row, on_it], feature)
    pooled, occupied = pool_pillars(features, cells, grid)
    np.testing.assert_array_equal(occupied, np.flatnonzero(np.isfinite(expected[..., 0])))
    np.testing.assert_array_equal(pooled, expected.reshape(-1, 5)[occupied])


def test_the_map_is_that_of_uniform_pillars() -> None:
    pooled = PillarGrid(zones=3, map="pooled")
    uniform = PillarGrid(zones=1, v_max_m=0.16)
    assert pooled.map_shape == uniform.map_shape == (496, 432) and pooled.head_shape == uniform.head_shape
    for ours, theirs in zip(pooled.head_centers_m(), uniform.head_centers_m(), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-9)


def test_maps_that_stay_as_they_are_and_no_pillars() -> None:
    for grid in (PillarGrid(zones=1, v_max_m=0.16, map="pooled"), PillarGrid()):
        features, cells = random_pillars(grid, 0.01)
        assert grid.map_shape == (grid.ny, grid.nx) and map_cells(cells, grid) is None
        assert pool_pillars(features, cells, grid)[0] is features
    grid = pooled_grid(3)
    pooled, occupied = pool_pillars(np.empty((0, 5), np.float32), np.empty(0, np.int64), grid)
    assert pooled.shape == (0, 5) and occupied.shape == (0,)
    assert dataclasses.replace(grid, map="warped").map_shape == (grid.ny, grid.nx)


def test_steps_may_be_pooled_in_place_of_values() -> None:
    grid = pooled_grid(4)
    features, cells = random_pillars(grid, 0.7)
    steps = np.clip(np.round(features * 40 + 120), 0, 255).astype(np.uint8)
    pooled, _ = pool_pillars(features, cells, grid)
    expected = np.clip(np.round(pooled * 40 + 120), 0, 255).astype(np.uint8)
    np.testing.assert_array_equal(pool_pillars(steps, cells, grid)[0], expected)
