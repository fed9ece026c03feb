"""Differences between the boxes of two detectors."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from asca_pillars.detection.detections import Detections

SAME_OBJECT_M = 0.5  # boxes of a class whose centers are farther apart than this are of different objects


@dataclass(frozen=True)
class BoxDifference:
    """Largest differences between boxes of the same objects, and how many boxes have no partner."""

    pairs: int
    lone: int
    """Boxes of either side without one of the other within SAME_OBJECT_M."""
    center_size_m: float
    """Largest difference of a center coordinate, length, width or height."""
    score: float


def box_difference(expected: Sequence[Detections], found: Sequence[Detections]) -> BoxDifference:
    """Pair the boxes of the same scans, each with the nearest one of its class that is still free, best first."""
    pairs = lone = 0
    largest_m = largest_score = 0.0
    for ours, theirs in zip(expected, found, strict=True):
        free, names = np.ones(len(theirs), bool), np.array(theirs.names, dtype=str)
        for box, score, name in zip(ours.boxes, ours.scores, ours.names, strict=True):
            distances = np.linalg.norm(theirs.boxes[:, :3] - box[:3], axis=1)
            distances[~free | (names != name)] = np.inf
            if distances.min(initial=np.inf) > SAME_OBJECT_M:
                lone += 1
                continue
            nearest = int(distances.argmin())
            free[nearest] = False
            pairs += 1
            largest_m = max(largest_m, float(np.abs(theirs.boxes[nearest, :6] - box[:6]).max()))
            largest_score = max(largest_score, float(abs(theirs.scores[nearest] - score)))
        lone += int(free.sum())
    return BoxDifference(pairs, lone, largest_m, largest_score)
