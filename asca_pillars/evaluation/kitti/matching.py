"""KITTI's assignment of detections to ground truth, for all frames and all score thresholds at once.

Ground truth is processed in file order; each object is matched to the best free detection. Within a frame this is
sequential, but frames and thresholds are independent. So the first round matches the first object of every frame at
every threshold, the next round the second ones; the number of rounds is the largest number of objects with a candidate
in a frame.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asca_pillars.evaluation.kitti.objects import KittiState
from asca_pillars.evaluation.kitti.pairs import Pairs
from asca_pillars.geometry.arrays import Floats, Ints, Mask


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
