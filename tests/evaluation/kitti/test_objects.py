"""Objects as arrays."""

from dataclasses import fields, replace

import numpy as np
import pytest

from asca_pillars.evaluation.kitti.objects import FrameObjects, concatenate_frames, frame_objects
from tests.evaluation.kitti.kitti_objects import CAR, DONT_CARE


def test_every_field_goes_where_it_belongs_in_order() -> None:
    frame = frame_objects("000007", [DONT_CARE, replace(CAR, truncated=0.15, occluded=2, score=-1.5)])
    assert frame.frame_id == "000007" and frame.types == ("DontCare", "Car") and len(frame) == 2
    assert frame.bbox.tolist() == [list(DONT_CARE.bbox), list(CAR.bbox)]
    assert frame.dimensions_hwl.tolist() == [[-1, -1, -1], [CAR.height_m, CAR.width_m, CAR.length_m]]
    assert frame.locations.tolist() == [[-1000, -1000, -1000], [CAR.x_m, CAR.y_m, CAR.z_m]]
    assert frame.alpha.tolist() == [-10, CAR.alpha] and frame.rotation_y.tolist() == [-10, CAR.rotation_y]
    # Double precision: float32(0.15) would be beyond the limit of the easy objects.
    assert frame.truncated.tolist() == [-1, 0.15]
    assert frame.occluded.tolist() == [-1, 2]
    assert frame.scores.tolist() == [0, -1.5]
    first = frame_objects("000000", [CAR, DONT_CARE])
    second = frame_objects("000001", [replace(CAR, type="Van", x_m=9.0)])
    both = concatenate_frames([first, second])
    assert both.types == ("Car", "DontCare", "Van")
    for field in fields(FrameObjects)[2:]:
        parts = [getattr(first, field.name), getattr(second, field.name)]
        np.testing.assert_array_equal(getattr(both, field.name), np.concatenate(parts))
    frame = frame_objects("000000", [])
    assert len(frame) == 0
    assert frame.bbox.shape == (0, 4) and frame.dimensions_hwl.shape == (0, 3) and frame.scores.shape == (0,)
    assert len(concatenate_frames([])) == 0 and len(concatenate_frames([frame, frame])) == 0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"bbox": np.zeros((2, 4))}, r"frame 000003: bbox is \(2, 4\), but 1 types need \(1, 4\)"),
        ({"scores": np.zeros((1, 1))}, r"frame 000003: scores is \(1, 1\)"),
        ({"types": ("Car", "Car")}, r"2 types need \(2, 4\)"),
        ({"alpha": np.array([np.nan])}, "frame 000003: alpha holds NaN or infinity"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(changes: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replace(frame_objects("000003", [CAR]), **changes)  # type: ignore[arg-type]
