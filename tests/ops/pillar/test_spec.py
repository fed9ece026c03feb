"""PillarSpec: the numbers together, and the package's promise to need NumPy alone."""

import subprocess
import sys

import numpy as np
import pytest

from asca_pillars.base.errors import ConfigError
from asca_pillars.detection.anchors import KITTI_CLASSES, make_anchors
from asca_pillars.detection.decode import HeadMaps
from asca_pillars.ops.pillar.grid import PillarGrid
from asca_pillars.ops.pillar.prepare import PillarLimits, pillarize
from asca_pillars.ops.pillar.spec import PillarSpec

SPEC = PillarSpec(
    grid=PillarGrid(x_range_m=(2.0, 17.36), y_range_m=(-3.2, 7.04), z_range_m=(-2.5, 1.5)),
    limits=PillarLimits(max_pillars=20, max_points=2),
    classes=KITTI_CLASSES[:2],
)


def test_the_specs_grid_limits_and_anchors_are_used() -> None:
    points = np.random.default_rng(0).uniform((2, -3, -2, 0), (17, 7, 1, 1), (200, 4)).astype(np.float32)
    pillars = SPEC.pillarize(points)
    assert pillars.stats.pillars == 20
    np.testing.assert_array_equal(pillars.features, pillarize(points, SPEC.grid, SPEC.limits).features)
    height, width = SPEC.grid.head_shape
    maps = HeadMaps(*(np.zeros((channels, height, width), np.float32) for channels in (4, 28, 8)))
    maps.scores[:] = -10
    maps.scores[2, 5, 9] = 4.0
    maps.directions[5] = 1.0  # bin 1 holds yaw 0
    detections = SPEC.decode(maps)
    assert detections.names == ["Pedestrian"]
    np.testing.assert_allclose(detections.boxes, SPEC.anchors[5, 9, 2][None], atol=1e-6)


def test_anchors_are_made_once_and_thresholds_set_for_all_or_by_name() -> None:
    assert SPEC.anchors is SPEC.anchors
    np.testing.assert_array_equal(SPEC.anchors, make_anchors(*SPEC.head_centers_m(), SPEC.classes))
    with pytest.raises(ValueError, match="read-only"):
        SPEC.anchors[0] = 0
    both = SPEC.with_score_threshold(0.11)
    assert [spec.score_threshold for spec in both.classes] == [0.11, 0.11]
    one = both.with_score_threshold({"Pedestrian": 0.5})
    assert [spec.score_threshold for spec in one.classes] == [0.11, 0.5]
    with pytest.raises(ConfigError, match="Tram: no such class; available: Car, Pedestrian"):
        SPEC.with_score_threshold({"Tram": 0.5})
    with pytest.raises(ConfigError, match="score_threshold 2 of class Car"):
        SPEC.with_score_threshold({"Car": 2.0})


def test_the_limit_of_pillars_grows_with_the_ranges() -> None:
    around = SPEC.with_ranges((-15.36, 15.36), (-10.24, 10.24))
    assert around.grid.x_range_m == (-15.36, 15.36) and around.grid.y_range_m == (-10.24, 10.24)
    assert around.limits == PillarLimits(max_pillars=80, max_points=2), "four times the area"
    assert SPEC.with_ranges((2.0, 9.68), (-3.2, 7.04)).limits == SPEC.limits, "near cells are full more often"


def test_impossible_directions_and_classes_are_refused() -> None:
    assert PillarSpec(direction_offset_rad=-np.pi).direction_offset_rad == -np.pi
    with pytest.raises(ConfigError, match="direction_offset_rad -90 must lie between -pi and pi; it is in radians"):
        PillarSpec(direction_offset_rad=-90)
    with pytest.raises(ConfigError, match="at least one class"):
        PillarSpec(classes=())
    with pytest.raises(ConfigError, match="Car, Car"):
        PillarSpec(classes=(KITTI_CLASSES[0], KITTI_CLASSES[0]))


def test_geometry_needs_numpy_alone() -> None:
    heavy = ["torch", "pydantic", "cv2", "onnxruntime", "scipy", "shapely", "numba"]
    code = f"import sys, asca_pillars.ops.pillar.spec; print([m for m in {heavy} if m in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"
