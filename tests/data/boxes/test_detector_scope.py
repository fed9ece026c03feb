"""What a line of results states of its detector."""

import json
from typing import Any

import numpy as np
import pytest

from asca_pillars.data.boxes.detector_scope import DetectorScope, detector_scope, scope_from_json
from asca_pillars.ops.pillar.spec import PillarSpec


@pytest.mark.parametrize("around", [False, True])
def test_it_survives_a_line(around: bool) -> None:
    spec = PillarSpec()
    scope = detector_scope(spec, around=around)
    assert scope_from_json(json.loads(json.dumps(scope.to_json()))) == scope
    far = np.array([[-500.0, 0, 0, 4, 2, 1.5, 0], [10, 0, 0, 4, 2, 1.5, 0]])
    assert scope.holds(far).tolist() == [around, True]


def test_the_lowest_end_is_inside_and_the_highest_is_not() -> None:
    scope = DetectorScope(("Car",), ((0.0, 50.0), (-20.0, 20.0)))
    boxes = np.zeros((4, 7))
    boxes[:, :2] = np.array([[0, -20], [50, 0], [10, 20], [49.9, 19.9]])
    assert scope.holds(boxes).tolist() == [True, False, False, True]


@pytest.mark.parametrize(
    "content",
    [
        *(None, "PointPillars", {"name": "PointPillars"}, {"classes": ["Car"]}, {"ranges_m": None}),
        {"classes": "Car", "ranges_m": None},
        *({"classes": ["Car"], "ranges_m": ranges} for ranges in (70, [[0, 70]], [[0, "far"], [0, 1]])),
    ],
    ids=str,
)
def test_other_programs_may_write_anything_there(content: Any) -> None:
    assert scope_from_json(content) is None
