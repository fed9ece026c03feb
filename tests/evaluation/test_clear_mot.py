"""Switches, fragmentations and MOTA of cases that can be counted by hand."""

import numpy as np
import pytest

from asca_pillars.evaluation.tracking_metrics import Boxes, ClearMot, clear_mot, tracked_frame
from tests.evaluation.tracked_frames import frame


def of(*found: int | None) -> ClearMot:
    """One object in as many frames, found under these identities or missed."""
    frames = [frame([0], [], []) if one is None else frame([0], [one], [[1.0]]) for one in found]
    return clear_mot([frames], 0.5)


def test_gaps_switches_and_matches_that_last() -> None:
    assert of(1, 1, 1) == (3, 3, 0, 0, 0) and of(1, 1, 1).mota == 1.0
    assert of(1, 1, 2, 2)[3:] == (1, 0) and of(1, 1, 2, 2).mota == 0.75, "a switch costs as much as a miss"
    assert of(1, None, 1)[3:] == (0, 1)
    assert of(1, None, None, 2)[3:] == (1, 1)
    assert of(None, 1, None)[3:] == (0, 0), "neither a late start nor an early end"
    assert of(1, None, 1).mota == pytest.approx(2 / 3)
    frames = [frame([0], [1, 2], [[0.9, 0.0]]), frame([0], [1, 2], [[0.6, 0.95]])]
    assert clear_mot([frames], 0.5) == (2, 2, 2, 0, 0)
    assert clear_mot([frames], 0.7).identity_switches == 1
    one = [frame([0], [1], [[1.0]])]
    assert clear_mot([one, [frame([0], [2], [[1.0]])], [frame([], [5, 6])]], 0.5) == (2, 2, 2, 0, 0)
    assert np.isnan(clear_mot([[frame([], [1])]], 0.5).mota)


def test_what_is_not_counted_takes_its_box_away() -> None:
    boxes = np.array([[5, 0, 0, 4, 2, 1.5, 0], [20, 0, 0, 4, 2, 1.5, 0]], np.float32)
    extra = np.concatenate([boxes, boxes[:1] + np.array([0, 30, 0, 0, 0, 0, 0], np.float32)])
    left = tracked_frame(Boxes(boxes, np.array([1, 2])), np.array([True, False]), Boxes(extra, np.array([7, 8, 9])))
    assert left.objects.tolist() == [1] and left.detections.tolist() == [7, 9]
    assert left.similarity[0].tolist() == [1.0, 0.0]
