"""Spec of a voxel detector, shared by training, export and runtime; stored in `bundle.json`."""

from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.errors import ConfigError
from asca_pillars.detection.spec import DetectorSpec
from asca_pillars.geometry.boxes import Ranges
from asca_pillars.ops.pv_rcnn.rulebooks import PV_RCNN_STRIDED, VoxelRulebookBuilder
from asca_pillars.ops.pv_rcnn.voxels import VoxelGrid
from asca_pillars.ops.sparse.rulebooks import Convolution, Shape

MAP_MULTIPLE = 2
"""Required divisor of the map's rows and columns: the neck halves the map once."""


@dataclass(frozen=True)
class VoxelSpec(DetectorSpec):
    """Grid, strides of the backbone over voxels, classes and post-processing; the defaults are PV-RCNN's on KITTI.

    Attributes:
        grid: of the voxels.
        last_stride: of conv4 along x and y; along z it always halves. With 1 the map has cells of four voxels instead
            of eight, and conv4's first convolution has a kernel along z alone: one that kept the resolution and grew
            sideways would more than double the active cells.
        anchor_places: `ends`: anchors stand evenly from one end of the range to the other, both included, as in the
            published PV-RCNN; `cells`: at the centers of the map's cells.

    Raises:
        ConfigError: the strides do not divide the grid, or it is too low for five levels.
    """

    grid: VoxelGrid = field(default_factory=VoxelGrid)
    last_stride: Literal[1, 2] = 2
    anchor_places: Literal["ends", "cells"] = "ends"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.level_shapes[-1][0] < 1:
            raise ConfigError(f"grid: {self.grid.shape[0]} voxels along z leave none after the strides; give 41")
        multiple = MAP_MULTIPLE * self.map_stride
        for axis, voxels in (("x", self.grid.shape[2]), ("y", self.grid.shape[1])):
            if voxels % multiple:
                raise ConfigError(
                    f"grid: {voxels} voxels along {axis} must be a multiple of {multiple}; change {axis}_range_m"
                )

    @property
    def ranges(self) -> Ranges:
        """Detection ranges."""
        return Ranges(*self.grid.ranges_m)

    @cached_property
    def strided(self) -> tuple[Convolution, ...]:
        """The convolutions from level to level: conv2, conv3, conv4, conv_out."""
        *first, fourth, out = PV_RCNN_STRIDED
        if self.last_stride == 1:
            fourth = Convolution((fourth.kernel[0], 1, 1), (fourth.stride[0], 1, 1), (fourth.padding[0], 0, 0))
        return *first, fourth, out

    @cached_property
    def level_shapes(self) -> tuple[Shape, ...]:
        """Cells along z, y, x of conv1 to conv4 and of conv_out."""
        shapes = [self.grid.shape]
        for convolution in self.strided:
            shapes.append(convolution.output_shape(shapes[-1]))
        return tuple(shapes)

    @cached_property
    def level_strides(self) -> tuple[Shape, ...]:
        """Voxels along z, y, x that a cell of each level stands for."""
        strides: list[Shape] = [(1, 1, 1)]
        for convolution in self.strided:
            z, y, x = (before * step for before, step in zip(strides[-1], convolution.stride, strict=True))
            strides.append((z, y, x))
        return tuple(strides)

    @property
    def scores_per_anchor(self) -> int:
        """Number of scores of each anchor: one per class."""
        return len(self.classes)

    @property
    def map_stride(self) -> int:
        """Voxels along x and along y of a cell of the bird's-eye-view map."""
        return self.level_strides[-1][1]

    @property
    def map_shape(self) -> tuple[int, int]:
        """Rows and columns of the bird's-eye-view map, that of the head."""
        return self.level_shapes[-1][1:]

    def map_places_m(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the positions of the map's features: x of its columns (W,), y of its rows (H,), metres, LiDAR frame.

        A strided convolution with padding 1 centers its output on the first of its voxels, so a cell stands at its
        lower end.
        """
        step_x, step_y = (self.grid.size_m[axis] * self.map_stride for axis in range(2))
        rows, columns = (np.arange(count, dtype=np.float64) for count in self.map_shape)
        return self.grid.x_range_m[0] + step_x * columns, self.grid.y_range_m[0] + step_y * rows

    def head_centers_m(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return anchor centers in metres, LiDAR frame: x of the head map's columns (W,), y of its rows (H,)."""
        rows, columns = self.map_shape
        if self.anchor_places == "ends":
            return np.linspace(*self.grid.x_range_m, columns), np.linspace(*self.grid.y_range_m, rows)
        x, y = self.map_places_m()
        half = [self.grid.size_m[axis] * self.map_stride / 2 for axis in range(2)]
        return x + half[0], y + half[1]

    def rulebook_builder(self, *, training: bool = False) -> VoxelRulebookBuilder:
        """Return a builder of rulebooks for this detector's levels; for one thread at a time."""
        return VoxelRulebookBuilder(self.grid.shape, self.strided, training=training)
