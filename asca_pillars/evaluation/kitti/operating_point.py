"""Recall and precision at a fixed score, as for a detector run at its thresholds.

    recall = counted objects found / counted objects
    precision = true positives / (true positives + false positives)

`score_threshold` defines counting and matching, and the differences to KITTI's AP. Recall in 3D at
easy, moderate and hard is reported in Table 2 of AV PV-RCNN (2023), without a score. A distance band keeps the
counted objects in it for the recall and the detections in it for the precision; it changes no match.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from math import inf, nan, sqrt
from typing import Any, Literal

import numpy as np

from asca_pillars.evaluation.kitti.objects import FrameObjects
from asca_pillars.evaluation.kitti.pairs import Frames
from asca_pillars.evaluation.kitti.score_threshold import MatchInput, ScoreMatches, match_class

Z_95 = 1.959964  # quantile of the standard normal distribution, 2.5 % above

_Band = tuple[float, float]


@dataclass(frozen=True)
class OperatingPoint:
    """Recall and precision of one class at one score, with Wilson's 95 % intervals; NaN for 0 / 0.

    Attributes:
        min_overlap: IoU that a true positive must exceed.
        metric: "bev" or "3d".
        band_m: (low, high) of the horizontal distance from the camera in metres, or None for all.
        objects: counted objects in the band.
        found: number of found objects.
        detections: true and false positives in the band.
        true_positives: number of those that match a counted object.
        ignored: other detections in the band.
    """

    class_name: str
    score: float
    min_overlap: float
    metric: str
    difficulty: str
    band_m: _Band | None
    objects: int
    found: int
    recall: float
    recall_interval: tuple[float, float]
    detections: int
    true_positives: int
    precision: float
    precision_interval: tuple[float, float]
    ignored: int


def operating_points(
    truth: Sequence[FrameObjects],
    detections: Sequence[FrameObjects],
    class_names: Sequence[str],
    *,
    scores: Mapping[str, float] | float,
    min_overlap: Mapping[str, float] | None = None,
    metric: Literal["bev", "3d"] = "3d",
    difficulties: Sequence[str] = ("moderate",),
    bands_m: Sequence[_Band] = (),
) -> list[OperatingPoint]:
    """Compute recall and precision for every class, difficulty and band, in that order; the band None comes first.

    Args:
        truth: labels of each frame.
        detections: detections of the same frames, in the same order.
        scores: the score threshold for every class or the same for all.
        min_overlap: IoU that a true positive must exceed, for every class; KITTI's if None.
        bands_m: distance bands to report in addition to the whole.

    Raises:
        ValueError: the frames differ, or `scores` or `min_overlap` lacks a class.
    """
    inputs = MatchInput.of(truth, detections, class_names, scores, min_overlap)
    points = []
    for name, difficulty in product(class_names, difficulties):
        matches = match_class(inputs, name, difficulty, metric)
        for band in (None, *bands_m):
            what = (name, inputs.scores[name], inputs.min_overlap[name], metric, difficulty, band)
            points.append(OperatingPoint(*what, *_shares(matches, inputs.frames, band)))
    return points


def best_scores(
    truth: Sequence[FrameObjects],
    detections: Sequence[FrameObjects],
    class_names: Sequence[str],
    *,
    min_overlap: Mapping[str, float] | None = None,
    metric: Literal["bev", "3d"] = "3d",
    difficulty: str = "moderate",
) -> dict[str, float]:
    """Return the score threshold of every class with the highest F1, the harmonic mean of recall and precision.

    A class without a true positive is absent. Arguments and errors as for `operating_points`.
    """
    # A detection's match depends only on those of higher scores: one pass over all of them serves every threshold.
    inputs = MatchInput.of(truth, detections, class_names, -inf, min_overlap)
    best = {}
    for name in class_names:
        matches = match_class(inputs, name, difficulty, metric)
        order = np.argsort(-inputs.frames.detections.scores, kind="stable")
        scores = inputs.frames.detections.scores[order]
        true, false = np.cumsum(matches.true_positive[order]), np.cumsum(matches.false_positive[order])
        f1 = 2 * true / np.maximum(matches.counted.sum() + true + false, 1)
        f1[:-1][scores[:-1] == scores[1:]] = 0.0  # equal scores are reported together
        if f1.max(initial=0.0) > 0:
            best[name] = float(scores[f1.argmax()])
    return best


def wilson_interval(hits: int, trials: int) -> tuple[float, float]:
    """Compute Wilson's score interval: shares whose 95 % range contains `hits` of `trials`; (0, 1) without trials."""
    if not trials:
        return 0.0, 1.0
    share, slack = hits / trials, Z_95**2 / trials
    center = (share + slack / 2) / (1 + slack)
    reach = sqrt(slack * (share * (1 - share) + slack / 4)) / (1 + slack)
    # Without min and max, rounding would give 0 of n a limit just above 0, and n of n one just below 1.
    return max(min(center - reach, share), 0.0), min(max(center + reach, share), 1.0)


def _shares(matches: ScoreMatches, frames: Frames, band_m: _Band | None) -> tuple[Any, ...]:
    """Return the counts and shares of an operating point, in the order of its fields."""
    low, high = (0.0, inf) if band_m is None else band_m
    objects, found, true, false, ignored = (
        int((mask & (low <= items.distances_m) & (items.distances_m < high)).sum())
        for mask, items in (
            (matches.counted, frames.truth),
            (matches.found, frames.truth),
            (matches.true_positive, frames.detections),
            (matches.false_positive, frames.detections),
            (matches.ignored, frames.detections),
        )
    )
    detections = true + false
    return (
        *(objects, found, found / objects if objects else nan, wilson_interval(found, objects)),
        *(detections, true, true / detections if detections else nan, wilson_interval(true, detections)),
        ignored,
    )
