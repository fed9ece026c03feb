"""Objects of a frame as arrays, for ground truth and detections alike, which of them count, and how they overlap.

Values are those of KITTI's text files, in the rectified camera frame (x right, y down, z forward) and in
pixels of the left color image, because KITTI's protocol uses 2D boxes in addition to 3D ones.

KITTI counts, ignores, or treats as absent each object, per class and difficulty. An ignored object need not be found,
but can be matched; an ignored detection is never false, but can be matched. An absent one is neither.

Overlaps take most of the time of an evaluation and depend on no class, difficulty or distance band: they are computed
once, and only the few pairs with enough overlap to match are kept.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from enum import IntEnum
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.progress import SILENT, Reporter
from asca_pillars.data.frames import NEIGHBOR_TYPES
from asca_pillars.data.kitti.kitti_labels import KittiObject
from asca_pillars.geometry.boxes import Floats
from asca_pillars.geometry.overlap import paired_bev_intersection


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
    of_class = is_type(truth, class_name)
    counted = of_class & ~beyond & _in_band(truth, band_m)
    return _states(counted, of_class | is_neighbor(truth, class_name))


def detection_states(
    detections: FrameObjects, class_name: str, difficulty: str, band_m: _Band | None = None
) -> NDArray[np.int8]:
    """Return the `KittiState` (N,) of each detection.

    Ignored: lower in the image than the difficulty's minimum, *whatever the class*. Counted: otherwise, if of the
    class. Absent: every other type. In a distance band, counted detections at a horizontal distance outside
    [low, high) are ignored.
    """
    low = np.abs(detections.bbox[:, 1] - detections.bbox[:, 3]) < LIMITS[difficulty].min_height_px
    of_class = is_type(detections, class_name)
    return _states(of_class & ~low & _in_band(detections, band_m), of_class | low)


def _in_band(objects: FrameObjects, band_m: _Band | None) -> NDArray[np.bool_]:
    if band_m is None:
        return np.ones(len(objects), dtype=bool)
    inside: NDArray[np.bool_] = (objects.distances_m >= band_m[0]) & (objects.distances_m < band_m[1])
    return inside


def _states(counted: NDArray[np.bool_], present: NDArray[np.bool_]) -> NDArray[np.int8]:
    other = np.where(present, KittiState.IGNORED, KittiState.ABSENT)
    return np.where(counted, KittiState.COUNTED, other).astype(np.int8)


_Doubles = NDArray[np.float64]
_Indices = NDArray[np.int64]

# Pairs processed at once: enough for NumPy's efficiency, few enough for about 100 MB of temporary arrays.
_BLOCK_PAIRS = 300_000


@dataclass(frozen=True, eq=False)
class Frames:
    """F frames joined into one: all their objects, and the frame of each.

    Attributes:
        truth, detections: concatenated objects of all frames.
        truth_frames: (N,) index of the frame of each ground truth.
        detection_starts: (F + 1,) start of the detections of each frame, and end of the last.
    """

    truth: FrameObjects
    detections: FrameObjects
    truth_frames: _Indices
    detection_starts: _Indices

    @classmethod
    def join(cls, truth: Sequence[FrameObjects], detections: Sequence[FrameObjects]) -> "Frames":
        """Join ground truth and detections of the same frames, in the same order."""
        frames = np.repeat(np.arange(len(truth)), [len(frame) for frame in truth])
        starts = np.cumsum([0, *(len(frame) for frame in detections)])
        return cls(concatenate_frames(truth), concatenate_frames(detections), frames, starts)


@dataclass(frozen=True, eq=False)
class Pairs:
    """P pairs of ground truth and detection of one frame, by ascending `truth`, then by ascending `detection`.

    Attributes:
        truth, detection: (P,) indices into the objects of all frames.
        frame: (P,) index of the frame.
        overlaps: of each metric ("bbox", "bev", "3d"), (P,) intersection over union.
    """

    truth: _Indices
    detection: _Indices
    frame: _Indices
    overlaps: dict[str, _Doubles]

    def where(self, keep: NDArray[np.bool_]) -> "Pairs":
        """Return the pairs in a (P,) mask."""
        overlaps = {metric: values[keep] for metric, values in self.overlaps.items()}
        return Pairs(self.truth[keep], self.detection[keep], self.frame[keep], overlaps)


def overlapping_pairs(
    frames: Frames, truth_mask: NDArray[np.bool_], above: float, *, reporter: Reporter = SILENT
) -> Pairs:
    """Return the pairs whose boxes overlap by more than `above` in the image, in bird's-eye view or in 3D.

    Args:
        truth_mask: (N,) mask of the ground truth to pair.
        reporter: for the progress.
    """
    truth_boxes, detection_boxes = _upright_boxes(frames.truth), _upright_boxes(frames.detections)
    blocks = []
    for truths in reporter.track(list(_blocks(frames, truth_mask)), "Overlaps"):
        pairs = _all_pairs(frames, truths)
        image = _image_iou(frames.detections.bbox[pairs.detection], frames.truth.bbox[pairs.truth])
        bev, solid = _ground_iou(detection_boxes[pairs.detection], truth_boxes[pairs.truth])
        pairs = Pairs(pairs.truth, pairs.detection, pairs.frame, {"bbox": image, "bev": bev, "3d": solid})
        blocks.append(pairs.where((image > above) | (bev > above) | (solid > above)))
    return _joined(blocks)


def dont_care_shares(frames: Frames) -> _Doubles:
    """Return the largest share (D,) of each detection's image box within one DontCare area of its frame."""
    shares = np.zeros(len(frames.detections))
    for truths in _blocks(frames, is_type(frames.truth, "DontCare")):
        pairs = _all_pairs(frames, truths)
        boxes, areas = frames.detections.bbox[pairs.detection], frames.truth.bbox[pairs.truth]
        np.maximum.at(shares, pairs.detection, _ratio(_image_intersection(boxes, areas), _image_area(boxes)))
    return shares


def _blocks(frames: Frames, truth_mask: NDArray[np.bool_]) -> Iterator[_Indices]:
    """Yield the wanted ground truth in blocks with a limited number of pairs."""
    truths = np.flatnonzero(truth_mask)
    pairs = np.cumsum(np.diff(frames.detection_starts)[frames.truth_frames[truths]])
    cuts = np.flatnonzero(np.diff(pairs // _BLOCK_PAIRS)) + 1
    yield from np.split(truths, cuts)


def _all_pairs(frames: Frames, truths: _Indices) -> Pairs:
    """Return each of the ground truths with every detection of its frame; without overlaps."""
    frame = frames.truth_frames[truths]
    starts = frames.detection_starts[frame]
    counts = frames.detection_starts[frame + 1] - starts
    row_starts = np.cumsum(counts) - counts
    detection = np.repeat(starts - row_starts, counts) + np.arange(counts.sum())
    return Pairs(np.repeat(truths, counts), detection, np.repeat(frame, counts), {})


def _joined(parts: list[Pairs]) -> Pairs:
    truth, detection, frame = (
        np.concatenate([getattr(part, name) for part in parts]) for name in ("truth", "detection", "frame")
    )
    overlaps = {metric: np.concatenate([part.overlaps[metric] for part in parts]) for metric in ("bbox", "bev", "3d")}
    return Pairs(truth, detection, frame, overlaps)


def _image_iou(a: _Doubles, b: _Doubles) -> _Doubles:
    shared = _image_intersection(a, b)
    return _ratio(shared, _image_area(a) + _image_area(b) - shared)


def _image_intersection(a: _Doubles, b: _Doubles) -> _Doubles:
    """Return pixels shared by a[k] and b[k]: (P, 4), (P, 4) -> (P,). As in KITTI's evaluation, no pixel is added."""
    width = np.minimum(a[:, 2], b[:, 2]) - np.maximum(a[:, 0], b[:, 0])
    height = np.minimum(a[:, 3], b[:, 3]) - np.maximum(a[:, 1], b[:, 1])
    return np.maximum(width, 0.0) * np.maximum(height, 0.0)


def _image_area(boxes: _Doubles) -> _Doubles:
    return (boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1])


def _upright_boxes(objects: FrameObjects) -> _Doubles:
    """Return (N, 7) x, z, *bottom* y, length, width, height, yaw for `geometry.overlap`, in the camera's x-z plane.

    rotation_y rotates from x towards -z, against the yaw of that plane.
    """
    height, width, length = objects.dimensions_hwl.T
    x, y, z = objects.locations.T
    return np.stack([x, z, y, length, width, height, -objects.rotation_y], axis=1)


def _ground_iou(a: _Doubles, b: _Doubles) -> tuple[_Doubles, _Doubles]:
    """Return the IoU of `_upright_boxes` a[k] and b[k] in bird's-eye view and in 3D: (P, 7), (P, 7) -> 2 x (P,)."""
    bev, solid = np.zeros((2, len(a)))
    near = _circles_meet(a, b)
    a, b = a[near], b[near]
    shared = paired_bev_intersection(a, b)
    a_area, b_area = a[:, 3] * a[:, 4], b[:, 3] * b[:, 4]
    bev[near] = _ratio(shared, a_area + b_area - shared)
    # y points down: a box extends from bottom - height to bottom. Equal boxes share exactly their height, whatever the
    # rounding of that difference.
    height = np.minimum(a[:, 2], b[:, 2]) - np.maximum(a[:, 2] - a[:, 5], b[:, 2] - b[:, 5])
    shared *= np.maximum(np.minimum(height, np.minimum(a[:, 5], b[:, 5])), 0.0)
    solid[near] = _ratio(shared, a_area * a[:, 5] + b_area * b[:, 5] - shared)
    return bev, solid


def _circles_meet(a: _Doubles, b: _Doubles) -> NDArray[np.bool_]:
    """Return the mask of the pairs of footprints whose circumscribed circles meet; sizes without a 3D box are -1."""
    squared = np.square(a[:, 0] - b[:, 0]) + np.square(a[:, 1] - b[:, 1])
    reach = np.hypot(a[:, 3], a[:, 4]) + np.hypot(b[:, 3], b[:, 4])
    exist = np.min([a[:, 3], a[:, 4], b[:, 3], b[:, 4]], axis=0) > 0
    meet: NDArray[np.bool_] = exist & (4 * squared < np.square(reach))
    return meet


def _ratio(part: _Doubles, whole: _Doubles) -> _Doubles:
    """Return part / whole; 0 where the part is 0."""
    ratio: _Doubles = np.divide(part, whole, out=np.zeros_like(part), where=part > 0)
    return ratio
