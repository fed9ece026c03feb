"""Footprints that are taken, so that nothing stands in anything else."""

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from asca_pillars.base.compiling import cached

Floats = npt.NDArray[np.float64]


@dataclass
class Occupied:
    """Footprints that are taken; they grow in number as things are placed.

    Rows are x, y, length, width, yaw, and by how much it may overlap others that may overlap.
    """

    rows: Floats = field(default_factory=lambda: np.zeros((2048, 6)))
    count: int = 0

    def take(
        self, x: float, y: float, length: float, width: float, yaw: float, margin_m: float = 0.0, overlap_m: float = 0.0
    ) -> bool:
        """Take a footprint if it is free with a margin around it; whether it was.

        Two footprints may overlap by the lesser `overlap_m` of theirs.
        """
        # Plain floats, so that one compiled version answers every caller.
        sides = float(length + 2 * margin_m), float(width + 2 * margin_m)
        wish = (float(x), float(y), *sides, float(yaw), float(overlap_m))
        if self.count == len(self.rows) or not _is_free(wish, self.rows, self.count):
            return False
        self.rows[self.count] = x, y, length, width, yaw, overlap_m
        self.count += 1
        return True

    def hold(self, x: float, y: float, length: float, width: float, yaw: float) -> None:
        """Take a footprint, free or not, for what will move there; nothing that comes later stands in it."""
        if self.count == len(self.rows):
            self.rows = np.concatenate([self.rows, np.zeros_like(self.rows)])
        self.rows[self.count] = x, y, length, width, yaw, 0.0
        self.count += 1


@cached()
def _is_free(row: tuple[float, float, float, float, float, float], rows: Floats, count: int) -> bool:
    """Whether a footprint overlaps none of the first `count` (separating axes of two rectangles)."""
    own = (row[2], row[3], row[4])
    for i in range(count):
        taken = (rows[i, 2], rows[i, 3], rows[i, 4])
        dx, dy = rows[i, 0] - row[0], rows[i, 1] - row[1]
        if max(abs(dx), abs(dy)) > (own[0] + own[1] + taken[0] + taken[1]) / 2:
            continue  # farther than half the diagonals reach
        apart = False
        overlap = min(row[5], rows[i, 5])
        for one, other in ((own, taken), (taken, own)):
            cos, sin = np.cos(one[2]), np.sin(one[2])
            c, s = abs(np.cos(other[2] - one[2])), abs(np.sin(other[2] - one[2]))
            along, across = abs(dx * cos + dy * sin), abs(dy * cos - dx * sin)
            if (
                along > (one[0] + other[0] * c + other[1] * s) / 2 - overlap
                or across > (one[1] + other[0] * s + other[1] * c) / 2 - overlap
            ):
                apart = True
        if not apart:
            return False
    return True
