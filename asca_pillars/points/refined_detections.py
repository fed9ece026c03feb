"""The last stop of two stages: proposals, confidences and residuals -> Detections."""

import numpy as np
from numpy.typing import NDArray

from asca_pillars.geometry.decode import PostProcess
from asca_pillars.geometry.detections import Detections
from asca_pillars.geometry.overlap import rotated_nms
from asca_pillars.points.refinement import decode_refinement


def refined_detections(
    proposals: Detections, scores: NDArray[np.float32], residuals: NDArray[np.float32], post: PostProcess
) -> Detections:
    """Refined boxes, best first, after rotated suppression within each class.

    Args:
        proposals: R of them.
        scores: (R,) confidences in [0, 1], which take the place of the first stage's.
        residuals: (R, 7), see `decode_refinement`.
    """
    with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is left out below
        boxes = decode_refinement(residuals, proposals.boxes)
    usable = np.isfinite(boxes).all(axis=1) & np.isfinite(scores)
    kept = []
    for label in range(len(proposals.class_names)):
        own = np.flatnonzero(usable & (proposals.labels == label))
        kept.append(own[rotated_nms(boxes[own], scores[own], post.nms_iou, post.max_detections)])
    survivors = np.concatenate(kept)
    best = survivors[np.argsort(-scores[survivors], kind="stable")[: post.max_detections]]
    return Detections(boxes[best], scores[best].astype(np.float32), proposals.labels[best], proposals.class_names)
