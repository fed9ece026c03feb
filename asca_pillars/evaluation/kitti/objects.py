"""Objects of a frame as arrays, for ground truth and detections alike, and which of them count.

Values are those of KITTI's text files, in the rectified camera frame (x right, y down, z forward) and in
pixels of the left color image, because KITTI's protocol uses 2D boxes in addition to 3D ones.

KITTI counts, ignores, or treats as absent each object, per class and difficulty. An ignored object need not be found,
but can be matched; an ignored detection is never false, but can be matched. An absent one is neither.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from enum import IntEnum
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asca_pillars.data.frames import NEIGHBOR_TYPES
from asca_pillars.data.kitti.kitti_labels import KittiObject
from asca_pillars.geometry.arrays import Floats


@dataclass(frozen=True, eq=False)
class FrameObjects:
    """N objects of one frame, in the order of the file; N may be 0. All arrays are float64.

    Attributes:
        frame_id: name of the frame's files, without ending.
        types: N type names; "Car" and "car" are the same type.
        bbox: (N, 4) x1, y1, x2, y2 in pixels.
        alpha: (N,) observation angle in radians; -10 where unknown.
        dimensions_hwl: (N, 3) height, width, length in metres; -1 without a 3D box.
        locations: (N, 3) x, y, z of the *bottom* center in metres; -1000 without a 3D box.
        rotation_y: (N,) radians about the y axis, 0 when the object faces x.
        truncated: (N,) 0..1. float32 is not precise enough: float32(0.15) is above KITTI's limit of 0.15.
        occluded: (N,) 0, 1, 2 or 3; -1 where unknown.
        scores: (N,) of detections, any monotonic measure; 0 for ground truth.

    Raises:
        ValueError: an array's shape does not fit the number of types, or it has a value that is not finite.
    """

    frame_id: str
    types: tuple[str, ...]
    bbox: Floats
    alpha: Floats
    dimensions_hwl: Floats
    locations: Floats
    rotation_y: Floats
    truncated: Floats
    occluded: Floats
    scores: Floats

    def __post_init__(self) -> None:
        count = len(self.types)
        widths = {"bbox": (4,), "dimensions_hwl": (3,), "locations": (3,)}
        for name in _ARRAYS:
            array, shape = getattr(self, name), (count, *widths.get(name, ()))
            if array.shape != shape:
                raise ValueError(f"frame {self.frame_id}: {name} is {array.shape}, but {count} types need {shape}")
            if not np.isfinite(array).all():
                raise ValueError(f"frame {self.frame_id}: {name} holds NaN or infinity")

    def __len__(self) -> int:
        return len(self.types)

    @cached_property
    def folded_types(self) -> NDArray[np.str_]:
        """(N,) type names without case, for comparison with `name.casefold()`."""
        return np.array([name.casefold() for name in self.types], dtype=np.str_)

    @property
    def distances_m(self) -> Floats:
        """(N,) horizontal distance from the camera, sqrt(x^2 + z^2), in metres."""
        return np.hypot(self.locations[:, 0], self.locations[:, 2])


_ARRAYS = tuple(field.name for field in fields(FrameObjects) if field.name not in ("frame_id", "types"))


def frame_objects(frame_id: str, objects: Sequence[KittiObject]) -> FrameObjects:
    """Convert the lines of a label or detection file to arrays, in order; the score of a label is 0."""
    rows = [
        (
            *(*item.bbox, item.alpha, item.height_m, item.width_m, item.length_m, item.x_m, item.y_m, item.z_m),
            *(item.rotation_y, item.truncated, item.occluded, item.score or 0.0),
        )
        for item in objects
    ]
    columns = np.array(rows, dtype=np.float64).reshape(-1, 15)
    return FrameObjects(
        frame_id=frame_id,
        types=tuple(item.type for item in objects),
        bbox=columns[:, :4],
        alpha=columns[:, 4],
        dimensions_hwl=columns[:, 5:8],
        locations=columns[:, 8:11],
        rotation_y=columns[:, 11],
        truncated=columns[:, 12],
        occluded=columns[:, 13],
        scores=columns[:, 14],
    )


def concatenate_frames(frames: Sequence[FrameObjects]) -> FrameObjects:
    """Concatenate the objects of all frames, as one frame named ""."""
    if not frames:
        return frame_objects("", [])
    arrays = {name: np.concatenate([getattr(frame, name) for frame in frames], dtype=np.float64) for name in _ARRAYS}
    return FrameObjects("", tuple(name for frame in frames for name in frame.types), **arrays)


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
