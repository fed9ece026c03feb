"""Which objects count at which difficulty, and in which distance band."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from asca_pillars.evaluation.kitti.average_precision import DIFFICULTIES, evaluate
from tests.evaluation.kitti.kitti_objects import (
    CAR,
    CLASSES,
    EVERY,
    as_frames,
    beside,
    counts,
    hit,
    low,
    results,
)


@pytest.mark.parametrize(
    ("changes", "counted"),
    [
        ({}, (1, 1, 1)),
        ({"height_px": 40.0}, (1, 1, 1)),
        ({"height_px": 39.99}, (0, 1, 1)),
        ({"height_px": 25.0}, (0, 1, 1)),
        ({"height_px": 24.99}, (0, 0, 0)),
        ({"occluded": -1}, (1, 1, 1)),
        ({"occluded": 1}, (0, 1, 1)),
        ({"occluded": 2}, (0, 0, 1)),
        ({"occluded": 3}, (0, 0, 0)),
        ({"truncated": 0.15}, (1, 1, 1)),
        ({"truncated": 0.16}, (0, 1, 1)),
        ({"truncated": 0.30}, (0, 1, 1)),
        ({"truncated": 0.31}, (0, 0, 1)),
        ({"truncated": 0.50}, (0, 0, 1)),
        ({"truncated": 0.51}, (0, 0, 0)),
        ({"type": "cAR"}, (1, 1, 1)),
        ({"type": "Van"}, (0, 0, 0)),
    ],
)
def test_the_limits_still_count(changes: dict[str, Any], counted: tuple[int, int, int]) -> None:
    changes = dict(changes)
    label = replace(low(CAR, changes.pop("height_px", 60.0)), **changes)
    found = [hit(type="CAR"), hit(beside(CAR, 1))]
    for metric in EVERY:
        assert tuple(counts([label], found, metric, d)[0] for d in DIFFICULTIES) == counted


@pytest.mark.parametrize(("name", "neighbor"), [("Car", "van"), ("Pedestrian", "PERSON_SITTING")])
def test_neighboring_types_excuse_a_detection(name: str, neighbor: str) -> None:
    truth = [replace(CAR, type=name), beside(CAR, 1, type=neighbor)]
    found = [hit(type=name), hit(beside(CAR, 1), type=name)]
    assert counts(truth, found, "3d", name=name) == [1, 1, 0, 0]
    assert counts(truth, found[:1], "3d", name=name) == [1, 1, 0, 0]


@pytest.mark.parametrize("other", ["Truck", "Tram", "Misc", "Cyclist", "Van", "Person_sitting"])
def test_other_types_and_duplicates_are_false(other: str) -> None:
    name = "Pedestrian" if other == "Van" else "Car"
    truth = [replace(CAR, type=name), beside(CAR, 1, type=other)]
    for metric in EVERY:
        assert counts(truth, [hit(type=name), hit(beside(CAR, 1), type=name)], metric, name=name) == [1, 1, 1, 0]
        assert counts(truth, [hit(type=name), hit(type=name)], metric, name=name) == [1, 1, 1, 0]


@pytest.mark.parametrize("metric", EVERY)
def test_a_low_detection_of_any_class_takes_an_object(metric: str) -> None:
    """Neither true nor missed: the object is gone, and there is no threshold left but the other car's."""
    other = beside(CAR, 1)
    near_limit = low(CAR, 40.0)
    small = hit(low(CAR, 39.5), type="Tram")
    assert counts([near_limit, other], [small, hit(other)], metric) == [2, 1, 0, 0]
    assert counts([near_limit, other], [hit(small, type="Car"), hit(other)], metric) == [2, 1, 0, 0]
    # A large one of another class does not, and a low one that stands alone is not false.
    assert counts([CAR, other], [hit(type="Tram"), hit(other)], metric) == [2, 1, 0, 1]
    assert counts([other], [small, hit(other)], metric) == [1, 1, 0, 0]


def test_detections_without_a_2d_box_are_ignored_on_the_ground_too() -> None:
    curve = results([CAR], [hit(bbox=(-1.0, -1.0, -1.0, -1.0))]).curve("Car", "3d", "easy")
    assert curve is not None and (curve.counted, curve.matched, curve.r40) == (1, 0, 0)


def test_a_band_ignores_what_stands_outside() -> None:
    """Distances 5, 10 and 15 m; the low end belongs to a band, the high end does not."""
    truth = [beside(CAR, n, x_m=3.0 * (n + 1), z_m=4.0 * (n + 1)) for n in range(3)]
    found = [hit(item, 0.9 - 0.1 * n) for n, item in enumerate(truth)]
    alone = hit(beside(CAR, 5, x_m=0.0, z_m=12.0), 0.95)
    bands = [(0.0, 10.0), (10.0, 15.0), (15.0, 99.0), (99.0, 100.0)]
    evaluation = evaluate(*as_frames([truth], [[alone, *found]]), CLASSES, bands_m=bands)
    assert list(evaluation.bands) == bands
    for metric in (*EVERY, "aos"):
        curves = [evaluation.bands[band].curves["Car", metric, "easy"] for band in bands]
        assert [curve.counted for curve in curves] == [1, 1, 1, 0]
        assert [curve.tp.tolist() for curve in curves] == [[1], [1], [1], []]
        assert [curve.fp.tolist() for curve in curves] == [[0], [1], [0], []]
    assert evaluation.overall.curves["Car", "3d", "easy"].counted == 3


def test_across_the_border_a_pair_is_neither_true_nor_false() -> None:
    near, far = (replace(CAR, x_m=0.0, z_m=z_m, rotation_y=np.pi / 2) for z_m in (19.9, 20.1))
    other = beside(CAR, 2, x_m=8.0, z_m=8.0)
    for label, detection in ((near, far), (far, near)):
        frames = as_frames([[label, other]], [[hit(detection), hit(other)]])
        curve = evaluate(*frames, CLASSES, bands_m=[(0.0, 20.0)]).bands[0.0, 20.0].curves["Car", "3d", "easy"]
        assert (curve.tp.tolist(), curve.fp.tolist(), curve.fn.tolist()) == ([1], [0], [0])
