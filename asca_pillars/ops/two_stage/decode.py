"""Decoding of refined boxes into detections, and proposals as regions of interest (RoI).

RoIs have grids in their own frames, residuals, and the targets of training.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from asca_pillars.detection.anchors import IGNORED
from asca_pillars.detection.decode import PostProcess, nms_by_class, sigmoid
from asca_pillars.detection.detections import Detections
from asca_pillars.detection.spec import DetectorSpec
from asca_pillars.geometry.boxes import decode_boxes, direction_bins, encode_boxes, points_in_boxes, wrap_angle
from asca_pillars.geometry.overlap import iou_3d


def to_box_frames(points: NDArray[np.floating[Any]], boxes: NDArray[np.floating[Any]]) -> NDArray[np.floating[Any]]:
    """Transform points of each box from the LiDAR frame to the box's own: (R, P, 3), (R, 7) -> (R, P, 3)."""
    return _turned(points - boxes[:, None, :3], -boxes[:, 6])


def from_box_frames(points: NDArray[np.floating[Any]], boxes: NDArray[np.floating[Any]]) -> NDArray[np.floating[Any]]:
    """Inverse of `to_box_frames`: (R, P, 3), (R, 7) -> (R, P, 3), metres, LiDAR frame."""
    return _turned(points, boxes[:, 6]) + boxes[:, None, :3]


def boxes_in_frames(boxes: NDArray[np.floating[Any]], frames: NDArray[np.floating[Any]]) -> NDArray[np.floating[Any]]:
    """Return boxes[k] as seen from the box frames[k]: (R, 7), (R, 7) -> (R, 7), metres, yaw in radians, [-pi, pi)."""
    position = to_box_frames(boxes[:, None, :3], frames)[:, 0]
    return np.concatenate([position, boxes[:, 3:6], wrap_angle(boxes[:, 6:] - frames[:, 6:])], axis=1)


def boxes_from_frames(boxes: NDArray[np.floating[Any]], frames: NDArray[np.floating[Any]]) -> NDArray[np.floating[Any]]:
    """Inverse of `boxes_in_frames`: (R, 7), (R, 7) -> (R, 7), metres and radians, yaw in [-pi, pi)."""
    position = from_box_frames(boxes[:, None, :3], frames)[:, 0]
    return np.concatenate([position, boxes[:, 3:6], wrap_angle(boxes[:, 6:] + frames[:, 6:])], axis=1)


def roi_grid_points(boxes: NDArray[np.floating[Any]], size: int) -> NDArray[np.floating[Any]]:
    """Return centers of size^3 cells of each box, LiDAR frame: (R, 7) -> (R, size^3, 3); z varies fastest, x slowest.

    These are the grid points of RoI-grid pooling (PV-RCNN, section 3.3).
    """
    share = (np.indices((size, size, size)).reshape(3, -1).T + 0.5) / size - 0.5
    return from_box_frames(share.astype(boxes.dtype)[None] * boxes[:, None, 3:6], boxes)


def _turned(points: NDArray[np.floating[Any]], yaw_rad: NDArray[np.floating[Any]]) -> NDArray[np.floating[Any]]:
    """Rotate (R, P, 3) about z by (R,)."""
    cos, sin = np.cos(yaw_rad)[:, None], np.sin(yaw_rad)[:, None]
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    return np.stack([cos * x - sin * y, sin * x + cos * y, z], axis=-1)


def encode_refinement(boxes: NDArray[np.floating[Any]], proposals: NDArray[np.floating[Any]]) -> NDArray[np.float32]:
    """Encode boxes[k] as residuals to proposals[k], metres and radians: (R, 7), (R, 7) -> (R, 7) float32.

    As an anchor's (`encode_boxes`), the proposal moved to the origin being the anchor; the heading difference lies in
    [-pi/2, pi/2), because the direction of the heading is the proposal's.
    """
    frames = proposals.astype(np.float64)
    seen = boxes_in_frames(boxes.astype(np.float64), frames)
    seen[:, 6] = wrap_angle(seen[:, 6], math.pi)
    return encode_boxes(seen, _at_origin(frames))[0]


def decode_refinement(
    residuals: NDArray[np.floating[Any]], proposals: NDArray[np.floating[Any]]
) -> NDArray[np.float32]:
    """Inverse of `encode_refinement`, up to half a turn: (R, 7), (R, 7) -> boxes (R, 7) float32.

    Boxes in metres and radians, in the frame of the proposals. Size ratios are held within 1/100 and 100.
    """
    frames = proposals.astype(np.float64)
    seen = decode_boxes(residuals, direction_bins(residuals[:, 6].astype(np.float64)), _at_origin(frames))
    return boxes_from_frames(seen.astype(np.float64), frames).astype(np.float32)


def _at_origin(boxes: NDArray[np.float64]) -> NDArray[np.float64]:
    moved = boxes.copy()
    moved[:, [0, 1, 2, 6]] = 0
    return moved


FOREGROUND_IOU = 0.55
"""3D IoU from which a proposal is sampled as foreground, and above which it learns residuals."""
HARD_IOU = 0.1
"""3D IoU from which background is hard; below it is easy."""
_FOREGROUND_SHARE = 0.5
_HARD_SHARE = 0.8  # share of hard samples in the background
_BORDER_M = 0.1  # around a box, in which a keypoint is neither inside nor outside
_CONFIDENCE_IOU = 0.25, 0.75  # where the confidence begins to rise from 0, and where it reaches 1


@dataclass(frozen=True)
class Overlaps:
    """Overlaps of proposals with the labelled boxes of their frame."""

    iou: NDArray[np.float64]
    """(R,) largest 3D IoU with a box of the proposal's own class; 0 without any."""
    matched: NDArray[np.int64]
    """(R,) row of that box; -1 without any."""
    ignored: NDArray[np.bool_]
    """(R,) proposals that overlap an IGNORED box more, by `HARD_IOU` at least: neither right nor wrong."""


@dataclass(frozen=True)
class RoiTargets:
    """Training targets of S sampled proposals."""

    rois: NDArray[np.int64]
    """(S,) rows of the proposals, some perhaps more than once."""
    confidence: NDArray[np.float32]
    """(S,) in [0, 1], rising with the overlap."""
    positive: NDArray[np.bool_]
    """(S,) those that learn residuals."""
    residuals: NDArray[np.float32]
    """(S, 7), see `encode_refinement`; 0 where not positive."""
    boxes: NDArray[np.float32]
    """(S, 7) the box to be found, LiDAR frame; the proposal itself where not positive."""


def match_proposals(proposals: Detections, boxes: NDArray[np.float32], labels: NDArray[np.int64]) -> Overlaps:
    """Match proposals with labelled boxes (N, 7), LiDAR frame, of classes (N,) or IGNORED, by 3D IoU."""
    iou = iou_3d(proposals.boxes, boxes)
    same_class_iou = np.where(proposals.labels[:, None] == labels[None], iou, 0.0)
    other = np.where(labels[None] == IGNORED, iou, 0.0).max(axis=1, initial=0.0)
    best = same_class_iou.max(axis=1, initial=0.0)
    matched = np.where(best > 0, same_class_iou.argmax(axis=1) if len(boxes) else -1, -1)
    return Overlaps(best, matched, (other > best) & (other >= HARD_IOU))


def sample_rois(overlaps: Overlaps, count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Sample rows (count,) of proposals for training; none if all of them are ignored.

    At most half is foreground, each once. The rest is background, drawn with replacement, 80 % of it hard; where a
    kind is missing the others take its place, and without any background the foreground is drawn with replacement.
    """
    usable = ~overlaps.ignored
    foreground = np.flatnonzero(usable & (overlaps.iou >= FOREGROUND_IOU))
    hard = np.flatnonzero(usable & (overlaps.iou < FOREGROUND_IOU) & (overlaps.iou >= HARD_IOU))
    easy = np.flatnonzero(usable & (overlaps.iou < HARD_IOU))
    if not len(hard) + len(easy):
        return rng.choice(foreground, count) if len(foreground) else foreground
    drawn = rng.permutation(foreground)[: round(count * _FOREGROUND_SHARE)]
    background = count - len(drawn)
    of_hard = round(background * _HARD_SHARE) if len(hard) and len(easy) else background * bool(len(hard))
    parts = [rng.choice(kind, n) for kind, n in ((hard, of_hard), (easy, background - of_hard)) if n]
    return np.concatenate([drawn, *parts])


def roi_targets(
    proposals: Detections, boxes: NDArray[np.float32], overlaps: Overlaps, rois: NDArray[np.int64]
) -> RoiTargets:
    """Return the targets of the proposals `rois` (S,), whose `overlaps` are with `boxes` (N, 7)."""
    low, high = _CONFIDENCE_IOU
    iou = overlaps.iou[rois]
    positive = iou > FOREGROUND_IOU
    roi_boxes = proposals.boxes[rois]
    target_boxes = roi_boxes.copy()
    target_boxes[positive] = boxes[overlaps.matched[rois[positive]]]
    return RoiTargets(
        rois=rois,
        confidence=np.clip((iou - low) / (high - low), 0, 1).astype(np.float32),
        positive=positive,
        residuals=encode_refinement(target_boxes, roi_boxes),
        boxes=target_boxes,
    )


def keypoint_states(
    keypoints: NDArray[np.float32], boxes: NDArray[np.float32], labels: NDArray[np.int64]
) -> NDArray[np.int8]:
    """Return 1 for keypoints in a labelled box, 0 outside, -1 if ignored: (K, 3), (N, 7), (N,) -> (K,).

    Ignored are those within 0.1 m outside a box's faces (PV-RCNN, section 3.3), and those in or at an IGNORED box.
    """
    inside, near = points_in_boxes(keypoints, boxes), points_in_boxes(keypoints, boxes, _BORDER_M)
    in_object = (inside & (labels != IGNORED)).any(axis=1)
    return np.where(in_object, 1, np.where(near.any(axis=1), -1, 0)).astype(np.int8)


Scores = Literal["second", "both"]
"""Score of a refined box: the second stage's, or the geometric mean of that and the proposal's."""


def refined_scores(proposals: Detections, confidence: NDArray[np.float32], scores: Scores) -> NDArray[np.float32]:
    """Return scores (R,) in [0, 1] of refined boxes, from the second stage's confidence (R,), logits."""
    refined = sigmoid(confidence)
    return refined if scores == "second" else np.sqrt(refined * proposals.scores)


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
    detections = refined_detections(proposals[kept], values[kept], residuals[kept], spec.post)
    return replace(detections, non_finite=proposals.non_finite + int((~finite).sum()) + detections.non_finite)


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
    rows = np.flatnonzero(usable)
    survivors = rows[nms_by_class(boxes[rows], scores[rows], proposals.labels[rows], post.nms_iou, post.max_detections)]
    best = survivors[np.argsort(-scores[survivors], kind="stable")[: post.max_detections]]
    detections = Detections(boxes[best], scores[best].astype(np.float32), proposals.labels[best], proposals.class_names)
    return replace(detections, non_finite=int((~usable).sum()))
