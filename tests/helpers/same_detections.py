"""Whether two detectors found the same, to the last bit."""

import numpy as np

from asca_deploy import Detections


def same(ours: Detections, theirs: Detections) -> bool:
    return all(np.array_equal(getattr(ours, name), getattr(theirs, name)) for name in ("boxes", "scores", "labels"))
