"""What is evaluated, what is false, and the curves, each by inputs of a few boxes."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from asca_pillars.evaluation.kitti.average_precision import evaluate
from tests.evaluation.kitti.kitti_objects import (
    CAR,
    DONT_CARE,
    EVERY,
    ON_GROUND,
    as_frames,
    beside,
    counts,
    hit,
    results,
)


def test_a_class_that_is_never_detected_is_not_evaluated() -> None:
    mine = results([CAR, replace(CAR, type="Cyclist")], [hit()])
    assert mine.curve("Cyclist", "3d", "easy") is None and mine.curve("Car", "3d", "easy") is not None
    assert mine.to_json()["Cyclist"] == dict.fromkeys(("bbox", "bev", "3d", "aos"))
    assert mine.mean_ap("3d", "easy") == mine.curves["Car", "3d", "easy"].r40


@pytest.mark.parametrize(
    ("changes", "metrics"),
    [
        ({"bbox": (-1.0, -1.0, -1.0, -1.0)}, {"bev", "3d"}),
        ({"bbox": (-0.5, 100.0, 200.0, 160.0)}, {"bev", "3d"}),
        ({"bbox": (0.0, 100.0, 200.0, 160.0)}, {"bbox", "aos", "bev", "3d"}),
        ({"x_m": -1000.0}, {"bbox", "aos", "3d"}),
        ({"y_m": -1000.0}, {"bbox", "aos", "bev"}),
        ({"alpha": -10.0}, {"bbox", "bev", "3d"}),
    ],
)
def test_one_detection_of_the_class_that_knows_decides_what_is_evaluated(
    changes: dict[str, Any], metrics: set[str]
) -> None:
    assert {metric for _, metric, _ in results([CAR], [hit(**changes)]).curves} == metrics
    both = {metric for _, metric, _ in results([CAR], [hit(**changes), hit()]).curves}
    assert both == {"bbox", "bev", "3d"} | ({"aos"} if "alpha" not in changes else set())


def test_one_unknown_heading_anywhere_switches_aos_off() -> None:
    assert results([CAR], [hit()]).curve("Car", "aos", "easy") is not None
    mine = results([CAR], [hit()], ([], [hit(type="Tram", alpha=-10.0)]))
    assert mine.curve("Car", "aos", "easy") is None and mine.curve("Car", "bbox", "easy") is not None
    # Ground truth without a heading, as DontCare areas are, does not.
    assert results([CAR, DONT_CARE], [hit()]).curve("Car", "aos", "easy") is not None


def test_detections_without_any_object_score_zero_but_are_evaluated() -> None:
    mine = results([], [hit()], ([DONT_CARE], []))
    curve = mine.curve("Car", "3d", "hard")
    assert curve is not None and (curve.counted, curve.r40, curve.r11, curve.r40_cap) == (0, 0, 0, 0)
    assert len(curve.thresholds) == len(curve.fp) == 0
    # An average over classes leaves out a class of which nothing could be found.
    assert mine.mean_ap("3d", "hard") is None


def test_nothing_at_all() -> None:
    assert results([], []).curves == {}
    assert evaluate([], []).overall.frames == 0
    assert results([CAR], [], ([DONT_CARE], [])).curves == {}


def test_frames_must_be_the_same() -> None:
    (truth,), (found,) = as_frames([[CAR]], [[hit()]])
    with pytest.raises(ValueError, match="same frames"):
        evaluate([truth], [replace(found, frame_id="1")])
    with pytest.raises(ValueError, match="same frames"):
        evaluate([truth, replace(truth, frame_id="1")], [found])


def test_dont_care_areas_excuse_in_2d_only() -> None:
    area = beside(DONT_CARE, 2)
    found = [hit(), hit(beside(CAR, 2))]
    assert counts([CAR, area], found) == [1, 1, 0, 0]
    for metric in ON_GROUND:
        assert counts([CAR, area], found, metric) == [1, 1, 1, 0]


@pytest.mark.parametrize(("name", "limit"), [("Car", 0.7), ("Cyclist", 0.5)])
def test_dont_care_areas_excuse_by_the_share_of_the_detection(name: str, limit: float) -> None:
    """However large the area; and the shares of two areas do not add up."""
    label = replace(CAR, type=name)
    x1, y1, x2, y2 = beside(CAR, 4).bbox

    def false(*shares: float) -> int:
        areas = [replace(DONT_CARE, bbox=(x1 - 200, y1 - 50, x1 + s * (x2 - x1), y2 + 50)) for s in shares]
        return counts([label, *areas], [hit(label), hit(beside(label, 4))], name=name)[2]

    assert [false(limit + 0.01), false(limit - 0.01), false(limit - 0.01, limit - 0.01), false()] == [0, 1, 1, 1]


def test_an_object_on_a_dont_care_area_is_still_found() -> None:
    assert counts([DONT_CARE, CAR], [hit()]) == [1, 1, 0, 0]


def test_precision_by_hand() -> None:
    """Three objects, false positives between them: 1/1, 2/4 and 3/5 at entries 0, 1, 2, then nothing."""
    truth = [beside(CAR, place) for place in range(3)]
    false = [hit(beside(CAR, place), score) for place, score in ((4, 0.8), (5, 0.7))]
    found = [*(hit(item, score) for item, score in zip(truth, (0.9, 0.6, 0.3), strict=True)), *false]
    for metric in EVERY:
        curve = results(truth, found).curve("Car", metric, "moderate")
        assert curve is not None and curve.thresholds.tolist() == [0.9, 0.6, 0.3]
        # The running maximum lifts 2/4 to 3/5.
        assert curve.precision.tolist() == [1.0, 0.6, 0.6, *[0.0] * 38]
        assert (curve.tp.tolist(), curve.fp.tolist(), curve.fn.tolist()) == ([1, 2, 3], [0, 2, 2], [2, 1, 0])
        # Entry 0 alone of 0, 4 .. 40; entries 1 and 2 of 1 .. 40.
        assert curve.r11 == pytest.approx(100 / 11) and curve.r40 == pytest.approx(120 / 40)
        assert curve.r40_cap == 100 * 2 / 40 and curve.r11_cap == 100 / 11


def test_aos_goes_by_alpha() -> None:
    turned: dict[str, Any] = {"alpha": CAR.alpha + np.pi / 2, "rotation_y": CAR.rotation_y}
    curve = results([CAR], [hit(**turned)]).curve("Car", "aos", "easy")
    assert curve is not None and curve.precision[0] == pytest.approx(0.5)
    curve = results([CAR], [hit(rotation_y=CAR.rotation_y + np.pi / 2)]).curve("Car", "aos", "easy")
    assert curve is not None and curve.precision[0] == 1.0
    # A false positive has no similarity: half of what one object and one of these reach.
    curve = results([CAR], [hit(), hit(beside(CAR, 1))]).curve("Car", "aos", "easy")
    assert curve is not None and curve.precision[0] == 0.5


def test_frames_are_matched_apart() -> None:
    """A detection of one frame neither finds nor excuses anything in another."""
    mine = results([CAR], [hit(beside(CAR, 3))], ([beside(CAR, 3)], [hit()]), ([beside(DONT_CARE, 3)], []))
    curve = mine.curve("Car", "bbox", "easy")
    assert curve is not None and (curve.counted, curve.matched) == (2, 0) and mine.frames == 3
