"""Which detection takes which object, and the scores at which they are counted."""

from dataclasses import replace

import numpy as np
import pytest

from asca_pillars.evaluation.kitti.average_precision import min_overlap
from asca_pillars.evaluation.kitti.matching import score_thresholds
from asca_pillars.evaluation.kitti.pairs import Frames, overlapping_pairs
from tests.evaluation.kitti.brute_force import pick_thresholds
from tests.evaluation.kitti.kitti_objects import (
    CAR,
    EVERY,
    as_frames,
    beside,
    counts,
    hit,
    random_frames,
    results,
    shifted,
)


@pytest.mark.parametrize(("name", "minimum"), [("Car", 0.7), ("Pedestrian", 0.5)])
def test_overlap_must_exceed_the_minimum(name: str, minimum: float) -> None:
    """Moved by 30 of its 90 pixels a box shares 60 of 120 with itself, exactly one half."""
    assert min_overlap(name) == min_overlap(name.upper()) == minimum
    label, other = replace(CAR, type=name), beside(CAR, 3, type=name)
    wide = replace(label, bbox=(100.0, 100.0, 190.0, 160.0))
    half = replace(wide, bbox=(130.0, 100.0, 220.0, 160.0), score=1.0)
    assert counts([wide, other], [half, hit(other)], name=name)[1] == 1


@pytest.mark.parametrize("turn", [0.0, 0.3, 1.0, np.pi / 2, -3.0])
def test_equal_boxes_overlap_by_exactly_one(turn: float) -> None:
    # In doubles bottom - (bottom - height) is more than this height.
    item = replace(CAR, rotation_y=turn, y_m=-0.99, height_m=0.67)
    assert item.y_m - (item.y_m - item.height_m) > item.height_m
    frames = Frames.join(*as_frames([[item]], [[hit(item)]]))
    pairs = overlapping_pairs(frames, np.array([True]), 0.5)
    assert {metric: values.tolist() for metric, values in pairs.overlaps.items()} == {m: [1.0] for m in EVERY}


@pytest.mark.parametrize("sizes", [{"width_m": 0.0}, {"height_m": -1.0, "width_m": -1.0, "length_m": -1.0}])
def test_boxes_without_size_overlap_nothing(sizes: dict[str, float]) -> None:
    small = replace(CAR, length_m=1.2, width_m=1.2, height_m=1.2)
    pairs = overlapping_pairs(Frames.join(*as_frames([[small]], [[hit(small, **sizes)]])), np.array([True]), 0.0)
    assert pairs.overlaps["bev"].tolist() == pairs.overlaps["3d"].tolist() == [0.0]


def test_blocks_of_pairs_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    frames = Frames.join(*random_frames(0, 8, 20))
    expected = np.arange(len(frames.truth)) % 3 > 0
    whole = overlapping_pairs(frames, expected, 0.5)
    monkeypatch.setattr("asca_pillars.evaluation.kitti.pairs._BLOCK_PAIRS", 13)
    parts = overlapping_pairs(frames, expected, 0.5)
    assert len(whole.truth) and not set(whole.truth) - set(np.flatnonzero(expected))
    for name in ("truth", "detection", "frame"):
        np.testing.assert_array_equal(getattr(parts, name), getattr(whole, name))
    for metric in EVERY:
        np.testing.assert_allclose(parts.overlaps[metric], whole.overlaps[metric], rtol=0, atol=1e-14)


def test_the_first_pass_goes_by_score_and_the_second_by_overlap() -> None:
    """One object: at the threshold that the higher score gives, the better box is not there yet."""
    better, higher = hit(score=0.2), shifted(CAR, 0.1, score=0.8)
    for found in ([better, higher], [higher, better]):
        curve = results([CAR], found).curve("Car", "bbox", "easy")
        assert curve is not None and curve.thresholds.tolist() == [0.8]
        assert (curve.tp.tolist(), curve.fp.tolist()) == ([1], [0])
    # Two objects: at the lower threshold each takes the box that fits, and the headings tell which.
    truth = [CAR, shifted(CAR, 0.1)]
    fits = [hit(truth[1], 0.9, alpha=CAR.alpha + np.pi), hit(truth[0], 0.4)]
    curve = results(truth, fits).curve("Car", "aos", "easy")
    assert curve is not None and curve.thresholds.tolist() == [0.9, 0.4]
    assert curve.precision[:3] == pytest.approx([0.5, 0.5, 0], abs=1e-12)


def test_thresholds_by_hand_and_by_the_rule() -> None:
    scores = np.array([0.2, 0.9, 0.5, 0.4])
    # Fewer objects than steps of recall: every score is a threshold.
    assert score_thresholds(scores, 4, 40).tolist() == [0.9, 0.5, 0.4, 0.2]
    # Two steps, 0, 1/2, 1. Recall 1/4: the next one, 2/4, is further from 0. Of 2/4 and 3/4 the first is nearer to
    # 1/2, so is the last one to 1.
    assert score_thresholds(scores, 4, 2).tolist() == [0.9, 0.5, 0.2]
    # One step: 3/4 is nearer to 1 than 2/4, and the last score is nearer still.
    assert score_thresholds(scores, 4, 1).tolist() == [0.9, 0.2]
    assert score_thresholds(scores[:0], 0, 40).tolist() == []
    rng = np.random.default_rng(0)
    for counted in range(1, 300):
        for matched in {1, counted // 2, counted}:
            scores = rng.random(matched)
            chosen = score_thresholds(scores, counted, 40)
            assert chosen.tolist() == pick_thresholds(scores.tolist(), counted)
            assert len(chosen) <= 41
