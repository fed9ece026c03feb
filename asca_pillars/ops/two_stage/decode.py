"""Decoding of refined boxes: proposals, confidences and residuals -> Detections."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from asca_pillars.detection.decode import PostProcess, nms_by_class, sigmoid
from asca_pillars.detection.detections import Detections
from asca_pillars.detection.spec import DetectorSpec
from asca_pillars.ops.two_stage.rois import decode_refinement

Scores = Literal["second", "both"]
"""Score of a refined box: the second stage's, or the geometric mean of that and the proposal's."""


def refined_scores(proposals: Detections, confidence: NDArray[np.float32], scores: Scores) -> NDArray[np.float32]:
    """Return scores (R,) in [0, 1] of refined boxes, from the second stage's confidence (R,), logits."""
    own = sigmoid(confidence)
    return own if scores == "second" else np.sqrt(own * proposals.scores)


def reported_detections(
    proposals: Detections,
    confidence: NDArray[np.float32],
    residuals: NDArray[np.float32],
    spec: DetectorSpec,
    scores: Scores,
) -> Detections:
    """Return the refined boxes whose scores reach the thresholds of `spec`, best first, after its suppression.

    Args:
        proposals: R of them.
        confidence: (R,) logits.
        residuals: (R, 7), see `decode_refinement`. Rows that are not finite are left out, and counted with what the
            first stage left out.
        spec: thresholds and suppression.
        scores: what the thresholds are of.
    """
    finite = np.isfinite(confidence) & np.isfinite(residuals).all(axis=1)
    values = refined_scores(proposals, np.where(finite, confidence, np.float32(0)), scores)
    thresholds = np.array([item.score_threshold for item in spec.classes])
    kept = np.flatnonzero(finite & (values >= thresholds[proposals.labels]))
    found = refined_detections(proposals[kept], values[kept], residuals[kept], spec.post)
    return replace(found, non_finite=proposals.non_finite + int((~finite).sum()) + found.non_finite)


def reported_frames(
    proposals: Sequence[Detections],
    confidence: NDArray[np.float32],
    residuals: NDArray[np.float32],
    spec: DetectorSpec,
    scores: Scores,
) -> list[Detections]:
    """Apply `reported_detections` to several frames, whose logits (R,) and residuals (R, 7) follow one another."""
    ends = np.cumsum([len(frame) for frame in proposals])[:-1]
    frames = zip(proposals, np.split(confidence, ends), np.split(residuals, ends), strict=True)
    return [reported_detections(*frame, spec, scores) for frame in frames]


def refined_detections(
    proposals: Detections, scores: NDArray[np.float32], residuals: NDArray[np.float32], post: PostProcess
) -> Detections:
    """Return refined boxes, best first, after rotated NMS within each class; non-finite ones are counted.

    Args:
        proposals: R of them.
        scores: (R,) in [0, 1], which take the place of the first stage's, see `refined_scores`.
        residuals: (R, 7), see `decode_refinement`.
    """
    with np.errstate(over="ignore", invalid="ignore"):  # non-finite values are left out below
        boxes = decode_refinement(residuals, proposals.boxes)
    usable = np.isfinite(boxes).all(axis=1) & np.isfinite(scores)
    own = np.flatnonzero(usable)
    survivors = own[nms_by_class(boxes[own], scores[own], proposals.labels[own], post.nms_iou, post.max_detections)]
    best = survivors[np.argsort(-scores[survivors], kind="stable")[: post.max_detections]]
    found = Detections(boxes[best], scores[best].astype(np.float32), proposals.labels[best], proposals.class_names)
    return replace(found, non_finite=int((~usable).sum()))
