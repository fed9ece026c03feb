"""Numbers about datasets whose errors are known."""

import dataclasses

import numpy as np
import pytest

from asca_pillars.evaluation.errors.error_summary import (
    ALL,
    CLEAR,
    FALSE_RATES,
    WITHOUT_MEDIANS,
    ClassErrors,
    DatasetErrors,
    GroupErrors,
    Spread,
    match_frames,
    summarize,
)
from asca_pillars.evaluation.errors.error_tables import error_notes, error_tables, group_tables
from tests.evaluation.errors.made_frames import GROUND_Z_M, MadeFrames, column, frame, ground

WALKER = np.array([12.0, 0.0, GROUND_Z_M + 0.88, 0.8, 0.6, 1.75, 0.0])
CAR = np.array([20.0, 4.0, GROUND_Z_M + 0.75, 4.0, 1.6, 1.5, 0.0])
WRONG = np.array([0.2, 0.0, 0.0, -0.3, 0.0, -0.2, 0.0])  # 20 cm too far, 30 cm too short, 20 cm too low


def walkers(count: int, wrong: np.ndarray) -> MadeFrames:
    rng, frames = np.random.default_rng(0), {}
    for number in range(count):
        label = np.add(WALKER, [rng.uniform(-3, 3), 0, 0, 0, 0, 0, 0])
        found = [("Pedestrian", 0.8, label + wrong + rng.normal(0, 0.01, 7))]
        frames[f"{number:04d}"] = frame([("Pedestrian", label)], found)
    return MadeFrames(frames)


def group(one: ClassErrors, name: str) -> GroupErrors:
    return next(own for own in one.groups if own.group == name)


def known(spread: Spread) -> tuple[float, float, float, tuple[float, float]]:
    """10th percentile, median, 90th and interval; they are there."""
    assert spread.low is not None and spread.middle is not None and spread.high is not None
    assert spread.interval is not None
    return spread.low, spread.middle, spread.high, spread.interval


def only(data: DatasetErrors) -> ClassErrors:
    (one,) = data.classes
    return one


def test_what_all_boxes_have_wrong_is_found_and_taken_away() -> None:
    (data,) = summarize(match_frames(walkers(80, WRONG), {"Pedestrian": 0.3}), "made", {})
    one = only(data)
    everything = group(one, ALL)
    assert data.frames == everything.objects == everything.found == one.boxes == 80
    for name, value in {"far_end": 0.05, "near_end": -0.35, "range": 0.2, "height": -0.2, "bottom": 0.1}.items():
        low, middle, high, interval = known(everything.residuals[name])
        assert middle == pytest.approx(value, abs=0.01) and 0.01 < high - low < 0.04
        assert low < interval[0] <= middle <= interval[1] < high
    assert one.reaching["as drawn"] == 0 and one.reaching[WITHOUT_MEDIANS] == 1 and one.iou_3d == 0.5
    assert one.reaching["label's ends"] == 1 and one.reaching["label's sides"] == 0


def test_parts_stand_beside_the_whole() -> None:
    frames = walkers(60, WRONG).frames
    frames |= {f"b{frame_id}": one for frame_id, one in walkers(60, -WRONG).frames.items()}
    parts = {name: [one for one in frames if (one[0] == "b") == (name == "b")] for name in "ab"} | {"c": ["none"]}
    matches = match_frames(MadeFrames(frames), {"Pedestrian": 0.3})
    whole, first, second = summarize(matches, "made", parts)
    assert [data.name for data in (whole, first, second)] == ["made", "a", "b"]
    assert [data.frames for data in (whole, first, second)] == [120, 60, 60]
    ranges = [known(group(only(data), ALL).residuals["range"]) for data in (whole, first, second)]
    assert [round(middle, 1) for _, middle, *_ in ranges[1:]] == [0.2, -0.2]
    of_all, of_first, _ = (np.ptp(interval) for *_, interval in ranges)
    assert of_all > 5 * of_first, "parts disagree"


def test_groups() -> None:
    places = {
        "near": (CAR, 0, 0.0, 200),
        "hidden": (np.add(CAR, [0, 6, 0, 0, 0, 0, 0]), 2, 0.0, 10),
        "cut": (np.add(CAR, [0, -12, 0, 0, 0, 0, 0]), 0, 0.4, 50),
        "far": (np.add(CAR, [30, 0, 0, 0, 0, 0, np.pi / 2]), 1, 0.0, 30),
        "aside": (np.add(CAR, [0, 0.9, 0, 0, 0, 0, 0.8]), 0, 0.0, 30),
    }
    boxes, occluded, truncated, points = zip(*places.values(), strict=True)
    made = frame(
        [("Car", box) for box in boxes],
        [("Car", 0.9, CAR)],
        occluded=occluded,
        truncated=truncated,
        object_points=points,
        counted=[True, False, False, True, True],
    )
    (data,) = summarize(match_frames(MadeFrames({"0": made}), {"Car": 0.3}), "made", {})
    counts = {own.group: (own.objects, own.found) for own in only(data).groups}
    assert counts == {
        ALL: (3, 1),
        CLEAR: (2, 1),
        "clear, end-on": (1, 1),
        "clear, oblique": (1, 0),
        "15-25 m": (2, 1),
        "40+ m": (1, 0),
        "fully visible": (2, 1),
        "partly occluded": (1, 0),
        "largely occluded": (1, 0),
        "20-99 points": (2, 0),
        "100+ points": (1, 1),
        "next one at 0-1 m": (2, 1),
        "next one at 2+ m": (1, 0),
    }


def test_false_detections_the_best_score_and_thresholds_by_false_ones_a_frame() -> None:
    frames = {}
    for number in range(20):
        post = column(10, -3, 2.8)
        found = [("Pedestrian", 0.9, WALKER), ("Pedestrian", 0.5, np.add(WALKER, [-2, -3, 0, 0, 0, 0, 0]))]
        points = np.concatenate([ground(), post])
        frames[f"{number:02d}"] = frame([("Pedestrian", WALKER)], found[1 - number % 2 :], points=points)
    (data,) = summarize(match_frames(MadeFrames(frames), {"Pedestrian": 0.4}), "made", {})
    one = only(data)
    assert one.false.kinds == {"background": 20, "localization": 0, "classification": 0, "duplicate": 0}
    assert one.false.per_frame == 1 and one.false.labels == {}
    assert one.false.traits["tall"] == 1 and one.false.traits["none"] == 0 and one.false.traits["low"] == 0
    assert one.false.surroundings["top_m"].middle == pytest.approx(2.75, abs=0.06)
    assert one.best_score == 0.9
    assert [dataclasses.astuple(rate) for rate in one.false_rates] == [(allowed, 0.9, 0.5) for allowed in FALSE_RATES]
    everything = group(one, ALL)
    assert (everything.objects, everything.found, everything.below_score) == (20, 10, 0)
    # Ten frames of one object each; a false one in every frame, of scores 0.31, 0.32, ... in turn.
    frames, beside = {}, np.add(WALKER, [-2, -3, 0, 0, 0, 0, 0])
    for number in range(10):
        found = [("Pedestrian", 0.345 if number < 8 else 0.2, WALKER), ("Pedestrian", 0.31 + number / 100, beside)]
        frames[str(number)] = frame([("Pedestrian", WALKER)], found, points=ground())
    (data,) = summarize(match_frames(MadeFrames(frames), {"Pedestrian": 0.3}), "made", {})
    rates = {rate.per_frame: (rate.score, rate.recall) for rate in only(data).false_rates}
    expected = {0.1: (0.4, 0.0), 0.2: (0.39, 0.0), 0.3: (0.38, 0.0), 0.5: (0.36, 0.0)}
    assert rates == {rate: (pytest.approx(score), recall) for rate, (score, recall) in expected.items()}


def test_hidden_objects_say_nothing_about_their_labels() -> None:
    rng = np.random.default_rng(0)
    cloud = np.column_stack([rng.normal(11.9, 0.1, 100), rng.normal(0, 0.1, 100), rng.uniform(-1.5, -0.2, 100)])
    points = np.concatenate([ground(), np.column_stack([cloud, np.zeros(100)]).astype(np.float32)])
    for occluded, count in ((0, 1), (1, 0), (-1, 1)):
        made = frame([("Pedestrian", WALKER)], [], points=points, occluded=[occluded])
        (data,) = summarize(match_frames(MadeFrames({"0": made}), {"Pedestrian": 0.3}), "made", {})
        fit = only(data).label_fit["range_50"]
        assert fit.count == count and (not count or fit.middle == pytest.approx(-0.1, abs=0.03))


def test_tables_of_several_datasets() -> None:
    named = (("real", WRONG), ("simulated", 0 * WRONG))
    sets = [summarize(match_frames(walkers(60, wrong), {"Pedestrian": 0.3}), name, {})[0] for name, wrong in named]
    by_view, reaching, false, *_ = error_tables(sets)
    rows = {row[:2]: row for row in by_view.rows}
    assert [row[1] for row in by_view.rows[:2]] == ["real", "simulated"]
    column = by_view.columns.index("range")
    assert rows[ALL, "real"][column].startswith("+0.20 ±0.0") and rows[ALL, "simulated"][column].startswith("+0.00 ±")
    assert [row[4] for row in reaching.rows] == ["0.00", "1.00"]
    assert [row[:2] for row in false.rows] == [("Pedestrian", "real"), ("Pedestrian", "simulated")]
    (more,) = group_tables(sets)
    assert {row[0] for row in more.rows} == {"0-15 m", "20-99 points", "next one at 2+ m"}
    assert error_notes(sets)


def test_no_objects_and_no_detections() -> None:
    empty = MadeFrames({"0": frame([], []), "1": frame([], [])})
    (data,) = summarize(match_frames(empty, {"Car": 0.3}), "made", {})
    one = only(data)
    assert one.groups == () and one.best_score is None and one.boxes == 0 and one.reaching == {}
    (false,) = error_tables([data])
    assert false.rows[0][-1] == "-" and group_tables([data]) == []
