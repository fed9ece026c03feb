"""Waymo's metrics: against the dataset's own tool and against hand-derived figures."""

from math import inf, pi

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from asca_pillars.detection.detections import Detections
from asca_pillars.evaluation.waymo import (
    EVERYWHERE,
    RANGES_M,
    WaymoScore,
    WaymoTruth,
    difficulty_levels,
    mean_over_classes,
    waymo_detection,
)

NAMES = ("Vehicle", "Pedestrian", "Cyclist")
SIZES = np.array([[4.6, 1.9, 1.7], [0.9, 0.8, 1.75], [1.8, 0.8, 1.75]])
VEHICLE, PEDESTRIAN, CYCLIST = 0, 1, 2


def box(x: float, y: float, label: int = VEHICLE, yaw: float = 0.0) -> list[float]:
    return [x, y, 0.0, *SIZES[label], yaw]


def score_of(
    truth: WaymoTruth | list[WaymoTruth],
    detections: Detections | list[Detections],
    level: int = 2,
    range_m: tuple[float, float] = EVERYWHERE,
    name: str = "Vehicle",
) -> WaymoScore:
    frames = truth if isinstance(truth, list) else [truth]
    results = waymo_detection(frames, detections if isinstance(detections, list) else [detections])
    return next(item for item in results if (item.class_name, item.level, item.range_m) == (name, level, range_m))


def labelled(*boxes: list[float], label: int = VEHICLE, levels: list[int] | None = None) -> WaymoTruth:
    count = len(boxes)
    levels = [1] * count if levels is None else levels
    return WaymoTruth(np.array(boxes, np.float32).reshape(-1, 7), np.full(count, label), np.array(levels, np.int64))


def found(*scored: tuple[float, list[float]], label: int = VEHICLE) -> Detections:
    boxes = np.array([item for _, item in scored], np.float32).reshape(-1, 7)
    scores = np.array([score for score, _ in scored], np.float32)
    return Detections(boxes, scores, np.full(len(scored), label), NAMES)


def crowded_frames(seed: int, frames: int) -> tuple[list[WaymoTruth], list[Detections]]:
    """Objects that overlap one another; detections off by little or much, doubled, turned around, or of nothing.

    The numbers come from a bit generator, whose stream NumPy never changes: what the tool says of them is below.
    """
    bits = np.random.PCG64(seed)

    def uniform(*shape: int) -> NDArray[np.float64]:
        return (bits.random_raw(int(np.prod(shape))) / 2**64).reshape(shape)

    truth, detections = [], []
    for _ in range(frames):
        count = 5 + int(35 * uniform(1)[0])
        labels = (3 * uniform(count)).astype(np.int64)
        sizes = SIZES[labels] * (0.8 + 0.4 * uniform(count, 3))
        boxes = np.column_stack([120 * uniform(count, 2) - 60, 3 * uniform(count) - 1, sizes, 2 * pi * uniform(count)])
        boxes[1:4] = boxes[0] + (0.4 * uniform(3, 7) - 0.2) * [1, 1, 1, 1, 1, 1, 0]
        labels[1:4] = labels[0]
        levels = 1 + (uniform(count) < 0.3)
        copies = np.repeat(np.arange(count), (4 * uniform(count)).astype(np.int64))
        noise = (uniform(len(copies), 7) + uniform(len(copies), 7) - 1) * [0.4, 0.4, 0.3, 0.3, 0.15, 0.15, 0.3]
        boxes_found = boxes[copies] + noise * (0.3 + 2 * uniform(len(copies), 1))
        boxes_found[:, 6] += np.where(uniform(len(copies)) < 0.15, pi, 0)
        labels_found = np.where(uniform(len(copies)) < 0.05, CYCLIST, labels[copies])
        scores = np.round(uniform(len(copies)), 3)
        truth.append(WaymoTruth(boxes.astype(np.float32), labels, levels))
        detections.append(Detections(boxes_found.astype(np.float32), scores.astype(np.float32), labels_found, NAMES))
    return truth, detections


# AP and APH of `crowded_frames(1, 12)` by waymo-open-dataset-tf 1.6.4 (Hungarian matching, cutoffs 0, 0.01, ..., 1):
# for each class LEVEL_1 and LEVEL_2, for each level everywhere, 0-30 m, 30-50 m and beyond.
OFFICIAL = (
    ((0.248096, 0.201543), (0.297577, 0.259530), (0.163807, 0.125817), (0.392227, 0.313781)),
    ((0.227383, 0.184539), (0.270176, 0.233938), (0.158241, 0.121447), (0.335000, 0.268734)),
    ((0.235514, 0.212685), (0.255208, 0.225833), (0.295775, 0.285285), (0.192381, 0.164585)),
    ((0.204974, 0.184254), (0.240196, 0.212486), (0.251274, 0.241710), (0.165972, 0.141819)),
    ((0.384127, 0.356140), (0.346128, 0.299660), (0.445279, 0.426672), (0.382064, 0.351478)),
    ((0.323405, 0.297459), (0.318562, 0.272588), (0.364353, 0.347921), (0.326869, 0.297624)),
)


def test_the_datasets_own_tool_with_and_without_no_label_zones() -> None:
    results = waymo_detection(*crowded_frames(1, 12))
    figures = np.array([(item.ap, item.aph) for item in results], dtype=np.float64)
    # The tool computes in float32.
    np.testing.assert_allclose(figures, 100 * np.array(OFFICIAL).reshape(-1, 2), atol=1e-4, rtol=0)
    # Every third detection overlaps a no-label zone; AP and APH everywhere, for each class LEVEL_1 and LEVEL_2.
    truth, detections = crowded_frames(1, 12)
    zones = [np.arange(len(found)) % 3 == 0 for found in detections]
    results = waymo_detection(truth, detections, no_label=zones)
    figures = np.array([(item.ap, item.aph) for item in results if item.range_m == EVERYWHERE], dtype=np.float64)
    official = [(0.295828, 0.239746), (0.271611, 0.219966), (0.274176, 0.246180), (0.239996, 0.214582)]
    official += [(0.419987, 0.388068), (0.356773, 0.327095)]
    np.testing.assert_allclose(figures, 100 * np.array(official), atol=1e-4, rtol=0)


def test_the_order_of_detections_does_not_matter() -> None:
    """Two labels on one place, LEVEL_1 and LEVEL_2, and one detection of them; the other detection is false.

    With the false one first in the file the tool gives LEVEL_1 an AP of 25 and leaves the LEVEL_1 object over; with
    the false one last it gives 50. LEVEL_2 is 25 both times.
    """
    truth = labelled(box(10, 0), box(10, 0), levels=[1, 2])
    false, true = (0.9, box(-20, 5)), (0.2, box(10, 0))
    for scored in ((false, true), (true, false)):
        assert score_of(truth, found(*scored), 1).ap == pytest.approx(50)
        assert score_of(truth, found(*scored), 2).ap == pytest.approx(25)


def test_a_label_turned_by_exactly_pi_is_found() -> None:
    """The tool's polygon code gives one such pair of its example files an overlap of 0; its overlap is 1."""
    rng = np.random.default_rng(0)
    truth, detections = [], []
    for _ in range(150):
        there = [*rng.uniform(-60, 60, 2), 0.0, *rng.uniform(1, 6, 3), rng.uniform(-pi, pi)]
        truth.append(labelled(there))
        detections.append(found((0.9, [*there[:6], there[6] + pi])))
    score = score_of(truth, detections)
    assert score.ap == pytest.approx(100) and score.aph == pytest.approx(0, abs=1e-4)


@settings(max_examples=20)
@given(st.lists(st.tuples(st.sampled_from([0, 1, 2]), st.integers(-9, 9)), min_size=1, unique_by=lambda item: item[1]))
def test_labels_score_100_against_themselves(places: list[tuple[int, int]]) -> None:
    boxes = np.array([box(7 * place, 3 - place, label, 0.3 * place) for label, place in places], np.float32)
    labels = np.array([label for label, _ in places])
    truth = WaymoTruth(boxes, labels, np.arange(len(places)) % 2 + 1)
    scores = np.linspace(0, 1, len(places), dtype=np.float32)
    for item in waymo_detection([truth], [Detections(boxes, scores, labels, NAMES)]):
        expected = (None, None) if item.objects == 0 else (pytest.approx(100), pytest.approx(100))
        assert (item.ap, item.aph) == expected


def test_level_2_and_what_holds_no_point() -> None:
    truth = labelled(box(10, 0), box(20, 0), levels=[1, 2])
    missing = found((0.9, box(10, 0)))
    assert score_of(truth, missing, 1).ap == pytest.approx(100)
    assert score_of(truth, missing, 2).ap == pytest.approx(50)
    assert (score_of(truth, missing, 1).objects, score_of(truth, missing, 2).objects) == (1, 2)
    # Finding it is no mistake at LEVEL_1: precision stays 1 when it comes first.
    both = found((0.9, box(20, 0)), (0.8, box(10, 0)))
    assert score_of(truth, both, 1).ap == score_of(truth, both, 2).ap == pytest.approx(100)
    # It counts as a find there: without the other one recall is 1 of 2.
    assert score_of(truth, found((0.9, box(20, 0))), 1).ap == pytest.approx(50)
    levels = difficulty_levels(np.array([0, 1, 5, 6, 100]))
    assert levels.tolist() == [0, 2, 2, 1, 1]
    truth = labelled(box(10, 0), box(20, 0), levels=[1, 0])
    assert score_of(truth, found((0.9, box(10, 0)))).ap == pytest.approx(100)
    # A detection of it is false: precision 1/2 when it comes first.
    assert score_of(truth, found((0.9, box(20, 0)), (0.8, box(10, 0)))).ap == pytest.approx(50)


def test_ranges_are_of_both_sides_and_frames_do_not_share() -> None:
    truth, detections = labelled(box(29.9, 0)), found((0.9, box(30.1, 0)))
    assert score_of(truth, detections).ap == pytest.approx(100)
    near, middle, far = (score_of(truth, detections, range_m=span) for span in RANGES_M[1:])
    assert (near.objects, near.ap, near.aph) == (1, 0, 0)
    assert (middle.objects, middle.ap, middle.aph) == (0, None, None)
    assert (far.objects, far.ap) == (0, None)
    # Distance is 3D: 29 m ahead and 9 m up is beyond 30 m.
    high = [29.0, 0, 9.0, 4, 2, 2, 0]
    assert score_of(labelled(high), found((0.5, high)), range_m=(30.0, 50.0)).ap == pytest.approx(100)
    here, elsewhere = labelled(box(10, 0)), labelled()
    nothing = found()
    assert score_of([here, elsewhere], [nothing, found((0.9, box(10, 0)))]).ap == 0
    assert score_of([here, elsewhere], [found((0.9, box(10, 0))), nothing]).ap == pytest.approx(100)
    assert score_of(elsewhere, nothing) == WaymoScore("Vehicle", 2, EVERYWHERE, 0, None, None)
    assert score_of(here, nothing) == WaymoScore("Vehicle", 2, EVERYWHERE, 1, 0.0, 0.0)


def test_mean_over_the_classes_that_have_objects() -> None:
    scores = [
        WaymoScore("Vehicle", 1, EVERYWHERE, 3, 60.0, 50.0),
        WaymoScore("Vehicle", 2, EVERYWHERE, 4, 1.0, 2.0),
        WaymoScore("Pedestrian", 1, EVERYWHERE, 5, 40.0, 20.0),
        WaymoScore("Cyclist", 1, EVERYWHERE, 0, None, None),
        WaymoScore("Vehicle", 1, (0.0, 30.0), 2, 3.0, 4.0),
    ]
    assert mean_over_classes(scores, 1) == (50.0, 35.0)
    assert mean_over_classes(scores, 1, (0.0, 30.0)) == (3.0, 4.0)
    assert np.isnan(mean_over_classes(scores, 2, (50.0, inf))).all()


def test_what_does_not_fit_is_refused() -> None:
    truth, detections = labelled(box(1, 2)), found((0.5, box(1, 2)))
    with pytest.raises(ValueError, match="2 labelled frames and 1"):
        waymo_detection([truth, truth], [detections])
    with pytest.raises(ValueError, match="0 labelled frames"):
        waymo_detection([], [])
    for wrong in (1.5, -0.1, float("nan")):
        with pytest.raises(ValueError, match=r"frame 0: scores must lie within \[0, 1\]"):
            waymo_detection([truth], [found((wrong, box(1, 2)))])
    other = Detections.empty(("Car",))
    with pytest.raises(ValueError, match="frame 1 has classes"):
        waymo_detection([truth, truth], [detections, other])
    with pytest.raises(ValueError, match="must have shapes"):
        WaymoTruth(np.zeros((2, 7), np.float32), np.zeros(2, np.int64), np.zeros(3, np.int64))
