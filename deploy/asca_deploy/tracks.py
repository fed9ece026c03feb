"""Result of tracking: the boxes of one scan with identities and velocities."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from asca_pillars.detection.detections import Detection, Detections

_DIGITS = 4


class Track(NamedTuple):
    """One tracked box: detection, identity, and velocity along the scan's x and y."""

    track_id: int
    detection: Detection
    vx_mps: float
    vy_mps: float


@dataclass(frozen=True, eq=False)
class Tracks:
    """N tracked boxes of one scan, best first. Iterate for `Track` records."""

    detections: Detections
    """N boxes as they were detected, in the frame of the scan."""
    track_ids: NDArray[np.int64]
    """(N,) identity of each object, the same from scan to scan; numbers are never reused."""
    velocities_mps: NDArray[np.float64]
    """(N, 2) along the scan's x and y: over ground if the tracker gets the vehicle's pose, else relative to it."""

    def __len__(self) -> int:
        return len(self.detections)

    def __iter__(self) -> Iterator[Track]:
        for number, found, (vx, vy) in zip(
            self.track_ids.tolist(), self.detections, self.velocities_mps.tolist(), strict=True
        ):
            yield Track(number, found, vx, vy)

    def to_dicts(self) -> list[dict[str, str | float]]:
        """Return `Detections.to_dicts` with `track_id`, `vx_mps` and `vy_mps` in each."""
        return [
            found
            | {"track_id": track.track_id, "vx_mps": round(track.vx_mps, _DIGITS)}
            | {"vy_mps": round(track.vy_mps, _DIGITS)}
            for found, track in zip(self.detections.to_dicts(), self, strict=True)
        ]
