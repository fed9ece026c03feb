"""Recall and precision at a fixed score, as for a detector run at its thresholds.

    recall = counted objects found / counted objects
    precision = true positives / (true positives + false positives)

An object is counted or, beyond a limit of the difficulty or of a neighboring type, ignored, as in KITTI (`objects`).
Each reported detection, by descending score, is matched to the free object of its class, counted or ignored, with
the largest overlap, if that is above the minimum. A matched object that is counted is found, and its detection is a
true positive.

An unmatched detection is a false positive unless it is ignored: lower in the image than the difficulty requires
(such objects need no label; nor do those outside the image, where detections have no 2D box), or with more than half
of its 2D box in one DontCare area. A detection that matches an ignored object is ignored too.

This differs from KITTI's AP, which ranks by score over the whole set: there each object selects a detection, an
object matched to a low detection (of any class) is neither found nor missed, DontCare areas apply in 2D only, and
objects outside a distance band are ignored.

Recall in 3D at easy, moderate and hard is reported in Table 2 of AV PV-RCNN (2023), without a score. A distance band
keeps the counted objects in it for the recall and the detections in it for the precision; it changes no match.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from math import inf, nan, sqrt
from typing import Any, Literal

import numpy as np

from asca_pillars.detection.targets import greedy_matches
from asca_pillars.evaluation.kitti.average_precision import min_overlap as kitti_min_overlap
from asca_pillars.evaluation.kitti.objects import (
    FrameObjects,
    Frames,
    KittiState,
    Pairs,
    detection_states,
    dont_care_shares,
    is_neighbor,
    is_type,
    overlapping_pairs,
    truth_states,
)
from asca_pillars.geometry.boxes import Mask

DONT_CARE_SHARE = 0.5  # of a detection's 2D box in one DontCare area; with more it is ignored


@dataclass(frozen=True, eq=False)
class ScoreMatches:
    """Matches of N objects and D detections at a score threshold.

    Attributes:
        frame_id: name of the frame; "" for all frames together.
        counted: (N,) counted objects.
        found: (N,) counted objects with a matched detection.
        reported: (D,) detections that reach the score.
        true_positive: (D,) reported detections that match a counted object.
        false_positive: (D,) reported detections that are unmatched and not ignored.
    """

    frame_id: str
    counted: Mask
    found: Mask
    reported: Mask
    true_positive: Mask
    false_positive: Mask

    @property
    def missed(self) -> Mask:
        """(N,) mask of the counted objects that were not found: the false negatives."""
        return self.counted & ~self.found

    @property
    def not_counted(self) -> Mask:
        """(N,) mask of the objects that are not counted."""
        return ~self.counted

    @property
    def ignored(self) -> Mask:
        """(D,) mask of the reported detections that are neither true nor false positives."""
        return self.reported & ~self.true_positive & ~self.false_positive

    @property
    def errors(self) -> int:
        """Number of missed objects and false positives."""
        return int(self.missed.sum() + self.false_positive.sum())


def matches_at_score(
    truth: Sequence[FrameObjects],
    detections: Sequence[FrameObjects],
    class_names: Sequence[str],
    *,
    scores: Mapping[str, float] | float,
) -> list[ScoreMatches]:
    """Return the matches of `operating_points`, frame by frame: all classes together, moderate, in 3D.

    Raises:
        ValueError: the frames differ, or `scores` lacks a class.
    """
    inputs = MatchInput.of(truth, detections, class_names, scores, None)
    classes = [match_class(inputs, name, "moderate", "3d") for name in class_names]
    starts = np.cumsum([0, *(len(frame) for frame in truth)])[:-1], inputs.frames.detection_starts[:-1]
    parts = [
        np.split(np.any([getattr(matches, name) for matches in classes], axis=0), starts[side])[1:]
        for name, side in (("counted", 0), ("found", 0), ("reported", 1), ("true_positive", 1), ("false_positive", 1))
    ]
    return [ScoreMatches(frame.frame_id, *masks) for frame, *masks in zip(truth, *parts, strict=True)]


@dataclass(frozen=True, eq=False)
class MatchInput:
    """All frames, and inputs independent of the difficulty: N objects and D detections, concatenated.

    Attributes:
        frames: all frames joined.
        pairs: pairs of objects and detections of one frame that overlap enough for some class.
        in_dont_care: (D,) detections in a DontCare area.
        scores: score threshold of every class.
        min_overlap: IoU that a match must exceed, of every class.

    Raises:
        ValueError: from `of`, if the frames differ, or `scores` or `min_overlap` lacks a class.
    """

    frames: Frames
    pairs: Pairs
    in_dont_care: Mask
    scores: Mapping[str, float]
    min_overlap: Mapping[str, float]

    @classmethod
    def of(
        cls,
        truth: Sequence[FrameObjects],
        detections: Sequence[FrameObjects],
        class_names: Sequence[str],
        scores: Mapping[str, float] | float,
        min_overlap: Mapping[str, float] | None,
    ) -> "MatchInput":
        """Compute overlaps and DontCare areas of the same frames in the same order; KITTI's minimum overlap if None."""
        if [frame.frame_id for frame in truth] != [frame.frame_id for frame in detections]:
            raise ValueError("ground truth and detections must be of the same frames, in the same order")
        if min_overlap is None:
            min_overlap = {name: kitti_min_overlap(name) for name in class_names}
        if not isinstance(scores, Mapping):
            scores = dict.fromkeys(class_names, float(scores))
        if missing := [name for name in class_names if name not in min_overlap or name not in scores]:
            raise ValueError(f"no score or no minimum overlap is given for {', '.join(missing)}")
        frames = Frames.join(truth, detections)
        related = [is_type(frames.truth, name) | is_neighbor(frames.truth, name) for name in class_names]
        lowest = min(min_overlap[name] for name in class_names)
        pairs = overlapping_pairs(frames, np.any(related, axis=0), lowest)
        return cls(frames, pairs, dont_care_shares(frames) > DONT_CARE_SHARE, scores, min_overlap)


def match_class(inputs: MatchInput, class_name: str, difficulty: str, metric: str) -> ScoreMatches:
    """Match one class over all frames.

    Args:
        inputs: N objects and D detections.
        difficulty: "easy", "moderate" or "hard".
        metric: "bev" or "3d", whose overlap is used.
    """
    objects, detections = inputs.frames.truth, inputs.frames.detections
    states = truth_states(objects, class_name, difficulty)
    reported = is_type(detections, class_name) & (detections.scores >= inputs.scores[class_name])
    pairs = inputs.pairs
    able = (states[pairs.truth] != KittiState.ABSENT) & reported[pairs.detection]
    pairs = pairs.where(able & (pairs.overlaps[metric] > inputs.min_overlap[class_name]))
    best = np.lexsort((-pairs.overlaps[metric], pairs.detection, -detections.scores[pairs.detection]))
    matched = best[greedy_matches(pairs.detection[best], pairs.truth[best])]

    counted = states == KittiState.COUNTED
    hits = matched[counted[pairs.truth[matched]]]
    found, true_positive = np.zeros_like(counted), np.zeros_like(reported)
    found[pairs.truth[hits]] = True
    true_positive[pairs.detection[hits]] = True
    low = detection_states(detections, class_name, difficulty) == KittiState.IGNORED
    false_positive = reported & ~low & ~inputs.in_dont_care
    false_positive[pairs.detection[matched]] = False
    return ScoreMatches("", counted, found, reported, true_positive, false_positive)


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
