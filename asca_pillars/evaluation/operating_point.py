"""Recall and precision at a fixed score: what somebody who runs the detector at its thresholds gets.

    recall = counted objects found / counted objects
    precision = detections that found a counted object / those and the false ones

`verdicts` says what is counted, found, true and false, and how that departs from KITTI's AP. A distance band keeps the
counted objects in it for the recall and the detections in it for the precision; it changes no match.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from math import inf, nan, sqrt
from typing import Any, Literal

import numpy as np

from asca_pillars.evaluation.kitti.average_precision import DIFFICULTIES
from asca_pillars.evaluation.kitti.objects import FrameObjects
from asca_pillars.evaluation.kitti.pairs import Frames
from asca_pillars.evaluation.kitti.verdicts import Scene, Verdict, judge

Z_95 = 1.959964  # what a standard normal variable exceeds in 2.5 % of all cases

_Band = tuple[float, float]


@dataclass(frozen=True)
class OperatingPoint:
    """Recall and precision of one class at one score, with Wilson's 95 % intervals; NaN is a share of nothing.

    Attributes:
        min_overlap: intersection over union that a find must exceed.
        metric: "bev" or "3d".
        band_m: (low, high) of the horizontal distance from the camera in metres, or None for all.
        objects: counted objects in the band, and
        found: how many of them were found.
        detections: detections in the band that are true or false, and
        true: how many of them found a counted object.
        excused: detections in the band that are neither true nor false.
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
    true: int
    precision: float
    precision_interval: tuple[float, float]
    excused: int


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
    """Recall and precision for every class, difficulty and band, in that order; the band None comes first.

    Args:
        truth: labels of each frame.
        detections: of the same frames, in the same order.
        scores: the least score of a detection, for every class or the same for all.
        min_overlap: intersection over union that a find must exceed, for every class; KITTI's if None.
        bands_m: distance bands to report beside the whole.

    Raises:
        ValueError: the frames differ, or `scores` or `min_overlap` lacks a class.
    """
    scene = Scene.of(truth, detections, class_names, scores, min_overlap)
    points = []
    for name, difficulty in product(class_names, difficulties):
        verdict = judge(scene, name, difficulty, metric)
        for band in (None, *bands_m):
            what = (name, scene.scores[name], scene.min_overlap[name], metric, difficulty, band)
            points.append(OperatingPoint(*what, *_shares(verdict, scene.frames, band)))
    return points


def recall_table(
    truth: Sequence[FrameObjects],
    detections: Sequence[FrameObjects],
    class_names: Sequence[str],
    *,
    scores: Mapping[str, float] | float,
) -> list[OperatingPoint]:
    """Table 2 of AV PV-RCNN (2023): for every class the recall at easy, moderate and hard, in 3D.

    A find takes an IoU above KITTI's 0.7 for cars and 0.5 for pedestrians and cyclists. The paper names no score: say
    beside the table which one it was made at.
    """
    return operating_points(truth, detections, class_names, scores=scores, difficulties=DIFFICULTIES)


def best_scores(
    truth: Sequence[FrameObjects],
    detections: Sequence[FrameObjects],
    class_names: Sequence[str],
    *,
    min_overlap: Mapping[str, float] | None = None,
    metric: Literal["bev", "3d"] = "3d",
    difficulty: str = "moderate",
) -> dict[str, float]:
    """For every class the score with the highest F1, the harmonic mean of recall and precision.

    A class of which nothing was found is absent. Arguments and errors as for `operating_points`.
    """
    # A detection's verdict depends on better ones alone: one pass over all of them serves every score.
    scene = Scene.of(truth, detections, class_names, -inf, min_overlap)
    best = {}
    for name in class_names:
        verdict = judge(scene, name, difficulty, metric)
        order = np.argsort(-scene.frames.detections.scores, kind="stable")
        scores = scene.frames.detections.scores[order]
        true, false = np.cumsum(verdict.true[order]), np.cumsum(verdict.false[order])
        f1 = 2 * true / np.maximum(verdict.counted.sum() + true + false, 1)
        f1[:-1][scores[:-1] == scores[1:]] = 0.0  # equal scores are reported together
        if f1.max(initial=0.0) > 0:
            best[name] = float(scores[f1.argmax()])
    return best


def wilson_interval(hits: int, trials: int) -> tuple[float, float]:
    """Wilson's score interval: the shares whose 95 % range holds `hits` of `trials`; (0, 1) without trials."""
    if not trials:
        return 0.0, 1.0
    share, slack = hits / trials, Z_95**2 / trials
    center = (share + slack / 2) / (1 + slack)
    reach = sqrt(slack * (share * (1 - share) + slack / 4)) / (1 + slack)
    # Rounding would leave 0 of n just above 0, and n of n just below 1.
    return max(min(center - reach, share), 0.0), min(max(center + reach, share), 1.0)


def _shares(verdict: Verdict, frames: Frames, band_m: _Band | None) -> tuple[Any, ...]:
    """The counts and shares of an operating point, in its order."""
    low, high = (0.0, inf) if band_m is None else band_m
    objects, found, true, false, excused = (
        int((mask & (low <= items.distances_m) & (items.distances_m < high)).sum())
        for mask, items in (
            (verdict.counted, frames.truth),
            (verdict.found, frames.truth),
            (verdict.true, frames.detections),
            (verdict.false, frames.detections),
            (verdict.excused, frames.detections),
        )
    )
    judged = true + false
    return (
        *(objects, found, found / objects if objects else nan, wilson_interval(found, objects)),
        *(judged, true, true / judged if judged else nan, wilson_interval(true, judged)),
        excused,
    )
