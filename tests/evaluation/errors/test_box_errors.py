"""Matches, kinds of false detections, and errors along the axes of labels."""

import numpy as np
import pytest

from asca_pillars.evaluation.errors.box_errors import (
    CORRECTIONS,
    RESIDUALS,
    box_residuals,
    boxes_from_residuals,
    corrected,
    match_frame,
)
from asca_pillars.geometry.boxes import wrap_angle
from asca_pillars.geometry.overlap import paired_iou_3d
from tests.evaluation.errors.made_frames import frame

CAR = np.array([20.0, 5.0, -0.9, 4.0, 1.6, 1.5, 0.2])


def residual(found: np.ndarray, label: np.ndarray) -> dict[str, float]:
    return dict(zip(RESIDUALS, box_residuals(found[None], label[None])[0], strict=True))


def random_boxes(count: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    centers = rng.uniform((-40, -40, -2), (40, 40, 1), (count, 3))
    return np.concatenate([centers, rng.uniform(0.5, 5, (count, 3)), rng.uniform(-np.pi, np.pi, (count, 1))], axis=1)


def test_a_box_that_is_drawn_too_long_at_its_unseen_end() -> None:
    label = np.array([20.0, 0, 0, 4, 2, 2, 0])
    for heading in (0.0, np.pi):  # seen from behind and from the front
        longer = np.add(label, [0.15, 0, 0.1, 0.5, 0.2, 0, 0])
        label[6] = longer[6] = heading
        errors = residual(longer, label)
        assert errors["near_end"] == pytest.approx(0.1) and errors["far_end"] == pytest.approx(0.4)
        assert errors["length"] == pytest.approx(0.5) and errors["range"] == pytest.approx(0.15)
        assert errors["bottom"] == pytest.approx(0.1) and errors["top"] == pytest.approx(0.1)
        assert errors["width"] == pytest.approx(0.2) and errors["left"] == pytest.approx(0)
        assert errors["height"] == pytest.approx(0) and errors["turned"] == 0


def test_the_near_side_and_left_are_those_that_the_sensor_sees() -> None:
    for y, left in ((5.0, -0.2), (-5.0, 0.2)):  # a car to the left shows its right side
        label = np.array([0.0, y, 0, 4, 2, 2, 0])
        errors = residual(np.add(label, [0, left, 0, 0, 0, 0, 0]), label)
        assert errors["near_side"] == pytest.approx(0.2) and errors["far_side"] == pytest.approx(-0.2)
        assert errors["range"] == pytest.approx(-0.2) and errors["left"] == pytest.approx(0)
    label = np.array([0.0, 10, 0, 1, 1, 2, 0.3])  # to the left of the sensor: its left is behind
    assert residual(np.add(label, [-0.2, 0, 0, 0, 0, 0, 0]), label)["left"] == pytest.approx(0.2)


def test_headings_and_what_a_box_turned_by_a_quarter_covers() -> None:
    for turn, axis, turned in ((0.1, 0.1, 0), (np.pi + 0.1, 0.1, 1), (-0.2, -0.2, 0), (3.0, 3.0 - np.pi, 1)):
        errors = residual(np.add(CAR, [0, 0, 0, 0, 0, 0, turn]), CAR)
        assert errors["heading_deg"] == pytest.approx(np.degrees(axis)) and errors["turned"] == turned
        assert errors["length"] == pytest.approx(0)
    across = CAR.copy()
    across[[3, 4]], across[6] = CAR[[4, 3]], CAR[6] + np.pi / 2
    errors = residual(across, CAR)
    assert abs(errors["heading_deg"]) == pytest.approx(90)
    assert [errors[name] for name in ("near_end", "far_end", "near_side", "far_side")] == pytest.approx([0] * 4)


def test_residuals_corrections_and_boxes_are_one() -> None:
    labels, found = random_boxes(500, 0), random_boxes(500, 1)
    again = boxes_from_residuals(labels, box_residuals(found, labels))
    np.testing.assert_allclose(paired_iou_3d(again, found), 1, atol=1e-9)
    turn = np.abs(wrap_angle(found[:, 6] - labels[:, 6], np.pi))
    same = turn < np.pi / 4 - 1e-6
    assert 200 < same.sum() < 300
    np.testing.assert_allclose(again[same, :6], found[same, :6], atol=1e-9)
    np.testing.assert_allclose(wrap_angle(again[same, 6] - found[same, 6]), 0, atol=1e-9)
    labels = random_boxes(200, 2)
    found = labels + np.random.default_rng(3).normal(0, 0.1, labels.shape)
    errors = box_residuals(found, labels)
    np.testing.assert_allclose(paired_iou_3d(corrected(labels, errors, "as drawn"), found), 1, atol=1e-9)
    for part, columns in CORRECTIONS.items():
        left = box_residuals(corrected(labels, errors, part), labels)
        np.testing.assert_allclose(left[:, list(columns)], 0, atol=1e-9)
        faces = [*range(2), 3, 4, 6, 7]
        kept = [column for column in faces if column not in columns]
        np.testing.assert_allclose(left[:, kept], errors[:, kept], atol=1e-9)


def test_kinds_of_detections() -> None:
    van, rider = np.add(CAR, [0, 8, 0, 1, 0, 0, 0]), np.array([10.0, -6, -0.8, 1.8, 0.6, 1.7, 0])
    found = [
        ("Car", 0.9, np.add(CAR, [0.1, 0, 0, 0, 0, 0, 0])),  # found
        ("Car", 0.8, np.add(CAR, [0.2, 0, 0, 0, 0, 0, 0])),  # on an object that is taken
        ("Car", 0.7, van),  # neither right nor wrong
        ("Car", 0.6, rider),  # on a cyclist
        ("Car", 0.6, np.add(CAR, [30, 0, 0, 0, 0, 0, 0])),  # on nothing
        ("Car", 0.5, np.add(CAR, [40, 0, 0, 0, 0, 0, 0])),  # on nothing, ignored
        ("Car", 0.1, np.add(CAR, [50, 0, 0, 0, 0, 0, 0])),  # not reported
        ("Cyclist", 0.9, rider),
    ]
    made = frame([("Car", CAR), ("Van", van), ("Cyclist", rider)], found, ignored=[False] * 5 + [True] + [False] * 2)
    objects, detections = match_frame(made, 3, "Car", 0.3)
    first, others = [("found", ""), ("duplicate", "Car"), ("ignored", "")], ("background", "ignored", "background")
    expected = [*first, ("classification", "Cyclist"), *((kind, "") for kind in others)]
    assert [(item.kind, item.label) for item in detections] == expected
    assert [item.is_false for item in detections] == [False, True, False, True, True, False, False]
    (item,) = objects
    assert item.frame == 3 and item.found and item.score == 0.9 and item.detection is not None


def test_badly_placed_boxes_boxes_below_the_score_and_boxes_that_found_another() -> None:
    aside = np.add(CAR, [2.5, 0, 0, 0, 0, 0, 0])
    objects, (detection,) = match_frame(frame([("Car", CAR)], [("Car", 0.9, aside)]), 0, "Car", 0.3)
    assert (detection.kind, detection.label) == ("localization", "Car")
    assert not objects[0].found and objects[0].detection is not None and not objects[0].below_score
    far, weak = np.add(CAR, [2.5, 0, 0, 0, 0, 0, 0]), ("Car", 0.2, CAR)
    ((item,), _) = match_frame(frame([("Car", CAR)], [weak]), 0, "Car", 0.3)
    assert not item.found and item.below_score and item.detection is None and np.isnan(item.score)
    ((item,), detections) = match_frame(frame([("Car", CAR)], [weak, ("Car", 0.9, far)]), 0, "Car", 0.3)
    assert item.below_score and item.score == 0.9, "the reported box on it is measured"
    assert [one.kind for one in detections] == ["localization", "found"]
    behind = np.add(CAR, [3 * np.cos(0.2), 3 * np.sin(0.2), 0, 0, 0, 0, 0])  # BEV IoU 1 / 7
    both = frame([("Car", CAR), ("Car", behind)], [("Car", 0.9, CAR)])
    (first, second), (detection,) = match_frame(both, 0, "Car", 0.3)
    assert first.found and detection.kind == "found"
    assert not second.found and second.detection is None


def test_objects_without_points_or_beyond_the_limits() -> None:
    hidden, small = np.add(CAR, [0, 6, 0, 0, 0, 0, 0]), np.add(CAR, [0, -12, 0, 0, 0, 0, 0])
    made = frame(
        [("Car", CAR), ("Car", hidden), ("Car", small)],
        [("Car", 0.9, hidden), ("Car", 0.8, small)],
        object_points=[9, 0, 9],
        counted=[True, False, False],
    )
    objects, detections = match_frame(made, 0, "Car", 0.3)
    assert [(item.counted, item.found) for item in objects] == [(True, False), (False, True)]
    assert [item.kind for item in detections] == ["ignored", "ignored"]
    assert [round(item.neighbor_m, 6) for item in objects] == [6.0, 12.0]


def test_nothing_at_all() -> None:
    assert match_frame(frame([], []), 0, "Car", 0.3) == ([], [])
    ((item,), detections) = match_frame(frame([("Car", CAR)], []), 0, "Car", 0.3)
    assert not item.found and item.neighbor_m == np.inf and detections == []
    objects, (detection,) = match_frame(frame([], [("Car", 0.9, CAR)]), 0, "Car", 0.3)
    assert objects == [] and detection.kind == "background"
    assert box_residuals(np.zeros((0, 7)), np.zeros((0, 7))).shape == (0, len(RESIDUALS))
