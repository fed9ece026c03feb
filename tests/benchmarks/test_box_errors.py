"""Errors that all boxes have are found, and boxes without them are right."""

from dataclasses import replace

import numpy as np

from asca_pillars.data.kitti.kitti_labels import KittiObject
from asca_pillars.evaluation.predictions import ScoredFrames
from benchmarks.box_errors import average_precision, box_errors
from tests.evaluation.kitti.kitti_objects import CAR, Frame, as_frames, beside, hit

WALKER = replace(CAR, type="Pedestrian", height_m=1.75, width_m=0.6, length_m=0.8)


def scored(truth: list[Frame], found: list[Frame]) -> ScoredFrames:
    labels, detections = as_frames(truth, found)
    return ScoredFrames(tuple(labels), tuple(detections), ())


def test_what_all_boxes_have_wrong_is_found_and_taken_away() -> None:
    rng, truth, found = np.random.default_rng(0), [], []
    for _ in range(50):
        walkers = [beside(WALKER, place, x_m=float(x), z_m=float(z)) for place, (x, z) in enumerate(_places(rng))]
        truth.append(walkers)
        found.append(
            [_farther(hit(one, length_m=0.6, width_m=0.7, height_m=1.6, y_m=one.y_m + 0.1), 0.15) for one in walkers]
        )
    frames = scored(truth, found)
    errors = box_errors(frames, "Pedestrian", 0.1)
    assert errors.shape == (100, 6)
    np.testing.assert_allclose(errors, np.tile([0.15, 0, 0.1, -0.15, 0.1, -0.2], (100, 1)), atol=0.002)
    before, after = (
        average_precision(frames, "Pedestrian", taken) for taken in (np.zeros(6), np.median(errors, axis=0))
    )
    assert float(before[0]) < 5 and after == ["100.0"] * 3


def test_only_found_objects_and_sure_boxes_of_the_class_have_errors() -> None:
    far = replace(WALKER, x_m=15.0)
    frames = scored(
        [[WALKER, far, CAR]], [[hit(WALKER), hit(WALKER, score=0.05, length_m=1.2), hit(CAR, length_m=4.0)]]
    )
    np.testing.assert_allclose(box_errors(frames, "Pedestrian", 0.1), np.zeros((1, 6)), atol=1e-9)
    np.testing.assert_allclose(box_errors(frames, "Car", 0.1)[:, 5], [0.1], atol=1e-9)


def _places(rng: np.random.Generator) -> np.ndarray:
    """x and z of two walkers, metres, far apart."""
    return np.array([[-10, 12], [5, 20]]) + rng.uniform(-2, 2, (2, 2))


def _farther(item: KittiObject, metres: float) -> KittiObject:
    way = 1 + metres / np.hypot(item.x_m, item.z_m)
    return replace(item, x_m=item.x_m * way, z_m=item.z_m * way)
