"""The KITTI protocol: against the official tool, against plain loops, and against itself.

Which detection takes which object, and the scores at which they are counted.
"""

import json
import math
import os
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from asca_pillars.data.kitti import read_labels
from asca_pillars.evaluation.kitti.average_precision import METRICS, Curve, evaluate, min_overlap, score_thresholds
from asca_pillars.evaluation.kitti.objects import FrameObjects, Frames, frame_objects, overlapping_pairs
from tests.evaluation.kitti.brute_force import brute_force, pick_thresholds
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

CLASSES = ("Car", "Pedestrian", "Cyclist")
CASES = os.environ.get("ASCA_KITTI_EVAL_CASES")
CASE_FOLDERS = sorted(path.parent for path in Path(CASES).glob("*/expected.json")) if CASES else []
assert CASE_FOLDERS or not CASES, f"{CASES}: no folder with an expected.json there"
needs_cases = pytest.mark.skipif(
    not CASES, reason="ASCA_KITTI_EVAL_CASES names no folder with results of the official evaluator"
)

# --- against the official tool -------------------------------------------------------------------------------------


def read_case(folder: Path) -> tuple[list[FrameObjects], list[FrameObjects]]:
    ids = sorted(path.stem for path in (folder / "det").glob("*.txt"))
    truth, found = ([frame_objects(i, read_labels(folder / side / f"{i}.txt")) for i in ids] for side in ("gt", "det"))
    return truth, found


@needs_cases
@pytest.mark.parametrize("case", CASE_FOLDERS)
def test_reference_case(case: Path) -> None:
    expected = json.loads((case / "expected.json").read_text())["results"]
    mine = json.loads(json.dumps(evaluate(*read_case(case)).overall.to_json()))
    assert mine.keys() == expected.keys()
    for name, metric in product(expected, METRICS):
        ours, theirs = mine[name][metric], expected[name][metric]
        assert (ours is None) == (theirs is None), (name, metric)
        if theirs is None:
            continue
        for key in ("R11", "R40"):
            np.testing.assert_allclose(ours[key], theirs[key], rtol=0, atol=1e-6)
        for difficulty, precision in theirs["precision"].items():
            np.testing.assert_allclose(ours["precision"][difficulty], precision, rtol=0, atol=1e-9)
        for difficulty, numbers in theirs.get("counts", {}).items():
            assert ours["counts"][difficulty] == numbers, (name, metric, difficulty)


@needs_cases
@pytest.mark.parametrize("case", CASE_FOLDERS)
def test_real_labels_find_themselves(case: Path) -> None:
    """In 2D labels hide one another so closely that one takes the other's detection; on the ground none does."""
    labels = read_case(case)[0]
    found = [replace(frame, scores=np.linspace(1, 0, len(frame)) + i) for i, frame in enumerate(labels)]
    for curve in evaluate(labels, found).overall.curves.values():
        if curve.metric in ("bev", "3d"):
            assert_perfect(curve)


# --- against plain loops -------------------------------------------------------------------------------------------


@settings(max_examples=80)
@given(
    st.integers(0, 2**32 - 1),
    st.integers(0, 6),
    st.integers(0, 25),
    st.sampled_from([None, (0.0, 28.0), (19.0, 21.0), (30.0, 60.0), (80.0, 90.0)]),
    st.sampled_from(["", "no heading", "no 2D box", "no 3D box", "no height"]),
)
def test_equals_plain_loops(
    seed: int, frames: int, detections: int, band: tuple[float, float] | None, missing: str
) -> None:
    truth, found = random_frames(seed, frames, detections)
    found = [without(frame, missing, np.random.default_rng(seed)) for frame in found]
    evaluation = evaluate(truth, found, CLASSES, bands_m=[] if band is None else [band])
    curves = (evaluation.overall if band is None else evaluation.bands[band]).curves
    references = brute_force(truth, found, CLASSES, band)
    assert curves.keys() == references.keys()
    for key, reference in references.items():
        curve = curves[key]
        lists = [part.tolist() for part in (curve.thresholds, curve.tp, curve.fp, curve.fn)]
        assert [curve.counted, curve.matched, *lists] == list(reference[1:]), key
        np.testing.assert_allclose(curve.precision, reference.precision, rtol=0, atol=1e-12)


def without(frame: FrameObjects, missing: str, rng: np.random.Generator) -> FrameObjects:
    """The frame with something left out of a part of its detections, as detectors of less than all of it write."""
    some = rng.random(len(frame)) < 0.3
    if missing == "no heading":
        return replace(frame, alpha=np.where(some, -10.0, frame.alpha))
    if missing == "no 2D box":
        return replace(frame, bbox=np.where(some[:, None], -1.0, frame.bbox))
    if missing == "no 3D box":
        sizes = np.where(some[:, None], -1.0, frame.dimensions_hwl)
        return replace(frame, dimensions_hwl=sizes, locations=np.where(some[:, None], -1000.0, frame.locations))
    if missing == "no height":
        return replace(frame, locations=np.where(some[:, None] & [False, True, False], -1000.0, frame.locations))
    return frame


# --- against itself ------------------------------------------------------------------------------------------------


def assert_perfect(curve: Curve) -> None:
    assert (curve.r11, curve.r40) == pytest.approx((curve.r11_cap, curve.r40_cap), abs=1e-12), curve
    assert not len(curve.fp) or (curve.fp[-1], curve.fn[-1]) == (0, 0)


@pytest.mark.parametrize("objects", [0, 1, 4, 5, 40, 41, 80, 81, 200])
@pytest.mark.parametrize("equal_scores", [False, True])
def test_labels_find_themselves(objects: int, equal_scores: bool) -> None:
    """Whoever finds everything gets the cap, which is below 100 for 40 objects or fewer; AOS is as good as 2D."""
    places = [range(min(6, objects - first)) for first in range(0, objects, 6)] or [range(0)]
    labels = [[beside(CAR, place, alpha=0.1 * place) for place in frame] for frame in places]
    rng = np.random.default_rng(objects)
    found = [[replace(item, score=0.5 if equal_scores else rng.random()) for item in frame] for frame in labels]
    if not objects:
        found = [[replace(CAR, score=0.5)]]
    mine = evaluate(*as_frames(labels, found)).overall
    assert {metric for _, metric, _ in mine.curves} == set(METRICS)
    for curve in mine.curves.values():
        assert curve.counted == objects
        if objects:
            assert_perfect(curve)
    expected = (100.0, 100.0)
    if objects <= 40:
        expected = (100 * max(objects - 1, 0) / 40, 100 * math.ceil(objects / 4) / 11)
    curve = mine.curves["Car", "3d", "moderate"]
    assert (curve.r40_cap, curve.r11_cap) == pytest.approx(expected)


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
    monkeypatch.setattr("asca_pillars.evaluation.kitti.objects._BLOCK_PAIRS", 13)
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
