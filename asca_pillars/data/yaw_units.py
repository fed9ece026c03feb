"""Check that yaws are in radians; values that look like degrees are refused or reported."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

LARGEST_YAW_RAD = 2 * math.pi + 0.01
"""Yaws may be counted from -pi to pi or from 0 to 2 pi, and be rounded."""
_ENOUGH = 2
"""Least number of nonzero yaws for a warning."""
_WHOLE = 1e-4


def yaw_error(yaw: float) -> str | None:
    """Return an error clause for a yaw that cannot be in radians; None if it can."""
    if abs(yaw) <= LARGEST_YAW_RAD:
        return None
    return f"is {yaw:g}, more than a full turn (6.28): give radians; multiply degrees by pi / 180 (0.0174533)"


def check_yaws(yaws: Sequence[ArrayLike]) -> str | None:
    """Return a warning if all yaws of a dataset, wrapped or not, are whole numbers; None if not.

    Zeros do not count: many boxes are labelled along the axes.
    """
    values = np.concatenate([np.zeros(0), *(np.ravel(frame).astype(np.float64) for frame in yaws)])
    values = values[np.abs(values) > _WHOLE]
    turns = 2 * np.pi * np.array([-1.0, 0.0, 1.0])
    stated = values[:, None] + turns
    off = np.abs(stated - np.round(stated))
    if len(values) < _ENOUGH or not (off.min(axis=1) < _WHOLE).all():
        return None
    examples: NDArray[np.float64] = np.unique(np.round(stated[np.arange(len(values)), off.argmin(axis=1)]))
    return (
        f"all {len(values)} yaws that are not 0 are whole numbers, such as {examples[-1]:g}: yaws must be in radians; "
        "if they are degrees, multiply them by pi / 180 (0.0174533)"
    )
