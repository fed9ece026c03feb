"""Voxelization: the mean of the first points in each cell of a 3D grid (SECOND, PV-RCNN)."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.errors import ConfigError
from asca_pillars.base.kernels import load_kernels
from asca_pillars.base.strict import Strict
from asca_pillars.geometry.boxes import within
from asca_pillars.ops.sparse.rulebooks import MAX_Z_CELLS, CellMap, Shape

KERNELS = "asca_pillars.ops.pv_rcnn.kernels"
_TOLERANCE = 1e-2  # of a voxel, for rounding errors and for sizes written with few digits


@dataclass(frozen=True)
class VoxelGrid(Strict):
    """Ranges and voxel sizes in metres, LiDAR frame; the defaults are PV-RCNN's on KITTI.

    Attributes:
        x_range_m, y_range_m, z_range_m: lower end inside, upper end outside.
        size_m: of a voxel along x, y, z.
        empty_layers: that lie on top of the range so that the strides of a backbone divide the height (SECOND: one).
        max_points: of a voxel that enter its mean, the first ones of the scan.

    Raises:
        ConfigError: the voxels do not fill the ranges, or are more than MAX_Z_CELLS along z.
    """

    x_range_m: tuple[float, float] = (0.0, 70.4)
    y_range_m: tuple[float, float] = (-40.0, 40.0)
    z_range_m: tuple[float, float] = (-3.0, 1.0)
    size_m: tuple[float, float, float] = (0.05, 0.05, 0.1)
    empty_layers: int = 1
    max_points: int = 5

    def __post_init__(self) -> None:
        for name, (low, high), size in zip(("x", "y", "z"), self.ranges_m, self.size_m, strict=True):
            if not (math.isfinite(low) and math.isfinite(high) and low < high):
                raise ConfigError(f"{name}_range_m [{low:g}, {high:g}] must be two finite numbers, the smaller first")
            if not (math.isfinite(size) and size > 0):
                raise ConfigError(f"size_m: {size:g} along {name} must be a positive size in metres")
            cells = (high - low) / size
            if round(cells) < 1 or abs(cells - round(cells)) > _TOLERANCE:
                nearest = (high - low) / max(round(cells), 1)
                raise ConfigError(
                    f"{name}_range_m [{low:g}, {high:g}] is not a whole number of voxels of {size:g} m; "
                    f"{nearest:.6g} m would fit"
                )
        if self.empty_layers < 0 or self.max_points < 1:
            raise ConfigError(f"empty_layers {self.empty_layers} must be at least 0, max_points {self.max_points} 1")
        if self.shape[0] > MAX_Z_CELLS:
            raise ConfigError(
                f"{self.shape[0]} voxels along z are more than {MAX_Z_CELLS}; choose a larger size_m along z, or a "
                "smaller z_range_m"
            )

    @property
    def ranges_m(self) -> tuple[tuple[float, float], tuple[float, float], tuple[float, float]]:
        """Ranges along x, y, z."""
        return self.x_range_m, self.y_range_m, self.z_range_m

    @cached_property
    def shape(self) -> Shape:
        """Cells along z, y, x, empty layers included."""
        sizes = zip(self.ranges_m, self.size_m, strict=True)
        x, y, z = (round((high - low) / size) for (low, high), size in sizes)
        return z + self.empty_layers, y, x

    def centers_m(
        self, cells: NDArray[np.int64], shape: Shape | None = None, strides: Shape = (1, 1, 1)
    ) -> NDArray[np.float32]:
        """Return centers x, y, z of these voxels: (N,) -> (N, 3), metres.

        Args:
            cells: flat indices on the lattice.
            shape: of a coarser lattice, cells along z, y, x; None for the grid's own.
            strides: voxels of the grid along z, y, x that one of its cells stands for.
        """
        nz, _, nx = shape or self.shape
        yx, z = np.divmod(cells, nz)
        y, x = np.divmod(yx, nx)
        lows = np.array([low for low, _ in self.ranges_m])
        sizes = np.array(self.size_m) * strides[::-1]
        return (lows + (np.stack([x, y, z], axis=-1) + 0.5) * sizes).astype(np.float32)

    def cells(self, points: NDArray[np.floating[Any]]) -> NDArray[np.int64]:
        """Return the flat index (y * nx + x) * nz + z of each point's voxel, or -1 outside the ranges.

        A border belongs to the voxel above it. Points are compared as float32.

        Args:
            points: (N, >=3), columns x, y, z in metres, LiDAR frame; non-finite ones are outside.

        Returns:
            (N,) int64.
        """
        points = np.require(points, np.float32, ["C", "ALIGNED"])
        lows_m, highs_m = (np.array(ends, np.float32) for ends in zip(*self.ranges_m, strict=True))
        sizes_m = np.array(self.size_m, np.float32)
        z, y, x = self.shape
        last = np.array([x, y, z - self.empty_layers]) - 1
        cells = np.empty(len(points), np.int64)
        load_kernels(KERNELS).cells_of_points(points, lows_m, highs_m, sizes_m, last, self.shape, cells)
        return cells

    def inside(self, points: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Return a mask (M,) of the points (M, >= 3), metres, LiDAR frame, that lie in a voxel."""
        return within(points, np.array(self.ranges_m, np.float32))


class Voxels(NamedTuple):
    """The voxels of one scan that hold points."""

    features: NDArray[np.float32]
    """(N, C) mean of the first points: x, y, z in metres (LiDAR frame), reflectance and what else points have."""
    cells: NDArray[np.int64]
    """(N,) flat index (y * nx + x) * nz + z, ascending."""
    points_outside: int
    """Points outside the ranges, or not finite."""


def voxelize(points: NDArray[np.float32], grid: VoxelGrid, cell_map: CellMap) -> Voxels:
    """Sort points into voxels and average the first of each.

    Sums are float64 in the scan's order, so the means do not depend on the machine.

    Args:
        points: (M, >=3) x, y, z in metres, LiDAR frame, and other values.
        grid: where the voxels are.
        cell_map: of the grid's shape; the voxels are its active cells afterwards.

    Raises:
        ValueError: `points` or `cell_map` has another shape.
    """
    if points.ndim != 2 or points.shape[1] < 3 or cell_map.shape != grid.shape:
        raise ValueError(f"points {points.shape} must be (M, >=3), the map {cell_map.shape} of shape {grid.shape}")
    points = np.require(points, np.float32, ["C", "ALIGNED"])
    cell_of_point = grid.cells(points)
    cell_map.activate_points(cell_of_point)
    sums = np.zeros((len(cell_map), points.shape[1]))
    features = np.empty(sums.shape, np.float32)
    counts = np.zeros(len(cell_map), np.int64)
    load_kernels(KERNELS).sum_points(
        points, cell_of_point, grid.shape[0], *cell_map.columns, grid.max_points, sums, counts, features
    )
    return Voxels(features, cell_map.cells, int((cell_of_point < 0).sum()))
