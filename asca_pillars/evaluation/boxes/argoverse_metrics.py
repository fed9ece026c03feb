"""Argoverse 2's detection metrics: AP by center distance, errors of true positives, and the composite score CDS.

Definition: B. Wilson et al., "Argoverse 2: Next Generation Datasets for Self-Driving Perception and Forecasting",
NeurIPS Datasets and Benchmarks 2021, and for details its API (`av2.evaluation.detection`):

- Distance is that of the centers in 3D. In each frame a detection is assigned to its nearest object, matched or not; of
  the detections of an object that with the highest score is a true positive if it is nearer than 0.5, 1, 2 and 4 m.
- Up to 100 detections of a class per frame count, by score, at distances below 150 m.
- Precision at a recall is the maximum at that recall or higher, sampled at the recalls 0, 0.01, ... 1, interpolated
  linearly, 0 beyond the highest. AP is their mean, and the class' AP the mean over the distances.
- Errors are means over the true positives below 2 m: ATE in m, ASE (`aligned_size_error`, unlike nuScenes'),
  AOE in rad. Without a true positive they are 2 m, 1 and pi.
- CDS = AP * mean(1 - ATE / 2 m, 1 - ASE, 1 - AOE / pi).

The API restricts both sides to the map's region of interest; without a map everything counts here.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import pi

import numpy as np
from numpy.typing import NDArray

from asca_pillars.evaluation.boxes.box_pairs import UNMATCHED, BoxPairs, EvaluatedFrame, pair_class
from asca_pillars.evaluation.boxes.nuscenes_metrics import DISTANCES_M, ERROR_DISTANCE_M, RECALLS
from asca_pillars.geometry.boxes import Floats, wrap_angle

MAX_DETECTIONS = 100
MAX_RANGE_M = 150.0
_WORST = np.array([ERROR_DISTANCE_M, 1.0, pi])
_TINY = 1e-10  # added by the API to the number of detections


@dataclass(frozen=True)
class ArgoverseScore:
    """Scores of one class: AP and CDS in percent, and errors; None without objects."""

    class_name: str
    objects: int
    ap: float | None
    ate_m: float | None
    ase: float | None
    aoe_rad: float | None
    cds: float | None


def argoverse_scores(frames: Sequence[EvaluatedFrame], class_names: Sequence[str]) -> list[ArgoverseScore]:
    """Compute a score for every class."""
    within = [_in_range(frame) for frame in frames]
    return [_score(pair_class(within, name, _similarity), name) for name in class_names]


def aligned_size_error(boxes: Floats, objects: Floats) -> Floats:
    """Scale error of boxes (K, 7), metres and radians, laid over each other, center on center and heading on heading.

    The API's `iou_3d_axis_aligned` divides the common volume by the product of the larger extents, which is the volume
    of the smallest box around both, not that of their union.

    Returns:
        (K,) in [0, 1).
    """
    shared = np.minimum(boxes[:, 3:6], objects[:, 3:6]).prod(axis=1)
    return 1 - shared / np.maximum(boxes[:, 3:6], objects[:, 3:6]).prod(axis=1)


def _similarity(boxes: Floats, objects: Floats) -> Floats:
    return -np.linalg.norm(boxes[:, None, :3] - objects[None, :, :3], axis=2)


def _in_range(frame: EvaluatedFrame) -> EvaluatedFrame:
    near = np.linalg.norm(frame.detections[:, :3], axis=1) < MAX_RANGE_M
    visible = frame.visible & (np.linalg.norm(frame.objects[:, :3], axis=1) < MAX_RANGE_M)
    types = [kind for kind, kept in zip(frame.detection_types, near, strict=True) if kept]
    detections, scores = frame.detections[near], frame.scores[near]
    return EvaluatedFrame(frame.frame_id, frame.objects, frame.object_types, visible, detections, types, scores)


def _score(pairs: BoxPairs, name: str) -> ArgoverseScore:
    objects = len(pairs.objects)
    if not objects:
        return ArgoverseScore(name, 0, None, None, None, None, None)
    kept, owner, distance_m = _first_of_each(pairs)
    ap = float(np.mean([_average_precision((distance_m < limit_m)[kept], objects) for limit_m in DISTANCES_M]))
    true = kept & (distance_m < ERROR_DISTANCE_M)
    errors = _WORST
    if true.any():
        detections, matched = pairs.detections[true], pairs.objects[owner[true]]
        turned = np.abs(wrap_angle(detections[:, 6] - matched[:, 6]))
        errors = np.array([distance_m[true].mean(), aligned_size_error(detections, matched).mean(), turned.mean()])
    cds = ap * float(np.mean(1 - errors / _WORST))
    ate_m, ase, aoe_rad = errors.tolist()
    return ArgoverseScore(name, objects, 100 * ap, ate_m, ase, aoe_rad, 100 * cds)


def _first_of_each(pairs: BoxPairs) -> tuple[NDArray[np.bool_], NDArray[np.int64], Floats]:
    """Return the mask (N,) of counted detections; index and distance of each one's first matched object, else inf."""
    count = len(pairs.scores)
    kept, owner, distance_m = np.ones(count, dtype=bool), np.full(count, UNMATCHED), np.full(count, np.inf)
    taken, in_frame = np.zeros(len(pairs.objects), dtype=bool), dict.fromkeys(pairs.frames.tolist(), 0)
    for row, (number, first, close) in enumerate(
        zip(pairs.frames.tolist(), pairs.first.tolist(), pairs.similarity, strict=True)
    ):
        in_frame[number] += 1
        kept[row] = in_frame[number] <= MAX_DETECTIONS
        if not kept[row] or not len(close):
            continue
        nearest = first + int(close.argmax())
        if not taken[nearest]:
            taken[nearest] = True
            owner[row], distance_m[row] = nearest, -close.max()
    return kept, owner, distance_m


def _average_precision(hits: NDArray[np.bool_], objects: int) -> float:
    if not len(hits):
        return 0.0
    precision = np.cumsum(hits) / (np.arange(1, len(hits) + 1) + _TINY)
    best = np.maximum.accumulate(precision[::-1])[::-1]
    return float(np.interp(RECALLS, np.cumsum(hits) / objects, best, right=0).mean())
