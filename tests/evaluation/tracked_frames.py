"""Frames of a few tracked objects."""

import numpy as np

from asca_pillars.evaluation.tracking_metrics import TrackedFrame


def frame(objects: list[int], found: list[int], similarity: list | np.ndarray | None = None) -> TrackedFrame:
    """Without a similarity equal numbers are equal boxes."""
    if similarity is None:
        similarity = np.equal.outer(np.array(objects, int), np.array(found, int)).astype(float)
    table = np.asarray(similarity, float).reshape(len(objects), len(found))
    return TrackedFrame(np.array(objects, np.int64), np.array(found, np.int64), table)
