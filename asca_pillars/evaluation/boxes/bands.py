"""Where around the sensor a box stands: bands of distance and of direction."""

from collections.abc import Callable
from math import inf, pi

import numpy as np
from numpy.typing import NDArray

from asca_pillars.evaluation.boxes.box_pairs import UNMATCHED, BoxPairs

Band = Callable[[NDArray[np.floating]], NDArray[np.bool_]]
"""(N, 7) boxes -> (N,) which centers it holds."""


def _distance(low_m: float, high_m: float) -> Band:
    def inside(boxes: NDArray[np.floating]) -> NDArray[np.bool_]:
        away = np.hypot(boxes[:, 0], boxes[:, 1])
        return (away >= low_m) & (away < high_m)

    return inside


def _direction(low_rad: float, high_rad: float) -> Band:
    def inside(boxes: NDArray[np.floating]) -> NDArray[np.bool_]:
        turned = np.abs(np.arctan2(boxes[:, 1], boxes[:, 0]))
        return (turned >= low_rad) & (turned < high_rad)

    return inside


BANDS: dict[str, Band] = {
    "all": _distance(0, inf),
    "0-30 m": _distance(0, 30),
    "30-50 m": _distance(30, 50),
    "50+ m": _distance(50, inf),
    "ahead": _direction(0, pi / 4),
    "beside": _direction(pi / 4, 3 * pi / 4),
    "behind": _direction(3 * pi / 4, inf),
}
"""By horizontal distance from the sensor, and by direction: 45 degrees either way of straight ahead, of straight
behind, and what is between."""


def in_band(pairs: BoxPairs, matched: NDArray[np.int64], band: str) -> tuple[NDArray[np.bool_], NDArray[np.bool_], int]:
    """Which detections (N,) a band counts and which of them are hits (N,), and how many objects it holds.

    An object takes its detection along: only what matches nothing is judged by where it stands itself.
    """
    counted, hits = BANDS[band](pairs.found), matched != UNMATCHED
    held = BANDS[band](pairs.objects)
    counted[hits] = held[matched[hits]]
    return counted, hits, int(held.sum())
