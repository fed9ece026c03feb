"""Recall and false positives per frame at a fixed score, for monitoring of training.

The official KITTI protocol ranks detections by score over a whole set; these metrics describe a detector
at its thresholds.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asca_pillars.detection.detections import Detections
from asca_pillars.detection.targets import match_by_overlap
from asca_pillars.geometry.overlap import bev_iou

BEV_IOU = {"Car": 0.5}  # 0.25 for the others, which are as small as a person
SMALL_BEV_IOU = 0.25


class RecallRow(NamedTuple):
    """Counts of one class, and ratios of them."""

    objects: int
    found: int
    false: int
    frames: int

    @property
    def recall(self) -> float:
        """Fraction of the objects that were found; NaN without objects."""
        return self.found / self.objects if self.objects else float("nan")

    @property
    def false_per_frame(self) -> float:
        """False positives per frame."""
        return self.false / max(self.frames, 1)


class RecallTally:
    """Accumulator of objects, found objects and false positives, frame by frame.

    Processes with different frames add up their `counts`: recall is the ratio of the sums, not a mean of ratios.

    Args:
        class_names: names of labels 0, 1, ...
        counts: (C + 1, 3) int64 to start from, for instance the sum over processes; zeros if None.

    Raises:
        ValueError: `counts` is of another shape.

    Attributes:
        counts: (C + 1, 3) int64. A row of objects, found and false for each class; the last row is the number of
            frames, 0, 0. Such arrays can be added.
    """

    def __init__(self, class_names: Sequence[str], counts: NDArray[np.integer] | None = None) -> None:
        shape = (len(class_names) + 1, 3)
        if counts is not None and counts.shape != shape:
            raise ValueError(f"counts of {len(class_names)} classes must have shape {shape}, not {counts.shape}")
        self.class_names = class_names
        self.counts = np.zeros(shape, dtype=np.int64) if counts is None else counts.astype(np.int64)

    @property
    def frames(self) -> int:
        """Number of counted frames."""
        return int(self.counts[-1, 0])

    def add(self, detections: Detections, boxes: NDArray[np.float32], labels: NDArray[np.int64]) -> None:
        """Count one frame.

        Args:
            detections: detections of the frame above the threshold, by descending score.
            boxes: (N, 7) labelled boxes, LiDAR frame, metres and radians.
            labels: (N,) class index, negative for ignored boxes: they match any class, and need not be found.
        """
        self.counts[-1, 0] += 1
        for index, name in enumerate(self.class_names):
            of_class = detections.labels == index
            related = (labels == index) | (labels < 0)
            self.counts[index] += _count(
                detections.boxes[of_class],
                boxes[related],
                labels[related] == index,
                BEV_IOU.get(name, SMALL_BEV_IOU),
            )

    def rows(self) -> dict[str, RecallRow]:
        """Return one row per class."""
        return {
            name: RecallRow(int(objects), int(found), int(false), self.frames)
            for name, (objects, found, false) in zip(self.class_names, self.counts[:-1], strict=True)
        }


def _count(
    detections: NDArray[np.float32],
    boxes: NDArray[np.float32],
    counted: NDArray[np.bool_],
    min_iou: float,
) -> tuple[int, int, int]:
    """Count objects, found objects and false positives of one class in one frame; detections by descending score."""
    matched, objects = match_by_overlap(bev_iou(detections, boxes), min_iou)
    return int(counted.sum()), int(counted[objects].sum()), len(detections) - len(matched)
