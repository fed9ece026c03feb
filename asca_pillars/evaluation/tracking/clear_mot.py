"""The CLEAR metrics: MOTA, identity switches, fragmentations (Bernardin, Stiefelhagen, EURASIP JIVP 2008).

A label stays matched with the identity of the frame before as long as their similarity reaches the threshold; the
others are matched one to one for the greatest total similarity. Then, over N_labels labelled boxes,

    MOTA = 1 - (misses + false boxes + identity switches) / N_labels

An identity switch is a match with another identity than that of the object's last match; a fragmentation is a match
after frames in which the object was missed, when it had been matched before (Li, Huang, Nevatia, CVPR 2009). TrackEval
counts the return of an object that was not labelled meanwhile, too, and no gap of frames in which nothing was found.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from asca_pillars.detection.targets import UNMATCHED, best_assignments
from asca_pillars.evaluation.tracking.tracked_frames import TrackedFrame


class ClearMot(NamedTuple):
    """Counts over all frames."""

    labels: int
    matches: int
    false_boxes: int
    identity_switches: int
    fragmentations: int

    @property
    def misses(self) -> int:
        """Labelled boxes that nothing was matched with."""
        return self.labels - self.matches

    @property
    def mota(self) -> float:
        """At most 1, may be negative; NaN without labels."""
        wrong = self.misses + self.false_boxes + self.identity_switches
        return 1.0 - wrong / self.labels if self.labels else float("nan")


def clear_mot(sequences: Sequence[Sequence[TrackedFrame]], threshold: float) -> ClearMot:
    """The counts of one class over several sequences, matched from this similarity on."""
    total = np.zeros(5, np.int64)
    for frames in sequences:
        last: dict[int, int] = {}  # object -> identity that it was last matched with
        matched_before: dict[int, int] = {}  # the same, of the frame before alone
        seen_before: dict[int, bool] = {}  # object -> matched in the last frame that it is labelled in
        for frame in frames:
            matches = _matches(frame, matched_before, threshold)
            for number in frame.objects.tolist():
                own = matches.get(number)
                if own is not None:
                    total[3] += number in last and last[number] != own
                    total[4] += number in last and not seen_before[number]
                    last[number] = own
                seen_before[number] = own is not None
            total[:3] += len(frame.objects), len(matches), len(frame.found) - len(matches)
            matched_before = matches
    return ClearMot(*total.tolist())


def _matches(frame: TrackedFrame, before: dict[int, int], threshold: float) -> dict[int, int]:
    """Object -> identity."""
    similarity = np.where(frame.similarity >= threshold, frame.similarity, 0.0)
    kept = np.array([[before.get(one) == other for other in frame.found.tolist()] for one in frame.objects.tolist()])
    if similarity.size:
        kept = kept.reshape(similarity.shape) & (similarity > 0)
        similarity[kept.any(axis=1)] = 0.0
        similarity[:, kept.any(axis=0)] = 0.0
        similarity[kept] = 1.0
    holders = best_assignments(similarity)[-1]
    held = np.flatnonzero(holders != UNMATCHED)
    return dict(zip(frame.objects[holders[held]].tolist(), frame.found[held].tolist(), strict=True))
