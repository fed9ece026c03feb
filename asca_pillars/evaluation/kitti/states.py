"""Objects that KITTI counts, ignores, or treats as absent, per class and difficulty.

An ignored object need not be found, but can be matched; an ignored detection is never false, but can be matched. An
absent one is neither.
"""

from collections.abc import Mapping
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asca_pillars.data.frames import NEIGHBOR_TYPES
from asca_pillars.evaluation.kitti.objects import FrameObjects


class KittiState(IntEnum):
    """State of an object at one class, difficulty and distance band."""

    ABSENT = -1
    COUNTED = 0
    IGNORED = 1


# Types so similar to a class that detecting one is not an error, and missing one neither.
NEIGHBORS: Mapping[str, str] = {name.casefold(): other.casefold() for name, other in NEIGHBOR_TYPES.items()}

_Band = tuple[float, float]


class Limits(NamedTuple):
    """Limits of one difficulty, inclusive."""

    min_height_px: float
    max_occluded: int
    max_truncated: float


LIMITS: Mapping[str, Limits] = {
    "easy": Limits(40.0, 0, 0.15),
    "moderate": Limits(25.0, 1, 0.30),
    "hard": Limits(25.0, 2, 0.50),
}


def is_type(objects: FrameObjects, name: str) -> NDArray[np.bool_]:
    """Return the mask (N,) of the objects of the named type, compared without case."""
    mask: NDArray[np.bool_] = objects.folded_types == name.casefold()
    return mask


def is_neighbor(objects: FrameObjects, class_name: str) -> NDArray[np.bool_]:
    """Return the mask (N,) of the objects of the ignored neighbor type: Van for Car, Person_sitting for Pedestrian."""
    neighbor = NEIGHBORS.get(class_name.casefold())
    return np.zeros(len(objects), dtype=bool) if neighbor is None else is_type(objects, neighbor)


def truth_states(
    truth: FrameObjects, class_name: str, difficulty: str, band_m: _Band | None = None
) -> NDArray[np.int8]:
    """Return the `KittiState` (N,) of each ground truth.

    Counted: of the class and within the difficulty's limits. Ignored: of the class but beyond a limit, or of its
    neighboring type. Absent: every other type. In a distance band, counted objects at a horizontal
    distance outside [low, high) are ignored.
    """
    limits = LIMITS[difficulty]
    beyond = truth.bbox[:, 3] - truth.bbox[:, 1] < limits.min_height_px
    beyond |= (truth.occluded > limits.max_occluded) | (truth.truncated > limits.max_truncated)
    own = is_type(truth, class_name)
    counted = own & ~beyond & _in_band(truth, band_m)
    return _states(counted, own | is_neighbor(truth, class_name))


def detection_states(
    detections: FrameObjects, class_name: str, difficulty: str, band_m: _Band | None = None
) -> NDArray[np.int8]:
    """Return the `KittiState` (N,) of each detection.

    Ignored: lower in the image than the difficulty's minimum, *whatever the class*. Counted: otherwise, if of the
    class. Absent: every other type. In a distance band, counted detections at a horizontal distance outside
    [low, high) are ignored.
    """
    low = np.abs(detections.bbox[:, 1] - detections.bbox[:, 3]) < LIMITS[difficulty].min_height_px
    own = is_type(detections, class_name)
    return _states(own & ~low & _in_band(detections, band_m), own | low)


def _in_band(objects: FrameObjects, band_m: _Band | None) -> NDArray[np.bool_]:
    if band_m is None:
        return np.ones(len(objects), dtype=bool)
    inside: NDArray[np.bool_] = (objects.distances_m >= band_m[0]) & (objects.distances_m < band_m[1])
    return inside


def _states(counted: NDArray[np.bool_], present: NDArray[np.bool_]) -> NDArray[np.int8]:
    other = np.where(present, KittiState.IGNORED, KittiState.ABSENT)
    return np.where(counted, KittiState.COUNTED, other).astype(np.int8)
