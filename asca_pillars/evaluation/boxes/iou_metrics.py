"""Metrics by IoU without a camera: AP in 3D and bird's-eye view (BEV), recall and precision at a fixed score."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from asca_pillars.evaluation.boxes.box_pairs import BANDS, UNMATCHED, BoxPairs, EvaluatedFrame, in_band, pair_class
from asca_pillars.evaluation.boxes.nuscenes_metrics import ground_distance, match_by_distance
from asca_pillars.geometry.overlap import bev_iou, iou_3d

Metric = Literal["3d", "bev"]

IOUS = (0.3, 0.5, 0.7)
_CLOSENESS = {"3d": iou_3d, "bev": bev_iou}


@dataclass(frozen=True)
class IouScore:
    """AP of one class in percent; None without objects."""

    class_name: str
    metric: Metric
    min_iou: float
    band: str
    objects: int
    ap: float | None


def iou_scores(frames: Sequence[EvaluatedFrame], class_names: Sequence[str]) -> list[IouScore]:
    """Compute the AP for every class, metric, IoU and band, in that order."""
    scores = []
    for name in class_names:
        metrics: tuple[Metric, ...] = ("3d", "bev")
        for metric in metrics:
            pairs = pair_class(frames, name, _CLOSENESS[metric])
            for least in IOUS:
                matched = match_by_iou(pairs, least)
                for band in BANDS:
                    counted, hits, objects = in_band(pairs, matched, band)
                    counted &= (matched != UNMATCHED) | (pairs.ignored_similarity < least)
                    ap = area_under_curve(hits[counted], objects)
                    scores.append(IouScore(name, metric, least, band, objects, ap))
    return scores


def match_by_iou(pairs: BoxPairs, least: float) -> NDArray[np.int64]:
    """Return the index (N,) of the object matched to each detection with an IoU of at least `least`, or UNMATCHED."""
    return pairs.match(lambda overlap: overlap >= least)


def area_under_curve(hits: NDArray[np.bool_], objects: int) -> float | None:
    """Compute the AP in percent of detections (N,) by descending score; None without objects."""
    if not objects:
        return None
    precision = np.cumsum(hits) / np.arange(1, len(hits) + 1)
    best = np.maximum.accumulate(precision[::-1])[::-1]
    return float(100 * best[hits].sum() / objects)


MATCH_M = 2.0


@dataclass(frozen=True)
class FixedScore:
    """Scores of one class in one band; centers less than MATCH_M apart on the ground match."""

    class_name: str
    score: float
    band: str
    objects: int
    found: int
    detections: int
    best_score: float | None
    """Score threshold with the best F1 (harmonic mean of recall and precision); None without a true positive."""

    @property
    def recall(self) -> float | None:
        """Recall; None without objects."""
        return self.found / self.objects if self.objects else None

    @property
    def precision(self) -> float | None:
        """Precision; None without detections."""
        return self.found / self.detections if self.detections else None


def fixed_scores(
    frames: Sequence[EvaluatedFrame], class_names: Sequence[str], scores: Mapping[str, float]
) -> list[FixedScore]:
    """Compute recall and precision at the class's score threshold, for every class and band."""
    results = []
    for name in class_names:
        pairs = pair_class(frames, name, lambda found, objects: -ground_distance(found, objects))
        matched = match_by_distance(pairs, MATCH_M)
        excused = (matched == UNMATCHED) & (-pairs.ignored_similarity < MATCH_M)
        for band in BANDS:
            counted, hits, objects = in_band(pairs, matched, band)
            counted &= ~excused
            true, all_ = np.cumsum(hits & counted), np.cumsum(counted)
            f1 = 2 * true / np.maximum(objects + all_, 1)
            f1[:-1][pairs.scores[:-1] == pairs.scores[1:]] = 0.0  # equal scores are reported together
            best = float(pairs.scores[f1.argmax()]) if f1.max(initial=0.0) > 0 else None
            reported = pairs.scores >= scores[name]
            found, detections = int((hits & counted & reported).sum()), int((counted & reported).sum())
            results.append(FixedScore(name, scores[name], band, objects, found, detections, best))
    return results
