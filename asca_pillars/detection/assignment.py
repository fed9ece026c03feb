"""Which detection takes which object, one to one: the better detection first, or for the greatest total overlap."""

import numpy as np
from numpy.typing import NDArray

_Doubles = NDArray[np.float64]
_Indices = NDArray[np.int64]

UNMATCHED = -1
_ROUNDING = 1e-12  # sums of overlaps that differ by less are equal


def greedy_matches(detections: _Indices, objects: _Indices) -> NDArray[np.bool_]:
    """Walk through candidate pairs and match each whose detection and object are both still free.

    Args:
        detections, objects: (P,) the pairs, in order of preference: by descending score of the detection, and for each
            detection by descending overlap.

    Returns:
        (P,) which pairs are matched.
    """
    matched = np.zeros(len(detections), dtype=bool)
    taken: set[int] = set()
    found: set[int] = set()
    for row, (detection, item) in enumerate(zip(detections.tolist(), objects.tolist(), strict=True)):
        if detection not in taken and item not in found:
            taken.add(detection)
            found.add(item)
            matched[row] = True
    return matched


def match_by_overlap(overlap: _Doubles, least: float) -> tuple[_Indices, _Indices]:
    """Each detection takes the free object that it overlaps most: (D, O) -> (M,) detections, (M,) objects.

    Args:
        overlap: intersection over union; detections stand by descending score.
        least: smallest overlap of a match.
    """
    detections, objects = np.nonzero(overlap >= least)
    order = np.lexsort((-overlap[detections, objects], detections))
    pairs = order[greedy_matches(detections[order], objects[order])]
    return detections[pairs], objects[pairs]


def best_assignments(overlap: _Doubles) -> _Indices:
    """The one-to-one matching of greatest total overlap, of the first k detections, for every k.

    Exact. Detections come one after the other; a new one changes the best matching along a single chain of detections
    that hand their objects on (Hungarian method), and few detections touch more than one object.

    Args:
        overlap: (N, M) of N detections with M objects; 0 where the two must not match.

    Returns:
        (N + 1, M): in row k which of the first k detections holds each object, or UNMATCHED.
    """
    holders = np.full((len(overlap) + 1, overlap.shape[1]), UNMATCHED)
    touching = np.any(overlap > 0, axis=1).tolist()
    for row in range(len(overlap)):
        holders[row + 1] = holders[row]
        if touching[row]:
            _admit(row, overlap, holders[row + 1])
    return holders


def _admit(row: int, overlap: _Doubles, holders: _Indices) -> None:
    """Bring `holders` (M,), the best matching of the detections before `row`, up to date with `row`.

    `gain[j]` is the most that the matching gains by a chain at whose end object j changes hands, not counting what its
    old holder loses; `source[j]` is the object that its new holder leaves, or UNMATCHED for `row` itself.
    """
    gain = _weights(overlap[row])
    source = np.full(len(holders), UNMATCHED)
    waiting = np.flatnonzero(gain > 0).tolist()
    for column in waiting:  # grows on the way
        if holders[column] == UNMATCHED:
            continue
        held = overlap[holders[column]]
        moved = gain[column] - held[column] + _weights(held)
        better = np.flatnonzero(moved > gain + _ROUNDING)
        gain[better], source[better] = moved[better], column
        waiting += better.tolist()

    lost = np.where(holders == UNMATCHED, 0.0, overlap[holders, np.arange(len(holders))])
    column = int((gain - lost).argmax())
    if gain[column] - lost[column] <= _ROUNDING:
        return
    while source[column] != UNMATCHED:
        holders[column] = holders[source[column]]
        column = int(source[column])
    holders[column] = row


def _weights(overlap: _Doubles) -> _Doubles:
    return np.where(overlap > 0, overlap, -np.inf)
