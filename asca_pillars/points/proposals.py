"""Which boxes of the first stage the second looks at."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from asca_pillars.geometry.detections import Detections


def best_of_each_class(detections: Detections, quotas: Sequence[int]) -> Detections:
    """The best `quotas[label]` detections of each class, in the order in which they come.

    A quota of their own keeps the classes with low scores from being crowded out by those with high ones.

    Raises:
        ValueError: not one quota for each class.
    """
    if len(quotas) != len(detections.class_names):
        raise ValueError(f"{len(quotas)} quotas for the {len(detections.class_names)} classes {detections.class_names}")
    kept: list[NDArray[np.int64]] = []
    for label, quota in enumerate(quotas):
        own = np.flatnonzero(detections.labels == label)
        kept.append(own[np.argsort(-detections.scores[own], kind="stable")[:quota]])
    return detections[np.sort(np.concatenate(kept))]
