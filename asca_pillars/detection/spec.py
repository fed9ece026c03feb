"""Settings that all families of detectors share: ranges, classes, and the decoding of head maps into boxes."""

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
from asca_pillars.detection.anchors import KITTI_CLASSES, ClassSpec, make_anchors
from asca_pillars.detection.decode import HeadMaps, PostProcess, decode
from asca_pillars.detection.detections import Detections
from asca_pillars.geometry.boxes import DIRECTION_OFFSET_RAD, Ranges

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
            raise ConfigError(f"{unknown[0]}: no such class; available: {', '.join(self.class_names)}")
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
        scores = {class_spec.name: class_spec.score_threshold for class_spec in other.classes}
        return replace(self.with_score_threshold(scores), post=other.post)

    def decode(self, maps: HeadMaps[NDArray[np.float32]], cells: NDArray[np.integer[Any]] | None = None) -> Detections:
        """Decode head maps of one scan, (channels, H, W) each, into detections, LiDAR frame.

        With `cells` (M,), flat indices: from rows (M, channels) of these head cells.
        """
        return decode(maps, self.anchors, self.classes, self.post, cells, self.direction_offset_rad)
