"""Statistics of labels: number, size, position, yaw and occlusion of objects, and the fit of boxes to points."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from asca_pillars.data.kitti import KittiObject, KittiSplit, boxes_from_objects, objects_3d
from asca_pillars.evaluation.errors.label_fit import STATISTICS, label_fit, view_angle_deg
from asca_pillars.geometry.arrays import Floats, Ints, Singles
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
    Fit,
    LabelStatistics,
    Spread,
)

_LABEL_STEP_M = 5.0
_ASIDE_RAD = np.pi / 12


def label_statistics(split: KittiSplit, frame_ids: Sequence[str]) -> tuple[dict[str, LabelStatistics], float]:
    """Return the label statistics of each of CLASSES that occurs in the frames, and the DontCare areas per frame.

    KITTI labels objects in the image; in a set labelled in every direction, the others are left out.

    Raises:
        DatasetError: a label or calibration file is missing or damaged.
    """
    per_frame = {name: np.zeros(len(frame_ids), np.int64) for name in CLASSES}
    objects: dict[str, list[KittiObject]] = {name: [] for name in CLASSES}
    boxes: dict[str, list[Singles]] = {name: [] for name in CLASSES}
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


def _of_class(objects: Sequence[KittiObject], boxes: Floats, per_frame: Ints) -> LabelStatistics:
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


def _spread(values: Floats) -> Spread:
    percentiles = tuple(np.percentile(values, PERCENTILES).tolist())
    return Spread(float(values.mean()), float(values.std()), percentiles)


def _band(values: Floats) -> Band | None:
    return Band(float(values.mean()), float(values.std())) if len(values) else None


WINDOW_RETURNS = "window_returns"
"""Points per height on side windows over those on the doors below them; cars neither end-on nor side-on."""
SHOWN: Mapping[str, tuple[str, ...]] = {
    "Car": (
        "flank_end",
        "upper_end",
        "roof_end",
        "roof_length",
        "nearest_point",
        "rear_width",
        "top_97",
        "top",
        "low_inside",
        WINDOW_RETURNS,
    ),
    "Pedestrian": ("range_5", "range_50", "range_95", "range_spread"),
    "Cyclist": ("range_5", "range_50", "range_95", "range_spread"),
}
COLUMNS = (*STATISTICS, WINDOW_RETURNS)
MEANS = ("low_inside",)  # fractions of objects, for which a median is meaningless
MIN_OBJECTS = 2
_MAX_TRUNCATION = 0.1
_WINDOW_RANGE_M = 25.0
_WINDOW_VIEW_DEG = 10.0, 73.0
_WINDOWS, _DOORS = (0.68, 0.82), (0.35, 0.55)  # fractions of the height
_BESIDE_FRONT_SEATS = -0.25, 0.05  # fractions of the length ahead of the center
_FLANK_M = 0.3
_MIN_DOOR_POINTS = 9


def object_fits(
    points: NDArray[np.floating], objects: Sequence[KittiObject], boxes: NDArray[np.floating]
) -> dict[str, Floats]:
    """Return `COLUMNS` of the unoccluded, untruncated objects of each class, (objects, len(COLUMNS)).

    Args:
        points: (N, >=3) points of the scan, metres.
        objects: M labels with a 3D box.
        boxes: (M, 7) their boxes in the frame of the points.
    """
    whole = np.array([item.occluded == 0 and item.truncated <= _MAX_TRUNCATION for item in objects], bool)
    names = np.array([item.type for item in objects])
    samples = {}
    for name in CLASSES:
        of_class = boxes[whole & (names == name)] if len(objects) else boxes[:0]
        windows = [window_returns(points, box.astype(np.float64)) if name == "Car" else np.nan for box in of_class]
        samples[name] = np.column_stack([label_fit(points, of_class), windows]).reshape(-1, len(COLUMNS))
    return samples


def window_returns(points: NDArray[np.floating], box: Floats) -> float:
    """Return `WINDOW_RETURNS` of a car's box (7,), or NaN if too little of its doors is visible."""
    x, y, z, length, width, height, yaw = box
    if np.hypot(x, y) > _WINDOW_RANGE_M or not _WINDOW_VIEW_DEG[0] < view_angle_deg(box[None])[0] < _WINDOW_VIEW_DEG[1]:
        return float("nan")
    offset = points[:, :2].astype(np.float64) - box[:2]
    along, across = offset @ (np.cos(yaw), np.sin(yaw)) / length, np.abs(offset @ (-np.sin(yaw), np.cos(yaw)))
    up = (points[:, 2] - z) / height + 0.5
    first, last = _BESIDE_FRONT_SEATS
    flank = (along > first) & (along < last) & (across > width / 2 - _FLANK_M) & (across < width / 2 + _FLANK_M)
    windows, doors = (int((flank & (up > low) & (up < high)).sum()) for low, high in (_WINDOWS, _DOORS))
    if doors < _MIN_DOOR_POINTS:
        return float("nan")
    return windows / doors * (_DOORS[1] - _DOORS[0]) / (_WINDOWS[1] - _WINDOWS[0])


def fits_of(rows: Mapping[str, Floats], source: str) -> dict[str, tuple[Fit, ...]]:
    """Return one `Fit` for each shown statistic, by "Car flank_end" and the like, of MIN_OBJECTS or more.

    Args:
        rows: by class, from `object_fits`, of one drive or folder.
        source: its name.
    """
    result: dict[str, tuple[Fit, ...]] = {}
    for name, statistics in SHOWN.items():
        for statistic in statistics:
            values = rows[name][:, COLUMNS.index(statistic)]
            values = values[np.isfinite(values)]
            if len(values) < MIN_OBJECTS:
                continue
            middle = float(values.mean() if statistic in MEANS else np.median(values))
            low, high = np.percentile(values, (10, 90)).tolist()
            result[f"{name} {statistic}"] = (Fit(source, len(values), middle, low, high),)
    return result
