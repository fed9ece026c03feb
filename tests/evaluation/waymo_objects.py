"""Objects of Waymo's protocol."""

import numpy as np

from asca_pillars.detection.detections import Detections
from asca_pillars.evaluation.waymo import (
    EVERYWHERE,
    WaymoScore,
    WaymoTruth,
    waymo_detection,
)

NAMES = ("Vehicle", "Pedestrian", "Cyclist")
SIZES = np.array([[4.6, 1.9, 1.7], [0.9, 0.8, 1.75], [1.8, 0.8, 1.75]])
VEHICLE, PEDESTRIAN, CYCLIST = 0, 1, 2


def box(x: float, y: float, label: int = VEHICLE, yaw: float = 0.0) -> list[float]:
    return [x, y, 0.0, *SIZES[label], yaw]


def score_of(
    truth: WaymoTruth | list[WaymoTruth],
    detections: Detections | list[Detections],
    level: int = 2,
    range_m: tuple[float, float] = EVERYWHERE,
    name: str = "Vehicle",
) -> WaymoScore:
    frames = truth if isinstance(truth, list) else [truth]
    results = waymo_detection(frames, detections if isinstance(detections, list) else [detections])
    return next(item for item in results if (item.class_name, item.level, item.range_m) == (name, level, range_m))
