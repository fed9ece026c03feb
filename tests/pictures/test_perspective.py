"""The picture in 3D: where the camera puts things, what hides what, and which color it has."""

import math

import numpy as np
import pytest

from asca_pillars.geometry.boxes import Ranges
from asca_pillars.pictures.drawing import BoxLayer, Trail
from asca_pillars.pictures.perspective import ChaseCamera, draw_chase
from asca_pillars.pictures.visualize import class_color

AHEAD = Ranges(x_m=(0.0, 69.12), y_m=(-30.72, 30.72), z_m=(-3.0, 1.0))
AROUND = Ranges(x_m=(-69.12, 69.12), y_m=(-69.12, 69.12), z_m=(-3.0, 1.0))
NO_POINTS = np.zeros((0, 4), np.float32)
CAMERA = ChaseCamera((-10.0, 0.0, 0.0), (0.0, 0.0, 0.0), 200, 100)


def test_a_camera_that_looks_along_x():
    """Half of 200 px is the tangent of 26 degrees: a place 1 m to the left at 10 m lies 20.50 px left of the middle."""
    pixels, depth = CAMERA.project(np.array([[0.0, 0, 0], [0, 1, 0], [0, 0, 1], [-12, 0, 0]]))
    step = 100 / math.tan(math.radians(26)) / 10
    np.testing.assert_allclose(pixels[:3], np.array([[100, 50], [100 - step, 50], [100, 50 - step]]))
    np.testing.assert_allclose(depth, [10, 10, 10, -2])


def test_lines_are_cut_at_the_camera_and_nan_behind_it():
    starts = np.array([[0.0, 1, 0], [-20, 1, 0], [-20, 1, 0]])
    ends = np.array([[10.0, 1, 0], [0, 1, 0], [-15, 1, 0]])
    whole, cut, behind = CAMERA.cut(starts, ends)
    np.testing.assert_allclose(whole, CAMERA.project(np.stack([starts[0], ends[0]]))[0])
    np.testing.assert_allclose(cut, CAMERA.project(np.array([[-9.5, 1, 0], [0, 1, 0]]))[0])
    assert np.isnan(behind).all()


def near(image, color, tolerance=40):
    """Rows and columns of the pixels of about this color."""
    return np.nonzero((np.abs(image.astype(int) - color) <= tolerance).all(axis=-1))


@pytest.mark.parametrize("ranges", [AHEAD, AROUND])
@pytest.mark.parametrize("points", [NO_POINTS, np.array([[np.nan, 0, 0, 0], [1e9, 0, 0, 0], [-40, 0, 90, 0]])])
def test_nothing_to_see_is_still_a_picture(ranges, points):
    image = draw_chase(points, [], ranges, width_px=320)
    assert image.shape == (180, 320, 3) and image.dtype == np.uint8
    assert len(near(image, (255, 255, 255))[0]) > 4  # where the sensor is


def test_boxes_have_their_color_left_is_left_and_the_front_is_tinted():
    colors = [class_color(name) for name in ("Car", "Pedestrian")]
    boxes = [np.array([[20.0, y, -0.9, 4, 2, 1.6, yaw]]) for y, yaw in ((6, 0.0), (-6, np.pi))]
    layers = [BoxLayer("a", boxes[0], colors[0]), BoxLayer("b", boxes[1], colors[1])]
    image = draw_chase(NO_POINTS, layers, AHEAD, width_px=800, ground_m=-1.73)[80:]
    left, right = (near(image, color, 60)[1] for color in colors)
    assert len(left) > 50 and len(right) > 50
    assert left.max() < 400 < right.min()
    turned = [BoxLayer("a", boxes[0] + [[0, 0, 0, 0, 0, 0, np.pi]], colors[0]), layers[1]]
    other = draw_chase(NO_POINTS, turned, AHEAD, width_px=800, ground_m=-1.73)[80:]
    changed = np.nonzero(np.abs(image.astype(int) - other).max(axis=-1) > 20)
    assert len(changed[1]) > 50 and changed[1].max() < 400


def test_near_points_hide_far_ones_and_those_in_a_box_have_its_color():
    ray = np.array([15.0, 0, 0]) - [-17, 0, 7.27]  # from the camera is
    points = np.stack([[-17, 0, 7.27] + ray * share for share in (1.0, 0.98)])
    colored = BoxLayer("a", np.array([[*points[1], 0.3, 0.3, 0.3, 0]]), (0, 0, 255), thickness_px=1)
    for order in ([0, 1], [1, 0]):
        image = draw_chase(points[order], [colored], AHEAD, width_px=800, ground_m=-1.73)[80:]
        reds = image[..., 2].astype(int) - image[..., :2].max(axis=-1)
        assert reds.max() > 150
    alone = draw_chase(points[:1], [], AHEAD, width_px=800, ground_m=-1.73)[80:]
    assert (alone[..., 2].astype(int) - alone[..., :2].max(axis=-1)).max() < 100


def test_boxes_and_trails_that_pass_the_camera_leave_no_error():
    boxes = np.array([[-17.0, 0, 6, 10, 4, 4, 0.4], [-60, 0, 0, 4, 2, 2, 0], [1e5, 1e5, 0, 4, 2, 2, 1], [5, *[0] * 6]])
    layer = BoxLayer("x", boxes, (0, 0, 255), ["text"] * 4)
    trail = Trail(np.column_stack([np.linspace(-40, 30, 20), np.zeros(20), np.full(20, -1.7)]), (0, 255, 0))
    image = draw_chase(NO_POINTS, [layer], AHEAD, width_px=400, trails=[trail])
    assert len(near(image, (0, 255, 0), 60)[0]) > 20


def test_a_trail_fades_to_its_oldest_place():
    trail = Trail(np.column_stack([np.linspace(5, 45, 9), np.zeros(9), np.full(9, -1.7)]), (0, 255, 0))
    image = draw_chase(NO_POINTS, [], AHEAD, width_px=800, trails=[trail], ground_m=-1.73)
    greens = image[:, 380:420, 1].astype(int) - image[:, 380:420, 2]
    rows = np.flatnonzero(greens.max(axis=1) > 20)
    assert greens[rows[0] : rows[0] + 10].max() > 2 * greens[rows[-1] - 10 : rows[-1] + 1].max()


@pytest.mark.parametrize("ranges", [AHEAD, AROUND])
@pytest.mark.parametrize("x_m", [-4.5, -4.0, -3.0])
def test_the_score_of_a_box_leaves_the_arrow_of_the_sensor_free(ranges, x_m):
    """A car behind the sensor, over whose roof the camera sees it: its score would stand on the arrow."""
    box = np.array([[x_m, 0, -0.9, 4, 1.8, 1.6, 0]])
    plain, scored, nothing = (
        draw_chase(NO_POINTS, [BoxLayer("a", one, (0, 0, 255), texts)], ranges, ground_m=-1.73)[80:]
        for one, texts in ((box, [""]), (box, ["0.88"]), (box[:0], []))
    )
    arrow = (nothing == 255).all(axis=-1)
    assert arrow.sum() > 100
    np.testing.assert_array_equal(scored[arrow], plain[arrow])
    assert (scored != plain).any(axis=-1).sum() > 100  # the score is elsewhere
