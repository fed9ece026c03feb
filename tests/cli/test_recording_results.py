"""In which order recorded scans are tracked, and what is said of their time stamps."""

from pathlib import Path

import numpy as np
import pytest

from asca_deploy import Detections
from asca_deploy.recordings.results import Journal, ScanResult, timestamp_note, track_results, tracking_order
from asca_deploy.tracker import Tracker

SECOND = 10**9
REGULAR = [1000 * SECOND + index * SECOND // 10 for index in range(12)]


def replaced(index: int, time_ns: int) -> list[int]:
    return [*REGULAR[:index], time_ns, *REGULAR[index + 1 :]]


def test_scans_are_tracked_in_the_order_of_their_times() -> None:
    assert tracking_order(REGULAR) == list(range(12))
    swapped = [REGULAR[i] for i in (0, 1, 3, 2, *range(4, 12))]
    assert tracking_order(swapped) == [0, 1, 3, 2, *range(4, 12)]
    assert tracking_order([]) == [] and tracking_order([5, 4, 3]) == [2, 1, 0]


@pytest.mark.parametrize("index", [0, 1, 5, 10, 11])
def test_one_wrong_stamp_leaves_the_others_together(index: int) -> None:
    others = [i for i in range(12) if i != index]
    assert tracking_order(replaced(index, REGULAR[0] + 3600 * SECOND)) == [*others, index]
    assert tracking_order(replaced(index, REGULAR[0] - 3600 * SECOND)) == [index, *others]


def test_a_drive_that_is_played_again_or_a_clock_that_was_set_begins_another() -> None:
    slower = [REGULAR[0] + index * SECOND for index in range(12)]
    assert tracking_order(slower * 2) == list(range(24))
    assert tracking_order([*slower, *(time_ns - 5 * SECOND for time_ns in slower)]) == list(range(24))


def test_stamps_that_go_back_or_jump_are_counted() -> None:
    assert timestamp_note(REGULAR) is None and timestamp_note(REGULAR[:1]) is None
    note = timestamp_note(replaced(5, REGULAR[0] + 3600 * SECOND))
    assert note is not None and note.startswith("of 12 time stamps 1 go back and 1 jump ahead by more than 2 s: ")


def found(number: int, time_ns: int) -> ScanResult:
    """A car that goes 10 m/s ahead."""
    x_m = 10 * (time_ns - REGULAR[0]) / SECOND
    boxes = np.array([[10 + x_m, 0, 0, 4, 2, 1.5, 0]], np.float32)
    return ScanResult(
        number, time_ns, "lidar", Detections(boxes, np.ones(1, np.float32), np.zeros(1, np.int64), ("Car",))
    )


@pytest.mark.parametrize("order", [range(12), (0, 1, 2, 3, 5, 4, *range(6, 12))])
def test_a_scan_out_of_order_ends_no_track(tmp_path: Path, order: list[int]) -> None:
    with Journal(tmp_path, {}, ("Car",)) as journal:
        for number, index in enumerate(order):
            journal.add(found(number, REGULAR[index]))
        journal.add(ScanResult(12, REGULAR[11], "lidar", None, "torn"))
        results = list(track_results(journal, Tracker()))
    assert [one.number for one in results] == list(range(12)), "lines stay in the order of the recording"
    assert [one.time_ns for one in results] == [REGULAR[index] for index in order]
    assert {tuple(one.tracks.track_ids.tolist()) for one in results if one.tracks is not None} == {(0,)}
