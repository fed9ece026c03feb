"""Result of a detector: the boxes of one scan, and the report on it."""

import json
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple, Self, overload

import numpy as np
from numpy.typing import NDArray

_DIGITS = 4  # tenths of a millimetre


class Detection(NamedTuple):
    """One detected box: center, size and heading in the LiDAR frame (x forward, y left, z up)."""

    class_name: str
    score: float
    """Score in [0, 1]."""
    x_m: float
    y_m: float
    z_m: float
    """Height of the box's center."""
    length_m: float
    width_m: float
    height_m: float
    yaw_rad: float
    """Counter-clockwise from x, in [-pi, pi)."""

    @property
    def box(self) -> NDArray[np.float32]:
        """(7,) x, y, z, length, width, height, yaw; metres and radians, LiDAR frame."""
        return np.array(self[2:], np.float32)

    @property
    def distance_m(self) -> float:
        """Horizontal distance from the LiDAR to the center."""
        return float(np.hypot(self.x_m, self.y_m))


@dataclass(frozen=True, eq=False, repr=False)
class Detections:
    """N detected boxes, best first. Iterate for `Detection` records, index with a number for one of them.

    A slice, a mask or an array of indices gives a part of them.

    Raises:
        ValueError: if the arrays do not describe the same number of boxes.
    """

    boxes: NDArray[np.float32]
    """(N, 7) x, y, z, length, width, height, yaw; metres and radians, LiDAR frame."""
    scores: NDArray[np.float32]
    """(N,) in [0, 1]."""
    labels: NDArray[np.int64]
    """(N,) indices into `class_names`."""
    class_names: tuple[str, ...]
    non_finite: int = 0
    """Anchors whose score was not finite, or whose box was not although its score counted; they were left out."""

    def __post_init__(self) -> None:
        count = len(self.scores) if self.scores.ndim else -1
        if self.boxes.shape != (count, 7) or self.scores.shape != (count,) or self.labels.shape != (count,):
            raise ValueError(
                "boxes, scores and labels must have shapes (N, 7), (N,) and (N,), "
                f"not {self.boxes.shape}, {self.scores.shape} and {self.labels.shape}"
            )

    @classmethod
    def empty(cls, class_names: tuple[str, ...]) -> "Detections":
        """Return detections without boxes."""
        return cls(np.empty((0, 7), np.float32), np.empty(0, np.float32), np.empty(0, np.int64), class_names)

    def __len__(self) -> int:
        return len(self.boxes)

    def __iter__(self) -> Iterator[Detection]:
        for label, score, box in zip(self.labels.tolist(), self.scores.tolist(), self.boxes.tolist(), strict=True):
            yield Detection(self.class_names[label], score, *box)

    @overload
    def __getitem__(self, index: int | np.integer[Any]) -> Detection: ...
    @overload
    def __getitem__(self, index: slice | NDArray[Any] | list[int]) -> Self: ...
    def __getitem__(self, index: int | np.integer[Any] | slice | NDArray[Any] | list[int]) -> Detection | Self:
        if isinstance(index, int | np.integer):
            name = self.class_names[self.labels[index]]
            return Detection(name, float(self.scores[index]), *self.boxes[index].tolist())
        return replace(self, boxes=self.boxes[index], scores=self.scores[index], labels=self.labels[index])

    def __repr__(self) -> str:
        counts = ", ".join(f"{count} {name}" for name, count in Counter(self.names).items())
        return f"<{type(self).__name__}: {counts or 'none'}>"

    @property
    def names(self) -> list[str]:
        """Class name of each detection."""
        return [self.class_names[label] for label in self.labels]

    @property
    def distances_m(self) -> NDArray[np.float32]:
        """(N,) horizontal distance from the LiDAR to each box's center."""
        return np.hypot(self.boxes[:, 0], self.boxes[:, 1])

    def to_dicts(self) -> list[dict[str, str | float]]:
        """Return `class`, `score` and the fields of `Detection` from `x_m` on of each detection, with four decimals."""
        return [
            {"class": detection.class_name}
            | {key: round(value, _DIGITS) for key, value in detection._asdict().items() if key != "class_name"}
            for detection in self
        ]

    def to_json(self) -> str:
        """Return `to_dicts` as JSON text."""
        return json.dumps(self.to_dicts())


@dataclass(frozen=True)
class ScanCounts:
    """Counts of a scan's points: points = kept + points_outside + points_over_limit. Families add their own."""

    points: int
    """Usable points of the scan."""
    points_outside: int
    """Points outside the detector's ranges."""
    points_over_limit: int
    """Points inside that the limits dropped."""


def sum_counts(counts: Sequence[ScanCounts]) -> ScanCounts:
    """Sum the counts of a scan's passes, all of one family."""
    first = counts[0]
    return type(first)(**{name.name: sum(getattr(part, name.name) for part in counts) for name in fields(first)})


@dataclass(frozen=True)
class FrameReport:
    """Report on one scan: times, counts, warnings."""

    times_ms: dict[str, float]
    """Wall time of each stage by name: "input" (check and conversion of the points), then those of the family."""
    waiting_ms: float
    """Time that the scan waited between stages in a stream; otherwise 0."""
    counts: ScanCounts
    """Counts of the usable points by ranges and limits; `PillarCounts` for a pillar detector. Summed over the passes,
    each of which takes every point."""
    non_finite_points: int
    """Points dropped because a value was NaN or infinite."""
    clipped_reflectances: int
    """Points whose reflectance lay outside 0..1 and was set to the nearer end."""
    non_finite_outputs: int
    """Anchors left out because the network's answer for them was NaN or infinite."""
    warnings: tuple[str, ...]
    """Differences from the scans the model was trained on, and repairs; empty if there are none."""
    passes: int = 1
    """Number of passes of the network, each on the scan turned differently. Times are sums over the passes."""

    @property
    def total_ms(self) -> float:
        """Latency: from the points to the detections, waiting included."""
        return sum(self.times_ms.values()) + self.waiting_ms
