"""Settings that all families of detectors share: ranges, classes, and the decoding of head maps into boxes.

Anchors on the head's map in metres (PointPillars, which the paper adopts).
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray

from asca_pillars.base.errors import ConfigError
from asca_pillars.base.strict import Strict
from asca_pillars.detection.decode import HeadMaps, PostProcess, decode
from asca_pillars.detection.detections import Detections
from asca_pillars.geometry.boxes import DIRECTION_OFFSET_RAD
from asca_pillars.geometry.ranges import Ranges

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
        for name in ("length_m", "width_m", "height_m"):
            if not 0 < getattr(self, name) <= _MOST_M:
                raise ConfigError(
                    f"{name} {getattr(self, name):g} of class {self.name} must be positive, at most {_MOST_M:g} m"
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


ScoreThresholds: TypeAlias = float | Mapping[str, float]
"""One score for every class, or scores of some classes by name."""


@dataclass(frozen=True)
class DetectorSpec(Strict, ABC):
    """Classes and post-processing; each family adds the grid that its ranges and head cells come from.

    Raises:
        ConfigError: if there is no class or two have the same name, or the direction bins begin beyond half a turn.
    """

    classes: tuple[ClassSpec, ...] = KITTI_CLASSES
    post: PostProcess = field(default_factory=PostProcess)
    direction_offset_rad: float = DIRECTION_OFFSET_RAD
    """Yaw at which direction bin 0 begins, half a turn before bin 1; -pi/2 in mmdetection3d's PointPillars."""

    def __post_init__(self) -> None:
        if not self.classes:
            raise ConfigError("classes is empty: a detector needs at least one class")
        if len({name.casefold() for name in self.class_names}) < len(self.classes):  # evaluations fold case
            raise ConfigError(f"classes {', '.join(self.class_names)} must have different names")
        if not abs(self.direction_offset_rad) <= math.pi:
            raise ConfigError(
                f"direction_offset_rad {self.direction_offset_rad:g} must lie between -pi and pi; it is in radians"
            )

    @property
    @abstractmethod
    def ranges(self) -> Ranges:
        """Detection ranges."""

    @abstractmethod
    def head_centers_m(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return centers of the head map's cells in metres, LiDAR frame: x of its columns (W,), y of its rows (H,)."""

    def anchor_centers_m(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return anchor centers, as `head_centers_m`; a family may place them elsewhere than in the cells' centers."""
        return self.head_centers_m()

    @cached_property
    def class_names(self) -> tuple[str, ...]:
        """Names in the order of the labels 0, 1, ..."""
        return tuple(spec.name for spec in self.classes)

    @cached_property
    def anchors(self) -> NDArray[np.float32]:
        """(H, W, A, 7) boxes in the LiDAR frame, see `make_anchors`. Read-only."""
        anchors = make_anchors(*self.anchor_centers_m(), self.classes)
        anchors.flags.writeable = False
        return anchors

    def with_score_threshold(self, score: ScoreThresholds) -> Self:
        """Return the same detector with other score thresholds: of every class, or of the classes named.

        Raises:
            ConfigError: no such class, or no score between 0 and 1.
        """
        scores = score if isinstance(score, Mapping) else dict.fromkeys(self.class_names, score)
        if wrong := [value for value in scores.values() if not isinstance(value, int | float | np.number)]:
            raise ConfigError(f"score_threshold {wrong[0]!r}: give a number between 0 and 1")
        if unknown := [name for name in scores if name not in self.class_names]:
            raise ConfigError(f"{unknown[0]}: no such class; there are {', '.join(self.class_names)}")
        return replace(
            self,
            classes=tuple(
                replace(spec, score_threshold=scores.get(spec.name, spec.score_threshold)) for spec in self.classes
            ),
        )

    def with_post_processing_of(self, other: "DetectorSpec") -> Self:
        """Return the same detector with the score thresholds and the suppression of another one, of the same classes.

        Raises:
            ConfigError: the other one has a class that this one lacks.
        """
        scores = {each.name: each.score_threshold for each in other.classes}
        return replace(self.with_score_threshold(scores), post=other.post)

    def decode(self, maps: HeadMaps[NDArray[np.float32]], cells: NDArray[np.integer[Any]] | None = None) -> Detections:
        """Decode head maps of one scan, (channels, H, W) each, into detections, LiDAR frame.

        With `cells` (M,), flat indices: from rows (M, channels) of these head cells.
        """
        return decode(maps, self.anchors, self.classes, self.post, cells, self.direction_offset_rad)
