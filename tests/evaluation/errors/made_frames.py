"""Made-up frames of the error analysis."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from asca_pillars.evaluation.errors.error_frames import UNKNOWN_OCCLUSION, ErrorFrame

GROUND_Z_M = -1.7


def ground() -> np.ndarray:
    """(N, 4) a level ground of dark points around the sensor."""
    x, y = np.meshgrid(np.arange(2, 40, 0.5), np.arange(-15, 15, 0.5))
    flat = np.stack([x.ravel(), y.ravel(), np.full(x.size, GROUND_Z_M), np.full(x.size, 0.1)], axis=1)
    return flat.astype(np.float32)


def column(x: float, y: float, top: float, *, bottom: float = 0.0, width: float = 0.2, reflectance: float = 0.2):
    """(N, 4) points every 5 cm up a square post; top and bottom are above the ground."""
    corners = np.array([(-1, -1), (-1, 1), (1, -1), (1, 1), (-1, 0)]) * width / 2
    heights = np.arange(bottom, top, 0.05) + GROUND_Z_M
    points = [(x + dx, y + dy, z, reflectance) for z in heights for dx, dy in corners]
    return np.array(points, np.float32)


def frame(
    objects: Sequence[tuple[str, ArrayLike]],
    found: Sequence[tuple[str, float, ArrayLike]],
    *,
    frame_id: str = "000000",
    points: np.ndarray | None = None,
    occluded: Sequence[int] | None = None,
    truncated: Sequence[float] | None = None,
    counted: Sequence[bool] | None = None,
    object_points: Sequence[int] | None = None,
    ignored: Sequence[bool] | None = None,
) -> ErrorFrame:
    """A frame of (type, box) and (type, score, box)."""
    return ErrorFrame(
        frame_id=frame_id,
        points=ground() if points is None else points,
        objects=np.array([box for _, box in objects], np.float64).reshape(-1, 7),
        types=tuple(kind for kind, _ in objects),
        occluded=np.array([UNKNOWN_OCCLUSION] * len(objects) if occluded is None else occluded, np.int64),
        truncated=np.array([0.0] * len(objects) if truncated is None else truncated),
        object_points=np.array([50] * len(objects) if object_points is None else object_points, np.int64),
        counted=np.array([True] * len(objects) if counted is None else counted, bool),
        detections=np.array([box for *_, box in found], np.float64).reshape(-1, 7),
        detection_types=tuple(kind for kind, *_ in found),
        scores=np.array([score for _, score, _ in found], np.float64),
        ignored=np.array([False] * len(found) if ignored is None else ignored, bool),
    )


@dataclass(frozen=True)
class MadeFrames:
    """Frames by their ids."""

    frames: dict[str, ErrorFrame]

    @property
    def frame_ids(self) -> tuple[str, ...]:
        return tuple(sorted(self.frames))

    def read(self, frame_id: str) -> ErrorFrame:
        return self.frames[frame_id]
