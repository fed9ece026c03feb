"""PillarGrid against the paper's equations, and `cells` against a search of the borders."""

import re

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from asca_pillars.base.errors import ConfigError
from asca_pillars.ops.pillar.grid import HEAD_STRIDE, NECK_STRIDE, PillarGrid

# x: 3 zones x 8 columns x 0.32 m = 7.68 m, twice; y: 8 rows x 0.16 m = 1.28 m, eight times.
SMALL = PillarGrid(x_range_m=(2.0, 17.36), y_range_m=(-3.2, 7.04), z_range_m=(-2.5, 1.5))


@st.composite
def grids(draw: st.DrawFn) -> PillarGrid:
    """Legal grids of all shapes, small enough for brute force."""
    zones = draw(st.integers(1, 5))
    v_max, v_y = draw(st.sampled_from([0.16, 0.32, 0.4, 1 / 3])), draw(st.sampled_from([0.1, 0.16, 0.25]))
    x0, y0 = draw(st.floats(-60, 60)), draw(st.floats(-60, 60))
    return PillarGrid(
        x_range_m=(x0, x0 + draw(st.integers(1, 2)) * NECK_STRIDE * zones * v_max),
        y_range_m=(y0, y0 + draw(st.integers(1, 4)) * NECK_STRIDE * v_y),
        v_max_m=v_max,
        v_y_m=v_y,
        zones=zones,
    )


def test_default_is_the_papers_grid() -> None:
    grid = PillarGrid()
    depths = np.diff(grid.x_edges_m)
    # Zones of 69.12 / 3 = 23.04 m: 23.04 / 0.32 = 72 columns, then 144 of 0.16 m and 288 of 0.08 m.
    np.testing.assert_allclose(depths, np.repeat([0.32, 0.16, 0.08], [72, 144, 288]))
    assert (grid.nx, grid.ny) == (504, 496)
    assert grid.head_shape == (248, 252)
    np.testing.assert_allclose(np.diff(grid.y_edges_m), 0.16)


@settings(max_examples=60)
@given(grids())
def test_columns_follow_equations_1_to_5_and_fill_the_ranges(grid: PillarGrid) -> None:
    d_min, d_max = grid.x_range_m
    near, depths = grid.x_edges_m[:-1], np.diff(grid.x_edges_m)
    a = (near - d_min) / (d_max - d_min)  # eq. 3-5 for the near edge of each column
    n = np.floor(a * grid.zones + 1e-9) + 1  # eq. 2
    np.testing.assert_allclose(depths, grid.v_max_m / 2 ** (n - 1), rtol=1e-6)  # eq. 1
    for edges, span, count in ((grid.x_edges_m, grid.x_range_m, grid.nx), (grid.y_edges_m, grid.y_range_m, grid.ny)):
        assert edges.shape == (count + 1,) and edges.dtype == np.float64
        assert (edges[0], edges[-1]) == span and (np.diff(edges) > 0).all() and count % NECK_STRIDE == 0
    # Head cells are two equal columns wide: no zone border lies inside.
    np.testing.assert_allclose(*depths.reshape(-1, HEAD_STRIDE).T)
    x, y = grid.head_centers_m()
    assert (len(y), len(x)) == grid.head_shape
    cells = np.arange(grid.nx * grid.ny)
    centers = grid.cell_centers_m(cells)
    assert centers.dtype == np.float32
    np.testing.assert_array_equal(grid.cells(np.insert(centers, 2, -1.0, axis=1)), cells)
    rows, columns = np.moveaxis(centers.reshape(grid.ny, grid.nx, 2).astype(np.float64), 2, 0)[::-1]
    np.testing.assert_allclose(x, columns[0].reshape(-1, 2).mean(axis=1), atol=1e-5)
    np.testing.assert_allclose(y, rows[:, 0].reshape(-1, 2).mean(axis=1), atol=1e-5)


def cells_by_search(grid: PillarGrid, points: np.ndarray) -> list[int]:
    """`cells`, one point at a time, by searching the borders."""
    x_edges, y_edges = grid.x_edges_m.astype(np.float32), grid.y_edges_m.astype(np.float32)
    low, high = np.float32(grid.z_range_m[0]), np.float32(grid.z_range_m[1])
    result = []
    for x, y, z in points:
        inside = np.isfinite([x, y, z]).all() and low <= z < high
        column = int(np.searchsorted(x_edges, x, side="right")) - 1 if inside else -1
        row = int(np.searchsorted(y_edges, y, side="right")) - 1 if inside else -1
        inside = 0 <= column < grid.nx and 0 <= row < grid.ny
        result.append(row * grid.nx + column if inside else -1)
    return result


@settings(max_examples=60)
@given(grids(), st.integers(0, 2**32 - 1))
def test_cells_equal_a_search_of_the_borders(grid: PillarGrid, seed: int) -> None:
    rng = np.random.default_rng(seed)
    x, y = (rng.uniform(span[0] - 1, span[1] + 1, 150) for span in (grid.x_range_m, grid.y_range_m))
    # Half of the points stand exactly on borders, or one float to either side.
    x[:75], y[:75] = rng.choice(grid.x_edges_m, 75), rng.choice(grid.y_edges_m, 75)
    z = rng.choice([-3.0, -1.0, 0.5, 1.0, 2.0], 150)
    points = np.stack([x, y, z], axis=1).astype(np.float32)
    points[:25] = np.nextafter(points[:25], np.float32(-np.inf))
    points[25:50] = np.nextafter(points[25:50], np.float32(np.inf))
    points[rng.integers(0, 150, 6), rng.integers(0, 3, 6)] = rng.choice([np.nan, np.inf, -np.inf], 6)
    cells = grid.cells(points)
    assert cells.dtype == np.int64
    assert cells.tolist() == cells_by_search(grid, points)


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        ({"x_range_m": (0.0, 70.0)}, ["[0, 69.12]", "[0, 76.8]", "0.32"]),
        ({"y_range_m": (-40.0, 40.0)}, ["[-39.68, 39.68]", "[-40.32, 40.32]"]),
        ({"y_range_m": (-30.0, 40.0)}, ["[-30, 39.12]", "[-30, 40.4]"]),
        ({"zones": 4}, ["zones 1 or 3", "[0, 61.44]", "[0, 71.68]"]),
        ({"v_max_m": 0.3}, ["use x_range_m [0, 64.8] or [0, 72], or v_max_m 0.288"]),
        ({"x_range_m": (0.0, 1e-4)}, ["use x_range_m [0, 7.68], or v_max_m"]),
        ({"y_range_m": (-39.68, 39.76)}, ["use y_range_m [-39.68, 39.68] or [-39.68, 40.96]"]),  # half a row
        ({"x_range_m": (69.12, 0.0)}, ["x_range_m", "smaller first"]),
        ({"y_range_m": (0.0, float("nan"))}, ["y_range_m", "finite"]),
        ({"z_range_m": (1.0, 1.0)}, ["z_range_m"]),
        ({"v_max_m": 0.0}, ["v_max_m"]),
        ({"v_y_m": -0.16}, ["v_y_m"]),
        ({"v_y_m": float("inf")}, ["v_y_m"]),
        ({"zones": 0}, ["zones 0", "1 and 5"]),
        ({"zones": 6}, ["zones 6"]),
    ],
)
def test_illegal_grids_are_refused_with_advice(settings: dict[str, object], named: list[str]) -> None:
    with pytest.raises(ConfigError) as error:
        PillarGrid(**settings)  # type: ignore[arg-type]
    message = str(error.value)
    assert "\n" not in message
    for text in named:
        assert text in message


@given(st.sampled_from([0.0, -20.0, 3.5]) | st.none(), st.floats(1, 120), st.floats(0.05, 0.6), st.integers(1, 5))
def test_advice_on_x_works(start_m: float | None, length_m: float, v_max_m: float, zones: int) -> None:
    span = (-length_m / 2, length_m / 2) if start_m is None else (start_m, start_m + length_m)
    try:
        PillarGrid(x_range_m=span, v_max_m=v_max_m, zones=zones)
        assume(False)
    except ConfigError as error:
        advice = str(error).split(": use ")[1]
    ranges = [(float(a), float(b)) for a, b in re.findall(r"\[(\S+), (\S+)\]", advice)]
    assert 1 <= len(ranges) <= 2
    step_m = NECK_STRIDE * zones * v_max_m
    for proposed in ranges:
        PillarGrid(x_range_m=proposed, v_max_m=v_max_m, zones=zones)
        assert abs((proposed[1] - proposed[0]) - length_m) <= max(step_m, 1e-3)  # one of the two nearest
        assert (proposed[0] == -proposed[1]) if span[0] == -span[1] else (proposed[0] == start_m)
    (size,) = re.findall(r"v_max_m (\S+?)(?:,|$)", advice)
    PillarGrid(x_range_m=span, v_max_m=float(size), zones=zones)
    for k in re.findall(r"\d", advice.split("zones ")[1]) if "zones" in advice else []:
        PillarGrid(x_range_m=span, v_max_m=v_max_m, zones=int(k))


@given(st.floats(-30, 30), st.floats(0.5, 90), st.floats(0.05, 0.6))
def test_advice_on_y_works(start_m: float, length_m: float, v_y_m: float) -> None:
    span = (start_m, start_m + length_m)
    try:
        PillarGrid(y_range_m=span, v_y_m=v_y_m)
        assume(False)
    except ConfigError as error:
        advice = str(error).split(": use ")[1]
    for a, b in re.findall(r"\[(\S+), (\S+)\]", advice):
        PillarGrid(y_range_m=(float(a), float(b)), v_y_m=v_y_m)
    (size,) = re.findall(r"v_y_m (\S+)$", advice)
    PillarGrid(y_range_m=span, v_y_m=float(size))
