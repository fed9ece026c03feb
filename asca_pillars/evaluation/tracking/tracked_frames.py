"""What tracking metrics compare: labelled and found identities of frame after frame, and how alike their boxes are."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asca_pillars.detection.targets import UNMATCHED, best_assignments
from asca_pillars.geometry.overlap import iou_3d

_Integers = NDArray[np.int64]
_Doubles = NDArray[np.float64]

IGNORED_IOU = 0.25
"""A box that takes a label which is not counted, by so much overlap, is not counted either."""


class TrackedFrame(NamedTuple):
    """One class in one frame: M labelled and N found identities, none twice."""

    objects: _Integers
    """(M,)."""
    found: _Integers
    """(N,)."""
    similarity: _Doubles
    """(M, N) in 0..1: 3D IoU."""


class Boxes(NamedTuple):
    """K boxes of one class in one frame, with their identities."""

    boxes: NDArray[np.float32]
    """(K, 7), LiDAR frame."""
    ids: _Integers
    """(K,)."""


def tracked_frame(labels: Boxes, counted: NDArray[np.bool_], found: Boxes) -> TrackedFrame:
    """Compare the boxes of a frame, without labels that are not counted and without the boxes that found those.

    Args:
        labels: M of one class.
        counted: (M,) mask; False for objects of which a detector cannot be asked, hidden or out of its reach.
        found: N of the same class.
    """
    similarity = iou_3d(labels.boxes, found.boxes)
    holders = best_assignments(np.where(similarity >= IGNORED_IOU, similarity, 0.0).T)[-1]
    of_ignored = holders[~counted & (holders != UNMATCHED)]
    kept = np.ones(len(found.ids), bool)
    kept[of_ignored] = False
    return TrackedFrame(labels.ids[counted], found.ids[kept], similarity[np.ix_(counted, kept)])


def counts_of_ids(frames: Sequence[TrackedFrame]) -> tuple[dict[int, int], dict[int, int]]:
    """In how many frames each labelled and each found identity is."""
    counts: tuple[dict[int, int], dict[int, int]] = ({}, {})
    for frame in frames:
        for own, ids in zip(counts, (frame.objects, frame.found), strict=True):
            for number in ids.tolist():
                own[number] = own.get(number, 0) + 1
    return counts
