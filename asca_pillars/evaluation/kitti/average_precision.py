"""Official KITTI object protocol: average precision in the image (2D), bird's-eye view (BEV) and 3D, and AOS.

Follows Geiger et al., "Are we ready for autonomous driving? The KITTI vision benchmark suite" (CVPR 2012), as the
official C++ tool computes it, with its 41 samples of recall:

- Ground truth and detections are counted, ignored or absent, per class and difficulty (`objects`).
- They match at an IoU *above* 0.7 (Car) or 0.5 (others), in 2D, BEV and 3D alike. A box's location is its bottom.
- Ground truth is processed in file order. The first pass, by score, gives the scores at which recall is
  nearest to 0, 1/40 ... 1; the second, by overlap, counts at each of these scores.
- Counted detections that are not assigned are false positives; in 2D only, not if more than the same 0.7 or 0.5 of
  one is in a DontCare area. These areas have no 3D box, so detections in them are false in BEV and 3D.
- Precision at each threshold's index is replaced by the maximum of itself and all later ones. R11 is the mean of
  entries 0, 4 .. 40, R40 (Simonelli et al., "Disentangling monocular 3D object detection", ICCV 2019) of 1 .. 40.
- AOS is the same in 2D with (1 + cos(difference of alpha)) / 2 for each true positive.

Results that the tool does not evaluate are absent rather than 0: a class in 2D unless a detection of it has x1 >= 0,
in BEV unless one has x != -1000, in 3D unless one has y != -1000; AOS if any detection at all has alpha -10.

Detections are assigned for all frames and all score thresholds at once: each object is matched to the best free
detection, which is sequential within a frame, but frames and thresholds are independent. So the first round matches the
first object of every frame at every threshold, the next round the second ones; the number of rounds is the largest
number of objects with a candidate in a frame.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise, product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.progress import SILENT, Reporter
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
from asca_pillars.geometry.boxes import Floats, Ints, Mask


class ClassStates(NamedTuple):
    """States of the objects of all frames at one class, difficulty and distance band.

    Attributes:
        truth_states: (N,) `KittiState` of the ground truth.
        detection_states: (D,) `KittiState` of the detections.
        scores: (D,) scores of the detections, any monotonic measure.
        in_dont_care: (D,) detections that are not false positives even if unmatched.
    """

    truth_states: NDArray[np.int8]
    detection_states: NDArray[np.int8]
    scores: Floats
    in_dont_care: Mask


@dataclass(frozen=True, eq=False)
class Counts:
    """True and false positives and missed objects at each of T score thresholds.

    Attributes:
        counted: number of counted objects.
        matched: number of those that the first pass matched with a counted detection.
        thresholds: (T,) scores, descending; T <= 41.
        tp, fp, fn: (T,).
        similarity: (T,) sum of the true positives' similarities passed to `count`.
    """

    counted: int
    matched: int
    thresholds: Floats
    tp: Ints
    fp: Ints
    fn: Ints
    similarity: Floats


def count(pairs: Pairs, metric: str, states: ClassStates, similarity: Floats, recall_steps: int) -> Counts:
    """Compute score thresholds at even steps of recall, then the counts at each of them: the protocol's two passes.

    Args:
        pairs: pairs that overlap enough for the class.
        metric: metric whose overlap is used in the second pass.
        similarity: (P,) orientation similarity of each pair.
        recall_steps: number of steps of recall from 0 to 1.
    """
    truth_states, detection_states = states.truth_states[pairs.truth], states.detection_states[pairs.detection]
    present = (truth_states != KittiState.ABSENT) & (detection_states != KittiState.ABSENT)
    pairs, similarity = pairs.where(present), similarity[present]
    truth_counted = truth_states[present] == KittiState.COUNTED
    detection_counted = detection_states[present] == KittiState.COUNTED
    true = truth_counted & detection_counted
    scores = states.scores[pairs.detection]

    # First pass: the highest score wins, the earlier line of the file among equals.
    best = np.lexsort((pairs.detection, -scores, pairs.truth))
    taken = assign(pairs, best, np.ones((len(scores), 1), dtype=bool))[:, 0]
    counted = int((states.truth_states == KittiState.COUNTED).sum())
    thresholds = score_thresholds(scores[taken & true], counted, recall_steps)

    # Second pass: the largest overlap among counted detections wins; an ignored one is used only without those.
    overlaps = np.where(detection_counted, pairs.overlaps[metric], 0.0)
    best = np.lexsort((pairs.detection, -overlaps, ~detection_counted, pairs.truth))
    found = assign(pairs, best, scores[:, None] >= thresholds)

    alone = (states.detection_states == KittiState.COUNTED) & ~states.in_dont_care
    reported = alone.sum() - np.searchsorted(np.sort(states.scores[alone]), thresholds)
    return Counts(
        counted=counted,
        matched=int((taken & true).sum()),
        thresholds=thresholds,
        tp=found[true].sum(axis=0),
        fp=reported - found[alone[pairs.detection]].sum(axis=0),
        fn=counted - found[truth_counted].sum(axis=0),
        similarity=_sums(found[true], similarity[true]),
    )


def assign(pairs: Pairs, best: Ints, candidates: Mask) -> Mask:
    """Let each ground truth in turn take the first candidate in its order of preference that is still free.

    Args:
        pairs: P pairs.
        best: (P,) indices of the pairs in order: by ground truth, for each of them the preferred detections first.
        candidates: (P, T) mask of the pairs that may be matched, in each of T separate assignments.

    Returns:
        (P, T) mask of the pairs that are matched.
    """
    found = np.zeros_like(candidates)
    _, detection = np.unique(pairs.detection, return_inverse=True)
    used = np.zeros((detection.max(initial=-1) + 1, candidates.shape[1]), dtype=bool)
    for rows, starts in _rounds(pairs.truth[best], pairs.frame[best]):
        chosen = best[rows]
        free = candidates[chosen] & ~used[detection[chosen]]
        first = _first_true(free, starts)
        found[chosen] = first
        # A round has one object per frame, so that no detection occurs twice here.
        used[detection[chosen]] |= first
    return found


def score_thresholds(scores: Floats, counted: int, recall_steps: int) -> Floats:
    """Return the scores at which recall is nearest to 0, 1 / recall_steps, 2 / recall_steps ...; descending.

    Args:
        scores: (S,) scores of the matched objects, in any order.
        counted: number of objects at recall 1, >= S.
    """
    ranked = np.sort(scores)[::-1]
    chosen: list[float] = []
    recall = 0.0
    for index, score in enumerate(ranked.tolist(), start=1):
        # The next score is nearer to the wanted recall than this one; the last score has no next.
        if index < len(ranked) and (index + 1) / counted - recall < recall - index / counted:
            continue
        chosen.append(score)
        recall += 1 / recall_steps
    return np.array(chosen, dtype=np.float64)


def _rounds(truth: Ints, frame: Ints) -> Iterator[tuple[Ints, Ints]]:
    """Yield the rows of each round, and the start of each ground truth's rows in them.

    Round k holds the k-th ground truth of every frame. `truth` and `frame` ascend: (P,), (P,).
    """
    starts = np.flatnonzero(np.diff(truth, prepend=-1))
    lengths = np.diff(starts, append=len(truth))
    frame_starts = np.flatnonzero(np.diff(frame[starts], prepend=-1))
    turns = np.arange(len(starts)) - np.repeat(frame_starts, np.diff(frame_starts, append=len(starts)))
    row_turns = np.repeat(turns, lengths)
    rows = np.argsort(row_turns, kind="stable")
    cuts = np.searchsorted(row_turns[rows], np.arange(turns.max(initial=-1) + 2))
    for turn, (low, high) in enumerate(pairwise(cuts)):
        sizes = lengths[turns == turn]
        yield rows[low:high], np.cumsum(sizes) - sizes


def _first_true(mask: Mask, starts: Ints) -> Mask:
    """Mark the first true row of each run of rows, in every column: (R, T), starts of the G runs (G,) -> (R, T)."""
    row = np.arange(len(mask), dtype=np.int32)[:, None]
    place = np.where(mask, row, np.int32(len(mask)))
    first = np.minimum.reduceat(place, starts, axis=0)
    matched: Mask = row == np.repeat(first, np.diff(starts, append=len(mask)), axis=0)
    return matched


def _sums(mask: Mask, values: Floats) -> Floats:
    """Sum of the values (P,) that each column of the mask (P, T) chooses: (T,)."""
    rows, columns = np.nonzero(mask)
    sums: Floats = np.bincount(columns, weights=values[rows], minlength=mask.shape[1]).astype(np.float64)
    return sums


CLASS_NAMES = ("Car", "Pedestrian", "Cyclist")
DIFFICULTIES = ("easy", "moderate", "hard")
METRICS = ("bbox", "bev", "3d", "aos")
MIN_OVERLAP: Mapping[str, float] = {"car": 0.7}
OTHER_MIN_OVERLAP = 0.5  # Pedestrian, Cyclist, and classes that KITTI does not evaluate

_RECALL_STEPS = 40
_UNKNOWN_M, _UNKNOWN_ALPHA = -1000.0, -10.0

_Doubles = NDArray[np.float64]
_Indices = NDArray[np.int64]
_Band = tuple[float, float]


@dataclass(frozen=True, eq=False)
class Curve:
    """Precision over recall of one class, metric and difficulty.

    Attributes:
        class_name, metric, difficulty: `metric` is one of METRICS, `difficulty` one of DIFFICULTIES.
        precision: (41,) fractions at recall 0, 1/40 .. 1, each the maximum of itself and all later ones; for "aos"
            the orientation similarity instead.
        counted: number of counted objects.
        matched: number of these with a counted detection.
        thresholds: (T,) scores, descending; T <= 41.
        tp, fp, fn: (T,) true and false positives and missed objects at these scores.
    """

    class_name: str
    metric: str
    difficulty: str
    precision: _Doubles
    counted: int
    matched: int
    thresholds: _Doubles
    tp: _Indices
    fp: _Indices
    fn: _Indices

    @property
    def r11(self) -> float:
        """Average precision in percent over recall 0, 0.1 .. 1, as the official tool prints it."""
        return 100 * float(self.precision[::4].mean())

    @property
    def r40(self) -> float:
        """Average precision in percent over recall 1/40 .. 1, as KITTI's leader board has it since 2019."""
        return 100 * float(self.precision[1:].mean())

    @property
    def r11_cap(self) -> float:
        """R11 of a perfect detector: below 100 if 40 objects or fewer are counted."""
        return 100 * min(-(-self.counted // 4), 11) / 11

    @property
    def r40_cap(self) -> float:
        """R40 of a perfect detector: below 100 if 40 objects or fewer are counted."""
        return 100 * min(max(self.counted - 1, 0), _RECALL_STEPS) / _RECALL_STEPS


@dataclass(frozen=True, eq=False)
class KittiResults:
    """Results of the protocol for a set of frames.

    Attributes:
        curves: by class name, metric and difficulty; absent if the official tool does not evaluate it.
        class_names: requested classes.
        frames: number of evaluated frames.
    """

    curves: dict[tuple[str, str, str], Curve]
    class_names: tuple[str, ...]
    frames: int

    def curve(self, class_name: str, metric: str, difficulty: str) -> Curve | None:
        """Return one curve, or None if the official tool does not evaluate it."""
        return self.curves.get((class_name, metric, difficulty))

    def mean_ap(self, metric: str, difficulty: str) -> float | None:
        """Return the mean R40 in percent over evaluated classes with counted objects; None without such a class."""
        curves = [self.curve(name, metric, difficulty) for name in self.class_names]
        values = [curve.r40 for curve in curves if curve is not None and curve.counted]
        return float(np.mean(values)) if values else None

    def to_json(self) -> dict[str, Any]:
        """Return plain values: class -> metric -> None if not evaluated, else R11, R40 (percent), precision and counts.

        R11 and R40 list easy, moderate and hard; precision and counts are by difficulty.
        """
        return {name: {metric: self._metric_json(name, metric) for metric in METRICS} for name in self.class_names}

    def _metric_json(self, class_name: str, metric: str) -> dict[str, Any] | None:
        curves = [curve for d in DIFFICULTIES if (curve := self.curve(class_name, metric, d)) is not None]
        if not curves:
            return None
        return {
            "R11": [curve.r11 for curve in curves],
            "R40": [curve.r40 for curve in curves],
            "precision": {curve.difficulty: curve.precision.tolist() for curve in curves},
            "counts": {
                curve.difficulty: {
                    "n_gt": curve.counted,
                    "n_tp_scores": curve.matched,
                    **{name: getattr(curve, name).tolist() for name in ("thresholds", "tp", "fp", "fn")},
                }
                for curve in curves
            },
        }


@dataclass(frozen=True, eq=False)
class KittiEvaluation:
    """Results over all frames, and in each distance band [low, high) in metres."""

    overall: KittiResults
    bands: dict[_Band, KittiResults]


def min_overlap(class_name: str) -> float:
    """Return the IoU above which a detection of the class matches: 0.7 for Car, 0.5 for every other class."""
    return MIN_OVERLAP.get(class_name.casefold(), OTHER_MIN_OVERLAP)


def evaluate(
    truth: Sequence[FrameObjects],
    detections: Sequence[FrameObjects],
    class_names: Sequence[str] = CLASS_NAMES,
    *,
    bands_m: Sequence[_Band] = (),
    reporter: Reporter = SILENT,
) -> KittiEvaluation:
    """Evaluate detections by the protocol above.

    Distance bands are not in the official protocol: there ground truth and detections of the class whose
    horizontal distance from the camera sqrt(x^2 + z^2) is outside [low, high) are ignored. A pair across the border
    is then neither true nor false, nor is its object missed. Detections without a 3D box are outside every band.

    Args:
        truth: labels of each frame, including DontCare areas and classes that are not evaluated.
        detections: detections of the same frames in the same order. The official tool skips frames without a file; a
            frame without detections has an empty one.
        class_names: compared without case.
        bands_m: distance bands (low, high) in metres to evaluate in addition.
        reporter: for the progress.

    Raises:
        ValueError: the two are not of the same frames, in the same order.
    """
    if [frame.frame_id for frame in truth] != [frame.frame_id for frame in detections]:
        raise ValueError("ground truth and detections must be of the same frames, in the same order")
    frames = Frames.join(truth, detections)
    related = [is_type(frames.truth, name) | is_neighbor(frames.truth, name) for name in class_names]
    lowest = min((min_overlap(name) for name in class_names), default=OTHER_MIN_OVERLAP)
    pairs = overlapping_pairs(frames, np.any(related, axis=0), lowest, reporter=reporter)
    dont_care = dont_care_shares(frames)

    bands: list[_Band | None] = [None, *bands_m]
    curves: dict[_Band | None, dict[tuple[str, str, str], Curve]] = {band: {} for band in bands}
    steps = list(product(zip(class_names, related, strict=True), DIFFICULTIES))
    for (name, mine), difficulty in reporter.track(steps, "Matching"):
        own_pairs = pairs.where(mine[pairs.truth])
        for band in bands:
            of_band = _curves(frames, own_pairs, dont_care, name, difficulty, band)
            curves[band] |= {(name, curve.metric, difficulty): curve for curve in of_band}
    overall, *banded = (KittiResults(curves[band], tuple(class_names), len(truth)) for band in bands)
    return KittiEvaluation(overall, dict(zip(bands_m, banded, strict=True)))


def _curves(
    frames: Frames, pairs: Pairs, dont_care: _Doubles, class_name: str, difficulty: str, band: _Band | None
) -> Iterator[Curve]:
    """Yield the curves of one class and difficulty in every evaluated metric."""
    truth, detections = frames.truth, frames.detections
    minimum = min_overlap(class_name)
    states = ClassStates(
        truth_states(truth, class_name, difficulty, band),
        detection_states(detections, class_name, difficulty, band),
        detections.scores,
        in_dont_care=dont_care > minimum,
    )
    no_dontcare = states._replace(in_dont_care=np.zeros_like(states.in_dont_care))
    similarity = (1 + np.cos(truth.alpha[pairs.truth] - detections.alpha[pairs.detection])) / 2
    of_class = is_type(detections, class_name)
    for metric, known, metric_states in (
        ("bbox", detections.bbox[:, 0] >= 0, states),
        ("bev", detections.locations[:, 0] != _UNKNOWN_M, no_dontcare),
        ("3d", detections.locations[:, 1] != _UNKNOWN_M, no_dontcare),
    ):
        if (of_class & known).any():
            enough = pairs.overlaps[metric] > minimum
            counts = count(pairs.where(enough), metric, metric_states, similarity[enough], _RECALL_STEPS)
            yield _curve(class_name, metric, difficulty, counts, counts.tp)
            if metric == "bbox" and not (detections.alpha == _UNKNOWN_ALPHA).any():
                yield _curve(class_name, "aos", difficulty, counts, counts.similarity)


def _curve(class_name: str, metric: str, difficulty: str, counts: Counts, gains: NDArray[Any]) -> Curve:
    """Return the curve of `gains` over the detections reported at each threshold."""
    reported = counts.tp + counts.fp
    precision = np.zeros(_RECALL_STEPS + 1)
    # The official tool divides 0 by 0 in the rare case that all detections at a threshold match ignored objects.
    precision[: len(gains)] = gains / np.maximum(reported, 1)
    precision = np.maximum.accumulate(precision[::-1])[::-1]
    fields = (counts.counted, counts.matched, counts.thresholds, counts.tp, counts.fp, counts.fn)
    return Curve(class_name, metric, difficulty, precision, *fields)
