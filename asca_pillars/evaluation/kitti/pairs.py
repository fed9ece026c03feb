"""Pairs of overlapping ground truth and detections, for all frames at once.

Overlaps take most of the time of an evaluation and depend on no class, difficulty or distance band: they are computed
once, and only the few pairs with enough overlap to match are kept.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.progress import SILENT, Reporter
from asca_pillars.evaluation.kitti.objects import FrameObjects, concatenate_frames, is_type
from asca_pillars.geometry.overlap import paired_bev_intersection

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
    found = []
    for truths in reporter.track(list(_blocks(frames, truth_mask)), "Overlaps"):
        pairs = _all_pairs(frames, truths)
        image = _image_iou(frames.detections.bbox[pairs.detection], frames.truth.bbox[pairs.truth])
        bev, solid = _ground_iou(detection_boxes[pairs.detection], truth_boxes[pairs.truth])
        pairs = Pairs(pairs.truth, pairs.detection, pairs.frame, {"bbox": image, "bev": bev, "3d": solid})
        found.append(pairs.where((image > above) | (bev > above) | (solid > above)))
    return _joined(found)


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
