"""Anchors on the head's map in metres (PointPillars, which the paper adopts)."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.errors import ConfigError
from asca_pillars.base.strict import Strict

ANCHOR_YAWS_RAD = (0.0, math.pi / 2)

_MOST_M = 1000.0  # no LiDAR sees farther, and float32 holds what is computed of it

IGNORED = -1  # label of a box that is neither to be found nor to be missed; others are indices into the classes


@dataclass(frozen=True)
class ClassSpec(Strict):
    """A class to detect: its anchor's size and height above the LiDAR, and how boxes are matched with it."""

    name: str
    length_m: float
    width_m: float
    height_m: float
    z_m: float
    """z of the anchor's center, LiDAR frame."""
    positive_iou: float
    """Overlap with a box from which an anchor is positive."""
    negative_iou: float
    """Overlap with every box below which an anchor is background; in between it is ignored."""
    score_threshold: float = 0.3
    """Detections below this score are not reported."""

    def __post_init__(self) -> None:
        if not self.name:
            raise ConfigError("a class needs a name")
        if self.name.split() != [self.name]:  # KITTI's label files have white space between their fields
            joined = "_".join(self.name.split()) or "Car"
            raise ConfigError(
                f"class name `{self.name}`: write it without white space, such as {joined}; "
                "`asca import --rename OLD=NEW` gives labels another name"
            )
        for field in ("length_m", "width_m", "height_m"):
            if not 0 < getattr(self, field) <= _MOST_M:
                raise ConfigError(
                    f"{field} {getattr(self, field):g} of class {self.name} must be positive, at most {_MOST_M:g} m"
                )
        if not abs(self.z_m) <= _MOST_M:
            raise ConfigError(f"z_m {self.z_m:g} of class {self.name} must lie within {_MOST_M:g} m of the LiDAR")
        if not 0 <= self.negative_iou <= self.positive_iou <= 1 or self.positive_iou == 0:
            raise ConfigError(
                f"negative_iou {self.negative_iou:g} and positive_iou {self.positive_iou:g} of class "
                f"{self.name} must lie between 0 and 1, the negative one no higher than the positive"
            )
        if not 0 <= self.score_threshold <= 1:
            raise ConfigError(f"score_threshold {self.score_threshold:g} of class {self.name} must lie between 0 and 1")


KITTI_CLASSES = (
    ClassSpec("Car", 3.9, 1.6, 1.56, z_m=-1.0, positive_iou=0.6, negative_iou=0.45),
    ClassSpec("Pedestrian", 0.8, 0.6, 1.73, z_m=-0.6, positive_iou=0.5, negative_iou=0.35),
    ClassSpec("Cyclist", 1.76, 0.6, 1.73, z_m=-0.6, positive_iou=0.5, negative_iou=0.35),
)


def make_anchors(
    x_m: NDArray[np.float64], y_m: NDArray[np.float64], classes: tuple[ClassSpec, ...]
) -> NDArray[np.float32]:
    """Return anchors for head cells, classes and anchor yaws: (H, W, A, 7) float32, metres, LiDAR frame.

    A = 2 * len(classes), class-major: anchor a belongs to class a // 2 and has yaw ANCHOR_YAWS_RAD[a % 2].

    Args:
        x_m: (W,) centers of the head map's columns in metres, LiDAR frame; they need not be evenly spaced.
        y_m: (H,) centers of its rows.
        classes: of the anchors.
    """
    anchors = np.empty((len(y_m), len(x_m), len(classes), len(ANCHOR_YAWS_RAD), 7), np.float32)
    anchors[..., 0] = x_m[None, :, None, None]
    anchors[..., 1] = y_m[:, None, None, None]
    for index, spec in enumerate(classes):
        anchors[:, :, index, :, 2:6] = (spec.z_m, spec.length_m, spec.width_m, spec.height_m)
    anchors[..., 6] = ANCHOR_YAWS_RAD
    return anchors.reshape(len(y_m), len(x_m), -1, 7)
