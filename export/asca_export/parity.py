"""The proof that a bundle is the trained model: PyTorch and onnxruntime on the same scans, stage by stage."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from asca_deploy.bundle import Parity
from asca_deploy.detector import Detector
from asca_pillars.errors import ExportError
from asca_pillars.geometry.boxes import wrap_angle
from asca_pillars.geometry.decode import HeadMaps, decode
from asca_pillars.geometry.detections import Detections
from asca_pillars.geometry.overlap import bev_iou
from asca_pillars.geometry.spec import DetectorSpec
from asca_pillars.models.detector import PillarDetector, batch_pillars

MAP_TOLERANCE = 1e-3  # largest absolute difference of a pillar feature or a head map
BOX_TOLERANCE_M = 0.01
YAW_TOLERANCE_RAD = np.deg2rad(0.5)
COMPARED_ANCHORS = (
    100  # per class and scan: the best ones, whatever their score, so that there is always something
)

Maps = HeadMaps[NDArray[np.float32]]


@dataclass(frozen=True)
class BoxDifference:
    """Largest differences between the boxes of two detectors that belong together."""

    center_size_m: float
    yaw_rad: float


def prove_parity(detector: PillarDetector, runtime: Detector, scans: Sequence[NDArray[np.float32]]) -> Parity:
    """Compare the PyTorch detector with the exported one.

    Args:
        detector: in evaluation mode.
        runtime: opened on the bundle that was exported from it.
        scans: (N, 4) each.

    Raises:
        ExportError: they differ; names the first stage that does, and the scan.
    """
    spec = runtime.spec
    worst_map = worst_box = worst_yaw = 0.0
    for number, points in enumerate(scans):
        pillars = spec.pillarize(points)
        batch = batch_pillars([pillars])
        with torch.inference_mode():
            expected_features = detector.encode(batch.features, batch.pillar_index, batch.point_counts)
            expected_canvas = detector.scatter(expected_features, batch.cells, batch.frame_pillars)
            expected_maps: Maps = HeadMaps(
                *(m[0].numpy() for m in detector.head(detector.neck(expected_canvas)))
            )
        features = runtime.encode(pillars)
        canvas = runtime.scatter(features, pillars.cells)
        maps = runtime.neck_and_head(canvas)
        stages = [
            ("encode", expected_features.numpy(), features),
            ("scatter", expected_canvas.numpy(), canvas),
        ]
        stages += [
            (f"head `{name}`", a, b) for name, a, b in zip(HeadMaps._fields, expected_maps, maps, strict=True)
        ]
        for stage, expected, found in stages:
            error = float(np.abs(expected - found).max(initial=0.0))
            if not error <= MAP_TOLERANCE:
                raise ExportError(
                    f"scan {number}: PyTorch and onnxruntime part at stage {stage}: "
                    f"largest difference {error:.3g}, allowed {MAP_TOLERANCE:g}"
                )
            worst_map = max(worst_map, error)
        boxes = compare_boxes(expected_maps, maps, spec, number)
        worst_box, worst_yaw = max(worst_box, boxes.center_size_m), max(worst_yaw, boxes.yaw_rad)
    return Parity(worst_map, worst_box, worst_yaw, len(scans), MAP_TOLERANCE)


def compare_boxes(expected: Maps, found: Maps, spec: DetectorSpec, scan: int = 0) -> BoxDifference:
    """Decode both maps and pair the boxes; every box needs a partner within the tolerances.

    Thresholds are lowered until the best COMPARED_ANCHORS of each class take part.

    Raises:
        ExportError: a box without a partner that no tie between scores explains.
    """
    classes = tuple(
        replace(
            spec_,
            score_threshold=min(spec_.score_threshold, _score_of_rank(expected.scores[2 * i : 2 * i + 2])),
        )
        for i, spec_ in enumerate(spec.classes)
    )
    ours, theirs = (decode(maps, spec.anchors, classes, spec.post) for maps in (expected, found))
    forward = _pair(ours, theirs, spec, scan)
    backward = _pair(theirs, ours, spec, scan)
    return BoxDifference(
        max(forward.center_size_m, backward.center_size_m), max(forward.yaw_rad, backward.yaw_rad)
    )


def _score_of_rank(logits: NDArray[np.float32]) -> float:
    rank = min(COMPARED_ANCHORS, logits.size)
    logit = np.partition(logits.reshape(-1), logits.size - rank)[logits.size - rank]
    return float(1 / (1 + np.exp(-logit.astype(np.float64))))


def _pair(boxes: Detections, partners: Detections, spec: DetectorSpec, scan: int) -> BoxDifference:
    worst_m = worst_rad = 0.0
    for index in range(len(boxes)):
        box, score = boxes.boxes[index], boxes.scores[index]
        same = partners[partners.labels == boxes.labels[index]]
        lengths = np.abs(same.boxes[:, :6] - box[:6]).max(axis=1, initial=0.0)
        yaws = np.abs(wrap_angle(same.boxes[:, 6] - box[6]))
        close = (lengths <= BOX_TOLERANCE_M) & (yaws <= YAW_TOLERANCE_RAD)
        if close.any():
            best = np.flatnonzero(close)[lengths[close].argmin()]
            worst_m, worst_rad = max(worst_m, float(lengths[best])), max(worst_rad, float(yaws[best]))
        elif not _is_tie(box, float(score), same, partners, spec):
            raise ExportError(
                f"scan {scan}: stage decode: the {boxes.names[index]} at x = {box[0]:.2f}, y = {box[1]:.2f} m with "
                f"score {score:.3f} has no partner within {BOX_TOLERANCE_M} m and {np.rad2deg(YAW_TOLERANCE_RAD)} degrees"
            )
    return BoxDifference(worst_m, worst_rad)


def _is_tie(
    box: NDArray[np.float32], score: float, same: Detections, partners: Detections, spec: DetectorSpec
) -> bool:
    """Whether the other detector may rightly have another box here: scores equal within the maps' tolerance.

    Either an overlapping box of the same score took its place, or the cut after the best so many fell between them.
    """
    rivals = same[bev_iou(box[None], same.boxes)[0] > spec.post.nms_iou]
    if (np.abs(rivals.scores - score) <= MAP_TOLERANCE).any():
        return True
    return len(partners) > 0 and abs(float(partners.scores.min()) - score) <= MAP_TOLERANCE
