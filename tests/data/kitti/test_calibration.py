"""Calibration files and projection into the image."""

import numpy as np
import pytest

from asca_pillars.data.kitti import objects_from_boxes
from asca_pillars.data.kitti.calibration import (
    image_boxes,
    in_image,
    project_edges,
    read_calibration,
    write_calibration,
)
from tests.helpers.cameras import assert_one_line, make_calibration


def test_image_boxes_by_hand():
    """A cube of 2 m whose front face is 9 m away: half width in pixels 700 * 1 / 9 = 77.78."""
    box = np.array([[10.0, 0, 0, 2, 2, 2, 0]], np.float32)
    [item] = objects_from_boxes(box, ["Car"], make_calibration(), scores=np.array([0.5]))
    np.testing.assert_allclose(item.bbox, (620 - 77.78, 180 - 77.78, 620 + 77.78, 180 + 77.78), atol=0.01)
    assert (item.truncated, item.occluded, item.score) == (-1, -1, 0.5)
    # Front face at 9 m, its center 7.97 m to the left: 620 - 700 * 7.97 / 9 = 0.1, so half of it is outside.
    # Width before clipping: left end -77.7 .. right end of the back face 620 - 700 * 6.97 / 11 = 176.5.
    pixels, truncated = image_boxes(np.array([[10.0, 7.97, 0, 2, 2, 2, 0]]), make_calibration(), (1000, 200))
    np.testing.assert_allclose(pixels[0], [0, 102.22, 176.45, 199], atol=0.01)
    shown = 176.45 * (199 - 102.22) / ((176.45 + 77.67) * 2 * 77.78)
    assert truncated[0] == pytest.approx(1 - shown, abs=1e-3)


@pytest.mark.parametrize("box", [(-10, 0, 0, 2, 2, 2, 0), (10, 40, 0, 2, 2, 2, 0), (10, 0, 30, 2, 2, 2, 1)])
def test_what_the_camera_does_not_see_has_no_image_box(box):
    pixels, truncated = image_boxes(np.array([box], dtype=float), make_calibration())
    assert pixels[0].tolist() == [-1, -1, -1, -1]
    assert truncated[0] == 1


def test_edges_are_cut_at_the_near_plane_and_pixels_behind_the_camera_are_nan():
    # From 1 m behind the camera to 3 m before it; 2 m wide, 2 m high, 5 m to the left.
    ends = project_edges(np.array([[1.0, 5, 0, 4, 2, 2, 0]]), make_calibration())[0]
    assert np.isnan(ends[[1, 5]]).all()  # the rear edges, between corners 1 and 2 and between 5 and 6
    assert np.isfinite(ends[[3, 7, 8, 11]]).all()
    # Bottom left edge, y = 6, z = -1: from the front (3 m) to the near plane (0.1 m).
    np.testing.assert_allclose(ends[0, 0], [620 - 700 * 6 / 3, 180 + 700 / 3])
    np.testing.assert_allclose(ends[0, 1], [620 - 700 * 6 / 0.1, 180 + 700 / 0.1])
    pixels, depth_m = make_calibration().project(np.array([[-10.0, 0, 0], [0, 0, 0], [10, 0, 0]]))
    assert np.isnan(pixels[:2]).all()
    assert pixels[2].tolist() == [620, 180]
    assert depth_m.tolist() == [-10, 0, 10]


def test_in_image_is_projecting_each_point():
    calib = make_calibration(1.0, 2.0, -1.0, (0.1, -0.08, -0.27))
    points = np.random.default_rng(0).uniform((-20, -40, -3, 0), (70, 40, 1, 1), (4000, 4)).astype(np.float32)
    size = (1000, 300)
    mask = in_image(points, calib, size)
    assert 100 < mask.sum() < 3000
    for point, inside in zip(points[:300].astype(float), mask, strict=False):
        camera = calib.r0_rect @ (calib.camera_from_lidar @ [*point[:3], 1.0])
        u, v, w = calib.p2 @ [*camera, 1.0]
        assert inside == (w > 0 and 0 <= u / w < size[0] and 0 <= v / w < size[1])


# --- files


def test_calibration_round_trip_all_seven_lines_and_the_tracking_benchmarks_spelling(tmp_path):
    calib = make_calibration(1.0, 2.0, -1.0, (0.1, -0.08, -0.27))
    write_calibration(tmp_path / "c.txt", calib)
    back = read_calibration(tmp_path / "c.txt")
    for name in ("p2", "r0_rect", "camera_from_lidar"):
        np.testing.assert_allclose(getattr(back, name), getattr(calib, name), atol=1e-11)
    lines = [line.split() for line in (tmp_path / "c.txt").read_text().splitlines()]
    assert [line[0] for line in lines[:4]] == ["P0:", "P1:", "P2:", "P3:"]
    assert [line[0] for line in lines[4:]] == ["R0_rect:", "Tr_velo_to_cam:", "Tr_imu_to_velo:"]
    assert [len(line) - 1 for line in lines] == [12, 12, 12, 12, 9, 12, 12]
    points = np.array([[10.0, 2, -1], [40, -7, 0.5]])
    np.testing.assert_allclose(back.lidar_from_rect(back.rect_from_lidar(points)), points, atol=1e-9)
    path = tmp_path / "c.txt"
    write_calibration(path, make_calibration(yaw_deg=1.0))
    text = path.read_text().replace("R0_rect:", "R_rect").replace("Tr_velo_to_cam:", "Tr_velo_cam")
    path.write_text("calib_time: 09-Jan-2012 13:57:47\n" + text)
    np.testing.assert_allclose(read_calibration(path).r0_rect, np.eye(3), atol=1e-9)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("R0_rect", "R9_rect", ["R0_rect"]),
        ("P2: 7.000000000000e+02", "P2:", ["P2", "11", "12"]),
        ("P2: 7.000000000000e+02", "P2: seven", ["P2", "seven"]),
        ("P2: 7.000000000000e+02", "P2: nan", ["P2", "finite"]),
        ("P2: ", f"P2: {'0 ' * 12}\nP9: ", ["P2 is not a projection"]),
        ("R0_rect: 1.000000000000e+00", "R0_rect: 0", ["R0_rect", "rotation"]),
    ],
)
def test_damaged_calibration_is_named(tmp_path, old, new, words):
    path = tmp_path / "c.txt"
    write_calibration(path, make_calibration())
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new))
    assert_one_line(path, words, lambda: read_calibration(path))
