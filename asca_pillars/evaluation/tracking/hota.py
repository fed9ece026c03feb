"""HOTA: how well objects are found and how well they are told apart (Luiten et al., IJCV 129, 548-578, 2021).

At a threshold alpha, labels and boxes are matched one to one in every frame, where their similarity reaches alpha.
A match c of a labelled and a found identity has the association score

    A(c) = TPA / (TPA + FNA + FPA)

over all frames: TPA counts the matches of these two identities, FNA the other boxes of the labelled one, FPA the other
boxes of the found one. Then

    HOTA(alpha) = sqrt( sum of A(c) over all matches / (TP + FN + FP) )
    DetA(alpha) = TP / (TP + FN + FP)
    AssA(alpha) = mean of A(c)

and HOTA, DetA, AssA and LocA (the mean similarity of matches) are means over alpha = 0.05, 0.10 ... 0.95. Matching is
the paper's: the most matches, of those the best associated, of those the most similar. The tool TrackEval matches once
for all alpha instead; its HOTA is up to 0.06 apart in sequences of some frames, and below 0.005 in ones of 150.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asca_pillars.detection.targets import UNMATCHED, best_assignments
from asca_pillars.evaluation.tracking.tracked_frames import TrackedFrame, counts_of_ids

_Doubles = NDArray[np.float64]
Pair = tuple[int, int]

ALPHAS = np.arange(1, 20) / 20
_EPSILON = 1e-3  # of the paper's matching score: parts the three aims
_ROUNDING = 1e-9  # similarities that are a threshold but for rounding reach it


class Hota(NamedTuple):
    """Means over ALPHAS, 0 to 1; NaN where there is neither a label nor a box."""

    hota: float
    det_a: float
    ass_a: float
    loc_a: float


def hota(sequences: Sequence[Sequence[TrackedFrame]]) -> Hota:
    """HOTA of one class over several sequences, whose identities have nothing to do with each other."""
    numbered = [_renumbered(frames, index) for index, frames in enumerate(sequences)]
    frames = [frame for own in numbered for frame in own]
    objects, found = counts_of_ids(frames)
    if not objects and not found:
        return Hota(*[float("nan")] * 4)
    scores = np.array([_at(alpha, frames, objects, found) for alpha in ALPHAS])
    return Hota(*scores.mean(axis=0).tolist())


def _at(
    alpha: float, frames: Sequence[TrackedFrame], objects: dict[int, int], found: dict[int, int]
) -> tuple[float, float, float, float]:
    """HOTA, DetA, AssA and LocA at one threshold."""
    could_match = _pairs(frames, [frame.similarity >= alpha - _ROUNDING for frame in frames])
    association = {pair: _association(pair, count, objects, found) for pair, count in could_match.items()}
    matched: list[NDArray[np.bool_]] = []
    similarities = 0.0
    for frame in frames:
        allowed = frame.similarity >= alpha - _ROUNDING
        score = np.zeros(frame.similarity.shape)
        for row, column in zip(*np.nonzero(allowed), strict=True):
            pair = int(frame.objects[row]), int(frame.found[column])
            score[row, column] = 1 / _EPSILON + association[pair] + _EPSILON * frame.similarity[row, column]
        holders = best_assignments(score)[-1]
        mask = np.zeros(score.shape, bool)
        held = np.flatnonzero(holders != UNMATCHED)
        mask[holders[held], held] = True
        matched.append(mask)
        similarities += float(frame.similarity[mask].sum())
    counts = _pairs(frames, matched)
    tp = sum(counts.values())
    everything = sum(objects.values()) + sum(found.values()) - tp  # TP + FN + FP
    total = sum(count * _association(pair, count, objects, found) for pair, count in counts.items())
    return (
        float(np.sqrt(total / everything)),
        tp / everything,
        total / tp if tp else 0.0,
        similarities / tp if tp else 1.0,
    )


def _association(pair: Pair, both: int, objects: dict[int, int], found: dict[int, int]) -> float:
    return both / (objects[pair[0]] + found[pair[1]] - both)


def _pairs(frames: Sequence[TrackedFrame], masks: Sequence[NDArray[np.bool_]]) -> dict[Pair, int]:
    """How often each pair of identities is in the masks (M, N) of the frames."""
    counts: dict[Pair, int] = {}
    for frame, mask in zip(frames, masks, strict=True):
        rows, columns = np.nonzero(mask)
        for pair in zip(frame.objects[rows].tolist(), frame.found[columns].tolist(), strict=True):
            counts[pair] = counts.get(pair, 0) + 1
    return counts


def _renumbered(frames: Sequence[TrackedFrame], sequence: int) -> list[TrackedFrame]:
    """Identities that no other sequence has."""
    return [
        frame._replace(objects=frame.objects + (sequence << 40), found=frame.found + (sequence << 40))
        for frame in frames
    ]
