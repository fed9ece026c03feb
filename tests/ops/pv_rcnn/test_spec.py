"""Where a voxel detector's levels, map and anchors lie."""

import numpy as np
import pytest

from asca_pillars.base.errors import ConfigError
from asca_pillars.ops.pv_rcnn.spec import VoxelSpec
from asca_pillars.ops.pv_rcnn.voxels import VoxelGrid, voxelize


def test_lattices_that_are_published_and_a_finer_one() -> None:
    spec = VoxelSpec()
    assert spec.level_shapes == ((41, 1600, 1408), (21, 800, 704), (11, 400, 352), (5, 200, 176), (2, 200, 176))
    assert spec.map_stride == 8 and spec.anchors.shape == (200, 176, 6, 7)
    x, y = spec.head_centers_m()
    assert (x[0], x[-1], y[0], y[-1]) == (0.0, 70.4, -40.0, 40.0), "both ends included"
    spec = VoxelSpec(
        grid=VoxelGrid((0.0, 6.4), (-3.2, 3.2), size_m=(0.1, 0.1, 0.1)), last_stride=1, anchor_places="cells"
    )
    assert spec.level_shapes[-1] == (2, 16, 16) and spec.map_stride == 4
    x, _ = spec.head_centers_m()
    np.testing.assert_allclose(x[:2], [0.2, 0.6])
    np.testing.assert_allclose(spec.map_places_m()[0][:2], [0.0, 0.4])


def test_a_level_that_keeps_its_resolution_does_not_grow_sideways() -> None:
    spec = VoxelSpec(grid=VoxelGrid((0.0, 6.4), (-3.2, 3.2), size_m=(0.1, 0.1, 0.1)), last_stride=1)
    builder = spec.rulebook_builder()
    voxelize(np.array([[1.0, 0.0, -1.0, 0.5], [5.0, 2.0, 0.3, 0.5]], np.float32), spec.grid, builder.maps[0])
    levels = builder.build()
    above = [set(level.cells // shape[0]) for level, shape in zip(levels, spec.level_shapes, strict=True)]
    assert above[2] == above[3] == above[4], "conv4 and conv_out have the columns of conv3"
    assert levels[3].strided.shape[1] == levels[4].strided.shape[1] == 3


def test_centers_of_coarse_voxels_hold_their_points() -> None:
    rng = np.random.default_rng(0)
    spec = VoxelSpec(grid=VoxelGrid((0.0, 6.4), (-3.2, 3.2), size_m=(0.1, 0.1, 0.1)))
    points = rng.uniform([-1, -4, -4, 0], [7, 4, 2, 1], (500, 4)).astype(np.float32)
    builder = spec.rulebook_builder()
    voxels = voxelize(points, spec.grid, builder.maps[0])
    assert spec.grid.inside(points).sum() == len(points) - voxels.points_outside
    np.testing.assert_array_equal(spec.grid.centers_m(voxels.cells), spec.grid.centers_m(voxels.cells, spec.grid.shape))
    levels = builder.build()
    inside = points[spec.grid.inside(points), :3]
    for number in range(3):  # a cell of each level is active around every point
        centers = spec.grid.centers_m(levels[number].cells, spec.level_shapes[number], spec.level_strides[number])
        half = np.array(spec.grid.size_m) * spec.level_strides[number][::-1] / 2
        away = np.abs(inside[:, None] - centers[None])
        assert (away <= half + 1e-4).all(axis=2).any(axis=1).all()


def test_grids_that_cannot_be() -> None:
    for grid, message in (
        (VoxelGrid((0.0, 6.0), (-3.2, 3.2), size_m=(0.1, 0.1, 0.1)), "60 voxels along x must be a multiple of 16"),
        (VoxelGrid((0.0, 6.4), (-3.2, 3.2), (-3.0, -1.0), (0.1, 0.1, 0.1)), "21 voxels along z leave none"),
    ):
        with pytest.raises(ConfigError, match=message):
            VoxelSpec(grid=grid)
