"""Tracking metrics: HOTA (Luiten et al., IJCV 129, 2021) and CLEAR MOT (Bernardin, Stiefelhagen, EURASIP JIVP 2008)."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from asca_pillars.detection.targets import UNMATCHED, best_assignments
from asca_pillars.geometry.boxes import Floats, Ints, Mask, Singles
from asca_pillars.geometry.overlap import iou_3d

IGNORED_IOU = 0.25
"""Least overlap by which a box that matches an uncounted label is not counted either."""


class TrackedFrame(NamedTuple):
    """One class in one frame: M labelled and N predicted identities, each unique."""

    objects: Ints
    """(M,) labelled identities."""
    detections: Ints
    """(N,) predicted identities."""
    similarity: Floats
    """(M, N) in 0..1: 3D IoU."""


class Boxes(NamedTuple):
    """K boxes of one class in one frame, with their identities."""

    boxes: Singles
    """(K, 7), LiDAR frame."""
    ids: Ints
    """(K,)."""


def tracked_frame(labels: Boxes, counted: Mask, detections: Boxes) -> TrackedFrame:
    """Compare the boxes of a frame, without labels that are not counted and without the boxes that found those.

    Args:
        labels: M of one class.
        counted: (M,) mask; False for objects of which a detector cannot be asked, hidden or out of its reach.
        detections: N of the same class.
    """
    similarity = iou_3d(labels.boxes, detections.boxes)
    holders = best_assignments(np.where(similarity >= IGNORED_IOU, similarity, 0.0).T)[-1]
    of_ignored = holders[~counted & (holders != UNMATCHED)]
    kept = np.ones(len(detections.ids), bool)
    kept[of_ignored] = False
    return TrackedFrame(labels.ids[counted], detections.ids[kept], similarity[np.ix_(counted, kept)])


def counts_of_ids(frames: Sequence[TrackedFrame]) -> tuple[dict[int, int], dict[int, int]]:
    """Count the frames of each labelled and each predicted identity."""
    counts: tuple[dict[int, int], dict[int, int]] = ({}, {})
    for frame in frames:
        for count, ids in zip(counts, (frame.objects, frame.detections), strict=True):
            for number in ids.tolist():
                count[number] = count.get(number, 0) + 1
    return counts


Pair = tuple[int, int]

ALPHAS = np.arange(1, 20) / 20
_EPSILON = 1e-3  # of the paper's matching score: ranks the three criteria
_ROUNDING = 1e-9  # tolerance of similarities at a threshold


class Hota(NamedTuple):
    """Means over ALPHAS, 0 to 1; NaN without labels and boxes."""

    hota: float
    det_a: float
    ass_a: float
    loc_a: float


def hota(sequences: Sequence[Sequence[TrackedFrame]]) -> Hota:
    """Compute HOTA of one class over several sequences with independent identities."""
    numbered = [_renumbered(frames, index) for index, frames in enumerate(sequences)]
    frames = [frame for sequence in numbered for frame in sequence]
    objects, detections = counts_of_ids(frames)
    if not objects and not detections:
        return Hota(*[float("nan")] * 4)
    scores = np.array([_at(alpha, frames, objects, detections) for alpha in ALPHAS])
    return Hota(*scores.mean(axis=0).tolist())


def _at(
    alpha: float, frames: Sequence[TrackedFrame], objects: dict[int, int], detections: dict[int, int]
) -> tuple[float, float, float, float]:
    """Compute HOTA, DetA, AssA and LocA at one threshold."""
    could_match = _pairs(frames, [frame.similarity >= alpha - _ROUNDING for frame in frames])
    association = {pair: _association(pair, count, objects, detections) for pair, count in could_match.items()}
    matched: list[Mask] = []
    similarities = 0.0
    for frame in frames:
        allowed = frame.similarity >= alpha - _ROUNDING
        score = np.zeros(frame.similarity.shape)
        for row, column in zip(*np.nonzero(allowed), strict=True):
            pair = int(frame.objects[row]), int(frame.detections[column])
            score[row, column] = 1 / _EPSILON + association[pair] + _EPSILON * frame.similarity[row, column]
        holders = best_assignments(score)[-1]
        mask = np.zeros(score.shape, bool)
        held = np.flatnonzero(holders != UNMATCHED)
        mask[holders[held], held] = True
        matched.append(mask)
        similarities += float(frame.similarity[mask].sum())
    counts = _pairs(frames, matched)
    tp = sum(counts.values())
    everything = sum(objects.values()) + sum(detections.values()) - tp  # TP + FN + FP
    total = sum(count * _association(pair, count, objects, detections) for pair, count in counts.items())
    return (
        float(np.sqrt(total / everything)),
        tp / everything,
        total / tp if tp else 0.0,
        similarities / tp if tp else 1.0,
    )


def _association(pair: Pair, both: int, objects: dict[int, int], detections: dict[int, int]) -> float:
    return both / (objects[pair[0]] + detections[pair[1]] - both)


def _pairs(frames: Sequence[TrackedFrame], masks: Sequence[Mask]) -> dict[Pair, int]:
    """Count each pair of identities in the masks (M, N) of the frames."""
    counts: dict[Pair, int] = {}
    for frame, mask in zip(frames, masks, strict=True):
        rows, columns = np.nonzero(mask)
        for pair in zip(frame.objects[rows].tolist(), frame.detections[columns].tolist(), strict=True):
            counts[pair] = counts.get(pair, 0) + 1
    return counts


def _renumbered(frames: Sequence[TrackedFrame], sequence: int) -> list[TrackedFrame]:
    """Return the frames with identities that are unique among all sequences."""
    return [
        frame._replace(objects=frame.objects + (sequence << 40), detections=frame.detections + (sequence << 40))
        for frame in frames
    ]


class ClearMot(NamedTuple):
    """Counts over all frames."""

    labels: int
    matches: int
    false_boxes: int
    identity_switches: int
    fragmentations: int

    @property
    def misses(self) -> int:
        """Number of unmatched labelled boxes."""
        return self.labels - self.matches

    @property
    def mota(self) -> float:
        """MOTA: at most 1, may be negative; NaN without labels."""
        wrong = self.misses + self.false_boxes + self.identity_switches
        return 1.0 - wrong / self.labels if self.labels else float("nan")


def clear_mot(sequences: Sequence[Sequence[TrackedFrame]], threshold: float) -> ClearMot:
    """Count the errors of one class over several sequences, matched from this similarity on."""
    total = np.zeros(5, np.int64)
    for frames in sequences:
        last: dict[int, int] = {}  # object -> identity of its last match
        matched_before: dict[int, int] = {}  # the same, of the previous frame only
        seen_before: dict[int, bool] = {}  # object -> matched in its last labelled frame
        for frame in frames:
            matches = _matches(frame, matched_before, threshold)
            for number in frame.objects.tolist():
                identity = matches.get(number)
                if identity is not None:
                    total[3] += number in last and last[number] != identity
                    total[4] += number in last and not seen_before[number]
                    last[number] = identity
                seen_before[number] = identity is not None
            total[:3] += len(frame.objects), len(matches), len(frame.detections) - len(matches)
            matched_before = matches
    return ClearMot(*total.tolist())


def _matches(frame: TrackedFrame, before: dict[int, int], threshold: float) -> dict[int, int]:
    """Match a frame: object -> identity."""
    similarity = np.where(frame.similarity >= threshold, frame.similarity, 0.0)
    kept = np.array(
        [[before.get(item) == identity for identity in frame.detections.tolist()] for item in frame.objects.tolist()]
    )
    if similarity.size:
        kept = kept.reshape(similarity.shape) & (similarity > 0)
        similarity[kept.any(axis=1)] = 0.0
        similarity[:, kept.any(axis=0)] = 0.0
        similarity[kept] = 1.0
    holders = best_assignments(similarity)[-1]
    held = np.flatnonzero(holders != UNMATCHED)
    return dict(zip(frame.objects[holders[held]].tolist(), frame.detections[held].tolist(), strict=True))
