"""Recall and false detections: labels find themselves, and what counts as found, false or excused."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from asca_pillars.detection.detections import Detections
from asca_pillars.evaluation.recall import RecallRow, RecallTally

NAMES = ("Car", "Pedestrian", "Cyclist")
SIZES = ((3.9, 1.6, 1.56), (0.8, 0.6, 1.73), (1.76, 0.6, 1.73))
CAR, PEDESTRIAN, CYCLIST, IGNORED = 0, 1, 2, -1


def box(x: float, y: float, label: int = CAR, yaw: float = 0.0) -> list[float]:
    return [x, y, -0.9, *SIZES[label], yaw]


def detections(*found: tuple[int, list[float]]) -> Detections:
    """Detections by descending score."""
    boxes = np.array([item for _, item in found], np.float32).reshape(-1, 7)
    labels = np.array([label for label, _ in found], np.int64)
    return Detections(boxes, np.linspace(0.9, 0.5, len(found), dtype=np.float32), labels, NAMES)


def count(
    found: list[tuple[int, list[float]]], wanted: list[tuple[int, list[float]]]
) -> dict[str, tuple[int, int, int]]:
    """Objects, found and false of each class in one frame."""
    tally = RecallTally(NAMES)
    labels = np.array([label for label, _ in wanted], np.int64)
    tally.add(detections(*found), np.array([item for _, item in wanted], np.float32).reshape(-1, 7), labels)
    return {name: row[:3] for name, row in tally.rows().items()}


@settings(max_examples=30)
@given(
    st.lists(
        st.tuples(st.sampled_from([CAR, PEDESTRIAN, CYCLIST]), st.integers(0, 11), st.integers(-6, 6)),
        max_size=12,
        unique_by=lambda item: item[1:],
    ),
    st.floats(-math.pi, 3.14),
)
def test_labels_find_themselves(places: list[tuple[int, int, int]], yaw: float) -> None:
    """Every class recalls all of its objects, in whatever order they are reported, without a false one."""
    labelled = [(label, box(6.0 * column, 6.0 * row, label, yaw)) for label, column, row in places]
    for found in (labelled, labelled[::-1]):
        for name, row in count(found, labelled).items():
            objects = sum(NAMES[label] == name for label, _ in labelled)
            assert row == (objects, objects, 0)


def test_frames_and_processes_add_up() -> None:
    tally = RecallTally(NAMES)
    labelled = np.array([box(10, 2), box(20, -5)], np.float32)
    tally.add(detections((CAR, box(10, 2)), (CAR, box(40, 2))), labelled, np.array([CAR, CAR]))
    tally.add(detections((CAR, box(20, -5))), labelled, np.array([CAR, CAR]))
    tally.add(Detections.empty(NAMES), labelled[:0], np.empty(0, np.int64))
    rows = tally.rows()
    assert rows["Car"] == RecallRow(objects=4, found=2, false=1, frames=3)
    assert rows["Car"].recall == 0.5 and rows["Car"].false_per_frame == pytest.approx(1 / 3)
    assert rows["Cyclist"] == (0, 0, 0, 3) and math.isnan(rows["Cyclist"].recall)
    assert list(rows) == list(NAMES)
    # One finds 1 of 3 cars, the other one no frame with cars: a mean of their recalls would be NaN, the sum is 1/3.
    first, second = RecallTally(NAMES), RecallTally(NAMES)
    cars = np.array([box(10, 2), box(20, -5), box(30, 5)], np.float32)
    first.add(detections((CAR, box(10, 2))), cars, np.array([CAR, CAR, CAR]))
    person = np.array([box(9, 1, PEDESTRIAN)], np.float32)
    second.add(detections((PEDESTRIAN, box(9, 1, PEDESTRIAN))), person, np.array([PEDESTRIAN]))
    second.add(detections((CAR, box(9, 1))), cars[:0], np.empty(0, np.int64))
    rows = RecallTally(NAMES, first.counts + second.counts).rows()
    assert rows["Car"] == RecallRow(objects=3, found=1, false=1, frames=3)
    assert rows["Pedestrian"] == (1, 1, 0, 3) and rows["Car"].recall == pytest.approx(1 / 3)
    assert first.frames == 1 and second.frames == 2
    with pytest.raises(ValueError, match=r"counts of 3 classes must have shape \(4, 3\), not \(3, 3\)"):
        RecallTally(NAMES, first.counts[:3])


def test_an_object_is_found_once_and_neighbors_share() -> None:
    car = (CAR, box(10, 2))
    assert count([car, (CAR, box(10.1, 2)), (CAR, box(10, 2.1))], [car])["Car"] == (1, 1, 2)
    # A duplicate takes no neighbor's place either: it overlaps that one by too little.
    assert count([car, car], [car, (CAR, box(14, 2))])["Car"] == (2, 1, 1)
    # The better detection takes the object it overlaps most and leaves the other one to the next.
    wanted = [(PEDESTRIAN, box(10.0, 0, PEDESTRIAN)), (PEDESTRIAN, box(10.2, 0, PEDESTRIAN))]
    for second_x in (10.25, 9.7):  # prefers the one that is taken; reaches only the other one
        found = [(PEDESTRIAN, box(10.2, 0, PEDESTRIAN)), (PEDESTRIAN, box(second_x, 0, PEDESTRIAN))]
        assert count(found, wanted)["Pedestrian"] == (2, 2, 0)


@pytest.mark.parametrize(
    ("label", "shift_m", "expected"),
    [
        # d further along its length l a box overlaps itself by (l - d) / (l + d): 0.5 at l / 3, 0.25 at 0.6 l.
        (CAR, 1.28, (1, 1, 0)),
        (CAR, 1.32, (1, 0, 1)),
        (PEDESTRIAN, 0.47, (1, 1, 0)),
        (PEDESTRIAN, 0.49, (1, 0, 1)),
        (CYCLIST, 1.04, (1, 1, 0)),
        (CYCLIST, 1.07, (1, 0, 1)),
    ],
)
def test_overlap_that_counts_as_found(label: int, shift_m: float, expected: tuple[int, int, int]) -> None:
    found = [(label, box(10 + shift_m, 3, label))]
    assert count(found, [(label, box(10, 3, label))])[NAMES[label]] == expected


def test_half_a_turn_and_height_do_not_matter_and_classes_are_apart() -> None:
    turned = box(10, 2, CAR, yaw=-math.pi)
    turned[2] += 3
    assert count([(CAR, turned)], [(CAR, box(10, 2))])["Car"] == (1, 1, 0)
    assert count([(CAR, box(10, 2, CAR, yaw=math.pi / 2))], [(CAR, box(10, 2))])["Car"] == (1, 0, 1)
    # A pedestrian where a cyclist stands is a false pedestrian and a cyclist not found.
    place = box(10, 2, PEDESTRIAN)
    assert count([(PEDESTRIAN, place)], [(CYCLIST, place)]) == {
        "Car": (0, 0, 0),
        "Pedestrian": (0, 0, 1),
        "Cyclist": (1, 0, 0),
    }


def test_ignored_boxes_excuse_one_detection_and_nothing_at_all() -> None:
    ignored = [(IGNORED, box(10, 2))]
    nothing = dict.fromkeys(NAMES, (0, 0, 0))
    assert count([], ignored) == nothing
    assert count([(CAR, box(10, 2))], ignored) == nothing
    assert count([(CAR, box(10, 2)), (CAR, box(10, 2))], ignored) == nothing | {"Car": (0, 0, 1)}
    assert count([(CYCLIST, box(10, 2))], ignored) == nothing
    assert count([(CAR, box(13, 2))], ignored) == nothing | {"Car": (0, 0, 1)}
    assert count([(CAR, box(10, 2)), (CAR, box(20, 2))], [*ignored, (CAR, box(20, 2))])["Car"] == (1, 1, 0)
    assert RecallTally(NAMES).rows() == dict.fromkeys(NAMES, (0, 0, 0, 0))
    assert RecallTally(NAMES).rows()["Car"].false_per_frame == 0
    assert count([], []) == dict.fromkeys(NAMES, (0, 0, 0))
    assert count([(CAR, box(9, 1))], [])["Car"] == (0, 0, 1)
    assert count([], [(CAR, box(9, 1))])["Car"] == (1, 0, 0)
