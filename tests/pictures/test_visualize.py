"""Pictures: what must be where, in which color."""

import cv2
import numpy as np
import pytest

from asca_pillars.data.kitti.calibration import Calibration
from asca_pillars.detection.detections import Detections
from asca_pillars.geometry.boxes import Ranges
from asca_pillars.pictures.colors import HEIGHT_RAMP
from asca_pillars.pictures.drawing import BoxLayer
from asca_pillars.pictures.visualize import class_color, draw_bev, draw_layers, draw_on_image, write_png

AHEAD = Ranges(x_m=(5.12, 25.6), y_m=(-10.24, 5.12), z_m=(-3.0, 1.0))
AROUND = Ranges(x_m=(-10.24, 20.48), y_m=(-5.12, 10.24), z_m=(-3.0, 1.0))
WHOLE = Ranges(x_m=(0.0, 69.12), y_m=(-39.68, 39.68), z_m=(-3.0, 1.0))
NAMES = ("Car", "Pedestrian", "Cyclist")
NO_POINTS = np.zeros((0, 4), np.float32)
# The corners of AHEAD's range, so that nothing is cropped: 15.36 m wide, 20.48 m deep.
CORNERS = np.array([[5.13, -10.23, 0, 0], [25.59, 5.11, 0, 0], [5.13, 5.11, 0, 0]], np.float32)


def detections(*boxes, labels=None) -> Detections:
    labels = [0] * len(boxes) if labels is None else labels
    return Detections(
        np.array(boxes, np.float32).reshape(-1, 7),
        np.linspace(0.9, 0.3, len(boxes), dtype=np.float32),
        np.array(labels, np.int64),
        NAMES,
    )


def near(image, color, tolerance=40):
    """Rows and columns of the pixels of about this color."""
    return np.nonzero((np.abs(image.astype(int) - color) <= tolerance).all(axis=-1))


def test_x_is_up_and_y_is_left_in_the_grids_range():
    """550 px wide, 1.1 times as high at most: 605 px for 20.48 m are 29.54 px/m, 18.62 m across, centered on -2.56.

    The left edge is y = -2.56 + 9.31 = 6.75. A point at (15.36, 1.25) is 10.24 m below the upper edge (row 302.5)
    and 5.5 m right of the left one (column 162.5).
    """
    point = np.array([[15.36, 1.25, 5.0, 0]], np.float32)
    with_point = draw_bev(np.vstack([CORNERS, point]), None, AHEAD, width_px=550)
    without = draw_bev(CORNERS, None, AHEAD, width_px=550)
    assert with_point.shape == (605, 550, 3)
    assert with_point.dtype == np.uint8
    rows, columns = np.nonzero((with_point.astype(int) - without).max(axis=-1) > 60)
    assert len(rows) >= 1
    np.testing.assert_allclose([rows.mean(), columns.mean()], [302.5, 162.5], atol=1.5)


def test_higher_points_are_brighter_and_on_top():
    # The first tenth of the heights counts as the ground.
    grounds = np.column_stack([np.full(30, 8.0), np.linspace(-9, 4, 30), np.full(30, -1.7), np.zeros(30)])
    low, high = [15.0, 0, -1.2, 0], [15.0, -4, 2.0, 0]
    hidden = [15.0, -4, -1.7, 0]
    points = np.vstack([CORNERS - [0, 0, 1.7, 0], grounds, [low, high, hidden]])
    image = draw_bev(points, None, AHEAD, width_px=550)
    row = round((25.6 - 15.0) * 605 / 20.48)
    brightness = image[row - 3 : row + 4].sum(axis=2).max(axis=0)
    column_low, column_high = (round((6.75 - y) * 605 / 20.48) for y in (0, -4))
    low_peak = brightness[column_low - 4 : column_low + 5].max()
    high_peak = brightness[column_high - 4 : column_high + 5].max()
    assert high_peak > 1.2 * low_peak > 1.2 * 150


def test_boxes_have_the_color_of_their_class_and_a_mark_towards_the_front():
    """The same box facing ahead and back differs by its mark alone: above its center, and below."""
    ahead, back = (
        draw_bev(NO_POINTS, detections([15, 0, -1, 8, 3, 2, yaw], labels=[1]), AHEAD, width_px=600).astype(int)
        for yaw in (0.0, np.pi)
    )
    rows, _ = near(ahead[110:], class_color("Pedestrian"))  # below the legend
    assert len(rows) > 100
    center = 110 + (rows.min() + rows.max()) / 2
    changed = np.abs(ahead - back).max(axis=-1) > 100
    for image, side in ((ahead, -1), (back, 1)):
        marks = near(np.where(changed[..., None], image, 0), class_color("Pedestrian"))[0]
        assert len(marks) > 20
        assert (np.sign(marks - center) == side).mean() > 0.9


def test_labels_are_white_and_under_the_detections():
    box = [15.0, -2, -1, 8, 3, 2, 0.3]
    labels_only = draw_bev(NO_POINTS, None, AHEAD, labels=np.array([box]), width_px=500)
    both = draw_bev(NO_POINTS, detections(box), AHEAD, labels=np.array([box]), width_px=500)
    white = [len(near(image[110:-60], (255, 255, 255), 60)[0]) for image in (labels_only, both)]
    assert white[0] > 100
    assert white[1] < white[0] / 5
    assert len(near(both[110:], class_color("Car"))[0]) > 100


def test_the_legend_lists_every_class_of_the_detector():
    image = draw_bev(CORNERS, detections([10, 0, -1, 4, 2, 2, 0]), AHEAD, width_px=500)
    for name in NAMES:
        assert len(near(image[:100, :40], class_color(name), 8)[0]) > 50, name
    assert class_color("Car") != class_color("Truck") == class_color("Truck")


@pytest.mark.parametrize("grid", [AHEAD, AROUND, WHOLE])
@pytest.mark.parametrize(
    "found",
    [None, Detections.empty(NAMES), detections([500, 0, 0, 4, 2, 2, 0], [10, 1, 0, 0, 0, 0, 0])],
    ids=["None", "none", "far outside and without size"],
)
def test_nothing_to_see_is_still_a_picture(grid, found):
    image = draw_bev(NO_POINTS, found, grid, width_px=300)
    assert image.shape[1] == 300
    assert 1 <= image.shape[0] <= 331


def test_scores_do_not_cover_each_other():
    """Forty boxes at one place: the first score is written, hardly any other; no error."""
    crowd = detections(*[[15, -2, -1, 4, 2, 2, 0]] * 40)
    alone = draw_bev(CORNERS, crowd[:1], AHEAD, width_px=500)
    crowded = draw_bev(CORNERS, crowd, AHEAD, width_px=500)
    colored = [len(near(image[110:], class_color("Car"))[0]) for image in (alone, crowded)]
    assert colored[1] < 2 * colored[0]


# --- over the camera image

CALIB = Calibration(
    np.array([[700.0, 0, 320, 0], [0, 700, 120, 0], [0, 0, 1, 0]]),
    np.eye(3),
    np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0]]),
)
GRAY = np.full((240, 640, 3), 90, np.uint8)


def test_a_box_is_drawn_around_its_projection():
    """A box of 2 m whose rear face is 14 m away and its front, 16 m: from 320 - 700 / 14 to 320 + 700 / 14."""
    image = draw_on_image(GRAY, np.array([[15.0, 0, 0, 2, 2, 2, 0]]), ["Car"], None, CALIB)
    assert (GRAY == 90).all()
    rows, columns = near(image, class_color("Car"))
    below = rows > 75  # what is above is the name
    np.testing.assert_allclose([columns[below].min(), columns[below].max()], [270, 370], atol=2)
    np.testing.assert_allclose(rows.max(), 170, atol=2)
    # The front face is tinted, half width 700 / 16 = 43.75: its inside is not the background any more.
    assert (image[120, 320] != 90).any()
    assert (image[167, 320] == 90).all()


def test_boxes_behind_the_camera_leave_no_trace_and_those_partly_behind_no_error():
    behind = np.array([[-15.0, 0, 0, 2, 2, 2, 0]])
    assert np.array_equal(draw_on_image(GRAY, behind, ["Car"], [0.5], CALIB), GRAY)
    beside = np.array([[1.0, 1.5, -0.5, 6, 2, 2, 0], [1.0, -1.5, -0.5, 6, 2, 2, 3.1], [1e4, 1e4, 0, 4, 2, 2, 1]])
    image = draw_on_image(GRAY, beside, ["Car", "Cyclist", "Van"], [0.5, 0.4, 0.3], CALIB)
    for name in ("Car", "Cyclist"):
        assert len(near(image, class_color(name))[0]) > 50, name


def test_nearer_boxes_are_drawn_over_farther_ones():
    boxes = np.array([[10.0, 0, 0, 2, 2, 2, 0], [10.5, 0, 0, 2, 2, 2, 0]])
    image = draw_on_image(GRAY, boxes, ["Car", "Cyclist"], [0.5, 0.5], CALIB)
    swapped = draw_on_image(GRAY, boxes[::-1], ["Cyclist", "Car"], [0.5, 0.5], CALIB)
    assert np.array_equal(image, swapped)


def test_no_boxes_give_a_copy():
    image = draw_on_image(GRAY, np.zeros((0, 7), np.float32), [], None, CALIB)
    assert np.array_equal(image, GRAY)
    assert image is not GRAY


def test_png_round_trip(tmp_path):
    image = draw_bev(CORNERS, detections([10, 0, -1, 4, 2, 2, 0]), AHEAD, width_px=200)
    write_png(tmp_path / "new" / "a.png", image)
    assert np.array_equal(np.asarray(cv2.imread(str(tmp_path / "new" / "a.png"))), image)
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["a.png"]


def test_the_first_layer_is_on_top():
    box = np.array([[15.0, -2, -1, 8, 3, 2, 0.3]])
    red, blue = BoxLayer("a", box, (0, 0, 255)), BoxLayer("b", box, (255, 0, 0))
    for layers in ([red, blue], [blue, red]):
        image = draw_layers(NO_POINTS, layers, AHEAD, width_px=500)[110:]
        top, hidden = (len(near(image, layer.color)[0]) for layer in layers)
        assert top > 100 > 10 * hidden


def test_every_layer_keeps_its_line_in_the_legend():
    """The texts of the rings keep clear of it: in this view one would stand on the fourth and fifth line."""
    layers = [BoxLayer(f"kind {number}", np.zeros((0, 7)), (10, 10, 10)) for number in range(8)]
    corners = np.array([[x, y, 0, 0] for x in (0.1, 45) for y in (-1, 10)], np.float32)
    image = draw_layers(corners, layers, WHOLE)
    for number in range(len(layers)):
        row = image[12 + 22 * number : 12 + 22 * (number + 1), 38:110]
        assert (row > 200).all(axis=-1).sum() > 40, number


def test_boxes_on_the_image_take_given_colors():
    box = np.array([[12.0, 0, 0, 4, 2, 2, 0]])
    drawn = draw_on_image(np.zeros_like(GRAY), box, [""], None, CALIB, colors=[(255, 0, 255)])
    assert len(near(drawn, (255, 0, 255))[0]) > 100
    assert not drawn[..., 1].any()  # an empty text leaves no mark


def test_the_score_of_a_box_leaves_the_arrow_of_the_sensor_free():
    """The sensor is to the right of the box, where its score would stand."""
    box = np.array([[0.2, 1.6, -1, 2, 1, 2, 0.0]])
    plain, scored = (
        draw_layers(NO_POINTS, [BoxLayer("a", box, (0, 0, 255), [text])], AROUND, width_px=300) for text in ("", "0.88")
    )
    arrow = (plain[60:-40] == 255).all(axis=-1)
    assert arrow.sum() > 30
    assert (scored[60:-40][arrow] == 255).all()
    assert len(near(scored, (0, 0, 255))[0]) > len(near(plain, (0, 0, 255))[0]) + 20  # the score is elsewhere


def test_a_bar_says_what_the_colors_of_the_points_mean():
    image = draw_bev(CORNERS, None, AHEAD, width_px=550)
    bar = image[16:92, 550 - 16 - 5]
    low, high = (np.array(color[::-1]) for color in (HEIGHT_RAMP[0], HEIGHT_RAMP[-1]))
    assert np.abs(bar[1].astype(int) - high).max() < 12 and np.abs(bar[-2].astype(int) - low).max() < 12
    small = draw_bev(CORNERS, None, AHEAD, width_px=200)  # where there is no room, there is no bar
    assert len(near(small[:60, 150:], high, 12)[0]) == 0
