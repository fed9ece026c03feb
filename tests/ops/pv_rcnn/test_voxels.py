"""Voxels against a loop over points."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from asca_pillars.base.errors import ConfigError
from asca_pillars.ops.pv_rcnn.voxels import VoxelGrid, voxelize
from asca_pillars.ops.sparse.rulebooks import CellMap

GRID = VoxelGrid((1.0, 4.0), (-2.0, 1.2), (-1.5, 0.5), (0.3, 0.2, 0.1), max_points=3)


def cloud(seed: int, count: int, spread_m: float, odd: float) -> np.ndarray:
    """(count, 4) points, the share `odd` of their values on borders of voxels, next to them, or not finite."""
    rng = np.random.default_rng(seed)
    points = rng.normal((2.5, 0, -0.5, 0.5), (spread_m, spread_m, 0.6, 0.2), (count, 4)).astype(np.float32)
    for axis, ((low, _), size) in enumerate(zip(GRID.ranges_m, GRID.size_m, strict=True)):
        edges = (low + size * np.arange(33)).astype(np.float32)
        borders = np.concatenate([edges, np.nextafter(edges, np.float32(9)), np.nextafter(edges, np.float32(-9))])
        chosen = rng.random(count) < odd
        points[chosen, axis] = rng.choice([*borders, np.nan, np.inf, -np.inf], chosen.sum())
    return points


def held(points: np.ndarray, grid: VoxelGrid) -> dict[int, list[np.ndarray]]:
    """The points of each voxel in the scan's order, by the voxel's flat index: point by point, in float32."""
    nz, ny, nx = grid.shape
    found: dict[int, list[np.ndarray]] = {}
    for point in points:
        place = [
            # The quotient may round up to the range's end: its last voxel has the point.
            min(int((value - np.float32(low)) / np.float32(size)), count - 1)
            for value, (low, high), size, count in zip(
                point[:3], grid.ranges_m, grid.size_m, (nx, ny, nz - grid.empty_layers), strict=True
            )
            if np.float32(low) <= value < np.float32(high)
        ]
        if len(place) == 3:
            x, y, z = place
            found.setdefault((y * nx + x) * nz + z, []).append(point)
    return found


@settings(max_examples=50)
@given(
    st.integers(0, 2**32 - 1),
    st.sampled_from([0, 1, 50, 300]),
    st.sampled_from([0.05, 1.0]),
    st.sampled_from([0.0, 0.4]),
)
@example(7, 400, 0.5, 0.0)  # more points in a voxel than enter its mean, and points outside
def test_voxels_hold_the_mean_of_their_first_points(seed: int, count: int, spread_m: float, odd: float) -> None:
    points, cell_map = cloud(seed, count, spread_m, odd), CellMap(GRID.shape)
    voxelize(cloud(seed + 1, count, spread_m, odd), GRID, cell_map)  # of which nothing may stay
    found, expected = voxelize(points, GRID, cell_map), held(points, GRID)
    assert found.cells.tolist() == sorted(expected)
    assert found.points_outside == count - sum(map(len, expected.values()))
    assert found.features.dtype == np.float32 and found.features.shape == (len(expected), 4)
    for cell, feature in zip(found.cells, found.features, strict=True):
        first = np.array(expected[cell][: GRID.max_points], np.float64)
        np.testing.assert_array_equal(feature, (np.cumsum(first, axis=0)[-1] / len(first)).astype(np.float32))
    inside = np.abs(GRID.centers_m(found.cells) - found.features[:, :3]) <= np.array(GRID.size_m) / 2 + 1e-5
    assert inside.all()


@settings(max_examples=40)
@given(st.integers(1, 9000), st.sampled_from([0.01, 0.03, 0.05, 0.1, 0.16]), st.floats(-200, 200))
@example(17, 0.01, 0.0)  # its quotient rounds up to the range's end
def test_the_last_point_of_a_range_is_in_its_last_voxel(count: int, size_m: float, low_m: float) -> None:
    """Far from 0 float32 rounds more than a voxel's share; a point was then put one row on, or beyond the map."""
    grid = VoxelGrid((low_m, low_m + count * size_m), (0, 0.2), (0, 0.2), (size_m, 0.1, 0.1), empty_layers=0)
    ends = np.array([low_m, low_m + count * size_m], np.float32)
    points = np.array([[ends[0], 0.15, 0.15], [np.nextafter(ends[1], ends[0]), 0.15, 0.15]], np.float32)
    cells = grid.cells(points)
    assert grid.shape == (2, 2, count)
    columns = (0, count - 1)
    assert cells.tolist() == [(count + column) * 2 + 1 for column in columns], "second row of y, second layer of z"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"x_range_m": (0.0, 70.42)}, "whole number"),
        ({"z_range_m": (-3.0, 3.5)}, "more than 64"),
        ({"y_range_m": (4.0, -4.0)}, "smaller first"),
        ({"size_m": (0.05, 0.0, 0.1)}, "positive size"),
        ({"max_points": 0}, "max_points"),
    ],
)
def test_impossible_grids_are_refused(change: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        VoxelGrid(**change)  # type: ignore[arg-type]
