"""Grids of proposals and the keypoints around their points, against SciPy's rotations and all distances."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from asca_pillars.ops.two_stage.prepare import RefineSettings, grid_neighbors

BOXES = np.array(
    [[12, -3, -1, 3.9, 1.6, 1.5, 0.7], [20, 5, -0.5, 0.8, 0.6, 1.7, -2.4], [31, 0, -1, 1.8, 0.6, 1.7, 1.9]], np.float32
)
RADII_M = (0.5, 1.7, 0.9)
"""In no order by size, so that sorted ones are seen."""
SAMPLES = 6


def settings(grid_size: int) -> RefineSettings:
    return RefineSettings(grid_size=grid_size, grid_radii_m=RADII_M, grid_samples=SAMPLES)


def keypoints() -> NDArray[np.float32]:
    """Around the first two boxes; the third has none."""
    rng = np.random.default_rng(0)
    around = np.repeat(BOXES[:2, :3], (90, 40), axis=0)
    return (around + rng.uniform(-2.5, 2.5, around.shape)).astype(np.float32)


def places(center: NDArray[np.floating], size: NDArray[np.floating], yaw_rad: float, cells: int) -> NDArray[np.float64]:
    """(cells^3, 3) centers of a box's cells, x slowest and z fastest."""
    steps = [(i + 0.5) / cells - 0.5 for i in range(cells)]
    shares = np.array([(x, y, z) for x in steps for y in steps for z in steps])
    turned = Rotation.from_euler("z", yaw_rad).apply(shares * size.astype(np.float64))
    return np.asarray(center + turned, np.float64)


def grid_places(grid_size: int) -> NDArray[np.float64]:
    """Of all boxes, one after the other."""
    return np.concatenate([places(box[:3], box[3:6], float(box[6]), grid_size) for box in BOXES])


@pytest.mark.parametrize("grid_size", [1, 3])
def test_grid_points_turn_with_their_box(grid_size: int) -> None:
    found = grid_neighbors(keypoints(), BOXES, settings(grid_size))
    assert found.points.dtype == np.float32
    np.testing.assert_allclose(found.points, grid_places(grid_size), atol=1e-5)


def test_each_radius_has_the_keypoints_of_its_balls() -> None:
    points = keypoints()
    found = grid_neighbors(points, BOXES, settings(3))
    away = np.linalg.norm(points[None].astype(np.float64) - grid_places(3)[:, None], axis=2)
    sizes = []
    for radius_m, indices in zip(RADII_M, found.indices, strict=True):
        assert indices.shape == (len(BOXES) * 27, SAMPLES)
        assert np.abs(away - radius_m).min() > 1e-5, "rounding decides nothing"
        for row, near in zip(indices.tolist(), away < radius_m, strict=True):
            within = set(np.flatnonzero(near).tolist())
            sizes.append(len(within))
            if len(within) > SAMPLES:
                assert len(set(row)) == SAMPLES and set(row) < within
            else:
                assert set(row) == (within or {len(points)})
    assert min(sizes) == 0 and max(sizes) > SAMPLES and {1, SAMPLES - 1} <= set(sizes), "balls of every kind"


def test_each_cell_of_a_cube_has_its_three_nearest_keypoints() -> None:
    points = keypoints()
    found = grid_neighbors(points, BOXES, settings(2), vector_cells=2)
    there_of_all = []
    for radius_m, indices in zip(RADII_M, found.indices, strict=True):
        assert indices.shape == (len(BOXES) * 8, 8, 3)
        for center, rows in zip(grid_places(2), indices, strict=True):
            reach = np.abs(points - center).max(axis=1)
            assert np.abs(reach - 2 * radius_m).min() > 1e-5, "rounding decides nothing"
            near = np.flatnonzero(reach < 2 * radius_m)
            there = min(len(near), 3)
            there_of_all.append(there)
            cells = places(center, np.full(3, 2 * radius_m), 0.0, 2)  # a cube does not turn with the box
            away = np.linalg.norm(points[near][None] - cells[:, None], axis=2)
            np.testing.assert_array_equal(rows[:, :there], near[np.argsort(away, axis=1)[:, :there]])
            assert (rows[:, there:] == len(points)).all()
    assert {0, 3} < set(there_of_all), "cubes with nothing, with too few and with enough in them"
