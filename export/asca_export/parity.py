"""Parity of a bundle and the trained model: PyTorch and onnxruntime on the same scans, stage by stage."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from asca_deploy.bundle import Parity
from asca_deploy.pillar.encoder import PILLAR_MAXIMA, Encoder, pfn_inputs
from asca_deploy.pillar.graphs import Maps
from asca_deploy.pillar.pipeline import Canvas, PillarPipeline
from asca_export.fast_forms import NEVER
from asca_pillars.base.errors import ExportError
from asca_pillars.detection.decode import HeadMaps
from asca_pillars.detection.detections import Detections
from asca_pillars.detection.spec import DetectorSpec
from asca_pillars.geometry.boxes import wrap_angle
from asca_pillars.geometry.overlap import bev_iou
from asca_pillars.models.pillar.network import PillarDetector
from asca_pillars.models.pillar.preparation import PillarBatch, batch_pillars
from asca_pillars.ops.pillar.prepare import Pillars
from asca_pillars.ops.pillar.spec import PillarSpec
from asca_pillars.ops.pv_rcnn.spec import VoxelSpec
from asca_pillars.ops.two_stage.decode import Scores, reported_detections

MAP_TOLERANCE = 1e-3  # largest absolute difference of a head map; of pillar features, see `check_parity`
BOX_TOLERANCE_M = 0.01
YAW_TOLERANCE_RAD = np.deg2rad(0.5)
OVERLAP_TIE = 1e-4  # tolerance of an overlap at the NMS threshold
COMPARED_ANCHORS = 100  # per class and scan: the best ones, whatever their score, so that there is always something


class LargestDifferences(NamedTuple):
    """Largest differences between the boxes of two detectors that belong together."""

    center_size_m: float
    yaw_rad: float


def check_parity(detector: PillarDetector, runtime: PillarPipeline, scans: Sequence[NDArray[np.float32]]) -> Parity:
    """Compare the PyTorch detector with the exported one.

    Args:
        detector: in evaluation mode.
        runtime: opened on the bundle that was exported from it.
        scans: (N, 4) each, LiDAR frame.

    Raises:
        ExportError: they differ; names the first stage that does, and the scan. Or no scan has a point in the ranges.
    """
    spec, compared = runtime.spec, 0
    worst_map = worst_box = worst_yaw = 0.0
    for number, points in enumerate(scans):
        pillars = spec.pillarize(points)
        compared += bool(len(pillars.cells))  # without pillars there is no more to compare than what is empty
        batch = batch_pillars([pillars], [detector.preparation.place(pillars)])
        with torch.inference_mode():
            expected_features = detector.encode(batch.features, batch.pillar_index, batch.point_counts)
            expected_maps = _maps(detector, batch)
        features = runtime.encode(pillars)
        _check_pfn(runtime.encode, pillars, number)
        placed = runtime.backbone.place(features, pillars.cells)
        # Features have no unit, and some readings of the attention sum over thousands of pillars: their scale counts.
        allowed = MAP_TOLERANCE * max(1.0, float(expected_features.abs().max()) if len(expected_features) else 0.0)
        require_close("encode", expected_features.numpy(), features, allowed, number)
        if isinstance(placed, Canvas):
            with torch.inference_mode():
                pseudo_image = detector.scatter(*detector.pool(expected_features, batch)).numpy()
            expected_canvas = np.pad(pseudo_image.transpose(0, 2, 3, 1), ((0, 0), (1, 0), (1, 0), (0, 0)))
            require_close("scatter", expected_canvas, placed.image, allowed, number)
        maps, cells = runtime.backbone.run(placed)
        if cells is None and batch.neck is not None:  # a sparse neck as dense convolutions
            maps, cells = _at_cells(maps, batch.neck.head_cells.numpy(), number)
        for name, expected, actual in zip(HeadMaps._fields, expected_maps, maps, strict=True):
            error = require_close(f"head `{name}`", expected, actual, MAP_TOLERANCE, number)
            worst_map = max(worst_map, error)
        boxes = compare_boxes(expected_maps, maps, spec, number, cells)
        worst_box, worst_yaw = max(worst_box, boxes.center_size_m), max(worst_yaw, boxes.yaw_rad)
    return Parity(worst_map, worst_box, worst_yaw, require_compared(compared), MAP_TOLERANCE)


def _check_pfn(encode: Encoder, pillars: Pillars, scan: int) -> None:
    """Raise ExportError unless pfn.onnx, which runtimes in other languages run, gives what this runtime computes."""
    if encode.pfn is None or not len(pillars.cells):
        return
    computed = encode.maxima(pillars)
    (maxima,) = encode.pfn.run((PILLAR_MAXIMA,), pfn_inputs(encode.pfn, pillars))
    require_close("pfn", computed, maxima, MAP_TOLERANCE * max(1.0, float(computed.max())), scan)


def require_compared(scans: int) -> int:
    """Return the number of compared scans; ExportError if there are none."""
    if not scans:
        raise ExportError("none of the scans given to prove parity on has a point in the model's ranges; give others")
    return scans


def _maps(detector: PillarDetector, batch: PillarBatch) -> Maps:
    """Return PyTorch's outputs for a batch of one frame: maps, or rows of its active head cells."""
    maps = (part.numpy() for part in detector(batch))
    return HeadMaps(*(part if batch.neck is not None else part[0] for part in maps))


def _at_cells(maps: Maps, cells: NDArray[np.int32], scan: int) -> tuple[Maps, NDArray[np.int32]]:
    """Return rows of maps (channels, H, W) at the active head cells, (M,); no other cell may have a score."""
    elsewhere = np.delete(maps.scores.reshape(len(maps.scores), -1), cells, axis=1)
    require_close("head `scores` of inactive cells", np.full_like(elsewhere, NEVER), elsewhere, 0, scan)
    return HeadMaps(*(part.reshape(len(part), -1).T[cells] for part in maps)), cells


def by_class(scores: NDArray[np.float32], spec: PillarSpec | VoxelSpec) -> NDArray[np.float32]:
    """Return the logits (A, H, W), or rows (M, A), of each class: (classes, n); likewise of A * classes."""
    classes = len(spec.classes)
    channels = scores if scores.ndim == 3 else scores.T
    if spec.scores_per_anchor > 1:  # anchor-major: scores of all classes for an anchor, then the next anchor
        channels = channels.reshape(-1, classes, channels.size // len(channels)).swapaxes(0, 1)
    return channels.reshape(classes, scores.size // classes)


def require_close(
    stage: str, expected: NDArray[np.float32], actual: NDArray[np.float32], allowed: float, scan: int
) -> float:
    """Return the largest difference; ExportError if it exceeds `allowed`."""
    error = float(np.abs(expected - actual).max(initial=0.0))
    if not error <= allowed:
        raise _parity_error(
            scan,
            f"PyTorch and onnxruntime differ at stage {stage}: largest difference {error:.3g}, allowed {allowed:.3g}",
        )
    return error


def _parity_error(scan: int, difference: str) -> ExportError:
    return ExportError(
        f"scan {scan}: {difference}; nothing is written: try other versions of onnxruntime or torch, and if the "
        "difference remains, report it with the scan, whose number counts from 0"
    )


def require_same_refined(
    proposals: Detections,
    expected: tuple[NDArray[np.float32], NDArray[np.float32]],
    actual: tuple[NDArray[np.float32], NDArray[np.float32]],
    spec: DetectorSpec,
    scores: Scores,
    scan: int,
) -> LargestDifferences:
    """Refine every proposal both ways, with no threshold and no suppression; every box needs a partner.

    Args:
        proposals: R of them.
        expected, actual: logits (R,) and residuals (R, 7), of PyTorch and of the graph.
        spec: of both detectors.
        scores: what a box is scored by.
        scan: its number, for messages.

    Raises:
        ExportError: a box without a partner within the tolerances.
    """
    spec = spec.with_score_threshold(0.0)
    spec = replace(spec, post=replace(spec.post, nms_iou=1.0, max_detections=max(len(proposals), 1)))
    boxes, partners = (reported_detections(proposals, *answer, spec, scores) for answer in (expected, actual))
    difference, lone = match_nearest(boxes, partners)
    if len(lone):
        raise _parity_error(
            scan,
            f"{len(lone)} refined boxes have no partner within {BOX_TOLERANCE_M} m and "
            f"{np.rad2deg(YAW_TOLERANCE_RAD)} degrees",
        )
    return difference


def compare_boxes(
    expected: Maps, actual: Maps, spec: PillarSpec, scan: int = 0, cells: NDArray[np.int32] | None = None
) -> LargestDifferences:
    """Decode both maps and pair the boxes, before and after suppression; every box needs a partner.

    Thresholds are lowered until the best COMPARED_ANCHORS of each class take part, and all boxes are kept. Before
    suppression only thresholds can explain a difference; after it, ties between overlapping boxes of equal score can.
    No box votes: all that could have been compared, and whether one has a vote can hang on a rounding.

    Args:
        expected, actual: maps, or rows of the same head cells.
        spec: of both detectors.
        scan: its number, for messages.
        cells: (M,) the head cells of rows, see `decode`.

    Raises:
        ExportError: a box without a partner within the tolerances that no tie between scores explains.
    """
    classes = tuple(
        replace(class_, score_threshold=min(class_.score_threshold, _score_of_rank(logits)))
        for class_, logits in zip(spec.classes, by_class(expected.scores, spec), strict=True)
    )
    uncut = replace(spec.post, vote_iou=None, max_detections=spec.post.candidates * len(classes))
    worst = LargestDifferences(0.0, 0.0)
    for post in (replace(uncut, nms_iou=1.0), uncut):
        lowered = replace(spec, classes=classes, post=post)
        in_torch, exported = lowered.decode(expected, cells), lowered.decode(actual, cells)
        forward, our_lone = match_nearest(in_torch, exported)
        backward, their_lone = match_nearest(exported, in_torch)
        _require_score_ties(in_torch[our_lone], exported[their_lone], in_torch, exported, lowered, scan)
        worst = LargestDifferences(*map(max, zip(worst, forward, backward, strict=True)))
    return worst


def _score_of_rank(logits: NDArray[np.float32]) -> float:
    if not logits.size:  # a sparse neck on a scan without pillars
        return 1.0
    rank = min(COMPARED_ANCHORS, logits.size)
    logit = np.partition(logits.reshape(-1), logits.size - rank)[logits.size - rank]
    return float(1 / (1 + np.exp(-logit.astype(np.float64))))


def match_nearest(boxes: Detections, partners: Detections) -> tuple[LargestDifferences, NDArray[np.int64]]:
    """Largest difference between boxes and their nearest partners, and the boxes (n,) without one in tolerance."""
    worst_m = worst_rad = 0.0
    lone = []
    for index, (box, label) in enumerate(zip(boxes.boxes, boxes.labels, strict=True)):
        same = partners.boxes[partners.labels == label]
        lengths = np.abs(same[:, :6] - box[:6]).max(axis=1, initial=0.0)
        yaws = np.abs(wrap_angle(same[:, 6] - box[6]))
        close = np.flatnonzero((lengths <= BOX_TOLERANCE_M) & (yaws <= YAW_TOLERANCE_RAD))
        if len(close) == 0:
            lone.append(index)
            continue
        best = close[lengths[close].argmin()]
        worst_m, worst_rad = max(worst_m, float(lengths[best])), max(worst_rad, float(yaws[best]))
    return LargestDifferences(worst_m, worst_rad), np.array(lone, dtype=np.int64)


def _require_score_ties(
    our_lone: Detections, their_lone: Detections, expected: Detections, actual: Detections, spec: PillarSpec, scan: int
) -> None:
    """Raise ExportError unless ties between scores explain every box that one side alone has.

    A box is explained if its score ties with the threshold or with a box of the other side that overlaps it; if its
    overlap with one is as large as suppression allows, within rounding; and if it overlaps an explained box of the
    other side, which suppression then put in its place or took out of its way.
    """
    explained = [_are_score_ties(our_lone, actual, spec), _are_score_ties(their_lone, expected, spec)]
    clash = _excess_overlap(our_lone, their_lone, spec) > 0
    while True:
        grown = [explained[0] | clash[:, explained[1]].any(axis=1), explained[1] | clash[explained[0]].any(axis=0)]
        if all(np.array_equal(before, after) for before, after in zip(explained, grown, strict=True)):
            break
        explained = grown
    for lone, known in zip((our_lone, their_lone), explained, strict=True):
        for name, box, score in zip(lone[~known].names, lone[~known].boxes, lone[~known].scores, strict=True):
            raise _parity_error(
                scan,
                f"the {name} at x = {box[0]:.2f}, y = {box[1]:.2f} m with score {score:.3f} "
                f"has no partner within {BOX_TOLERANCE_M} m and {np.rad2deg(YAW_TOLERANCE_RAD)} degrees",
            )


def _are_score_ties(lone: Detections, others: Detections, spec: PillarSpec) -> NDArray[np.bool_]:
    thresholds = np.array([class_.score_threshold for class_ in spec.classes])
    tied = np.abs(thresholds[lone.labels] - lone.scores) <= MAP_TOLERANCE
    equal = np.abs(lone.scores[:, None] - others.scores[None]) <= MAP_TOLERANCE
    beyond = _excess_overlap(lone, others, spec)
    barely = (np.abs(beyond) <= OVERLAP_TIE) & (spec.post.nms_iou < 1)  # 1: nothing was suppressed
    return tied | ((beyond > 0) & equal | barely).any(axis=1)


def _excess_overlap(a: Detections, b: Detections, spec: PillarSpec) -> NDArray[np.float64]:
    """Return (N, M): overlap minus the largest that suppression allows; -inf for pairs of two classes."""
    same_class = a.labels[:, None] == b.labels[None]
    return np.where(same_class, bev_iou(a.boxes, b.boxes) - spec.post.nms_iou, -np.inf)
