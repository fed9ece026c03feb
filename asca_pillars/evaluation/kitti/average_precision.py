"""Official KITTI object protocol: average precision in the image (2D), bird's-eye view (BEV) and 3D, and AOS.

Follows Geiger et al., "Are we ready for autonomous driving? The KITTI vision benchmark suite" (CVPR 2012), as the
official C++ tool computes it, with its 41 samples of recall:

- Ground truth and detections are counted, ignored or absent, per class and difficulty (`states`).
- They match at an IoU *above* 0.7 (Car) or 0.5 (others), in 2D, BEV and 3D alike. A box's location is its bottom.
- Ground truth is processed in file order (`matching`). The first pass, by score, gives the scores at which recall is
  nearest to 0, 1/40 ... 1; the second, by overlap, counts at each of these scores.
- Counted detections that are not assigned are false positives; in 2D only, not if more than the same 0.7 or 0.5 of
  one is in a DontCare area. These areas have no 3D box, so detections in them are false in BEV and 3D.
- Precision at each threshold's index is replaced by the maximum of itself and all later ones. R11 is the mean of
  entries 0, 4 .. 40, R40 (Simonelli et al., "Disentangling monocular 3D object detection", ICCV 2019) of 1 .. 40.
- AOS is the same in 2D with (1 + cos(difference of alpha)) / 2 for each true positive.

Results that the tool does not evaluate are absent rather than 0: a class in 2D unless a detection of it has x1 >= 0,
in BEV unless one has x != -1000, in 3D unless one has y != -1000; AOS if any detection at all has alpha -10.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.progress import SILENT, Reporter
from asca_pillars.evaluation.kitti.matching import ClassStates, Counts, count
from asca_pillars.evaluation.kitti.objects import FrameObjects, detection_states, is_neighbor, is_type, truth_states
from asca_pillars.evaluation.kitti.pairs import Frames, Pairs, dont_care_shares, overlapping_pairs

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
            found = _curves(frames, own_pairs, dont_care, name, difficulty, band)
            curves[band] |= {(name, curve.metric, difficulty): curve for curve in found}
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
    own = is_type(detections, class_name)
    for metric, known, metric_states in (
        ("bbox", detections.bbox[:, 0] >= 0, states),
        ("bev", detections.locations[:, 0] != _UNKNOWN_M, no_dontcare),
        ("3d", detections.locations[:, 1] != _UNKNOWN_M, no_dontcare),
    ):
        if (own & known).any():
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
