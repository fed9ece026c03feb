"""Anchors in metres, and classes that cannot be."""

import dataclasses
import math

import numpy as np
import pytest

from asca_pillars.base.errors import ConfigError
from asca_pillars.detection.anchors import KITTI_CLASSES, ClassSpec, make_anchors
from asca_pillars.ops.pillar.grid import PillarGrid

GRID = PillarGrid(x_range_m=(2.0, 17.36), y_range_m=(-3.2, 7.04), z_range_m=(-2.5, 1.5))


def test_anchors_by_hand() -> None:
    anchors = make_anchors(*GRID.head_centers_m(), KITTI_CLASSES)
    # 10.24 m / 0.16 m / 2 = 32 rows; 5.12 m per zone hold 16, 32 and 64 columns, halved 8 + 16 + 32 = 56.
    assert anchors.shape == (32, 56, 6, 7) and anchors.dtype == np.float32
    # The first cell is two columns of 0.32 m by two rows of 0.16 m; the ninth begins the second zone.
    np.testing.assert_allclose(anchors[0, 0, 0], [2.32, -3.04, -1.0, 3.9, 1.6, 1.56, 0.0], rtol=1e-6)
    np.testing.assert_allclose(anchors[31, 8, 5], [7.28, 6.88, -0.6, 1.76, 0.6, 1.73, math.pi / 2], rtol=1e-6)
    # Class-major: car, car, pedestrian, pedestrian, cyclist, cyclist, each at 0 and 90 degrees.
    np.testing.assert_allclose(anchors[3, 5, :, 3], [3.9, 3.9, 0.8, 0.8, 1.76, 1.76], rtol=1e-6)
    np.testing.assert_allclose(anchors[3, 5, :, 6], [0, math.pi / 2] * 3, rtol=1e-6)


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        ({"name": ""}, "name"),
        ({"name": "traffic cone"}, "`traffic cone`: write it without white space, such as traffic_cone; .*--rename"),
        ({"name": "Van "}, "such as Van;"),
        ({"name": "\t"}, "such as Car;"),
        ({"length_m": 0.0}, "length_m 0 of class Van"),
        ({"width_m": -1.0}, "width_m -1"),
        ({"height_m": math.nan}, "height_m nan"),
        ({"height_m": 1e308}, "height_m"),
        ({"z_m": math.inf}, "z_m inf"),
        ({"z_m": 1e308}, "z_m"),
        ({"negative_iou": 0.7}, "negative_iou 0.7"),
        ({"positive_iou": 1.1}, "positive_iou 1.1"),
        ({"negative_iou": -0.1}, "negative_iou -0.1"),
        ({"score_threshold": 1.5}, "score_threshold 1.5"),
        ({"score_threshold": math.nan}, "score_threshold nan"),
    ],
)
def test_impossible_classes_are_refused(settings: dict[str, object], named: str) -> None:
    van = ClassSpec("Van", 5.0, 1.9, 2.2, -0.8, positive_iou=0.6, negative_iou=0.45)
    with pytest.raises(ConfigError, match=named):
        dataclasses.replace(van, **settings)  # type: ignore[arg-type]
