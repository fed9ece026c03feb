"""`pillarize` against a dictionary of lists, its limits, and clouds that hold almost nothing."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from asca_pillars.base.errors import ConfigError
from asca_pillars.ops.pillar.grid import PillarGrid
from asca_pillars.ops.pillar.prepare import FEATURES, PillarCounts, PillarLimits, Pillars, evenly_spaced_mask, pillarize

GRID = PillarGrid(x_range_m=(2.0, 17.36), y_range_m=(-3.2, 7.04), z_range_m=(-2.5, 1.5))
NO_LIMITS = PillarLimits(max_pillars=10**9, max_points=10**9)


def cloud(seed: int, count: int, spread_m: float = 12.0) -> np.ndarray:
    """(count, 4) points around the middle of the grid, some of them outside."""
    rng = np.random.default_rng(seed)
    xyz = rng.normal((9.0, 2.0, -0.5), (spread_m, spread_m, 1.2), (count, 3))
    return np.column_stack([xyz, rng.random(count)]).astype(np.float32)


def pillars_by_loop(points: np.ndarray, grid: PillarGrid) -> dict[int, list[int]]:
    """Indices of the points of each pillar, by cell, without limits."""
    pillars: dict[int, list[int]] = {}
    for index, cell in enumerate(grid.cells(points)):
        if cell >= 0:
            pillars.setdefault(int(cell), []).append(index)
    return dict(sorted(pillars.items()))


def assert_consistent(pillars: Pillars, points: np.ndarray, grid: PillarGrid) -> None:
    """Everything that must hold whatever was dropped."""
    features, stats = pillars.features, pillars.stats
    assert features.dtype == np.float32 and features.shape == (len(pillars.pillar_index), len(FEATURES))
    for array in (pillars.pillar_index, pillars.point_counts, pillars.cells):
        assert array.dtype == np.int64 and array.ndim == 1
    assert stats.pillars == len(pillars.cells) == len(pillars.point_counts)
    assert stats.points == len(points)
    assert stats.points == len(features) + stats.points_outside + stats.points_over_limit
    assert (np.diff(pillars.cells) > 0).all()
    np.testing.assert_array_equal(pillars.pillar_index, np.repeat(np.arange(stats.pillars), pillars.point_counts))
    np.testing.assert_array_equal(grid.cells(features), pillars.cells[pillars.pillar_index])
    for pillar, cell in enumerate(pillars.cells):
        inside = features[pillars.pillar_index == pillar].astype(np.float64)
        np.testing.assert_allclose(inside[:, 4:7], inside[:, :3] - inside[:, :3].mean(axis=0), atol=1e-5)
        np.testing.assert_allclose(inside[:, 7:], inside[:, :2] - grid.cell_centers_m(cell[None]), atol=1e-5)


@settings(max_examples=40)
@given(
    st.integers(0, 2**32 - 1),
    st.integers(0, 300),
    st.sampled_from([0.2, 2.0, 12.0]),
    st.sampled_from([GRID, PillarGrid()]),  # some 4,000 cells, and 250,000
)
def test_equals_a_dictionary_of_lists(seed: int, count: int, spread_m: float, grid: PillarGrid) -> None:
    points = cloud(seed, count, spread_m)
    pillars = pillarize(points, grid, NO_LIMITS)
    expected = pillars_by_loop(points, grid)
    assert pillars.cells.tolist() == list(expected)
    assert pillars.point_counts.tolist() == [len(indices) for indices in expected.values()]
    order = [index for indices in expected.values() for index in indices]  # the scan's order within a pillar
    np.testing.assert_array_equal(pillars.features[:, :4], points[order].reshape(-1, 4))
    assert pillars.stats == PillarCounts(count, count - len(order), 0, len(expected), 0)
    assert_consistent(pillars, points, grid)


@settings(max_examples=40)
@given(st.integers(0, 2**32 - 1), st.integers(1, 30), st.integers(1, 8))
def test_limits_keep_a_subset(seed: int, max_pillars: int, max_points: int) -> None:
    points = cloud(seed, 400, 0.5)
    points[:, 3] = np.arange(400) / 400  # tells the points apart
    limits = PillarLimits(max_pillars, max_points)
    pillars = pillarize(points, GRID, limits)
    assert_consistent(pillars, points, GRID)

    expected = pillars_by_loop(points, GRID)
    assert pillars.stats.pillars == min(len(expected), max_pillars)
    assert pillars.stats.pillars_over_limit == len(expected) - pillars.stats.pillars
    kept = np.round(pillars.features[:, 3] * 400).astype(int)
    for pillar, cell in enumerate(pillars.cells.tolist()):
        indices = kept[pillars.pillar_index == pillar].tolist()
        assert len(indices) == min(len(expected[cell]), max_points)
        assert set(indices) <= set(expected[cell])
        assert indices == sorted(indices)
    before = points.copy()
    pillars.features[:] = 0
    np.testing.assert_array_equal(points, before)


@given(st.integers(1, 500), st.integers(1, 600))
def test_an_even_subset_has_steps_that_differ_by_one(count: int, most: int) -> None:
    stays = np.flatnonzero(evenly_spaced_mask(np.arange(count), count, most))
    assert len(stays) == min(count, most)
    steps = np.diff(stays, prepend=-1)
    assert steps.max() - steps.min() <= 1


@pytest.mark.parametrize(
    "points", [np.empty((0, 4)), np.full((3, 4), 1000.0), np.full((3, 4), np.nan)], ids=["empty", "outside", "nan"]
)
def test_nothing_inside_gives_empty_pillars(points: np.ndarray) -> None:
    pillars = pillarize(points.astype(np.float32), GRID, PillarLimits())
    assert pillars.features.shape == (0, 9)
    assert pillars.cells.shape == pillars.point_counts.shape == pillars.pillar_index.shape == (0,)
    assert pillars.stats == PillarCounts(len(points), len(points), 0, 0, 0)
    assert_consistent(pillars, points, GRID)


@pytest.mark.parametrize("shape", [(4,), (5, 3), (5, 5)])
def test_other_shapes_are_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"\(N, 4\)"):
        pillarize(np.zeros(shape, np.float32), GRID, PillarLimits())


@pytest.mark.parametrize("settings", [{"max_pillars": 0}, {"max_points": -1}, {"max_points": 10**20}])
def test_limits_that_nothing_counts_to_are_refused(settings: dict[str, int]) -> None:
    with pytest.raises(ConfigError, match=next(iter(settings))):
        PillarLimits(**settings)
