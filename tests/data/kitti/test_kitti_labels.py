"""Label files, and the way between KITTI's boxes and LiDAR boxes."""

import math
from dataclasses import astuple, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from asca_pillars.data.kitti.kitti_labels import (
    KittiObject,
    boxes_from_objects,
    objects_3d,
    objects_from_boxes,
    read_labels,
    write_labels,
)
from tests.helpers.cameras import assert_one_line, make_calibration

CAR = "Car 0.00 1 1.85 387.63 181.54 423.81 203.12 1.67 1.87 3.69 -16.53 2.39 58.49 1.57"
DONT_CARE = "DontCare -1 -1 -10 503.89 169.71 590.61 190.13 -1 -1 -1 -1000 -1000 -1000 -10"
BOX_FIELDS = ("height_m", "width_m", "length_m", "x_m", "y_m", "z_m", "rotation_y")


def make_object(**fields) -> KittiObject:
    plain = KittiObject("Car", 0.0, 0, 0.0, (0.0, 0.0, 9.0, 9.0), 2.0, 1.6, 4.0, 1.0, 1.5, 10.0, 0.0)
    return replace(plain, **fields)


@pytest.mark.parametrize(
    ("rotation_y", "yaw"),
    # rotation_y turns from the camera's x (right) towards -z (backwards), seen from above clockwise:
    # 0 faces right (LiDAR -y), -pi/2 faces forward (LiDAR +x), pi/2 faces the camera.
    [(0.0, -math.pi / 2), (-math.pi / 2, 0.0), (math.pi / 2, -math.pi), (-3.0, 3.0 - math.pi / 2)],
)
def test_label_to_box_without_any_tilt(rotation_y, yaw):
    """Camera 0.5 m above, 0.3 m before the LiDAR: bottom (1, 1.5, 10), height 2 -> center (10.3, -1, 0)."""
    calib = make_calibration(offset_m=(0.0, 0.5, -0.3))
    box = boxes_from_objects([make_object(rotation_y=rotation_y)], calib)
    # y_camera = -z_lidar + 0.5 = 1.5 - 2 / 2 -> z_lidar = 0; z_camera = x_lidar - 0.3 = 10.
    np.testing.assert_allclose(box[0, :6], [10.3, -1, 0, 4, 1.6, 2], atol=1e-6)
    assert abs(math.remainder(float(box[0, 6]) - yaw, 2 * math.pi)) < 1e-6
    assert box.dtype == np.float32


def test_heading_follows_a_lidar_that_is_turned_against_the_camera():
    """A camera frame turned by 2 degrees about its vertical: headings turn by these 2 degrees."""
    straight, turned = make_calibration(), make_calibration(yaw_deg=2.0)
    item = make_object(rotation_y=-0.4)
    difference = boxes_from_objects([item], turned)[0, 6] - boxes_from_objects([item], straight)[0, 6]
    assert abs(difference) == pytest.approx(math.radians(2.0), abs=1e-6)
    # An object that faces away from the camera along the line of sight still does so in the LiDAR frame.
    away = make_object(x_m=3.0, z_m=12.0, y_m=1.0, rotation_y=-math.atan2(12.0, 3.0))
    box = boxes_from_objects([away], turned)[0]
    assert box[6] == pytest.approx(math.atan2(box[1], box[0]), abs=1e-6)


angles = st.floats(-3.0, 3.0)
cents = st.integers


@settings(max_examples=50)
@given(
    tilt=st.tuples(angles, angles, angles),
    offset=st.tuples(*[st.floats(-1.5, 1.5)] * 3),
    size=st.tuples(*[cents(20, 1500)] * 3),
    place=st.tuples(cents(-4000, 4000), cents(-100, 400), cents(100, 8000)),
    heading=cents(-314, 314),
)
def test_label_box_label_is_exact_to_its_two_decimals(tilt, offset, size, place, heading):
    roll, pitch, yaw = tilt
    calib = make_calibration(roll, pitch, yaw, offset_m=offset)
    values = [v / 100 for v in (*size, *place, heading)]
    item = make_object(**dict(zip(BOX_FIELDS, values, strict=True)))
    [back] = objects_from_boxes(boxes_from_objects([item], calib), ["Car"], calib)
    for name, value in zip(BOX_FIELDS, values, strict=True):
        assert f"{getattr(back, name):z.2f}" == f"{value:z.2f}", name
    expected = item.rotation_y - math.atan2(item.x_m, item.z_m)
    assert abs(math.remainder(back.alpha - expected, 2 * math.pi)) < 1e-4
    assert -math.pi <= back.alpha < math.pi


def test_dont_care_has_no_box(tmp_path):
    (tmp_path / "a.txt").write_text(f"{DONT_CARE}\n{CAR}\n")
    objects = read_labels(tmp_path / "a.txt")
    assert [o.type for o in objects_3d(objects)] == ["Car"]
    with pytest.raises(ValueError, match="objects_3d"):
        boxes_from_objects(objects, make_calibration())


# --- files


def test_files_as_kitti_prints_them_with_scores_and_without_objects(tmp_path):
    text = f"{CAR}\n{DONT_CARE}\n"
    (tmp_path / "a.txt").write_text(text, encoding="utf-8-sig")  # a byte-order mark is no part of the first type
    objects = read_labels(tmp_path / "a.txt")
    box = (387.63, 181.54, 423.81, 203.12)
    assert astuple(objects[0]) == ("Car", 0.0, 1, 1.85, box, 1.67, 1.87, 3.69, -16.53, 2.39, 58.49, 1.57, None)
    write_labels(tmp_path / "b.txt", objects)
    assert (tmp_path / "b.txt").read_text() == text
    write_labels(tmp_path / "a.txt", [make_object(truncated=-1.0, occluded=-1, x_m=-0.001, score=0.123456)])
    assert (tmp_path / "a.txt").read_text() == (
        "Car -1 -1 0.00 0.00 0.00 9.00 9.00 2.00 1.60 4.00 0.00 1.50 10.00 0.00 0.123456\n"
    )
    assert read_labels(tmp_path / "a.txt")[0].score == 0.123456
    write_labels(tmp_path / "a.txt", [])
    assert (tmp_path / "a.txt").read_text() == ""
    assert read_labels(tmp_path / "a.txt") == []
    assert boxes_from_objects([], make_calibration()).shape == (0, 7)
    assert objects_from_boxes(np.zeros((0, 7), np.float32), [], make_calibration()) == []


@pytest.mark.parametrize(
    ("line", "words"),
    [
        (CAR.rsplit(" ", 1)[0], ["14 fields"]),
        (f"0 1 {CAR}", ["17 fields"]),
        (CAR.replace("58.49", "58,49"), ["'58,49'"]),
        (CAR.replace("58.49", "nan"), ["'nan'"]),
        (CAR.replace("58.49", "inf"), ["'inf'"]),
        (CAR.replace("Car 0.00 1", "Car 0.00 1.5"), ["occluded", "1.5"]),
    ],
)
def test_damaged_label_line_is_named(tmp_path, line, words):
    path = tmp_path / "a.txt"
    path.write_text(f"{CAR}\n\n{line}\n")
    assert_one_line(f"{path}:3", words, lambda: read_labels(path))
