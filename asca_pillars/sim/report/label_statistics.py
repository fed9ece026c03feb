"""Statistics of labels: how many objects, how large, where, how turned, how hidden."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from asca_pillars.data.kitti import KittiObject, KittiSplit, boxes_from_objects, objects_3d
from asca_pillars.sim.report.reference import (
    BAND_M,
    BANDS,
    CLASSES,
    LABEL_RANGE_BINS,
    MAX_PER_FRAME,
    PERCENTILES,
    TRUNCATION_EDGES,
    YAW_BINS,
    Band,
    LabelStatistics,
    Spread,
)

_LABEL_STEP_M = 5.0
_ASIDE_RAD = np.pi / 12


def label_statistics(split: KittiSplit, frame_ids: Sequence[str]) -> tuple[dict[str, LabelStatistics], float]:
    """The labels of each of CLASSES that occurs in the frames, and the DontCare areas per frame.

    KITTI labels what stands in the image; in a set that is labelled all around, the others are left out.

    Raises:
        DatasetError: a label or calibration file is missing or damaged.
    """
    per_frame = {name: np.zeros(len(frame_ids), np.int64) for name in CLASSES}
    objects: dict[str, list[KittiObject]] = {name: [] for name in CLASSES}
    boxes: dict[str, list[NDArray[np.float32]]] = {name: [] for name in CLASSES}
    dont_care = 0
    for index, frame_id in enumerate(frame_ids):
        everything = split.objects(frame_id)
        dont_care += sum(item.type == "DontCare" for item in everything)
        calibration = split.calibration(frame_id)
        for name in CLASSES:
            mine = objects_3d(item for item in everything if item.type == name and item.bbox[2] > item.bbox[0])
            per_frame[name][index] = len(mine)
            objects[name] += mine
            boxes[name].append(boxes_from_objects(mine, calibration))
    of_class = {
        name: _of_class(objects[name], np.concatenate(boxes[name]).astype(np.float64), per_frame[name])
        for name in CLASSES
        if objects[name]
    }
    return of_class, dont_care / len(frame_ids)


def _of_class(
    objects: Sequence[KittiObject], boxes: NDArray[np.float64], per_frame: NDArray[np.int64]
) -> LabelStatistics:
    x, y, z, length, width, height, yaw = boxes.T
    range_m = np.hypot(x, y)
    truncated = np.array([item.truncated for item in objects])
    occluded = np.clip([item.occluded for item in objects], 0, 3)
    return LabelStatistics(
        count=len(objects),
        per_frame=_counts(np.minimum(per_frame, MAX_PER_FRAME), MAX_PER_FRAME + 1),
        height_m=_spread(height),
        width_m=_spread(width),
        length_m=_spread(length),
        left_m=_spread(y),
        range_counts=_counts(np.minimum(range_m // _LABEL_STEP_M, LABEL_RANGE_BINS - 1), LABEL_RANGE_BINS),
        bottom_z_m=tuple(_band((z - height / 2)[range_m // BAND_M == band]) for band in range(BANDS)),
        yaw_counts=tuple(np.histogram(yaw, YAW_BINS, (-np.pi, np.pi))[0].tolist()),
        yaw_same=float(np.mean(np.abs(yaw) < _ASIDE_RAD)),
        yaw_oncoming=float(np.mean(np.abs(yaw) > np.pi - _ASIDE_RAD)),
        yaw_across=float(np.mean(np.abs(np.abs(yaw) - np.pi / 2) < _ASIDE_RAD)),
        occlusion=_counts(occluded, 4),
        truncation=_counts(np.searchsorted(TRUNCATION_EDGES, truncated), len(TRUNCATION_EDGES) + 1),
    )


def _counts(values: NDArray[np.number], bins: int) -> tuple[int, ...]:
    return tuple(np.bincount(values.astype(np.int64), minlength=bins).tolist())


def _spread(values: NDArray[np.float64]) -> Spread:
    percentiles = tuple(np.percentile(values, PERCENTILES).tolist())
    return Spread(float(values.mean()), float(values.std()), percentiles)


def _band(values: NDArray[np.float64]) -> Band | None:
    return Band(float(values.mean()), float(values.std())) if len(values) else None
