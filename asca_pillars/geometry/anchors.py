"""Anchors on the head's map in metres, and box residuals against them (PointPillars, which the paper adopts).

`encode_boxes` and `decode_boxes` are an inverse pair. The yaw is carried twice: as a residual, in which the
loss does not see half a turn (it takes the sine of the error), and as one of two direction bins, which
settles it.
"""

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from asca_pillars.errors import ConfigError
from asca_pillars.geometry.boxes import wrap_angle

ANCHOR_YAWS_RAD = (0.0, math.pi / 2)

IGNORED = -1  # label of a box that is neither to be found nor to be missed; others are indices into the classes

# Bin 0 holds the yaws in [pi/4, 5pi/4), bin 1 the others. Most boxes stand near an anchor's yaw, and near a
# bin's border the bin is hard to tell: so no border lies on an anchor's yaw.
_BIN_START_RAD = math.pi / 4

# Nothing is a hundred times as long as its anchor, but exp() of what an untrained or overflowing network
# answers can be infinite, and an infinite box makes NaN of every overlap it takes part in.
_MAX_LOG_RATIO = math.log(100.0)


@dataclass(frozen=True)
class ClassSpec:
    """A class to detect: its anchor's size and height above the LiDAR, and how boxes are matched with it."""

    name: str
    length_m: float
    width_m: float
    height_m: float
    z_m: float
    """z of the anchor's center, LiDAR frame."""
    positive_iou: float
    """An anchor that overlaps a box at least this much is to find it."""
    negative_iou: float
    """An anchor that overlaps every box less than this is background; in between it is ignored."""
    score_threshold: float = 0.3
    """Detections below this score are not reported."""

    __pydantic_config__: ClassVar[dict[str, str]] = {"extra": "forbid"}

    def __post_init__(self) -> None:
        if not self.name:
            raise ConfigError("a class needs a name")
        for field in ("length_m", "width_m", "height_m"):
            if not 0 < getattr(self, field) < math.inf:
                raise ConfigError(f"{field} {getattr(self, field):g} of class {self.name} must be positive")
        if not math.isfinite(self.z_m):
            raise ConfigError(f"z_m {self.z_m:g} of class {self.name} must be finite")
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
    """One box per head cell, class and anchor yaw: (H, W, A, 7) float32, metres, LiDAR frame.

    A = 2 * len(classes), class-major: anchor a belongs to class a // 2 and has yaw ANCHOR_YAWS_RAD[a % 2].

    Args:
        x_m: (W,) centers of the head map's columns in metres, LiDAR frame; they need not be evenly spaced.
        y_m: (H,) centers of its rows.
        classes: what the anchors look for.
    """
    anchors = np.empty((len(y_m), len(x_m), len(classes), len(ANCHOR_YAWS_RAD), 7), np.float32)
    anchors[..., 0] = x_m[None, :, None, None]
    anchors[..., 1] = y_m[:, None, None, None]
    for index, spec in enumerate(classes):
        anchors[:, :, index, :, 2:6] = (spec.z_m, spec.length_m, spec.width_m, spec.height_m)
    anchors[..., 6] = ANCHOR_YAWS_RAD
    return anchors.reshape(len(y_m), len(x_m), -1, 7)


def encode_boxes(
    boxes: NDArray[np.floating[Any]], anchors: NDArray[np.floating[Any]]
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Boxes as the network learns them: boxes and anchors (..., 7) -> residuals (..., 7), direction (...,).

    dx and dy over the anchor's diagonal, dz over its height, logarithms of the size ratios, and the yaw
    difference in [-pi, pi); direction is the bin 0 or 1 of the box's yaw. The paper's eq. 12 as printed
    takes the logarithm of a difference; this is the encoding of PointPillars, which the paper says it
    adopts.
    """
    box, anchor = boxes.astype(np.float64), anchors.astype(np.float64)
    diagonal = np.hypot(anchor[..., 3], anchor[..., 4])[..., None]
    residuals = np.concatenate(
        [
            (box[..., :2] - anchor[..., :2]) / diagonal,
            (box[..., 2:3] - anchor[..., 2:3]) / anchor[..., 5:6],
            np.log(box[..., 3:6] / anchor[..., 3:6]),
            wrap_angle(box[..., 6:] - anchor[..., 6:]),
        ],
        axis=-1,
    ).astype(np.float32)
    # From the rounded residual, as the decoder will see it: a yaw within rounding of a bin's border must not
    # come back turned round.
    return residuals, direction_bins(residuals[..., 6].astype(np.float64) + anchor[..., 6])


def direction_bins(yaw_rad: NDArray[np.floating[Any]]) -> NDArray[np.int64]:
    """Bin 0 or 1 of each yaw: (...,) -> (...,); the two directions of a heading are in different bins."""
    return (np.mod(yaw_rad - _BIN_START_RAD, 2 * math.pi) >= math.pi).astype(np.int64)


def decode_boxes(
    residuals: NDArray[np.floating[Any]],
    direction: NDArray[np.integer[Any]],
    anchors: NDArray[np.floating[Any]],
) -> NDArray[np.float32]:
    """Inverse of `encode_boxes`: residuals (..., 7), direction (...,), anchors (..., 7) -> boxes (..., 7).

    The direction bin alone decides between a yaw and its opposite. Size ratios are held within 1/100 and 100.
    """
    residual, anchor = residuals.astype(np.float64), anchors.astype(np.float64)
    diagonal = np.hypot(anchor[..., 3], anchor[..., 4])[..., None]
    center = anchor[..., :2] + residual[..., :2] * diagonal
    z = anchor[..., 2:3] + residual[..., 2:3] * anchor[..., 5:6]
    size = anchor[..., 3:6] * np.exp(np.clip(residual[..., 3:6], -_MAX_LOG_RATIO, _MAX_LOG_RATIO))
    into_bin = np.mod(residual[..., 6] + anchor[..., 6] - _BIN_START_RAD, math.pi)
    yaw = _BIN_START_RAD + math.pi * direction + into_bin
    boxes = np.concatenate([center, z, size, yaw[..., None]], axis=-1).astype(np.float32)
    boxes[..., 6] = wrap_angle(yaw.astype(np.float32))
    return boxes
