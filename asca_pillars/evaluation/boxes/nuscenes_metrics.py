"""nuScenes' detection metrics: AP by center distance, and the errors of true positives.

Definition: H. Caesar et al., "nuScenes: A Multimodal Dataset for Autonomous Driving", CVPR 2020, section 3.1, and its
devkit (1.1) for details:

- A detection matches by the distance of centers on the ground, below 0.5, 1, 2 and 4 m, as in `box_pairs`.
- Precision is sampled at the recalls 0, 0.01, ... 1, interpolated linearly, 0 beyond the highest recall. AP is the mean
  over the recalls above 0.1 of the precision above 0.1, divided by 0.9. The class' AP is the mean over the
  distances.
- Errors are those of the matches below 2 m: ATE distance of centers on the ground in m, ASE 1 - IoU of the aligned
  sizes, AOE smallest difference of yaw in rad. Their running mean over the matches, by descending score,
  is sampled at the scores of the recalls, and averaged over the achieved recalls above 0.1. If a recall of
  0.1 is not achieved, each error is 1.

Not included: velocity and attributes, hence NDS, which need more than a single scan; the range limits per
class and nuScenes' tolerance of half a turn for barriers.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from asca_pillars.evaluation.boxes.box_pairs import BANDS, BoxPairs, EvaluatedFrame, in_band, pair_class
from asca_pillars.geometry.boxes import Floats, wrap_angle

DISTANCES_M = (0.5, 1.0, 2.0, 4.0)
ERROR_DISTANCE_M = 2.0
RECALLS = np.linspace(0, 1, 101)
_FIRST = 11  # the first recall above the floor of 0.1, as in the devkit: its index is one beyond the floor's
_FLOOR = 0.1  # of precision


@dataclass(frozen=True)
class NuScenesScore:
    """Scores of one class: AP in percent, mean and by match distance, and errors; None without objects."""

    class_name: str
    band: str
    objects: int
    ap: float | None
    ap_by_distance: tuple[float, ...] | None
    ate_m: float | None
    ase: float | None
    aoe_rad: float | None


def nuscenes_scores(frames: Sequence[EvaluatedFrame], class_names: Sequence[str]) -> list[NuScenesScore]:
    """Compute a score for every class and band, in that order."""
    scores = []
    for name in class_names:
        pairs = pair_class(frames, name, lambda boxes, objects: -ground_distance(boxes, objects))
        matches = {limit_m: match_by_distance(pairs, limit_m) for limit_m in DISTANCES_M}
        scores += [_score(pairs, matches, name, band) for band in BANDS]
    return scores


def ground_distance(a: Floats, b: Floats) -> Floats:
    """Return distance of centers on the ground in m: (N, 7), (M, 7) -> (N, M)."""
    return np.hypot(a[:, None, 0] - b[None, :, 0], a[:, None, 1] - b[None, :, 1])


def match_by_distance(pairs: BoxPairs, limit_m: float) -> NDArray[np.int64]:
    """Return the index (N,) of the object matched to each detection at less than `limit_m`, or UNMATCHED."""
    return pairs.match(lambda similarity: -similarity < limit_m)


def match_errors(boxes: Floats, objects: Floats) -> Floats:
    """Return (K, 3) ground distance in m, 1 - IoU of the sizes and yaw difference in rad of K matches (K, 7)."""
    moved = np.hypot(boxes[:, 0] - objects[:, 0], boxes[:, 1] - objects[:, 1])
    turned = np.abs(wrap_angle(boxes[:, 6] - objects[:, 6]))
    return np.stack([moved, size_error(boxes, objects), turned], axis=1)


def size_error(boxes: Floats, objects: Floats) -> Floats:
    """Return 1 - IoU (K,) of boxes (K, 7) after alignment of centers and yaws."""
    shared = np.minimum(boxes[:, 3:6], objects[:, 3:6]).prod(axis=1)
    return 1 - shared / (boxes[:, 3:6].prod(axis=1) + objects[:, 3:6].prod(axis=1) - shared)


def _score(pairs: BoxPairs, matches: dict[float, NDArray[np.int64]], name: str, band: str) -> NuScenesScore:
    by_distance, errors, objects = [], (1.0, 1.0, 1.0), 0
    for limit_m, matched in matches.items():
        counted, hits, objects = in_band(pairs, matched, band)
        if not objects:
            return NuScenesScore(name, band, 0, None, None, None, None, None)
        counted_hits = hits[counted]
        precision = _at_recalls(counted_hits, np.cumsum(counted_hits) / np.arange(1, len(counted_hits) + 1), objects)
        by_distance.append(float(100 * np.maximum(precision[_FIRST:] - _FLOOR, 0).mean() / (1 - _FLOOR)))
        if limit_m == ERROR_DISTANCE_M:
            true = counted & hits
            matched_errors = match_errors(pairs.detections[true], pairs.objects[matched[true]])
            errors = _mean_errors(
                matched_errors, pairs.scores[true], _at_recalls(counted_hits, pairs.scores[counted], objects)
            )
    return NuScenesScore(name, band, objects, float(np.mean(by_distance)), tuple(by_distance), *errors)


def _at_recalls(hits: NDArray[np.bool_], values: Floats, objects: int) -> Floats:
    """Interpolate `values` of the detections (N,) at each recall: (101,); 0 beyond the highest."""
    if not hits.any():
        return np.zeros(len(RECALLS))
    return np.interp(RECALLS, np.cumsum(hits) / objects, values, right=0)


def _mean_errors(errors: Floats, scores: Floats, score_at_recall: Floats) -> tuple[float, float, float]:
    achieved = np.flatnonzero(score_at_recall)
    if not len(achieved) or achieved[-1] < _FIRST:
        return 1.0, 1.0, 1.0
    running = np.cumsum(errors, axis=0) / np.arange(1, len(errors) + 1)[:, None]
    ate, ase, aoe = (
        float(np.interp(score_at_recall, scores[::-1], column[::-1])[_FIRST : achieved[-1] + 1].mean())
        for column in running.T
    )
    return ate, ase, aoe
