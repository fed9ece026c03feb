"""Greedy matching of one class's detections to its objects by descending score; distance and direction bands."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import inf, pi

import numpy as np
from numpy.typing import NDArray

from asca_pillars.data.frames import NEIGHBOR_TYPES
from asca_pillars.geometry.boxes import Floats, Ints, Mask

UNMATCHED = -1

Similarity = Callable[[Floats, Floats], Floats]
"""(N, 7), (M, 7) -> (N, M), larger is closer."""


@dataclass(frozen=True, eq=False)
class EvaluatedFrame:
    """Labels and detections of one frame, LiDAR frame.

    Attributes:
        frame_id: name of the frame.
        objects: (M, 7) labelled boxes.
        object_types: class of each.
        visible: (M,) whether an object contains a point; one without is neither missed nor makes a detection false.
        detections: (N, 7) detected boxes.
        detection_types: class of each.
        scores: (N,).
    """

    frame_id: str
    objects: NDArray[np.floating]
    object_types: Sequence[str]
    visible: Mask
    detections: NDArray[np.floating]
    detection_types: Sequence[str]
    scores: NDArray[np.floating]


@dataclass(frozen=True, eq=False)
class BoxPairs:
    """N detections of a class by descending score, and its K counted objects.

    Attributes:
        scores: (N,).
        detections: (N, 7).
        frames: (N,) number of each detection's frame.
        objects: (K, 7).
        first: (N,) the first object of the detection's frame, and
        similarity: similarity of each object of the frame, from the first one on.
        ignored_similarity: (N,) similarity of the closest object that is not counted; -inf without one.
    """

    scores: Floats
    detections: Floats
    frames: Ints
    objects: Floats
    first: Ints
    similarity: tuple[Floats, ...]
    ignored_similarity: Floats

    def match(self, close_enough: Callable[[float], bool]) -> Ints:
        """Return the index (N,) of the object matched to each detection, or UNMATCHED."""
        matched = np.full(len(self.scores), UNMATCHED)
        taken = np.zeros(len(self.objects), dtype=bool)
        for row, (first, close) in enumerate(zip(self.first.tolist(), self.similarity, strict=True)):
            if not len(close):
                continue
            free = np.where(taken[first : first + len(close)], -np.inf, close)
            best = int(free.argmax())
            if close_enough(float(free[best])):
                matched[row] = first + best
                taken[first + best] = True
        return matched


def pair_class(frames: Sequence[EvaluatedFrame], class_name: str, similarity: Similarity) -> BoxPairs:
    """Collect the detections and objects of one class over all frames.

    Objects without a point, and those of a neighboring type (KITTI's Van for Car), are not counted.
    """
    detections, scores, numbers, objects, first, rows, ignored_similarity = [], [], [], [], [], [], []
    start = 0
    for number, frame in enumerate(frames):
        types = np.array(frame.object_types, dtype=object)
        of_class = types == class_name
        counted = of_class & frame.visible
        spare = (of_class & ~frame.visible) | (types == NEIGHBOR_TYPES.get(class_name, ""))
        detected = np.array(frame.detection_types, dtype=object) == class_name
        boxes = np.asarray(frame.detections, np.float64)[detected]
        truth = np.asarray(frame.objects, np.float64)
        detections.append(boxes)
        scores.append(np.asarray(frame.scores, np.float64)[detected])
        numbers.append(np.full(len(boxes), number))
        objects.append(truth[counted])
        first.append(np.full(len(boxes), start))
        rows += list(similarity(boxes, truth[counted]))
        ignored_similarity.append(similarity(boxes, truth[spare]).max(axis=1, initial=-np.inf))
        start += len(objects[-1])
    score = np.concatenate([*scores, np.zeros(0)])
    order = np.argsort(-score, kind="stable")
    return BoxPairs(
        score[order],
        np.concatenate([*detections, np.zeros((0, 7))])[order],
        np.concatenate([*numbers, np.zeros(0, np.int64)])[order],
        np.concatenate([*objects, np.zeros((0, 7))]),
        np.concatenate([*first, np.zeros(0, np.int64)])[order],
        tuple(rows[row] for row in order),
        np.concatenate([*ignored_similarity, np.zeros(0)])[order],
    )


Band = Callable[[NDArray[np.floating]], Mask]
"""(N, 7) boxes -> (N,) whether each center is inside."""


def _distance(low_m: float, high_m: float) -> Band:
    def inside(boxes: NDArray[np.floating]) -> Mask:
        away = np.hypot(boxes[:, 0], boxes[:, 1])
        return (away >= low_m) & (away < high_m)

    return inside


def _direction(low_rad: float, high_rad: float) -> Band:
    def inside(boxes: NDArray[np.floating]) -> Mask:
        turned = np.abs(np.arctan2(boxes[:, 1], boxes[:, 0]))
        return (turned >= low_rad) & (turned < high_rad)

    return inside


BANDS: dict[str, Band] = {
    "all": _distance(0, inf),
    "0-30 m": _distance(0, 30),
    "30-50 m": _distance(30, 50),
    "50+ m": _distance(50, inf),
    "ahead": _direction(0, pi / 4),
    "beside": _direction(pi / 4, 3 * pi / 4),
    "behind": _direction(3 * pi / 4, inf),
}
"""Bands of horizontal distance from the sensor, and of direction: within 45 degrees of straight ahead, of straight
behind, and the rest."""


def in_band(pairs: BoxPairs, matched: Ints, band: str) -> tuple[Mask, Mask, int]:
    """Return masks (N,) of a band's detections and of the true positives among them, and its number of objects.

    A matched detection is in the band of its object; only an unmatched one is assigned by its own center.
    """
    counted, hits = BANDS[band](pairs.detections), matched != UNMATCHED
    held = BANDS[band](pairs.objects)
    counted[hits] = held[matched[hits]]
    return counted, hits, int(held.sum())
