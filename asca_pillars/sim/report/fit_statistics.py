"""How the labels of a folder, or of one drive, lie around the points of their objects: medians over objects."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from asca_pillars.data.kitti import KittiObject
from asca_pillars.evaluation.errors.label_fit import STATISTICS, label_fit, view_angle_deg
from asca_pillars.sim.report.reference import CLASSES, Fit

WINDOW_RETURNS = "window_returns"
"""Points per height on side windows over those on the doors below them; cars seen neither end-on nor broadside."""
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
MEANS = ("low_inside",)  # shares of objects, of which a median says nothing
MIN_OBJECTS = 2
_MAX_TRUNCATION = 0.1
_WINDOW_RANGE_M = 25.0
_WINDOW_VIEW_DEG = 10.0, 73.0
_WINDOWS, _DOORS = (0.68, 0.82), (0.35, 0.55)  # shares of the height
_BESIDE_FRONT_SEATS = -0.25, 0.05  # shares of the length ahead of the center
_FLANK_M = 0.3
_MIN_DOOR_POINTS = 9

Floats = NDArray[np.float64]


def object_fits(
    points: NDArray[np.floating], objects: Sequence[KittiObject], boxes: NDArray[np.floating]
) -> dict[str, Floats]:
    """`COLUMNS` of the objects of each class, (objects, len(COLUMNS)), that are neither hidden nor cut.

    Args:
        points: (N, >=3) of the scan, metres.
        objects: M labels with a 3D box.
        boxes: (M, 7) of these in the frame of the points.
    """
    whole = np.array([item.occluded == 0 and item.truncated <= _MAX_TRUNCATION for item in objects], bool)
    names = np.array([item.type for item in objects])
    found = {}
    for name in CLASSES:
        mine = boxes[whole & (names == name)] if len(objects) else boxes[:0]
        windows = [window_returns(points, box.astype(np.float64)) if name == "Car" else np.nan for box in mine]
        found[name] = np.column_stack([label_fit(points, mine), windows]).reshape(-1, len(COLUMNS))
    return found


def window_returns(points: NDArray[np.floating], box: Floats) -> float:
    """`WINDOW_RETURNS` of a car's box (7,), or NaN where too little of its doors is seen."""
    x, y, z, length, width, height, yaw = box
    if np.hypot(x, y) > _WINDOW_RANGE_M or not _WINDOW_VIEW_DEG[0] < view_angle_deg(box[None])[0] < _WINDOW_VIEW_DEG[1]:
        return float("nan")
    offset = points[:, :2].astype(np.float64) - box[:2]
    along, across = offset @ (np.cos(yaw), np.sin(yaw)) / length, np.abs(offset @ (-np.sin(yaw), np.cos(yaw)))
    up = (points[:, 2] - z) / height + 0.5
    first, last = _BESIDE_FRONT_SEATS
    beside = (along > first) & (along < last) & (across > width / 2 - _FLANK_M) & (across < width / 2 + _FLANK_M)
    windows, doors = (int((beside & (up > low) & (up < high)).sum()) for low, high in (_WINDOWS, _DOORS))
    if doors < _MIN_DOOR_POINTS:
        return float("nan")
    return windows / doors * (_DOORS[1] - _DOORS[0]) / (_WINDOWS[1] - _WINDOWS[0])


def fits_of(rows: Mapping[str, Floats], source: str) -> dict[str, tuple[Fit, ...]]:
    """One `Fit` for each shown statistic, by "Car flank_end" and the like, of MIN_OBJECTS or more.

    Args:
        rows: by class, as `object_fits` gives them, of one drive or folder.
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
