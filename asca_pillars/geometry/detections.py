"""The result: what was found in one scan."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Detections:
    """N detected boxes. Index with a mask, a slice or an array of indices to get a part of them.

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

    def __post_init__(self) -> None:
        count = len(self.scores) if self.scores.ndim else -1
        if self.boxes.shape != (count, 7) or self.scores.shape != (count,) or self.labels.shape != (count,):
            raise ValueError(
                "boxes, scores and labels must have shapes (N, 7), (N,) and (N,), "
                f"not {self.boxes.shape}, {self.scores.shape} and {self.labels.shape}"
            )

    @classmethod
    def empty(cls, class_names: tuple[str, ...]) -> "Detections":
        """No boxes."""
        return cls(np.empty((0, 7), np.float32), np.empty(0, np.float32), np.empty(0, np.int64), class_names)

    def __len__(self) -> int:
        return len(self.boxes)

    def __getitem__(self, index: slice | NDArray[Any] | list[int]) -> "Detections":
        return Detections(self.boxes[index], self.scores[index], self.labels[index], self.class_names)

    @property
    def names(self) -> list[str]:
        """Class name of each detection."""
        return [self.class_names[label] for label in self.labels]

    @property
    def distances_m(self) -> NDArray[np.float32]:
        """(N,) horizontal distance from the LiDAR to each box's center."""
        return np.hypot(self.boxes[:, 0], self.boxes[:, 1])
