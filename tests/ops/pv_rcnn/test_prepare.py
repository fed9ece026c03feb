"""What the host computes for PV-RCNN: neighbors that are there, and the same with and without compiled loops."""

import dataclasses
from typing import Literal

import numpy as np
import pytest

from asca_pillars.base.errors import ConfigError
from asca_pillars.ops.pv_rcnn.prepare import SourceBalls, VoxelSetSettings, voxel_scan
from asca_pillars.ops.pv_rcnn.spec import VoxelSpec
from asca_pillars.ops.pv_rcnn.voxels import VoxelGrid
from tests.helpers.scenes import make_scene

SPEC = VoxelSpec(grid=VoxelGrid((4.8, 24.0), (-6.4, 6.4), size_m=(0.2, 0.2, 0.1)), last_stride=1)
SETTINGS = VoxelSetSettings(
    keypoints=64, sources=(SourceBalls("points", (0.8,), (8,)), SourceBalls("conv3", (1.2, 2.4), (4, 8)))
)


def test_neighbors_lie_in_their_balls() -> None:
    points = make_scene(0)[0]
    scan = voxel_scan(points, SPEC, SETTINGS, SPEC.rulebook_builder())
    assert scan.counts.points == len(points) and scan.counts.points - scan.counts.points_outside == len(scan.points)
    assert len(scan.keypoints) == 64 and len(scan.positions[1]) == len(scan.levels[2].cells)
    for source, positions, balls in zip(SETTINGS.sources, scan.positions, scan.ball_indices, strict=True):
        padded = np.vstack([positions, np.full((1, 3), np.nan, np.float32)])
        for radius, samples, indices in zip(source.radii_m, source.samples, balls, strict=True):
            assert indices.shape == (64, samples)
            away = np.linalg.norm(padded[indices] - scan.keypoints[:, None], axis=2)
            assert np.nanmax(away) < radius
            within = (np.linalg.norm(positions[None] - scan.keypoints[:, None], axis=2) < radius * 0.999).any(axis=1)
            assert (indices[within] < len(positions)).all()
    np.testing.assert_allclose(scan.bev_weights.sum(axis=1), 1, atol=1e-6)
    assert scan.bev_cells.max() < np.prod(SPEC.map_shape)


@pytest.mark.parametrize(("last_stride", "stride"), [(1, 4), (2, 8)])
def test_a_keypoint_reads_the_map_where_openpcdet_does(last_stride: Literal[1, 2], stride: int) -> None:
    """Column (x - x_min) / voxel / stride, without half a cell: as the published weights have learnt to read it."""
    spec = dataclasses.replace(SPEC, last_stride=last_stride)
    scan = voxel_scan(make_scene(0)[0], spec, SETTINGS, spec.rulebook_builder())
    rows, columns = spec.map_shape
    x, y = scan.keypoints[:, :2].astype(np.float64).T
    column, row = (x - 4.8) / 0.2 / stride, (y + 6.4) / 0.2 / stride
    # Beside the outermost cells the map's border counts.
    between = (column > 0) & (column < columns - 1) & (row > 0) & (row < rows - 1)
    assert between.sum() > 30
    flat = np.arange(columns) + 1000.0 * np.arange(rows)[:, None]
    found = (flat.ravel()[scan.bev_cells] * scan.bev_weights).sum(axis=1)
    np.testing.assert_allclose(found[between], (column + 1000 * row)[between], atol=2e-3)


@pytest.mark.parametrize("points", [np.empty((0, 4)), np.array([[500.0, 0, 0, 0]])])
def test_scans_without_anything_in_range(points: np.ndarray) -> None:
    scan = voxel_scan(points.astype(np.float32), SPEC, SETTINGS, SPEC.rulebook_builder())
    assert len(scan.features) == len(scan.points) == len(scan.keypoints) == len(scan.bev_cells) == 0
    assert [len(level.cells) for level in scan.levels] == [0] * 5


def test_settings_that_cannot_be() -> None:
    with pytest.raises(ConfigError, match="must go in pairs"):
        SourceBalls("points", (0.4, 0.8), (16,))
    for radius in (0.0, float("inf"), float("nan")):
        with pytest.raises(ConfigError, match="must be positive and finite"):
            SourceBalls("points", (0.4, radius), (16, 16))
    with pytest.raises(ConfigError, match="must be different"):
        VoxelSetSettings(sources=(SourceBalls("conv1", (0.4,), (4,)), SourceBalls("conv1", (0.8,), (4,))))
