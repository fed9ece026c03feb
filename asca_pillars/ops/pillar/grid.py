"""The adaptive-scale pillar grid (ASP): which pillar a point falls into, and where a pillar stands in metres.

The x range is cut into K equal zones (paper eq. 2-5). Pillars are `v_max_m` deep in the nearest zone and half
as deep in each following one (eq. 1), so the pseudo-image has more columns per metre far away:

    zone          1                2                      3
    x       |-----------|---------------------|-----------------------------|
    depth     v_max          v_max / 2                 v_max / 4
    columns     c               2c                        4c            (K = 3: nx = 7c)

Columns run along x and rows along y; a pillar's flat index is row * nx + column.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Generic, Literal, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.errors import ConfigError
from asca_pillars.base.strict import Strict
from asca_pillars.geometry.boxes import Ranges, within

__all__ = ["HEAD_STRIDE", "NECK_STRIDE", "PillarGrid"]

# Beyond these a mistyped number asks for more memory than there is.
_FARTHEST_M = 10_000.0
_MOST_PILLARS = 1 << 17  # along one axis


class GridTables(NamedTuple):
    """Lookup tables from points to cells: x in slices of the finest depth, whose borders include every column's.

    Borders are float32, as the points are.
    """

    ranges_m: NDArray[np.float32]
    """(3, 2) lower and upper end along x, y, z."""
    slice_edges_m: NDArray[np.float32]
    """(S + 1,) evenly spaced along x."""
    column_of_slice: NDArray[np.int64]
    """(S,)"""
    row_edges_m: NDArray[np.float32]
    """(ny + 1,) evenly spaced along y."""


@dataclass(frozen=True)
class PillarGrid(Strict):
    """Ranges and pillar sizes in metres, LiDAR frame (paper section 3.2, eq. 1-5). Immutable and validated.

    With zones=1 and v_max_m=0.16 it is the uniform grid of PointPillars.

    Raises:
        ConfigError: if the pillars do not fill the ranges evenly or the map does not fit the network's
            strides; the message names the nearest settings that work.
    """

    x_range_m: tuple[float, float] = (0.0, 69.12)
    y_range_m: tuple[float, float] = (-39.68, 39.68)
    z_range_m: tuple[float, float] = (-3.0, 1.0)
    v_max_m: float = 0.32
    """Depth along x of the pillars nearest to the sensor."""
    v_y_m: float = 0.16
    """Width along y of every pillar."""
    zones: int = 3
    """K, the number of pillar depths."""
    map: Literal["warped", "pooled"] = "warped"
    """Map that the neck reads. `warped`: a column for every pillar along x, as the paper prints it. `pooled`: columns
    as deep as the second zone's pillars everywhere, see `pool_pillars`. With one zone both are the same."""

    def __post_init__(self) -> None:
        for name in ("x_range_m", "y_range_m", "z_range_m"):
            low, high = getattr(self, name)
            if not (math.isfinite(low) and math.isfinite(high) and low < high):
                raise ConfigError(f"{name} [{low:g}, {high:g}] must be two finite numbers, the smaller first")
            if max(-low, high) > _FARTHEST_M:
                raise ConfigError(
                    f"{name} [{low:g}, {high:g}] leads farther than {_FARTHEST_M:g} m, which no LiDAR sees"
                )
        for name in ("v_max_m", "v_y_m"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise ConfigError(f"{name} {getattr(self, name):g} must be a positive size in metres")
        if not 1 <= self.zones <= MAX_ZONES:
            raise ConfigError(f"zones {self.zones} must lie between 1 and {MAX_ZONES}")
        finest_m = self.v_max_m / 2 ** (self.zones - 1)
        for name, size_m in (("x_range_m", finest_m), ("y_range_m", self.v_y_m)):
            low, high = getattr(self, name)
            if (high - low) / size_m > _MOST_PILLARS:
                raise ConfigError(
                    f"{name} [{low:g}, {high:g}] in pillars of {size_m:g} m has more than {_MOST_PILLARS} of them; "
                    "choose larger pillars"
                )
        if not fits(self.x_range_m, self.v_max_m, self.zones):
            raise ConfigError(x_advice(self.x_range_m, self.v_max_m, self.zones))
        if not fits(self.y_range_m, self.v_y_m):
            raise ConfigError(y_advice(self.y_range_m, self.v_y_m))

    @cached_property
    def nx(self) -> int:
        """Columns of the pseudo-image, along x."""
        # Column counts double from zone to zone: c (1 + 2 + ... + 2^(K-1)).
        return self._first_zone_columns * ((1 << self.zones) - 1)

    @cached_property
    def ny(self) -> int:
        """Rows of the pseudo-image, along y."""
        return round((self.y_range_m[1] - self.y_range_m[0]) / self.v_y_m)

    @property
    def ranges(self) -> Ranges:
        """Detection ranges along x, y, z."""
        return Ranges(self.x_range_m, self.y_range_m, self.z_range_m)

    @property
    def head_shape(self) -> tuple[int, int]:
        """(H, W) of the map that the head reads."""
        rows, columns = self.map_shape
        return rows // HEAD_STRIDE, columns // HEAD_STRIDE

    @property
    def pools(self) -> bool:
        """True if the map differs from the grid of pillars."""
        return self.map == "pooled" and self.zones > 1

    @cached_property
    def map_shape(self) -> tuple[int, int]:
        """(rows, columns) of the pseudo-image that the neck reads."""
        return self.ny, 2 * self.zones * self._first_zone_columns if self.pools else self.nx

    @cached_property
    def map_columns(self) -> NDArray[np.int64]:
        """First column of the pooled map that each column of pillars covers, (nx,)."""
        per_zone = 2 * self._first_zone_columns
        zones = [
            zone * per_zone + (np.arange(self._first_zone_columns << zone) * 2 >> zone) for zone in range(self.zones)
        ]
        return np.concatenate(zones)

    @cached_property
    def map_copies(self) -> NDArray[np.int64]:
        """Number of columns of the pooled map that each column of pillars covers, (nx,)."""
        return np.where(np.arange(self.nx) < self._first_zone_columns, 2, 1)

    @cached_property
    def x_edges_m(self) -> NDArray[np.float64]:
        """Column borders, (nx + 1,), ascending; the ends are exactly `x_range_m`. Read-only."""
        return _read_only(np.linspace(*self.x_range_m, self._slices + 1)[self._edge_slices])

    @cached_property
    def y_edges_m(self) -> NDArray[np.float64]:
        """Row borders, (ny + 1,), ascending; the ends are exactly `y_range_m`. Read-only."""
        return _read_only(np.linspace(*self.y_range_m, self.ny + 1))

    def cells(self, points: NDArray[np.floating[Any]]) -> NDArray[np.int64]:
        """Return the flat pillar index row * nx + column of each point, or -1 outside the ranges.

        Borders belong to the pillar above them: a point on a range's lower end is inside, on its upper end
        outside. Points and borders are compared as float32, so that a point written as -39.68 stands on a
        border at -39.68.

        Args:
            points: (N, >=3), columns x, y, z in metres, LiDAR frame; non-finite ones are outside.

        Returns:
            (N,) int64.
        """
        if points.ndim != 2 or points.shape[1] < 3:
            raise ValueError(f"points must have shape (N, >=3), not {points.shape}")
        xyz = points[:, :3].astype(np.float32, copy=False)
        cells = np.full(len(points), -1, np.int64)
        chosen = np.flatnonzero(within(xyz, self.tables.ranges_m))
        slices = _interval(xyz[chosen, 0], self.tables.slice_edges_m)
        rows = _interval(xyz[chosen, 1], self.tables.row_edges_m)
        cells[chosen] = rows * self.nx + self.tables.column_of_slice[slices]
        return cells

    def cell_centers_m(self, cells: NDArray[np.int64]) -> NDArray[np.float32]:
        """Return the centers x, y of the pillars with these flat indices: (n,) -> (n, 2) float32, metres."""
        rows, columns = np.divmod(cells, self.nx)
        return np.stack([self.column_centers_m[columns], self.row_centers_m[rows]], axis=-1)

    def head_centers_m(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return centers of the head map's cells, metres, LiDAR frame: x of its columns (W,), y of its rows (H,).

        Zones hold a multiple of HEAD_STRIDE columns, so the two columns of a head cell are equally deep.
        """
        x_edges_m = np.linspace(*self.x_range_m, self.map_shape[1] + 1) if self.pools else self.x_edges_m
        x_m, y_m = x_edges_m[::HEAD_STRIDE], self.y_edges_m[::HEAD_STRIDE]
        return (x_m[:-1] + x_m[1:]) / 2, (y_m[:-1] + y_m[1:]) / 2

    @cached_property
    def _first_zone_columns(self) -> int:
        return round((self.x_range_m[1] - self.x_range_m[0]) / (self.zones * self.v_max_m))

    # The x range in slices of the finest depth: every border of a column is a border of a slice, so finding
    # the column is one multiplication and one look-up, whatever the number of zones.

    @cached_property
    def _slices(self) -> int:
        return self.zones * self._first_zone_columns << (self.zones - 1)

    @cached_property
    def _edge_slices(self) -> NDArray[np.int64]:
        """The slice at whose lower border each column starts, and the end: (nx + 1,)."""
        slices_per_column = 2 ** np.arange(self.zones - 1, -1, -1, dtype=np.int64)
        columns = self._first_zone_columns * 2 ** np.arange(self.zones, dtype=np.int64)
        return np.concatenate([[0], np.cumsum(np.repeat(slices_per_column, columns))])

    @cached_property
    def tables(self) -> GridTables:
        """See GridTables."""
        return GridTables(
            ranges_m=np.array([self.x_range_m, self.y_range_m, self.z_range_m], np.float32),
            slice_edges_m=np.linspace(*self.x_range_m, self._slices + 1, dtype=np.float32),
            column_of_slice=np.repeat(np.arange(self.nx, dtype=np.int64), np.diff(self._edge_slices)),
            row_edges_m=self.y_edges_m.astype(np.float32),
        )

    @cached_property
    def column_centers_m(self) -> NDArray[np.float32]:
        """x of the columns' centers, (nx,), metres, LiDAR frame."""
        return ((self.x_edges_m[:-1] + self.x_edges_m[1:]) / 2).astype(np.float32)

    @cached_property
    def row_centers_m(self) -> NDArray[np.float32]:
        """y of the rows' centers, (ny,), metres, LiDAR frame."""
        return ((self.y_edges_m[:-1] + self.y_edges_m[1:]) / 2).astype(np.float32)


def _interval(values: NDArray[np.float32], edges: NDArray[np.float32]) -> NDArray[np.int64]:
    """Return the index of the interval [edges[i], edges[i + 1]) around each value, for evenly spaced edges.

    Equal to np.searchsorted(edges, values, "right") - 1 and several times faster on unsorted values.
    """
    per_metre = (len(edges) - 1) / (edges[-1] - edges[0])
    guess: NDArray[np.int64] = np.minimum((values - edges[0]) * per_metre, len(edges) - 2).astype(np.int64)
    # The product rounds; the borders decide.
    guess -= values < edges[guess]
    guess += values >= edges[guess + 1]
    return guess


def _read_only(array: NDArray[np.float64]) -> NDArray[np.float64]:
    array.flags.writeable = False
    return array


Array = TypeVar("Array")
Value = TypeVar("Value", np.float32, np.uint8)


class MapCells(NamedTuple, Generic[Array]):
    """The M cells of the map that P pillars occupy."""

    cells: Array
    """(M,) flat index row * columns + column on the map, ascending."""
    pillars: Array
    """(E,) rows of the pillars of one cell after those of the other."""
    counts: Array
    """(M,) pillars of each cell, at least 1."""


def map_cells(cells: NDArray[np.int64], grid: PillarGrid) -> MapCells[NDArray[np.int64]] | None:
    """Return the map cells of pillars at ascending grid cells (P,); None where map and grid are the same."""
    if not grid.pools:
        return None
    rows, columns = np.divmod(cells, grid.nx)
    copies = grid.map_copies[columns]
    pillars = np.repeat(np.arange(len(cells)), copies)
    first = np.repeat(rows * grid.map_shape[1] + grid.map_columns[columns], copies)
    place = (
        first + np.arange(len(pillars)) - np.repeat(np.cumsum(copies) - copies, copies)
    )  # ascending, as the cells are
    starts = np.flatnonzero(np.diff(place, prepend=-1))
    return MapCells(place[starts], pillars, np.diff(starts, append=len(place)))


def pool_pillars(
    features: NDArray[Value], cells: NDArray[np.int64], grid: PillarGrid
) -> tuple[NDArray[Value], NDArray[np.int64]]:
    """Pool features (P, C) of pillars at cells (P,) of the grid -> (M, C) and (M,) of the map.

    Steps of a quantized graph may be pooled as well: their order is that of the values.
    """
    mapped = map_cells(cells, grid)
    if mapped is None:
        return features, cells
    starts = np.cumsum(mapped.counts) - mapped.counts
    pooled = features[mapped.pillars[starts]]
    for further in range(1, int(mapped.counts.max(initial=1))):
        shared = np.flatnonzero(mapped.counts > further)
        pooled[shared] = np.maximum(pooled[shared], features[mapped.pillars[starts[shared] + further]])
    return pooled, mapped.cells


NECK_STRIDE = 8  # stride of the coarsest map in the paper's Table 1
HEAD_STRIDE = 2  # stride of the map that the head reads, Table 1
MAX_ZONES = 5

# How far from a whole number a count of pillars may be: room for float dust (69.12 / 0.32 is not exactly 216)
# and for sizes written with seven digits, and still under a millimetre.
_PILLAR_TOLERANCE = 1e-3


def fits(span_m: tuple[float, float], pillar_m: float, zones: int = 1) -> bool:
    """Return whether each of `zones` equal parts of a range is a multiple of NECK_STRIDE of the first one's pillars.

    Columns double from zone to zone, so the map has an odd multiple (2^K - 1) of the first zone's columns,
    and the neck's stride must divide these. Then every zone also holds a multiple of HEAD_STRIDE columns,
    and the borders of zones fall between head cells.
    """
    pillars = (span_m[1] - span_m[0]) / (zones * pillar_m)
    groups = round(pillars / NECK_STRIDE)
    return groups >= 1 and abs(pillars - groups * NECK_STRIDE) <= _PILLAR_TOLERANCE


def x_advice(span_m: tuple[float, float], v_max_m: float, zones: int) -> str:
    """Explain why an x range does not fit, with the nearest ranges, pillar depth and numbers of zones that do."""
    step_m = NECK_STRIDE * zones * v_max_m
    advice = f"x_range_m {_nearest_ranges(span_m, step_m)}, or v_max_m {_nearest_size(span_m, v_max_m, zones)}"
    working = [str(k) for k in range(1, MAX_ZONES + 1) if fits(span_m, v_max_m, k)]
    if working:
        advice += f", or zones {' or '.join(working)}"
    return (
        f"x_range_m {_show(span_m)} must be a multiple of {step_m:.7g} m "
        f"({zones} zones x {NECK_STRIDE} columns x v_max_m {v_max_m:g}): use {advice}"
    )


def y_advice(span_m: tuple[float, float], v_y_m: float) -> str:
    """Explain why a y range does not fit, with the nearest ranges and pillar width that do."""
    step_m = NECK_STRIDE * v_y_m
    return (
        f"y_range_m {_show(span_m)} must be a multiple of {step_m:.7g} m "
        f"({NECK_STRIDE} rows x v_y_m {v_y_m:g}): "
        f"use y_range_m {_nearest_ranges(span_m, step_m)}, or v_y_m {_nearest_size(span_m, v_y_m, zones=1)}"
    )


def _nearest_ranges(span_m: tuple[float, float], step_m: float) -> str:
    """Return the next shorter and longer range: about the origin if `span_m` is, else from the same minimum."""
    low, high = span_m
    steps = math.floor((high - low) / step_m)
    ranges = []
    for length_m in (n * step_m for n in (steps, steps + 1) if n > 0):
        start_m = -length_m / 2 if low == -high else low
        ranges.append(_show((start_m, start_m + length_m)))
    return " or ".join(ranges)


def _nearest_size(span_m: tuple[float, float], pillar_m: float, zones: int) -> str:
    group_m = (span_m[1] - span_m[0]) / (zones * NECK_STRIDE)
    return f"{group_m / max(1, round(group_m / pillar_m)):.7g}"


def _show(span_m: tuple[float, float]) -> str:
    return f"[{span_m[0]:.10g}, {span_m[1]:.10g}]"
