"""Recall and precision of any class at a fixed score, and the score with the best F1."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from asca_pillars.evaluation.boxes.bands import BANDS, in_band
from asca_pillars.evaluation.boxes.box_pairs import UNMATCHED, EvaluatedFrame, pair_class
from asca_pillars.evaluation.boxes.nuscenes_metrics import ground_distance, match_by_distance

MATCH_M = 2.0


@dataclass(frozen=True)
class FixedScore:
    """Of one class in one band, by centers less than MATCH_M apart on the ground."""

    class_name: str
    score: float
    band: str
    objects: int
    found: int
    detections: int
    best_score: float | None
    """From which on detections have the best F1 (harmonic mean of recall and precision); None if nothing is found."""

    @property
    def recall(self) -> float | None:
        """None without objects."""
        return self.found / self.objects if self.objects else None

    @property
    def precision(self) -> float | None:
        """None without detections."""
        return self.found / self.detections if self.detections else None


def fixed_scores(
    frames: Sequence[EvaluatedFrame], class_names: Sequence[str], scores: Mapping[str, float]
) -> list[FixedScore]:
    """For every class and band the recall and precision of detections from the class' score on."""
    results = []
    for name in class_names:
        pairs = pair_class(frames, name, lambda found, objects: -ground_distance(found, objects))
        matched = match_by_distance(pairs, MATCH_M)
        excused = (matched == UNMATCHED) & (-pairs.excuse < MATCH_M)
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
