"""Proposals of a head whose every anchor has a score for every class (PV-RCNN, section 3.1)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.errors import ConfigError
from asca_pillars.base.strict import Strict
from asca_pillars.detection.decode import HeadMaps, rotated_nms, sigmoid
from asca_pillars.detection.detections import Detections
from asca_pillars.detection.spec import DetectorSpec
from asca_pillars.geometry.boxes import decode_boxes


@dataclass(frozen=True)
class AnchorProposals(Strict):
    """How head maps become proposals, whatever their class; the defaults are PV-RCNN's in use.

    Attributes:
        candidates: anchors that enter the suppression, by the best of their scores.
        nms_iou: boxes that overlap less, seen from above, are both proposed.
        count: of the proposals at most.
    """

    candidates: int = 1024
    nms_iou: float = 0.7
    count: int = 100

    def __post_init__(self) -> None:
        if not 0 <= self.nms_iou <= 1:
            raise ConfigError(f"nms_iou {self.nms_iou:g} of the proposals must lie between 0 and 1")
        if min(self.candidates, self.count) < 1:
            raise ConfigError(
                f"candidates {self.candidates} and count {self.count} of the proposals must be at least 1"
            )


def propose_anchors(maps: HeadMaps[NDArray[np.float32]], spec: DetectorSpec, settings: AnchorProposals) -> Detections:
    """Proposals of one scan, best first, each of the class that its anchor's best score is of.

    Anchors whose numbers are not finite are left out and counted.

    Args:
        maps: scores (A * classes, H, W) with the classes of an anchor side by side, boxes (7A, H, W), directions
            (2A, H, W).
        spec: anchors and classes.
        settings: how many.

    Raises:
        ValueError: the maps do not belong to these anchors and classes.
    """
    height, width, count, _ = spec.anchors.shape
    classes = len(spec.classes)
    expected = [(channels * count, height, width) for channels in (classes, 7, 2)]
    if [part.shape for part in maps] != expected:
        raise ValueError(f"head maps must have shapes {expected}, not {[part.shape for part in maps]}")
    scores, residuals, directions = (
        part.reshape(len(part), -1).T.reshape(-1, len(part) // count) for part in maps
    )  # (anchors, channels)
    best = scores.max(axis=1)
    finite = np.isfinite(best)
    chosen = _best(np.where(finite, best, -np.inf), min(settings.candidates, int(finite.sum())))
    with np.errstate(over="ignore", invalid="ignore"):  # what overflows is left out below
        bins, anchors = directions[chosen].argmax(axis=1), spec.anchors.reshape(-1, 7)[chosen]
        boxes = decode_boxes(residuals[chosen], bins, anchors, spec.direction_offset_rad)
    usable = np.isfinite(boxes).all(axis=1) & np.isfinite(directions[chosen]).all(axis=1)
    lost = int((~finite).sum() + (~usable).sum())
    boxes, chosen = boxes[usable], chosen[usable]
    kept = rotated_nms(boxes, best[chosen], settings.nms_iou, settings.count)
    rows = chosen[kept]
    labels = scores[rows].argmax(axis=1)
    return Detections(boxes[kept], sigmoid(best[rows]), labels, spec.class_names, non_finite=lost)


def _best(scores: NDArray[np.float32], count: int) -> NDArray[np.int64]:
    """Rows of the `count` largest scores, best first; of equal ones the earlier."""
    if count == 0:
        return np.empty(0, np.int64)
    rows = np.flatnonzero(scores >= np.partition(scores, len(scores) - count)[len(scores) - count])
    return rows[np.argsort(-scores[rows], kind="stable")[:count]]
