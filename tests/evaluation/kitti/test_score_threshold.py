"""Recall and precision at a fixed score: hand-made frames for every rule, and published intervals."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from asca_pillars.data.kitti.kitti_labels import KittiObject
from asca_pillars.evaluation.kitti.average_precision import DIFFICULTIES
from asca_pillars.evaluation.kitti.score_threshold import (
    OperatingPoint,
    best_scores,
    matches_at_score,
    operating_points,
    wilson_interval,
)
from tests.evaluation.kitti.scored_frames import NAMES, frame, item

ELSEWHERE = (400.0, 100.0, 460.0, 150.0)


def point(
    truth: list[KittiObject], found: list[KittiObject], name: str = "Car", score: float = 0.5, **options: Any
) -> OperatingPoint:
    return operating_points([frame(*truth)], [frame(*found)], [name], scores=score, **options)[0]


def counts(*given: Any, **options: Any) -> tuple[int, int, int, int, int]:
    """found, objects; true, detections; ignored."""
    made = point(*given, **options)
    return made.found, made.objects, made.true_positives, made.detections, made.ignored


def test_found_missed_true_false_and_nothing() -> None:
    truth = [item("Car", 0, 10), item("Car", 9, 10), item("Pedestrian", 3, 10)]
    found = [item("Car", 0, 10, 0.9), item("Car", -9, 10, 0.5), item("Car", 9, 10, 0.49)]
    result = point(truth, found)
    assert (result.found, result.objects, result.recall) == (1, 2, 0.5)
    assert (result.true_positives, result.detections, result.precision, result.ignored) == (1, 2, 0.5, 0)
    assert result.recall_interval == wilson_interval(1, 2) == result.precision_interval
    assert (result.class_name, result.score, result.metric, result.difficulty) == ("Car", 0.5, "3d", "moderate")
    assert (result.min_overlap, result.band_m) == (0.7, None)
    assert counts(truth, found, score=0.4) == (2, 2, 2, 3, 0)
    assert counts(truth, found, "Pedestrian") == (0, 1, 0, 0, 0)
    result = point([], [])
    assert math.isnan(result.recall) and math.isnan(result.precision)
    assert result.recall_interval == result.precision_interval == (0, 1)
    empty = operating_points([], [], NAMES, scores=0.5)
    assert [(made.class_name, made.objects, made.detections) for made in empty] == [(name, 0, 0) for name in NAMES]


def test_a_detection_takes_the_object_it_overlaps_most() -> None:
    """Though only it could have had the other one; and another overlap may be asked for: 0.25 at 0.6 of a length."""
    truth = [item("Pedestrian", 0, 10), item("Pedestrian", 0.2, 10)]
    found = [item("Pedestrian", 0.15, 10, 0.9), item("Pedestrian", 0.45, 10, 0.8)]
    assert counts(truth, found, "Pedestrian") == (1, 2, 1, 2, 0)
    for shift, hits in ((2.39, 1), (2.41, 0)):
        assert point([item("Car", 0, 10)], [item("Car", shift, 10, 0.9)], min_overlap={"Car": 0.25}).found == hits


def test_dont_care_areas_excuse() -> None:
    def area(x2: float) -> KittiObject:
        return KittiObject("DontCare", -1, -1, -10, (100.0, 90.0, x2, 160.0), -1, -1, -1, -1000, -1000, -1000, -10)

    alone = [item("Car", 30, 10, 0.9)]  # its image box is 100..160
    assert counts([area(131.0)], alone) == (0, 0, 0, 0, 1)
    assert counts([area(129.0)], alone) == (0, 0, 0, 1, 0)
    assert counts([area(129.0), area(128.0)], alone) == (0, 0, 0, 1, 0)
    assert counts([area(160.0), item("Car", 30, 10)], alone) == (1, 1, 1, 1, 0)
    assert counts([area(160.0)], [replace(alone[0], bbox=ELSEWHERE)]) == (0, 0, 0, 1, 0)
    # In another frame there is no such area.
    points = operating_points(
        [frame(area(160.0)), frame(name="1")], [frame(), frame(*alone, name="1")], ["Car"], scores=0
    )
    assert (points[0].detections, points[0].ignored) == (1, 0)


def test_bands_judge_objects_and_detections_by_their_own_distance() -> None:
    """13 m is (5, 12). A pair across the limit: found on its side, true on the other."""
    truth, found = [item("Car", 5, 12.1), item("Car", 0, 30)], [item("Car", 5, 11.9, 0.9), item("Car", -9, 30, 0.9)]
    points = operating_points(
        [frame(*truth)], [frame(*found)], ["Car"], scores=0.5, min_overlap={"Car": 0.5}, bands_m=[(0, 13), (13, 99)]
    )
    assert [made.band_m for made in points] == [None, (0, 13), (13, 99)]
    assert [(made.found, made.objects, made.true_positives, made.detections) for made in points] == [
        (1, 2, 1, 2),
        (0, 0, 1, 1),
        (1, 2, 0, 1),
    ]
    # A limit belongs to the band above it: (3, 4) is 5 m away.
    halves = operating_points([frame(item("Car", 3, 4))], [frame()], ["Car"], scores=0, bands_m=[(0, 5), (5, 9)])
    assert [made.objects for made in halves] == [1, 0, 1]


def test_scores_and_overlaps_per_class() -> None:
    truth = frame(*(item(kind, 5 * i, 10) for i, kind in enumerate(NAMES)))
    found = frame(*(item(kind, 5 * i, 10, 0.4 + 0.1 * i) for i, kind in enumerate(NAMES)))
    points = operating_points([truth], [found], NAMES, scores={"Car": 0.3, "Pedestrian": 0.6, "Cyclist": 0.6})
    assert [(made.class_name, made.score, made.found, made.min_overlap) for made in points] == [
        ("Car", 0.3, 1, 0.7),
        ("Pedestrian", 0.6, 0, 0.5),
        ("Cyclist", 0.6, 1, 0.5),
    ]
    with pytest.raises(ValueError, match="given for Cyclist"):
        operating_points([truth], [found], NAMES, scores={"Car": 0.3, "Pedestrian": 0.6})
    with pytest.raises(ValueError, match="given for Car, Cyclist"):
        operating_points([truth], [found], NAMES, scores=0.3, min_overlap={"Pedestrian": 0.5})
    with pytest.raises(ValueError, match="same frames"):
        operating_points([truth], [frame(name="other")], NAMES, scores=0.3)


def test_best_score_weighs_misses_against_false_ones() -> None:
    truth = [item("Car", 0, 10), item("Car", 9, 10), item("Pedestrian", 3, 10)]
    found = [item("Car", 0, 10, 0.9), item("Car", -9, 10, 0.6), item("Car", 9, 10, 0.4), item("Car", -9, 20, 0.3)]
    best = best_scores([frame(*truth)], [frame(*found)], NAMES)
    assert best == {"Car": 0.4}  # F1 2/3, 1/2, 4/5, 2/3 at the four scores; nobody was found on foot
    assert best_scores([frame(*truth)], [frame(*found[:2])], NAMES) == {"Car": 0.9}
    # A false one with the score of a true one comes with it.
    tied = [found[0], item("Car", 9, 10, 0.6), *(item("Car", -9, 10 * i, 0.6) for i in range(1, 6))]
    assert best_scores([frame(*truth)], [frame(*tied)], NAMES) == {"Car": 0.9}
    assert best_scores([frame(*truth)], [frame()], NAMES) == {}


@settings(max_examples=20)
@given(st.integers(0, 10_000))
def test_no_other_score_is_better(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = [frame(*(item("Car", 6.0 * i, 10) for i in range(4)), name=str(k)) for k in range(3)]
    found = [
        frame(*(item("Car", 6.0 * rng.integers(8), 10, float(rng.integers(1, 9)) / 10) for _ in range(5)), name=str(k))
        for k in range(3)
    ]
    best = best_scores(truth, found, ["Car"])

    def f1(score: float) -> float:
        at = operating_points(truth, found, ["Car"], scores=score)[0]
        return 2 * at.found / (at.objects + at.detections)

    assert f1(best.get("Car", 1.0)) == pytest.approx(max(f1(score / 10) for score in range(1, 10)))


def test_every_difficulty_has_its_limits() -> None:
    """Easy asks for 40 px and nothing hidden, moderate allows one step of hiding, hard two."""
    truth = [item("Car", 5 * level, 10, occluded=level) for level in range(4)]
    found = [item("Car", 0, 10, 0.9), item("Car", 10, 10, 0.2)]
    table = operating_points(
        [frame(*truth)], [frame(*found)], ("Car", "Cyclist"), scores=-math.inf, difficulties=DIFFICULTIES
    )
    assert [(made.class_name, made.difficulty, made.found, made.objects) for made in table] == [
        ("Car", "easy", 1, 1),
        ("Car", "moderate", 1, 2),
        ("Car", "hard", 2, 3),
        *(("Cyclist", difficulty, 0, 0) for difficulty in ("easy", "moderate", "hard")),
    ]
    assert {(made.metric, made.min_overlap) for made in table} == {("3d", 0.7), ("3d", 0.5)}


def test_matches_stand_behind_the_points() -> None:
    hidden = item("Car", -9, 9, occluded=2)
    truth = [frame(hidden, item("Car", 0, 10), item("Pedestrian", 5, 10)), frame(item("Truck", 0, 9), name="1")]
    seen = [item("Pedestrian", 5, 10, 0.9), item("Car", 9, 30, 0.3), item("Car", 0, 10, 0.2)]
    low = item("Cyclist", 3, 60, 0.9, bbox=(0.0, 0.0, 9.0, 9.0))
    found = [frame(*seen), frame(low, item("Cyclist", 3, 60, 0.9), name="1")]
    first, second = matches_at_score(truth, found, NAMES, scores={"Car": 0.25, "Pedestrian": 0.5, "Cyclist": 0.5})
    assert (first.frame_id, second.frame_id) == ("0", "1")
    assert first.missed.tolist() == [False, True, False] and first.found.tolist() == [False, False, True]
    assert first.not_counted.tolist() == [True, False, False]
    assert first.true_positive.tolist() == [True, False, False]
    assert first.false_positive.tolist() == [False, True, False]
    assert first.reported.tolist() == [True, True, False] and first.ignored.tolist() == [False] * 3
    assert second.not_counted.tolist() == [True]
    assert second.ignored.tolist() == [True, False] and second.false_positive.tolist() == [False, True]
    assert (first.errors, second.errors) == (2, 1)
    assert matches_at_score([], [], NAMES, scores=0.5) == []


@pytest.mark.parametrize(
    ("hits", "trials", "low", "high"),
    # R. Newcombe, "Two-sided confidence intervals for the single proportion", Statistics in Medicine 1998, table I.
    [(81, 263, 0.2553, 0.3662), (15, 148, 0.0624, 0.1605), (0, 20, 0.0, 0.1611), (1, 29, 0.0061, 0.1718)],
)
def test_published_intervals(hits: int, trials: int, low: float, high: float) -> None:
    assert wilson_interval(hits, trials) == pytest.approx((low, high), abs=5e-5)
    assert wilson_interval(trials - hits, trials) == pytest.approx((1 - high, 1 - low), abs=5e-5)


@given(st.integers(1, 5000), st.data())
def test_interval_ends_where_the_share_is_two_deviations_away(trials: int, data: st.DataObject) -> None:
    hits = data.draw(st.integers(0, trials))
    low, high = wilson_interval(hits, trials)
    assert 0 <= low <= hits / trials <= high <= 1
    for end in (low, high):
        deviation = math.sqrt(end * (1 - end) / trials)
        assert abs(hits / trials - end) == pytest.approx(1.959964 * deviation, abs=1e-6)
